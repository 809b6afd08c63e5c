"""The prose of the documentation and the README: short sentences, and the words of the glossary."""

from __future__ import annotations

import re

from tests.project.documentation import PAGES, ROOT, label
from tests.project.prose import line_of, misnamed, sentences

MOST_WORDS = 35  # of a sentence; aim at 25

TEXTS = [
    *PAGES,
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    ROOT / "CODE_OF_CONDUCT.md",
    ROOT / "README.md",
    ROOT / "docker" / "README.md",
    ROOT / "results" / "README.md",
]
# The paper's own word, explained beside it.
ALLOWED = {
    "docs/glossary.md": ("'student'",),
    "docs/explanation/recrl-in-five-minutes.md": ("'student'",),
}


def prose(text: str) -> str:
    """Paragraphs and list items; without tables, code, equations, link targets and directives."""
    text = re.sub(r"\A---\n.*?^---\n", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^(`{3,}|:{3,}).*?^\1\s*$", "\n", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"\$\$.*?\$\$", "\n", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"\{\w+\}`[^`]*`|`[^`]*`", "code", text)
    text = re.sub(r"\$[^$\n]+\$", "symbol", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    lines = [line for line in text.split("\n") if not line.lstrip().startswith("|")]
    return re.sub(r"^\s*([-*]|\d+\.)\s+|^#+\s.*$|^\s*:\s+", "\n", "\n".join(lines), flags=re.MULTILINE)


def sentences_of(text: str) -> list[str]:
    """The sentences of some Markdown."""
    return [it for each in re.split(r"\n\s*\n", prose(text)) for it in sentences(each)]


def test_sentences_are_short() -> None:
    long = [
        f"{label(page)}:{line_of(text, it)}: {it}"
        for page in TEXTS
        for text in [page.read_text(encoding="utf-8")]
        for it in sentences_of(text)
        if len(it.split()) > MOST_WORDS
    ]
    assert not long, f"more than {MOST_WORDS} words:\n" + "\n".join(long)


def test_words_are_those_of_the_field() -> None:
    found = [
        f"{label(page)}:{line_of(text, it.split(': ', 2)[-1])}: {it}"
        for page in TEXTS
        for text in [page.read_text(encoding="utf-8")]
        for it in misnamed(prose(text))
        if not it.startswith(ALLOWED.get(label(page), ()))
    ]
    assert not found, "\n".join(found)


def test_sentences_are_counted_without_code_tables_and_links() -> None:
    text = "# Title\n\nOne `two three` four. Five\nsix [seven](eight.md).\n\n| nine |\n\n"
    text += "```sh\nten\n```\n- eleven\n"
    assert sentences_of(text) == ["One code four.", "Five six seven.", "eleven"]
