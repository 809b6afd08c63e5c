"""Python source without what cannot change a result: docstrings, comments, blank lines."""

from __future__ import annotations

import ast
import io
import tokenize
import warnings
from collections.abc import Iterator

Position = tuple[int, int]  # a line, from 1, and a byte of it, from 0
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def without_documentation(source: bytes) -> bytes:
    r"""Return Python source without docstrings, blank lines and lines that only have a comment.

    A comment behind code stays. What does not parse, or names ``__doc__``, is returned as it is.

    >>> without_documentation(b'def f():\n    "Return 1."\n    # always\n    return 1\n')
    b'def f():\n    return 1'
    """
    if b"__doc__" in source:
        return source
    try:
        encoding, _ = tokenize.detect_encoding(io.BytesIO(source).readline)
        source_text = source.decode(encoding)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of an escape sequence in the user's file
            tree = ast.parse(source_text)
    except (SyntaxError, ValueError, RecursionError):
        return source
    lines = source_text.encode().splitlines()  # ast counts bytes of UTF-8
    nodes = list(ast.walk(tree))
    inside_text = {number for first, last in _long_strings(nodes) for number in range(first + 1, last + 1)}
    for (first, begin), (last, end) in _docstrings(nodes):
        before, after = lines[first - 1][:begin], lines[last - 1][end:]
        lines[first - 1 : last] = [before + after, *[b""] * (last - first)]
        inside_text -= set(range(first + 1, last + 1))
    kept = (
        line
        for number, line in enumerate(lines, 1)
        if number in inside_text or (line.strip() and not line.lstrip().startswith(b"#"))
    )
    return b"\n".join(kept)


def _long_strings(nodes: list[ast.AST]) -> Iterator[tuple[int, int]]:
    """Yield the first and the last line of each string that has more than one."""
    for node in nodes:
        if isinstance(node, ast.JoinedStr | ast.Constant) and node.end_lineno != node.lineno:
            yield node.lineno, node.end_lineno or node.lineno


def _docstrings(nodes: list[ast.AST]) -> Iterator[tuple[Position, Position]]:
    """Yield where each docstring begins and ends."""
    for node in nodes:
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            text = node.body[0]
            yield (
                (text.lineno, text.col_offset),
                (text.end_lineno or text.lineno, text.end_col_offset or text.col_offset),
            )
