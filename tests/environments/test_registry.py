"""Finding tasks by name and validating their options."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel, ValidationError

from recrl.environments.cmdp import CostLimits
from recrl.environments.gymnasium_adapter import SyncCMDPVectorEnv
from recrl.environments.plugins import MODULES, UnknownNameError, load_attribute, modules_in
from recrl.environments.registry import TASKS, find_task, make_vector, optimal_return, task_options
from recrl.environments.rivergrid.maps import MAPS, parse_map
from tests.environments.sample_options import sample_options


@pytest.mark.parametrize("name", TASKS)
def test_everything_a_task_refers_to_exists_and_explains_itself(name: str) -> None:
    task = TASKS[name]
    assert task.summary.endswith(".")
    for reference in (task.make, task.optimum):
        assert reference is None or callable(load_attribute(str(reference)))
    model = load_attribute(str(task.options))
    assert issubclass(model, BaseModel)
    assert model.model_config["frozen"]
    assert model.model_config["extra"] == "forbid"


@pytest.mark.parametrize("name", [name for name, task in TASKS.items() if task.optimum is not None])
def test_a_looser_limit_never_lowers_the_optimum(name: str) -> None:
    options = sample_options(name)
    num_costs = make_vector(name, 1, options=options).cmdp.num_costs
    optima = [
        optimal_return(name, options, CostLimits((limit,) * num_costs)) for limit in (0.0, 0.5, 2.0, math.inf)
    ]
    known = [optimum for optimum in optima if optimum is not None]
    assert len(known) == len(optima)
    assert known == sorted(known)


def test_building_rivergrid_imports_nothing_slow() -> None:
    program = (
        "import sys; from recrl.environments.registry import make_vector; make_vector('rivergrid-1a', 1); "
        "print(sorted({'scipy', 'minigrid', 'pygame', 'torch', 'mujoco'} & set(sys.modules)))"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout == "[]\n"


def test_an_unknown_task_is_named_with_its_nearest_known_one() -> None:
    with pytest.raises(
        UnknownNameError, match=r"no task is called 'rivergrid-1c'; did you mean 'rivergrid-1"
    ):
        make_vector("rivergrid-1c", 1)


def test_all_mistakes_in_options_are_reported_at_once() -> None:
    with pytest.raises(ValidationError) as error:
        task_options("rivergrid-1a", {"horizon": 0, "costs": ["river", "fire"], "hats": 3})
    assert {mistake["loc"] for mistake in error.value.errors()} == {("horizon",), ("costs", 1), ("hats",)}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"map": "####\n#>.#\n####"}, "map: needs a goal 'G'"),
        ({"map": "no/such/map.txt"}, "no/such/map.txt: cannot be read as a map"),
        ({"map": MAPS["1a"], "costs": ["river", "river"]}, "must differ, got river, river"),
        (
            {"map": "######\n#>..G#\n######", "horizon": 2},
            "at least 3, the steps to the goal of the map, got 2",
        ),
    ],
)
def test_maps_that_cannot_be_used_are_found_when_options_are_checked(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValidationError, match=message):
        task_options("rivergrid", options)


def test_options_keep_the_drawing_of_a_map_file_not_its_path(tmp_path: Path) -> None:
    path = tmp_path / "ford.txt"
    path.write_text(MAPS["1b"])
    options = task_options("rivergrid", {"map": str(path)}).model_dump(mode="json")
    assert options["map"] == str(parse_map(MAPS["1b"]))
    path.unlink()
    assert task_options("rivergrid", options).model_dump(mode="json") == options


def test_a_map_of_ones_own_has_its_exact_optimum_too() -> None:
    # Two steps through one river tile, or five on dry ground.
    drawing = "#####\n#>~G#\n#...#\n#####"
    optima = [
        optimal_return("rivergrid", {"map": drawing}, CostLimits((limit,))) for limit in (0.0, 0.5, 1.0)
    ]
    round_it, across = 10.0 - 0.1 * 6, 10.0 - 0.1
    assert optima == pytest.approx([round_it, (round_it + across) / 2.0, across])


def test_limits_that_nobody_can_keep_have_the_optimum_of_an_empty_set() -> None:
    options = {"costs": ["river", "turns"]}
    # Heading east, 1a is either turned in or walked into the water: no policy does neither.
    assert optimal_return("rivergrid-1a", options, CostLimits((0.0, 0.0))) == -math.inf


@pytest.mark.parametrize("limits", [5.0, 5, [5.0], (5.0,), np.array([5.0]), np.float32(5.0)])
def test_limits_of_an_optimum_may_be_plain_numbers(limits: Any) -> None:
    assert optimal_return("rivergrid-1a", {}, limits) == optimal_return(
        "rivergrid-1a", {}, CostLimits((5.0,))
    )


@pytest.mark.parametrize(
    ("limits", "sentence"),
    [
        ({"river": 5.0}, r"^limits must be a number, a list of numbers or CostLimits, got \{'river': 5.0\}$"),
        ("many", "^limits must be a number, a list of numbers or CostLimits, got 'many'$"),
        ([[5.0, 6.0]], "^rivergrid-1a: there must be one limit per cost, 1, got 2$"),
        (-1.0, r"^cost limits must be at least 0, got -1\.0$"),
        (None, "^cost limits must be at least 0, got nan$"),
    ],
)
def test_limits_that_are_no_numbers_are_refused(limits: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        optimal_return("rivergrid-1a", {}, limits)


def test_a_task_whose_optimum_nobody_knows_says_none() -> None:
    assert optimal_return("gymnasium", {"id": "CartPole-v1", "costless": True}, CostLimits((1.0,))) is None


def test_a_users_callable_is_a_task_by_its_import_path() -> None:
    path = "recrl.environments.rivergrid.minigrid_env:RiverGridEnv"
    environment = make_vector(path, 3, options={"horizon": 9, "costs": ["river", "turns"]})
    assert isinstance(environment, SyncCMDPVectorEnv)
    assert environment.cmdp.name == path
    assert environment.cmdp.cost_names == ("river", "turns")
    environment.reset(seed=0)
    _, rewards, _, _, info = environment.step(np.array([0, 1, 2]))
    assert rewards.tolist() == [-0.1] * 3
    assert info["cost"].tolist() == [[0.0, 1.0], [0.0, 1.0], [1.0, 0.0]]


def test_a_users_task_is_found_by_entry_point(
    tmp_path: Path, install: Callable[[str, str, str], None]
) -> None:
    (tmp_path / "goldrush.py").write_text(
        "from recrl.environments.registry import TASKS\nRUSH = TASKS['two-state']\n"
    )
    install("goldrush", "recrl.tasks", "rush = goldrush:RUSH")
    assert find_task("rush") is TASKS["two-state"]


def test_an_entry_point_of_two_packages_names_neither(install: Callable[[str, str, str], None]) -> None:
    install("gold-rush", "recrl.tasks", "rush = gold:RUSH")
    install("silver-rush", "recrl.tasks", "rush = silver:RUSH")
    with pytest.raises(UnknownNameError) as error:
        find_task("rush")
    for part in ("the task 'rush'", "'gold:RUSH' of the package gold-rush", "'silver:RUSH' of the package"):
        assert part in str(error.value)


def test_folders_of_modules_may_overlap_in_several_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    before, folder = list(sys.path), str(tmp_path)
    for name in ("early_room", "late_room"):
        (tmp_path / f"{name}.py").write_text("def make(): ...")
    first, second = modules_in(tmp_path), modules_in(tmp_path)
    first.__enter__()
    assert load_attribute("early_room:make")
    second.__enter__()
    first.__exit__(None, None, None)
    assert (os.environ[MODULES], sys.path) == (folder, [*before, folder])
    assert load_attribute("late_room:make")
    second.__exit__(None, None, None)
    assert (os.environ.get(MODULES), sys.path) == (None, before)


def test_a_module_of_the_same_name_in_another_folder_is_not_confused_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "my_twin.py").write_text(f"NAME = {name!r}\n")
    monkeypatch.setattr(sys, "path", [*sys.path])
    with modules_in(tmp_path / "one"):
        assert load_attribute("my_twin:NAME") == "one"
    try:
        with (
            modules_in(tmp_path / "two"),
            pytest.raises(UnknownNameError, match="start a new Python process"),
        ):
            load_attribute("my_twin:NAME")
    finally:
        del sys.modules["my_twin"]


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("coalrush:RUSH", "No module named 'shovel'"),
        ("goldrash:RUSH", "No module named 'goldrash'"),
        ("silverrush:RUSH", "module 'silverrush' has no attribute 'RUSH'"),
        ("bankrupt:RUSH", "it ends the process (exit code 3)"),
    ],
)
def test_a_broken_entry_point_is_named_with_its_package(
    target: str, reason: str, tmp_path: Path, install: Callable[[str, str, str], None]
) -> None:
    (tmp_path / "coalrush.py").write_text("import shovel\n")
    (tmp_path / "silverrush.py").write_text("")
    (tmp_path / "bankrupt.py").write_text("raise SystemExit(3)\n")
    install("gold-rush", "recrl.tasks", f"rush = {target}")
    with pytest.raises(UnknownNameError) as error:
        find_task("rush")
    assert str(error.value) == (
        f"the entry point rush of the package gold-rush cannot load {target!r}: {reason}"
    )


@pytest.mark.parametrize(
    ("name", "limits", "number"),
    [
        ("two-state", (1.0, 2.0), 1),
        ("two-state-2", (1.0,), 2),
        ("continuous-bandit", (1.0, 2.0), 1),
        ("rivergrid-1a", (1.0, 2.0), 1),
    ],
)
def test_an_optimum_needs_one_limit_per_cost(name: str, limits: tuple[float, ...], number: int) -> None:
    with pytest.raises(ValueError) as error:
        optimal_return(name, {}, CostLimits(limits))
    assert str(error.value) == f"{name}: there must be one limit per cost, {number}, got {len(limits)}"


def test_what_is_neither_a_task_nor_callable_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"task 'math:pi' must be a Task or return an environment, got float"
    ):
        find_task("math:pi")


def test_a_misspelt_attribute_of_a_module_is_met_with_the_nearest() -> None:
    with pytest.raises(
        UnknownNameError, match=r"has no attribute 'JSONDecoer'; did you mean 'JSONDecoder'\?"
    ):
        load_attribute("json:JSONDecoer")
