"""The prose in the product's code: short sentences, and the words of the field.

Read are docstrings, comments, descriptions of options, help texts, log lines and error sentences.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator

from tests.project.documentation import ROOT, label
from tests.project.prose import line_of, misnamed, sentences

MOST_WORDS = 25  # of a sentence; symbols and code do not count
FOLDERS = ("agents", "analysis", "environments", "orchestrator", "teachers", "src/recrl", "docs/_ext")
MODULES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
SHORTEST_MESSAGE = 3  # words: below that a string is a key or a name


def texts(source: str) -> Iterator[str]:
    """The docstrings, comments and messages of a module."""
    tree = ast.parse(source)
    nested = {part for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    statements = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in nested:
            yield from paragraphs(node.value) if node in statements else message(node.value)
        elif isinstance(node, ast.JoinedStr):
            yield from message("".join(literal(part) for part in node.values))
    yield from comments(source)


def paragraphs(docstring: str) -> Iterator[str]:
    """The paragraphs and the entries of a docstring, without examples, equations and drawings."""
    for block in re.split(r"\n\s*\n", docstring):
        if block.lstrip().startswith(">>>"):
            continue
        entry = ""
        for line in block.split("\n"):
            if re.match(r"\s*(- |[\w*`. ,()\[\]/-]{1,40}: |(Args|Attributes|Returns|Raises):$)", line):
                yield entry
                entry = re.sub(r"^\s*(- |[\w*`., ()\[\]/-]{1,40}:( |$))", "", line)
            elif re.search(r" {3,}\S|^\s*(python|recrl|gymnasium)\b| = .*[({]", line.strip()):
                yield entry
                entry = ""
            else:
                entry += f" {line.strip()}"
        yield entry


def message(text: str) -> Iterator[str]:
    """The lines of a text that are sentences; without the first columns of a table."""
    for line in text.split("\n"):
        cell = line.split("   ")[-1]
        if len(re.findall(r"[A-Za-z']{2,} ", cell)) >= SHORTEST_MESSAGE and "<" not in cell:
            yield cell


def literal(part: ast.expr) -> str:
    """A part of a formatted string; a value counts as one word."""
    return str(part.value) if isinstance(part, ast.Constant) else "value"


def comments(source: str) -> Iterator[str]:
    """The comments of a module; lines of one block belong together."""
    block, last = "", -1
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT or re.match(r"#!|# (noqa|type:)", token.string):
            continue
        text = re.sub(r"^#\s*|#\s*(noqa|type:).*", "", token.string)
        own_line = not token.line[: token.start[1]].strip()
        if own_line and token.start[0] == last + 1:
            block += f" {text}"
        else:
            yield block
            block = text
        last = token.start[0] if own_line else -1
    yield block


def is_word(token: str) -> bool:
    """Whether a token is a word and not a symbol or a part of an equation."""
    return (
        token != "code" and re.fullmatch(r"[\"'(*]*([A-Za-z][A-Za-z'*-]+|a)[.,:;)\"'*!?]*", token) is not None
    )


def test_sentences_are_short() -> None:
    long = [
        f"{label(module)}:{line_of(source, it)}: {it}"
        for module in MODULES
        for source in [module.read_text(encoding="utf-8")]
        for text in texts(source)
        for it in sentences(text)
        if sum(map(is_word, it.split())) > MOST_WORDS
    ]
    assert not long, f"more than {MOST_WORDS} words:\n" + "\n".join(long)


def test_words_are_those_of_the_field() -> None:
    found = [
        f"{label(module)}:{line_of(source, it.split(': ', 2)[-1])}: {it}"
        for module in MODULES
        for source in [module.read_text(encoding="utf-8")]
        for text in texts(source)
        for it in misnamed(text)
    ]
    assert not found, "\n".join(found)


def test_docstrings_comments_and_messages_are_read_without_examples_and_code() -> None:
    source = '''
def f(x):
    """Return ``x y`` twice.

    Args:
        x: any number.

    >>> f(1)
    2
    """
    # a comment
    # of two lines
    raise ValueError(f"x must be above 0, got {x}")
'''
    found = [it for text in texts(source) for it in sentences(text)]
    assert found == [
        "Return code twice.",
        "any number.",
        "x must be above 0, got value",
        "a comment of two lines",
    ]
