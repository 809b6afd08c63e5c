"""Generated instances: the same on every machine, of the kind asked for, and binding at their limits."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recrl.environments.cmdp import CostLimits
from recrl.environments.registry import make_vector, optimal_return, task_options
from recrl.environments.rivergrid import instances
from recrl.environments.rivergrid.grid_world import RiverGridGeneratedOptions, RiverGridVectorEnv, task_map
from recrl.environments.rivergrid.instances import (
    LEAST_DETOUR,
    InstanceSettings,
    Route,
    cheapest_route,
    draw_instance,
    is_instance,
    quickest_route,
    suggested_limit,
)
from recrl.environments.rivergrid.maps import DRY, GOAL, MAPS, RIVER, STEPS, MapError, RiverMap, parse_map
from recrl.environments.rivergrid.print_instances import grid_entry, main
from recrl.orchestrator.grid.checking import parse_grid, read_grid

PAPERS = {name: parse_map(drawing) for name, drawing in MAPS.items()}


def shortest_path(river_map: RiverMap, through: str) -> int | None:
    """The fewest steps to a goal through some tiles, turns included, level by level; None without a path."""
    crossable = {river_map.start, *river_map.cells(through + GOAL)}
    frontier, seen, steps = {(*river_map.start, river_map.heading)}, set(), 0
    while frontier:
        if any(river_map.tile((x, y)) == GOAL for x, y, _ in frontier):
            return steps
        seen |= frontier
        turned = {(x, y, (heading + turn) % 4) for x, y, heading in frontier for turn in (1, -1)}
        ahead = {(x + STEPS[heading][0], y + STEPS[heading][1], heading) for x, y, heading in frontier}
        frontier = (turned | {pose for pose in ahead if pose[:2] in crossable}) - seen
        steps += 1
    return None


def test_equal_seeds_give_these_maps_on_every_machine() -> None:
    assert draw_instance(InstanceSettings(map_seed=0)) == parse_map(
        """
        #########
        #.......#
        #.~~#~..#
        #.~~~~~.#
        #.~~#~~.#
        #.~~~~#.#
        #.~~~~~.#
        #G~~#~^.#
        #########
        """
    )
    assert draw_instance(InstanceSettings(map_seed=2)) == parse_map(
        """
        #########
        #.~~~~~.#
        #.~~~~~v#
        #.~~~~..#
        #.~~~...#
        #G~~~.#.#
        #..~~~..#
        #..~~~.##
        #########
        """
    )


def test_routes_of_the_papers_maps_are_counted_by_hand() -> None:
    assert quickest_route(PAPERS["1a"]) == cheapest_route(PAPERS["1a"]) == Route(steps=6, cost=5)
    assert quickest_route(PAPERS["1b"]) == Route(steps=6, cost=5)
    assert cheapest_route(PAPERS["1b"]) == Route(steps=11, cost=0)


def test_a_turn_in_the_river_is_a_step_that_costs() -> None:
    river_map = parse_map("#####\n#>~##\n##~G#\n#####")
    # Forward, right, forward, left, forward: all but the last end in the water.
    assert quickest_route(river_map) == cheapest_route(river_map) == Route(steps=5, cost=4)


def test_of_equally_quick_ways_the_cheapest_counts_and_of_equally_cheap_ones_the_quickest() -> None:
    # Round the wall either way: seven steps; two of them in the water above, one below.
    assert quickest_route(parse_map("#####\n#..~#\n#>#G#\n#.~.#\n#####")) == Route(steps=7, cost=1)
    # Straight on, or along the bottom and up: two steps in the water either way.
    assert cheapest_route(parse_map("######\n#v~~G#\n#...~#\n######")) == Route(steps=4, cost=2)


def test_the_papers_maps_are_instances_and_the_rule_gives_their_limits() -> None:
    anything = InstanceSettings(map_seed=0)
    assert is_instance(PAPERS["1a"], anything, safe_path=False)
    assert is_instance(PAPERS["1b"], anything, safe_path=True)
    assert suggested_limit(PAPERS["1a"]) == 5.0
    assert suggested_limit(PAPERS["1b"]) == 1.0


def test_a_map_on_which_the_river_does_not_matter_is_no_instance_and_has_no_limit() -> None:
    river_map = parse_map("#####\n#>.G#\n#~~~#\n#####")
    for safe_path in (True, False):
        assert not is_instance(river_map, InstanceSettings(map_seed=0), safe_path=safe_path)
    with pytest.raises(MapError, match="the shortest path does not cross the river"):
        suggested_limit(river_map)


@settings(max_examples=25)
@given(
    map_seed=st.integers(0, 2**64),
    width=st.integers(6, 12),
    height=st.integers(6, 12),
    safe_path=st.sampled_from([None, True, False]),
)
def test_instances_are_valid_repeatable_and_as_asked_for(
    map_seed: int, width: int, height: int, safe_path: bool | None
) -> None:
    wanted = InstanceSettings(
        map_seed=map_seed, width=width, height=height, river_width=(1, 2), safe_path=safe_path
    )
    river_map = draw_instance(wanted)
    assert parse_map(str(river_map)) == river_map
    assert draw_instance(wanted) == river_map
    assert (river_map.width, river_map.height) == (width, height)
    dry, quickest = shortest_path(river_map, DRY), shortest_path(river_map, DRY + RIVER)
    assert safe_path is None or (dry is not None) == safe_path
    assert quickest is not None
    assert dry is None or dry >= quickest + LEAST_DETOUR


def test_other_seeds_give_other_maps_of_both_kinds() -> None:
    drawn = {draw_instance(InstanceSettings(map_seed=seed)) for seed in range(20)}
    assert len(drawn) == 20
    assert {shortest_path(river_map, DRY) is not None for river_map in drawn} == {True, False}


@pytest.mark.parametrize("safe_path", [True, False])
@pytest.mark.parametrize("map_seed", range(3))
def test_the_limit_binds_at_the_exact_optimum(map_seed: int, safe_path: bool) -> None:
    options = {"map_seed": map_seed, "safe_path": safe_path, "horizon": 40}
    river_map = draw_instance(InstanceSettings(map_seed=map_seed, safe_path=safe_path))
    quickest, cheapest = quickest_route(river_map), cheapest_route(river_map)
    assert quickest is not None and cheapest is not None

    def optimum(limit: float) -> float:
        value = optimal_return("rivergrid-generated", options, CostLimits((limit,)))
        assert value is not None
        return value

    limit = suggested_limit(river_map)
    assert optimum(math.inf) == pytest.approx(10.0 - 0.1 * (quickest.steps - 1))
    if safe_path:
        assert optimum(0.0) == pytest.approx(10.0 - 0.1 * (cheapest.steps - 1))
        assert optimum(0.0) <= optimum(math.inf) - 0.5 + 1e-9
        mixture = 0.8 * optimum(0.0) + 0.2 * optimum(math.inf)  # a third way may be better
        assert mixture - 1e-9 <= optimum(limit) < optimum(math.inf) - 1e-3
    else:
        assert optimum(limit) >= 10.0 - 0.1 * (cheapest.steps - 1) - 1e-9
        assert optimum(limit - 1.0) < optimum(limit) - 1.0  # at times nothing but staying is left


def test_a_trial_walks_on_the_map_that_its_options_name() -> None:
    environment = make_vector("rivergrid-generated", 1, options={"map_seed": 4, "width": 11})
    assert isinstance(environment, RiverGridVectorEnv)
    assert environment.river_map == draw_instance(InstanceSettings(map_seed=4, width=11))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"river_width": [2, 6]}, "two widths from 1 to 5 in a map of 9 by 9, the least first, got 2 and 6"),
        ({"river_width": [3, 2]}, "the least first, got 3 and 2"),
        ({"wall_share": 0.6}, "less than or equal to 0.5"),
        ({"horizon": 8}, "horizon must be at least 9, the steps to the goal of map 0, got 8"),
    ],
)
def test_settings_that_give_no_instance_are_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        task_options("rivergrid-generated", {"map_seed": 0, **wrong})


def test_settings_that_hardly_ever_give_an_instance_are_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(instances, "GENERATION_ATTEMPTS", 3)
    with pytest.raises(MapError, match=r"no instance in 3 attempts met .*\"wall_share\":0\.5.*, change the"):
        draw_instance(InstanceSettings(map_seed=0, width=20, wall_share=0.5))


def test_what_the_command_prints_is_a_grids_task(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["river_limits", "0", "1", "--options", '{"horizon": 30}'])
    main()
    printed = capsys.readouterr().out
    assert printed == "\n".join(grid_entry({"map_seed": seed, "horizon": 30}) for seed in (0, 1)) + "\n"
    head = "name: generated\nagents: [ppo-lag]\nmethods: [none]\nseeds: 1\nrun: {total_steps: 4000}\ntasks:\n"
    grid = parse_grid((head + printed).encode(), source="printed.yaml")
    for seed, cell in enumerate(grid.tasks):
        assert cell.task.label == f"map-{seed}"
        river_map = draw_instance(InstanceSettings(map_seed=seed))
        assert cell.deploy_limits == CostLimits((suggested_limit(river_map),))
        assert all(f"  # {row}\n" in printed for row in river_map.rows)


def test_the_command_names_a_wrong_option(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["river_limits", "0", "--options", '{"widht": 8}'])
    with pytest.raises(SystemExit):
        main()
    assert "widht" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("[1]", "argument --options: must be a JSON object, got '[1]'"),
        (
            '{"map_seed": 3}',
            "argument --options: must not have map_seed, give the seeds before it, got '{\"map_seed\": 3}'",
        ),
        (
            '{"costs": ["turns"]}',
            'costs must be ["river"], because the rule for limits counts the river only, got ["turns"]',
        ),
        ('{"horizon": 3}', "horizon must be at least 9, the steps to the goal of map 0, got 3"),
        ('{"horizon": 20}', "horizon must be at least 23, the steps of the cheapest path on map 0, got 20"),
        ('{"widht": 8}', "widht: Extra inputs are not permitted"),
    ],
)
def test_the_command_refuses_in_one_sentence(
    options: str, sentence: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["print_instances", "0", "--options", options])
    with pytest.raises(SystemExit):
        main()
    assert capsys.readouterr().err.splitlines()[-1].endswith(f"error: {sentence}")


def test_the_committed_grid_has_the_first_six_maps_under_the_limits_of_the_rule() -> None:
    path = Path(__file__).parents[2] / "results" / "rivergrid" / "generated.yaml"
    grid = read_grid(path)
    assert [cell.task.options["map_seed"] for cell in grid.tasks] == list(range(6))
    for cell in grid.tasks:
        river_map = task_map(cell.task.name, RiverGridGeneratedOptions.model_validate(cell.task.options))
        assert cell.deploy_limits == CostLimits((suggested_limit(river_map),))
        assert "\n".join(f"  # {row}" for row in river_map.rows) in grid.text.decode()


def test_a_map_is_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    def counted(seed: int) -> Any:
        drawn.append(seed)
        return original(seed)

    original = instances._Draws
    monkeypatch.setattr(instances, "_Draws", counted)
    for _ in range(2):
        make_vector("rivergrid-generated", 1, options={"map_seed": 987_654})
    assert drawn == [987_654]
