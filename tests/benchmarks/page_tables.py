"""Tables of the documentation that scripts draw, each below a comment such as ``<!-- table: answers -->``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def replace_table(page: Path, name: str, lines: Sequence[str]) -> None:
    """Write a table into a page, in the place of the one below the comment with its name.

    Raises:
        SystemExit: if the page does not have the comment exactly once.
    """
    before, _, after = find_table(page, name)
    page.write_text("\n".join([*before, *lines, *after]) + "\n")


def find_table(page: Path, name: str) -> tuple[list[str], list[str], list[str]]:
    """Return the lines of a page before a table, those of the table, and those after it.

    Raises:
        SystemExit: if the page does not have the table's comment exactly once.
    """
    lines = page.read_text().splitlines()
    comment = f"<!-- table: {name} -->"
    if lines.count(comment) != 1:
        raise SystemExit(f"{page.name} must have the line {comment} once, not {lines.count(comment)} times")
    first = lines.index(comment) + 1
    last = next((i for i in range(first, len(lines)) if not lines[i].startswith("|")), len(lines))
    return lines[:first], lines[first:last], lines[last:]
