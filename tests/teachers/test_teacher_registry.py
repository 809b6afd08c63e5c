"""Teachers by name, their settings, and what importing them brings in."""

import json
import math
import subprocess
import sys
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from recrl.environments.cmdp import CostLimits, CurriculumStep, EpisodeStats, Phase
from recrl.environments.plugins import UnknownNameError, WrongKindError
from recrl.teachers.dynamic_options import PAPER, DynamicConfig
from recrl.teachers.registry import TEACHERS, TeacherKind, make_teacher, teacher_config
from recrl.teachers.static import NoConfig, step_teacher
from recrl.teachers.teacher import ProgressReport, TeacherSpec

# What a user's module offers under an import path.
MINE = TeacherKind("d_t, then d_d.", NoConfig, step_teacher)


def spec(name: str, **options: Any) -> TeacherSpec:
    return TeacherSpec(name, options, CostLimits((50.0,)), CostLimits((5.0,)), train_steps=100)


def test_the_names() -> None:
    assert sorted(TEACHERS) == [
        "cooling",
        "cosine",
        "dynamic",
        "exponential",
        "linear",
        "none",
        "step",
        "unconstrained",
    ]


@pytest.mark.parametrize("name", TEACHERS)
def test_every_teacher_is_made_from_its_spec(name: str) -> None:
    step, state = make_teacher(spec(name)).start()
    assert len(step.limits) == 1
    assert state["update"] == 0


def late_step(name: str, cost: float) -> CurriculumStep:
    """The step at 99% of the training budget, after episodes that all had the same cost."""
    teacher = make_teacher(replace(spec(name), train_steps=10_000))
    step, state = teacher.start()
    for update in range(1, 100):
        steps = 100 * update
        finished = (steps - 90, steps - 50, steps)
        episodes = tuple(
            EpisodeStats(0, Phase.TRAINING, end, 40, 1.0, (cost,), step.limits, 0.0, begin_step=end - 40)
            for end in finished
        )
        step, state = teacher.step(state, ProgressReport(update, steps, episodes))
    return step


@pytest.mark.parametrize("name", TEACHERS)
def test_the_entry_says_what_a_teacher_does(name: str) -> None:
    kind, unlimited = TEACHERS[name], replace(spec(name), train_limits=CostLimits.unlimited(1))
    assert kind.measures_start == (make_teacher(unlimited).start()[0].start_limits is None)
    assert kind.compares_costs == (late_step(name, 1.0) != late_step(name, 100.0))
    assert kind.is_control == (late_step(name, 1.0).limits[0] >= 50.0)
    assert kind.rewards_entropy == (late_step(name, 1.0).entropy_coefficient is not None)


@pytest.mark.parametrize(
    ("name", "options"), [*((name, {}) for name in TEACHERS), ("dynamic", {"preset": "paper"})]
)
def test_resolved_settings_validate_to_themselves(name: str, options: dict[str, Any]) -> None:
    resolved = teacher_config(name, options)
    assert teacher_config(name, resolved.model_dump()) == resolved


def test_an_unknown_name_is_told_the_nearest_one() -> None:
    with pytest.raises(UnknownNameError, match="no curriculum is called 'liner'; did you mean 'linear'"):
        make_teacher(spec("liner"))


def test_an_import_path_leads_to_a_teacher(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("somebodys_package")
    module.mine = MINE  # type: ignore[attr-defined]
    module.broken = step_teacher  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "somebodys_package", module)
    step, _ = make_teacher(spec("somebodys_package:mine")).start()
    assert step.limits == CostLimits((50.0,))
    with pytest.raises(
        WrongKindError, match=r"'somebodys_package:broken' must be a TeacherKind, got function; write MINE = "
    ):
        make_teacher(spec("somebodys_package:broken"))


@pytest.mark.parametrize("name", TEACHERS)
def test_an_unknown_option_is_refused(name: str) -> None:
    with pytest.raises(ValidationError, match="windw"):
        make_teacher(spec(name, windw=3))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("linear", {"start_fraction": 0.0}),
        ("dynamic", {"start_fraction": -0.1}),
        ("dynamic", {"window": 0}),
        ("dynamic", {"return_tolerance": -0.1}),
        ("dynamic", {"cost_floor": -1.0}),
        ("dynamic", {"policy_noise": 1.5}),
        ("dynamic", {"preset": "papers"}),
    ],
)
def test_an_option_out_of_its_range_is_refused(name: str, options: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=next(iter(options))):
        make_teacher(spec(name, **options))


@pytest.mark.parametrize("preset", ["recommended", "paper"])
def test_the_switches_of_earlier_versions_are_unknown_options(preset: str) -> None:
    switches = {
        "window_unit": "updates",
        "window_grows": True,
        "adherence_tolerance": "relative",
        "windows_after_noise": 2,
        "remaining": "windows",
        "clock_reset": "change",
        "dimensions": "separate",
        "overlapping_episodes": "ignore",
    }
    with pytest.raises(ValidationError) as error:
        make_teacher(spec("dynamic", preset=preset, **switches))
    assert {(*mistake["loc"], mistake["type"]) for mistake in error.value.errors()} == {
        (name, "extra_forbidden") for name in switches
    }


def test_the_paper_preset_fills_in_what_is_not_given() -> None:
    config = DynamicConfig.model_validate({"preset": "paper", "window": 30})
    assert config.model_dump(include=set(PAPER)) == {**PAPER, "window": 30}


def test_teachers_import_neither_torch_nor_gymnasium() -> None:
    code = (
        "import sys, recrl.teachers.registry, recrl.teachers.bounds\n"
        "print(sorted({'torch', 'gymnasium', 'minigrid', 'ray', 'mlflow'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("train", "deploy", "train_steps", "message"),
    [
        (
            (5.0,),
            (5.0, 1.0),
            1,
            "train_limits and deploy_limits must have one entry per cost, got 1 and 2",
        ),
        ((4.0,), (5.0,), 1, "train_limits must be at least deploy_limits (d_t >= d_d), got 4.0 < 5.0"),
        ((math.inf, 5.0), (math.inf, 5.0), 1, "deploy_limits must be finite, got ['inf', 5.0]"),
        ((5.0,), (5.0,), 0, "train_steps must be at least 1, got 0"),
    ],
)
def test_a_spec_that_makes_no_sense_is_refused(
    train: tuple[float, ...], deploy: tuple[float, ...], train_steps: int, message: str
) -> None:
    with pytest.raises(ValueError) as error:
        TeacherSpec("linear", {}, CostLimits(train), CostLimits(deploy), train_steps)
    assert str(error.value) == message


def test_plain_and_numpy_numbers_become_what_json_can_hold() -> None:
    spec = TeacherSpec("linear", {}, (50.0,), np.array([5.0]), 100)  # type: ignore[arg-type]
    assert spec.train_limits == CostLimits((50.0,)) and spec.deploy_limits == CostLimits((5.0,))
    step = CurriculumStep(CostLimits((-0.0,)), np.float32(0.5), np.float32(0.25))  # type: ignore[arg-type]
    assert json.dumps(step.to_json()) == (
        '{"limits": [0.0], "policy_noise": 0.5, "entropy_coefficient": 0.25, "start_limits": null}'
    )


@pytest.mark.parametrize("limits", ["55", 5.0, None])
def test_what_is_no_list_of_limits_is_refused(limits: Any) -> None:
    sentence = f"^cost limits must be a list of numbers, got {limits!r}$"
    for make in (CostLimits, CurriculumStep, lambda given: TeacherSpec("linear", {}, given, given, 1)):
        with pytest.raises(ValueError, match=sentence):
            make(limits)


@pytest.mark.parametrize("noise", [-0.1, 1.1])
def test_noise_beyond_its_range_is_refused(noise: float) -> None:
    with pytest.raises(ValueError) as error:
        CurriculumStep(CostLimits((5.0,)), noise)
    assert str(error.value) == f"policy noise must lie in [0, 1], got {noise}"


@pytest.mark.parametrize(
    "step",
    [
        CurriculumStep(CostLimits((5.0, math.inf)), 0.25),
        CurriculumStep(CostLimits((5.0,)), 0.0, 1.5, CostLimits((math.inf,))),
    ],
)
def test_a_step_survives_json_and_ends_with_deployment(step: CurriculumStep) -> None:
    assert CurriculumStep.from_json(json.loads(json.dumps(step.to_json(), allow_nan=False))) == step
    deployed = step.in_deployment(CostLimits((1.0,)))
    assert (deployed.limits, deployed.policy_noise) == (CostLimits((1.0,)), 0.0)
    assert deployed.start_limits == step.start_limits
    assert (deployed.entropy_coefficient is None) == (step.entropy_coefficient is None)
    assert not deployed.rewards_entropy
