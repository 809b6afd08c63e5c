"""Tables in the documentation are those of the results."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks import safety_gym_pages
from tests.benchmarks.page_tables import find_table, replace_table


@pytest.mark.parametrize(
    ("page", "name", "lines"),
    [pytest.param(*it, id=f"{it[0].stem}: {it[1]}") for it in safety_gym_pages.tables()],
)
def test_tables_on_relaxed_limits_are_those_of_the_rows(page: Path, name: str, lines: list[str]) -> None:
    _, table, _ = find_table(page, name)
    assert table == lines, "python -m tests.benchmarks.safety_gym_pages writes the tables again"


def test_a_table_is_written_in_the_place_of_the_one_before(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Page\n\n<!-- table: one -->\n| a |\n|---|\n| 1 |\n\nText\n\n<!-- table: two -->\n")
    replace_table(page, "one", ["| b |", "|---|"])
    replace_table(page, "two", ["| c |", "|---|"])
    wanted = "# Page\n\n<!-- table: one -->\n| b |\n|---|\n\nText\n\n<!-- table: two -->\n| c |\n|---|\n"
    assert page.read_text() == wanted


def test_a_page_without_the_comment_is_said(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Page\n")
    with pytest.raises(
        SystemExit, match=r"page\.md must have the line <!-- table: one --> once, not 0 times"
    ):
        replace_table(page, "one", [])
