"""The plan says what a launch would do with every trial, and about how long it takes."""

from pathlib import Path

import pytest
import torch

from recrl.orchestrator.cli.display import estimate_sentence
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.grid.file_models import Resources
from recrl.orchestrator.launch_grid import room
from recrl.orchestrator.launch_plan import (
    Estimate,
    PlannedAction,
    TrialSelection,
    estimate,
    make_plan,
    unmeasured,
)
from recrl.orchestrator.spec import TrialSpec, TrialStatus

GRID = b"""\
name: plan
tasks: [{name: two-state, deploy_limits: 2}]
agents: [ppo-lag, cpo]
methods: [none, linear]
seeds: 2
run: {total_steps: 1000, num_envs: 1}
"""
SPECS = parse_grid(GRID, source="grid.yaml").trials()


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    return SweepStore(tmp_path, "plan")


def _begin(store: SweepStore, spec: TrialSpec, *, env_steps: int, end: TrialStatus | None = None) -> None:
    """Leave a trial that has taken some steps, in the given state or running."""
    writer = store.trial(spec).begin(spec)
    writer.commit({}, update=1, env_steps=env_steps)
    if end is not None:
        writer.close(end)


def test_nothing_on_disk_is_all_new(store: SweepStore) -> None:
    plan = make_plan(SPECS, store)
    assert plan.to_do == SPECS
    assert plan.counts == {**dict.fromkeys(PlannedAction, 0), PlannedAction.NEW: 8}
    assert [trial.steps_left for trial in plan.trials] == [1000] * 8
    assert not store.folder.exists()


def test_each_trial_gets_the_work_its_files_ask_for(store: SweepStore) -> None:
    _begin(store, SPECS[0], env_steps=1000, end=TrialStatus.COMPLETE)
    _begin(store, SPECS[1], env_steps=400, end=TrialStatus.WAITING)
    _begin(store, SPECS[2], env_steps=300)
    _begin(store, SPECS[3], env_steps=200, end=TrialStatus.FAILED)
    plan = make_plan(SPECS[:5], store)
    actions = [trial.action for trial in plan.trials]
    assert actions == [
        PlannedAction.COMPLETE,
        PlannedAction.RESUME,
        PlannedAction.RESUME,
        PlannedAction.FAILED,
        PlannedAction.NEW,
    ]
    assert plan.to_do == (SPECS[1], SPECS[2], SPECS[4])
    assert [trial.steps_left for trial in plan.trials] == [0, 600, 700, 0, 1000]


def test_failed_trials_are_tried_again_only_when_asked(store: SweepStore) -> None:
    _begin(store, SPECS[0], env_steps=200, end=TrialStatus.FAILED)
    assert make_plan(SPECS[:1], store).to_do == ()
    assert (
        make_plan(SPECS[:1], store, TrialSelection(retry_failed=True)).trials[0].action is PlannedAction.RETRY
    )


def test_trials_that_left_the_grid_are_listed_and_kept(store: SweepStore) -> None:
    _begin(store, SPECS[0], env_steps=1000, end=TrialStatus.COMPLETE)
    plan = make_plan(SPECS[1:], store)
    assert [orphan.spec for orphan in plan.orphans] == [SPECS[0]]
    assert store.trial(SPECS[0]).record().status is TrialStatus.COMPLETE


def test_a_selection_makes_no_orphans(store: SweepStore) -> None:
    _begin(store, SPECS[0], env_steps=1000, end=TrialStatus.COMPLETE)
    plan = make_plan(SPECS, store, TrialSelection(only={"seed": ["1"]}))
    assert {spec.seed for spec in plan.to_do} == {1}
    assert plan.orphans == ()


def test_the_time_is_unknown_before_a_trial_of_the_kind_has_run(store: SweepStore) -> None:
    found = estimate(make_plan(SPECS, store), concurrent=2)
    assert found.wall_seconds is None
    assert found.unknown == ("two-state ppo-lag", "two-state cpo")
    assert found.concurrent == 2


def test_the_time_follows_from_the_speed_of_the_same_task_and_agent(store: SweepStore) -> None:
    for spec in (SPECS[0], SPECS[2]):  # one of each agent
        _begin(store, spec, env_steps=1000, end=TrialStatus.COMPLETE)
    plan = make_plan(SPECS, store)
    seconds = {
        trial.spec.agent.label: trial.record.cpu_seconds for trial in plan.trials if trial.record.update
    }
    found = estimate(plan, concurrent=2)
    assert found.unknown == ()
    assert found.cpu_seconds == pytest.approx(3 * seconds["ppo-lag"] + 3 * seconds["cpo"])
    assert found.wall_seconds == pytest.approx((3 * seconds["ppo-lag"] + 3 * seconds["cpo"]) / 2)


def test_the_sentence_has_wall_time_and_cpu_time() -> None:
    found = Estimate(cpu_seconds=7200.0, concurrent=2, gigabytes=1.9, unknown=())
    said = estimate_sentence(found, "on this machine")
    assert said == (
        "about 1 h with 2 trials at once on this machine, about 1.9 GB of memory, 2 h of CPU time"
    )


def test_a_trial_that_has_taken_no_step_tells_no_speed(store: SweepStore) -> None:
    _begin(store, SPECS[0], env_steps=0, end=TrialStatus.WAITING)
    plan = make_plan(SPECS[:2], store)
    assert plan.trials[0].record.cpu_seconds > 0.0
    assert estimate(plan, concurrent=1).unknown == ("two-state ppo-lag",)
    assert unmeasured(plan) == (SPECS[0],)


def test_nothing_to_do_takes_nothing(store: SweepStore) -> None:
    _begin(store, SPECS[0], env_steps=1000, end=TrialStatus.COMPLETE)
    found = estimate(make_plan(SPECS[:1], store), concurrent=2)
    assert (found.wall_seconds, found.concurrent, found.gigabytes) == (0.0, 0, 0.0)


@pytest.mark.parametrize(
    ("gpus", "per_trial", "fitting"),
    [(0, 1.0, 1), (3, 1.0, 3), (2, 0.4, 4), (1, 0.1, 10), (3, 2.0, 1), (8, 0.0, 64)],
)
def test_no_more_trials_run_than_fit_on_the_gpus(
    monkeypatch: pytest.MonkeyPatch, gpus: int, per_trial: float, fitting: int
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr("recrl.orchestrator.capacity.usable_cores", lambda: 64)
    resources = Resources(cpus_per_trial=1, gpus_per_trial=per_trial)
    assert room(resources, address=None, max_concurrent=None)[0] == fitting
    assert room(resources, address=None, max_concurrent=64)[0] == fitting
    assert room(resources, address=None, max_concurrent=1)[0] == 1
    assert room(resources, address=None, max_concurrent=None, cores=16)[0] == 16, "another machine's cores"


@pytest.mark.parametrize(
    ("there", "most", "shown"), [(6, None, 6), (6, 4, 4), (6, 64, 6), (0, None, 1), (0, 8, 1)]
)
def test_a_limit_does_not_hide_the_size_of_a_cluster(
    monkeypatch: pytest.MonkeyPatch, there: int, most: int | None, shown: int
) -> None:
    monkeypatch.setattr("recrl.orchestrator.ray.ray_executor.room_on_cluster", lambda *_: there)
    for resources, given in ((Resources(), most), (Resources(max_concurrent=most), None)):
        at_once, where = room(resources, address="head:6379", max_concurrent=given)
        assert (at_once, where) == (shown, "on the cluster at present")
