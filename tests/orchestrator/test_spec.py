"""A trial's identity follows what its results depend on, and nothing else."""

import json
import math
import re
from dataclasses import replace

import pytest

from recrl.environments.cmdp import CostLimits
from recrl.orchestrator.spec import Choice, TrialSpec, TrialStatus

SPEC = TrialSpec(
    task=Choice("rivergrid-1a"),
    agent=Choice("ppo-lag", {"hidden": [64, 64]}),
    method=Choice("dynamic", {"window": 80}, label="dynamic 80"),
    train_limits=CostLimits.unlimited(1),
    deploy_limits=CostLimits((5.0,)),
    train_steps=950,
    deploy_steps=50,
    num_envs=4,
    rollout_steps=7,
    evaluation_episodes=10,
    seed=3,
)


def test_json_round_trip_keeps_identity() -> None:
    text = json.dumps(SPEC.to_json(), allow_nan=False)
    again = TrialSpec.from_json(json.loads(text))
    assert again == SPEC
    assert again.trial_id == SPEC.trial_id
    assert math.isinf(again.train_limits[0])


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 4},
        {"train_steps": 951},
        {"deploy_limits": CostLimits((4.0,))},
        {"agent": Choice("ppo-lag", {"hidden": [64, 65]})},
        {"task": Choice("rivergrid-1b")},
    ],
)
def test_any_change_changes_the_identity(change: dict[str, object]) -> None:
    assert replace(SPEC, **change).trial_id != SPEC.trial_id  # type: ignore[arg-type]


def test_group_ignores_only_the_seed() -> None:
    assert replace(SPEC, seed=9).group == SPEC.group
    assert replace(SPEC, num_envs=5).group != SPEC.group


def test_last_update_ends_at_or_after_the_total() -> None:
    assert SPEC.steps_per_update == 28
    assert SPEC.num_updates == 36  # 35 updates are 980 steps, 36 are 1008


def test_folder_name_is_safe_and_readable() -> None:
    hostile = replace(SPEC, task=Choice("x", label="../../etc/pass wd"))
    assert re.fullmatch(r"[A-Za-z0-9._+-]+", hostile.folder_name)
    assert not hostile.folder_name.startswith(".")
    assert SPEC.folder_name == f"rivergrid-1a__ppo-lag__dynamic-80__s3__{SPEC.trial_id}"


def test_only_a_curriculum_that_measures_d_t_can_find_it_too_low() -> None:
    """``cooling`` without relaxation begins at d_d, and measures nothing."""
    unlimited = replace(SPEC, train_limits=CostLimits((math.inf,)), deploy_limits=CostLimits((2.0,)))
    for name, is_none in (("linear", True), ("dynamic", True), ("cooling", False), ("none", False)):
        assert replace(unlimited, method=Choice(name)).is_no_curriculum([1.5]) == is_none
    assert not replace(unlimited, method=Choice("linear")).is_no_curriculum([3.0])


def test_only_complete_and_failed_are_finished() -> None:
    assert [state for state in TrialStatus if state.is_finished] == [TrialStatus.COMPLETE, TrialStatus.FAILED]
