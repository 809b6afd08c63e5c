"""Maps: the paper's two, what is refused and with which sentence, and what is generated."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recrl.environments.rivergrid.maps import (
    DRY,
    MAPS,
    RIVER,
    MapError,
    MapGenerator,
    generate_map,
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


def test_only_1b_can_be_walked_round() -> None:
    assert parse_map(MAPS["1a"]).shortest_route(through=DRY) is None
    assert parse_map(MAPS["1b"]).shortest_route(through=DRY) is not None


def test_routes_are_counted_in_steps_with_their_turns() -> None:
    assert parse_map(MAPS["1a"]).shortest_route(through=DRY + RIVER) == 6
    assert parse_map(MAPS["1b"]).shortest_route(through=DRY) == 11  # reward -0.1 * 10 + 10 = 9


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


@settings(max_examples=40, deadline=None)  # a loaded machine is no failure
@given(
    seed=st.integers(0, 2**32),
    width=st.integers(5, 12),
    height=st.integers(5, 12),
    dry_route=st.sampled_from([None, True, False]),
)
def test_generated_maps_are_valid_repeatable_and_as_asked_for(
    seed: int, width: int, height: int, dry_route: bool | None
) -> None:
    wanted = MapGenerator(seed=seed, width=width, height=height, dry_route=dry_route)
    river_map = generate_map(wanted)
    assert parse_map(str(river_map)) == river_map
    assert generate_map(wanted) == river_map
    assert (river_map.width, river_map.height) == (width, height)
    dry, quickest = river_map.shortest_route(through=DRY), river_map.shortest_route(through=DRY + RIVER)
    assert dry_route is None or (dry is not None) == dry_route
    assert quickest is not None
    assert dry is None or quickest < dry


def test_other_seeds_give_other_maps() -> None:
    assert len({generate_map(MapGenerator(seed=seed)) for seed in range(20)}) == 20


def test_a_map_that_cannot_be_generated_is_one_sentence() -> None:
    with pytest.raises(MapError, match=r"no map in 2000 attempts met .*river_share"):
        generate_map(MapGenerator(seed=0, width=4, height=4, river_share=0.0))
    with pytest.raises(
        MapError, match=r"river_share and wall_share must sum to at most 1, got 0\.9 and 0\.5"
    ):
        generate_map(MapGenerator(seed=0, river_share=0.9, wall_share=0.5))
