"""Maps: 1a and 1b, what is refused and with which sentence, and what is generated."""

from __future__ import annotations

from pathlib import Path

import pytest

from recrl.environments.rivergrid.maps import (
    DRY,
    MAPS,
    RIVER,
    MapError,
    parse_map,
    read_map,
)


def test_the_papers_maps_are_drawn_as_defined() -> None:
    assert str(parse_map(MAPS["1a"])) == "\n".join(
        [
            "#########",
            "#.~~~~~.#",
            "#.~~~~~.#",
            "#.~~~~~.#",
            "#>~~~~~G#",
            "#.~~~~~.#",
            "#.~~~~~.#",
            "#.~~~~~.#",
            "#########",
        ]
    )
    assert str(parse_map(MAPS["1b"])) == "\n".join(
        [
            "#########",
            "#.~~~~~.#",
            "#.~~~~~.#",
            "#.~~~~~.#",
            "#.~~~~~.#",
            "#.~~~~~.#",
            "#>~~~~~G#",
            "#.......#",
            "#########",
        ]
    )


def test_cells_count_from_the_top_left_and_headings_from_east() -> None:
    river_map = parse_map("####\n#~G#\n#.^#\n####")
    assert (river_map.width, river_map.height) == (4, 4)
    assert (river_map.start, river_map.heading) == ((2, 2), 3)
    assert river_map.cells("G") == ((2, 1),)
    assert river_map.tile((1, 1)) == RIVER
    assert river_map.tile((1, 2)) == DRY


def test_indentation_empty_lines_and_trailing_blanks_do_not_matter() -> None:
    assert parse_map("\n\n    ####  \n    #>G#\n    ####\n\n") == parse_map("####\n#>G#\n####")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "map: must be at least 3 columns by 3 rows, got 0 by 1"),
        ("####\n#>G#", "map: must be at least 3 columns by 3 rows, got 4 by 2"),
        ("####\n#>G##\n####", "map: line 2: must have 4 columns like the first row, got 5"),
        ("\n####\n#>w#\n####", "map: line 3, column 3: unknown tile 'w', allowed are # . ~ % G > v < ^"),
        ("####\n#>G#\n##.#", "map: line 3, column 3: the border must be wall '#', got '.'"),
        ("#####\n#>v.#\n#G..#\n#####", "map: line 2, column 3: there must be one start, the first is at "
         "map: line 2, column 2"),
        ("####\n#.G#\n####", "map: needs a start, one of > v < ^"),
        ("####\n#>.#\n####", "map: needs a goal 'G'"),
        ("#####\n#>#G#\n#####", "map: no goal can be reached from the start, open a way through the walls"),
    ],
)  # fmt: skip
def test_a_drawing_that_is_no_map_is_refused_with_one_located_sentence(text: str, message: str) -> None:
    with pytest.raises(MapError) as error:
        parse_map(text)
    assert str(error.value) == message


def test_a_map_file_is_named_in_its_errors(tmp_path: Path) -> None:
    path = tmp_path / "ford.txt"
    with pytest.raises(MapError, match=r"ford\.txt: cannot be read as a map"):
        read_map(path)
    path.write_text("####\n#>.#\n####\n")
    with pytest.raises(MapError, match=r"ford\.txt: needs a goal 'G'"):
        read_map(path)
    path.write_text(MAPS["1a"])
    assert read_map(path) == parse_map(MAPS["1a"])
