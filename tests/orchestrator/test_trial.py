"""A trial walks the paper's two phases, records what happened, and never depends on how it was run."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
import torch

from recrl.agents.agent import FinalPolicy
from recrl.agents.evaluation import evaluate
from recrl.agents.registry import AGENTS, make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.finite.finite_cmdp import FiniteVectorEnv
from recrl.environments.vector import CMDPVectorEnv
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import Choice, TrialSpec, TrialStatus
from recrl.orchestrator.trial import attempt, trial
from recrl.orchestrator.trial.attempt import run_recorded
from recrl.orchestrator.trial.trial import Trial
from recrl.teachers.registry import TEACHERS, TeacherKind, make_teacher
from recrl.teachers.static import NoConfig, step_teacher
from recrl.teachers.teacher import ProgressReport, TeacherSpec, TeacherState

SMALL = {"hidden_sizes": [16]}
QUICK = {**SMALL, "critic_steps": 4, "critic_passes": 1}  # for what holds however long critics are fitted
SPEC = TrialSpec(
    task=Choice("two-state", {"horizon": 10}),
    agent=Choice("ppo-lag", SMALL),
    method=Choice("linear"),
    train_limits=CostLimits.unlimited(1),
    deploy_limits=CostLimits((3.0,)),
    train_steps=19 * 60,
    deploy_steps=60,
    num_envs=4,
    rollout_steps=15,  # not a multiple of the horizon: episodes span updates
    evaluation_episodes=6,
    seed=5,
)


def never() -> bool:
    return False


def stop_after(updates: int) -> Callable[[], bool]:
    """Asked once before each update, it stops a trial after so many."""
    answers = iter([False] * updates + [True])
    return lambda: next(answers)


def run(
    folder: Path, spec: TrialSpec = SPEC, stops: tuple[int, ...] = (), *, on_gpu: bool = False
) -> TrialStore:
    """The trial, stopped and resumed after the given numbers of further updates, then run to its end."""
    store = SweepStore(folder, "sweep").trial(spec)
    for updates in stops:
        state = run_recorded(spec, store, should_stop=stop_after(updates), on_gpu=on_gpu)
        assert state is TrialStatus.WAITING
    assert run_recorded(spec, store, should_stop=never, on_gpu=on_gpu) is TrialStatus.COMPLETE
    return store


def final_tree(store: TrialStore) -> dict[str, Any]:
    tree = store.latest_checkpoint()
    assert tree is not None
    trial = tree["trial"]
    assert isinstance(trial, dict)
    return trial


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    return run(tmp_path_factory.mktemp("undisturbed"))


def test_equal_seeds_give_equal_bytes(undisturbed: TrialStore, tmp_path: Path) -> None:
    again = run(tmp_path)
    assert again.episodes_path.read_bytes() == undisturbed.episodes_path.read_bytes()
    assert again.evaluation_path.read_bytes() == undisturbed.evaluation_path.read_bytes()
    np.testing.assert_equal(final_tree(again), final_tree(undisturbed))


def assert_pieces_make_the_whole(folder: Path, spec: TrialSpec, stops: tuple[int, ...]) -> None:
    """That a trial stopped and resumed at ``stops`` leaves the bytes of one that never was."""
    whole = run(folder / "whole", spec)
    pieces = run(folder / "pieces", spec, stops=stops)
    assert pieces.record().attempt == len(stops) + 1
    assert whole.episodes_path.stat().st_size > 0
    assert pieces.episodes_path.read_bytes() == whole.episodes_path.read_bytes()
    assert pieces.events() == whole.events()
    assert pieces.evaluation_path.read_bytes() == whole.evaluation_path.read_bytes()
    np.testing.assert_equal(final_tree(pieces), final_tree(whole))


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device")
def test_a_trial_without_the_gpu_that_it_is_to_learn_on_fails(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "sweep").trial(SPEC)
    assert run_recorded(SPEC, store, should_stop=never, on_gpu=True) is TrialStatus.FAILED
    assert "cannot use a GPU here; install torch with CUDA and a driver" in str(store.record().error)
    assert run_recorded(SPEC, store, should_stop=never) is TrialStatus.COMPLETE
    attempts = json.loads(store.provenance_path.read_text())["attempts"]
    assert [attempt["device"] for attempt in attempts] == ["cpu"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("task", ["two-state", "continuous-bandit", "PointGoal2"])
@pytest.mark.parametrize("agent", sorted(AGENTS))
def test_a_trial_on_a_gpu_is_resumed_there_and_on_a_cpu(agent: str, task: str, tmp_path: Path) -> None:
    spec = replace(SPEC, agent=Choice(agent, QUICK), task=Choice(task))
    whole = run(tmp_path / "whole", spec, on_gpu=True)
    pieces = run(tmp_path / "pieces", spec, stops=(7, 5), on_gpu=True)
    moved = SweepStore(tmp_path / "moved", "sweep").trial(spec)
    assert run_recorded(spec, moved, should_stop=stop_after(7), on_gpu=True) is TrialStatus.WAITING
    assert run_recorded(spec, moved, should_stop=never) is TrialStatus.COMPLETE
    np.testing.assert_equal(final_tree(pieces), final_tree(whole))
    assert pieces.evaluation_path.read_bytes() == whole.evaluation_path.read_bytes()
    assert len(pd.read_csv(moved.updates_path)) == spec.num_updates


@pytest.mark.parametrize(
    ("agent", "method"), [*product(["ppo-lag"], TEACHERS), *product(["cpo"], ["linear", "dynamic"])]
)
def test_interrupted_equals_uninterrupted(tmp_path: Path, agent: str, method: str) -> None:
    options = {"window": 8} if method == "dynamic" else {}
    spec = replace(SPEC, agent=Choice(agent, QUICK), method=Choice(method, options))
    assert_pieces_make_the_whole(tmp_path, spec, stops=(1, 0, 7, 11))


@pytest.mark.parametrize("agent", sorted(set(AGENTS) - {"ppo-lag", "cpo"}))
def test_every_other_agent_interrupted_equals_itself_uninterrupted(tmp_path: Path, agent: str) -> None:
    spec = replace(SPEC, agent=Choice(agent, QUICK))
    assert_pieces_make_the_whole(tmp_path, spec, stops=(1, 8))


@pytest.mark.parametrize("agent", ["ppo-lag", "cpo"])
@pytest.mark.parametrize("task", ["rivergrid-1b", "CarGoal2", "CarButton2", "CarPush2", "PointGoal1"])
def test_physics_and_maps_interrupted_equal_themselves_uninterrupted(
    tmp_path: Path, agent: str, task: str
) -> None:
    spec = replace(
        SPEC,
        task=Choice(task, {"horizon": 25}),
        agent=Choice(agent, QUICK),
        method=Choice("dynamic", {"window": 2, "start_fraction": 0.01}),
        train_steps=7 * 60,
    )
    assert_pieces_make_the_whole(tmp_path, spec, stops=(1, 3, 0))


def test_killed_and_resumed_equals_undisturbed(undisturbed: TrialStore, tmp_path: Path) -> None:
    program = (
        "import json, sys, threading; from pathlib import Path\n"
        "from recrl.orchestrator.spec import TrialSpec\n"
        "from recrl.orchestrator.files.sweep_store import SweepStore\n"
        "from recrl.orchestrator.trial.attempt import run_recorded\n"
        "spec = TrialSpec.from_json(json.loads(sys.argv[2]))\n"
        "store = SweepStore(Path(sys.argv[1]), 'sweep').trial(spec)\n"
        "asked = iter(range(99))\n"
        "hang = lambda: next(asked) >= 3 and threading.Event().wait()\n"
        "run_recorded(spec, store, should_stop=hang, commit_seconds=0.0)\n"
    )
    store = SweepStore(tmp_path, "sweep").trial(SPEC)
    process = subprocess.Popen([sys.executable, "-c", program, str(tmp_path), json.dumps(SPEC.to_json())])
    deadline = time.monotonic() + 300.0  # torch is imported
    while store.record().update < 3 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert store.record().status is TrialStatus.RUNNING  # it had no time to say otherwise
    assert store.record().update == 3
    assert run_recorded(SPEC, store, should_stop=never) is TrialStatus.COMPLETE
    assert store.episodes_path.read_bytes() == undisturbed.episodes_path.read_bytes()
    np.testing.assert_equal(final_tree(store), final_tree(undisturbed))


def test_a_trial_sets_pytorch_and_leaves_it_the_settings_it_had(
    tmp_path: Path, undisturbed: TrialStore
) -> None:
    store, seen = SweepStore(tmp_path, "sweep").trial(SPEC), set()

    def look() -> bool:
        seen.add((torch.get_num_threads(), torch.get_default_dtype()))
        return False

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    torch.set_default_dtype(torch.float64)
    try:
        with torch.inference_mode():
            assert run_recorded(SPEC, store, should_stop=look) is TrialStatus.COMPLETE
        assert (torch.get_num_threads(), torch.get_default_dtype()) == (3, torch.float64)
    finally:
        torch.set_num_threads(before)
        torch.set_default_dtype(torch.float32)
    assert seen == {(1, torch.float32)}
    assert store.episodes_path.read_bytes() == undisturbed.episodes_path.read_bytes()


def test_code_that_changes_the_default_type_of_pytorch_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Later trials of the process, which import it no more, would have float32."""
    (tmp_path / "own_double.py").write_text(
        "import torch\n"
        "from recrl.agents.registry import AGENTS\n"
        "torch.set_default_dtype(torch.float64)\n"
        "MINE = AGENTS['ppo']\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    store = SweepStore(tmp_path, "sweep").trial(spec := replace(SPEC, agent=Choice("own_double:MINE")))
    assert run_recorded(spec, store, should_stop=never) is TrialStatus.FAILED
    assert "sets PyTorch's default type to torch.float64; trials compute in float32" in store.record().error
    assert torch.get_default_dtype() is torch.float32


def test_the_last_part_is_deployment_under_the_deploy_limits(undisturbed: TrialStore) -> None:
    updates = undisturbed.updates()
    assert updates["phase"].tolist() == ["training"] * 19 + ["deployment"]
    assert updates["end_step"].tolist() == [60 * i for i in range(1, 21)]
    assert updates["limit_0"].iloc[-1] == 3.0
    assert updates["noise"].iloc[-1] == 0.0


def test_limits_start_where_the_teacher_measured_and_never_rise(undisturbed: TrialStore) -> None:
    limits = undisturbed.updates()["limit_0"]
    assert np.isinf(limits.iloc[0])
    assert limits.is_monotonic_decreasing
    assert undisturbed.record().start_limits is not None
    assert [event["event"] for event in undisturbed.events()] == ["start limits measured"]


def test_a_limit_that_falls_at_once_when_training_ends_is_an_event(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = TeacherKind("d_t, then d_d.", NoConfig, step_teacher)
    monkeypatch.setitem(TEACHERS, "mine", kind)
    own = replace(SPEC, method=Choice("mine"), train_limits=CostLimits((50.0,)))
    (event,) = run(tmp_path, own).events()
    assert event["event"] == "hard landing"
    assert (event["limits"], event["deploy_limits"]) == ([50.0], SPEC.deploy_limits.to_json())
    monkeypatch.setitem(TEACHERS, "mine", replace(kind, is_control=True))
    assert run(tmp_path / "control", own).events() == []
    assert run(tmp_path / "soft", replace(SPEC, method=Choice("none"))).events() == []
    monkeypatch.setitem(TEACHERS, "mine", kind)
    assert run(tmp_path / "no-deployment", replace(own, train_steps=1200, deploy_steps=0)).events() == []
    # a limit that falls steadily is a little above d_d in the last update
    linear = run(
        tmp_path / "linear", replace(SPEC, method=Choice("linear"), train_limits=CostLimits((50.0,)))
    )
    assert linear.updates()["limit_0"].iloc[-2] > 1.1 * SPEC.deploy_limits[0]
    assert linear.events() == []


def test_every_episode_is_recorded_once_with_its_place(undisturbed: TrialStore) -> None:
    episodes = undisturbed.episodes()
    assert episodes["index"].tolist() == list(range(len(episodes)))
    # 20 updates of 15 steps make 30 episodes of 10 steps in each of 4 environments.
    assert len(episodes) == 120
    assert episodes["end_step"].tolist() == [40 * i for i in range(1, 31) for _ in range(4)]
    assert (episodes["length"] == 10).all()
    assert undisturbed.updates()["episodes"].sum() == 120


def test_an_update_reports_the_mean_of_its_episodes(undisturbed: TrialStore) -> None:
    episodes = undisturbed.episodes()
    third = episodes[(episodes["end_step"] > 120) & (episodes["end_step"] <= 180)]
    row = undisturbed.updates().iloc[2]
    assert row["episode_return"] == pytest.approx(third["episode_return"].mean())
    assert row["cost_0"] == pytest.approx(third["cost_0"].mean())


def test_methods_of_a_seed_start_alike(undisturbed: TrialStore, tmp_path: Path) -> None:
    other = run(tmp_path, replace(SPEC, method=Choice("none")))
    columns = ["end_step", "length", "episode_return", "cost_0"]
    first = undisturbed.episodes()["end_step"] <= SPEC.steps_per_update
    pd.testing.assert_frame_equal(
        undisturbed.episodes().loc[first, columns], other.episodes().loc[first, columns]
    )


def test_what_entropy_was_worth_is_recorded_and_ends_with_the_heat(tmp_path: Path) -> None:
    spec = replace(SPEC, method=Choice("cooling", {"temperature": 2.0, "cooled": 0.5}))
    updates = run(tmp_path, spec).updates()
    # 19 updates of training; what the teacher says after an update counts in the next. The first has none.
    expected = [0.0, *(2.0 * max(0.0, 1.0 - update / 9.5) for update in range(1, 20))]
    assert updates["entropy_coefficient"].tolist() == pytest.approx(expected)
    assert updates["limit_0"].tolist() == pytest.approx([7.5, *(3.0 + 2.25 * each for each in expected[1:])])
    assert "entropy_coefficient" not in run(tmp_path).updates()


class Opaque:
    """A user's teacher whose state has keys of our own teachers, and means other things by them."""

    def __init__(self, spec: TeacherSpec) -> None:
        self._teacher = make_teacher(spec)

    def start(self) -> tuple[CurriculumStep, TeacherState]:
        return self._hidden(*self._teacher.start())

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        return self._hidden(*self._teacher.step(state["limits"], report))

    def _hidden(self, step: CurriculumStep, state: TeacherState) -> tuple[CurriculumStep, TeacherState]:
        return step, {"limits": state, "temperature": "warm", "start_limits": "mine", "policy_noise": 3.0}


def test_a_teachers_state_is_opaque_to_the_trial(undisturbed: TrialStore, tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "sweep").trial(SPEC)
    teacher = Opaque(SPEC.teacher)
    assert run_recorded(SPEC, store, should_stop=stop_after(5), teacher=teacher) is TrialStatus.WAITING
    assert run_recorded(SPEC, store, should_stop=never, teacher=teacher) is TrialStatus.COMPLETE
    assert store.episodes_path.read_bytes() == undisturbed.episodes_path.read_bytes()
    assert list(store.updates()) == list(undisturbed.updates())
    assert store.record().start_limits == undisturbed.record().start_limits
    assert [event["event"] for event in store.events()] == ["start limits measured"]


def test_the_names_of_several_costs_are_recorded(undisturbed: TrialStore, tmp_path: Path) -> None:
    spec = replace(
        SPEC,
        task=Choice("two-state-2", {"horizon": 10}),
        train_limits=CostLimits((9.0, 9.0)),
        deploy_limits=CostLimits((3.0, 3.0)),
    )
    store = SweepStore(tmp_path, "sweep").trial(spec)
    assert run_recorded(spec, store, should_stop=stop_after(1)) is TrialStatus.WAITING
    assert run_recorded(spec, store, should_stop=stop_after(1)) is TrialStatus.WAITING
    assert [attempt["cost_names"] for attempt in store.provenance()] == [["wear", "noise"]] * 2
    assert [attempt["attempt"] for attempt in store.provenance()] == [1, 2]
    assert all(attempt["packages"] for attempt in store.provenance())
    assert "cost_names" not in undisturbed.provenance()[0]


class Rising:
    """A curriculum of the user's own that raises its limit after update 2."""

    def start(self) -> tuple[CurriculumStep, TeacherState]:
        return CurriculumStep(CostLimits((9.0,))), {"update": 0}

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        limit = 9.0 if report.update < 2 else 12.0
        return CurriculumStep(CostLimits((limit,))), {"update": report.update}


def test_a_limit_that_rises_fails_the_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TEACHERS, "mine", TeacherKind("9, then 12.", NoConfig, lambda _: Rising()))
    spec = replace(SPEC, method=Choice("mine", label="rising"))
    store = SweepStore(tmp_path, "sweep").trial(spec)
    assert run_recorded(spec, store, should_stop=never) is TrialStatus.FAILED
    assert store.record().error == (
        "ValueError: curriculum rising: the limit of wear rose from 9 to 12 after update 2; limits may only "
        "fall (in update 2; no checkpoint before it)"
    )


class Warming(Rising):
    """A curriculum of the user's own that rewards entropy only after update 2."""

    def step(self, state: TeacherState, report: ProgressReport) -> tuple[CurriculumStep, TeacherState]:
        coefficient = None if report.update < 2 else 0.5
        return CurriculumStep(CostLimits((9.0,)), 0.0, coefficient), {"update": report.update}


def test_a_curriculum_that_rewards_entropy_declares_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = TeacherKind("Entropy from update 3 on.", NoConfig, lambda _: Warming())
    spec = replace(SPEC, method=Choice("mine"), train_steps=4 * 60)
    monkeypatch.setitem(TEACHERS, "mine", kind)
    store = SweepStore(tmp_path, "sweep").trial(spec)
    assert run_recorded(spec, store, should_stop=never) is TrialStatus.FAILED
    assert store.record().error.startswith(
        "TypeError: curriculum mine: a step has an entropy_coefficient, so its TeacherKind must have "
        "rewards_entropy=True"
    )
    monkeypatch.setitem(TEACHERS, "mine", replace(kind, rewards_entropy=True))
    assert run(tmp_path / "declared", spec).updates()["entropy_coefficient"].tolist() == [0, 0, 0.5, 0.5, 0]


def test_a_curriculum_that_measures_its_start_declares_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(TEACHERS, "mine", replace(TEACHERS["linear"], measures_start=False))
    spec = replace(SPEC, method=Choice("mine"))
    store = SweepStore(tmp_path, "sweep").trial(spec)
    assert run_recorded(spec, store, should_stop=never) is TrialStatus.FAILED
    assert store.record().error.startswith(
        "TypeError: curriculum mine: start_limits came after the first step, so its TeacherKind must have "
        "measures_start=True"
    )


def test_an_agent_whose_entropy_cannot_be_rewarded_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_it(*arguments: Any) -> SimpleNamespace:
        agent = make_agent(*arguments)
        return SimpleNamespace(act=agent.act, update=agent.update, state_dict=agent.state_dict)

    monkeypatch.setattr("recrl.orchestrator.trial.trial.make_agent", without_it)
    spec = replace(SPEC, method=Choice("cooling"))
    store = SweepStore(tmp_path, "sweep").trial(spec)
    assert run_recorded(spec, store, should_stop=never) is TrialStatus.FAILED
    assert "method cooling rewards entropy, which agent ppo-lag does not support" in store.record().error


def test_both_frozen_policies_are_evaluated(undisturbed: TrialStore) -> None:
    counts = undisturbed.evaluation().groupby("policy").size().to_dict()
    assert counts == {"stochastic": 6, "deterministic": 6}


def test_a_finite_tasks_final_policy_is_written_as_a_table(undisturbed: TrialStore) -> None:
    table = undisturbed.policy()
    assert list(table) == ["action_0", "action_1"]
    assert table.sum(axis=1).tolist() == pytest.approx([1.0, 1.0])  # a row a state: camp and mine


def test_a_task_that_is_not_finite_has_no_table(tmp_path: Path) -> None:
    task = Choice("continuous-bandit")
    store = run(tmp_path, replace(SPEC, task=task, train_steps=60, rollout_steps=15))
    assert store.policy().empty


def test_a_finished_trial_learns_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = run(tmp_path)
    paths = store.episodes_path, store.evaluation_path
    before = [path.read_bytes() for path in paths]
    monkeypatch.setattr(Trial, "advance", Mock(side_effect=AssertionError))
    assert run_recorded(SPEC, store, should_stop=never) is TrialStatus.COMPLETE
    assert [path.read_bytes() for path in paths] == before


def test_a_trial_that_is_stopped_in_its_evaluation_is_evaluated_by_the_next_launch(
    undisturbed: TrialStore, tmp_path: Path
) -> None:
    stopped = SweepStore(tmp_path, "sweep").trial(SPEC)
    state = run_recorded(SPEC, stopped, should_stop=stop_after(SPEC.num_updates + 1))
    assert state is TrialStatus.WAITING
    assert stopped.record().update == SPEC.num_updates
    assert not stopped.evaluation_path.exists()
    assert run_recorded(SPEC, stopped, should_stop=never) is TrialStatus.COMPLETE
    assert stopped.evaluation_path.read_bytes() == undisturbed.evaluation_path.read_bytes()


@pytest.mark.parametrize(
    "interrupted",
    ["recrl.orchestrator.trial.trial.Trial.advance", "recrl.environments.plugins.import_module"],
    ids=["training", "importing the task"],
)
def test_a_trial_that_sigterm_interrupts_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: TrialStore, interrupted: str
) -> None:
    store = SweepStore(tmp_path, "sweep").trial(SPEC)
    with monkeypatch.context() as ended:
        ended.setattr(interrupted, Mock(side_effect=SystemExit(1)))
        state = run_recorded(SPEC, store, should_stop=never, is_interrupted=lambda: True)
        assert state is TrialStatus.WAITING
    record = store.record()
    assert (record.status, record.error, store.error_path.exists()) == (TrialStatus.WAITING, "", False)
    assert run_recorded(SPEC, store, should_stop=never) is TrialStatus.COMPLETE
    assert store.evaluation_path.read_bytes() == undisturbed.evaluation_path.read_bytes()


@pytest.mark.parametrize("failing", [False, True])
def test_environments_are_closed_and_an_error_of_that_fails_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: bool
) -> None:
    closed = []

    def close(environments: CMDPVectorEnv, **_: object) -> None:
        closed.append(environments)
        if failing:
            raise OSError("the simulator is gone")

    monkeypatch.setattr(FiniteVectorEnv, "close_extras", close)
    store = SweepStore(tmp_path, "small").trial(SPEC)
    assert run_recorded(SPEC, store, should_stop=lambda: False) is TrialStatus.COMPLETE
    assert len(closed) == 3  # of the training, and of two evaluations


def test_environments_are_closed_if_the_agent_cannot_be_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = []
    monkeypatch.setattr(FiniteVectorEnv, "close_extras", lambda self, **_: closed.append(self))
    monkeypatch.setattr(trial, "make_agent", Mock(side_effect=ValueError("no agent")))
    store = SweepStore(tmp_path, "small").trial(SPEC)
    assert run_recorded(SPEC, store, should_stop=never) is TrialStatus.FAILED
    assert len(closed) == 1


@pytest.mark.parametrize(("episodes", "environments"), [(3, 3), (4, 4), (6, 4)])
def test_an_evaluation_of_few_episodes_makes_no_environment_that_it_does_not_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, episodes: int, environments: int
) -> None:
    evaluated = []

    def watched(actor: FinalPolicy, made: CMDPVectorEnv, *rest: Any, **named: Any) -> Any:
        evaluated.append(made.num_envs)
        return evaluate(actor, made, *rest, **named)

    monkeypatch.setattr(trial, "evaluate", watched)
    run(tmp_path, replace(SPEC, evaluation_episodes=episodes))
    assert evaluated == [environments, environments]  # stochastic and deterministic


def test_a_trial_that_raises_is_failed_with_its_traceback(tmp_path: Path) -> None:
    spec = replace(SPEC, agent=Choice("ppo-lag", {**SMALL, "hidden_sizes": ["not a number"]}))
    store = SweepStore(tmp_path, "sweep").trial(spec)
    assert run_recorded(spec, store, should_stop=never) is TrialStatus.FAILED
    assert "not a number" in store.record().error
    assert "Traceback" in store.error_path.read_text()
    assert "failed; rows and checkpoint end at the last commit" in store.log_path.read_text()


def test_the_run_says_what_it_was_made_of(undisturbed: TrialStore) -> None:
    assert '"torch"' in undisturbed.provenance_path.read_text()


def test_the_speed_is_that_of_whole_updates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Updates of 440 steps take 1.1 seconds, the last one 9.9; a beat comes some time after each."""
    clock, running, writer = SimpleNamespace(now=0.0), SimpleNamespace(update=0, env_steps=0), Mock()
    monkeypatch.setattr(attempt, "time", SimpleNamespace(monotonic=lambda: clock.now))
    life = attempt._SignsOfLife(writer)
    life.of(running)  # type: ignore[arg-type]
    speeds = []
    for number in range(1, 102):
        clock.now = 1.1 * number if number <= 100 else 110.0 + 9.9
        running.env_steps += 440
        life.advanced()
        clock.now += 0.3 * (number % 3)
        life.beat()
        speeds.append(writer.heartbeat.call_args.kwargs["steps_per_second"])
    assert speeds[:100] == pytest.approx([400.0] * 100)
    assert speeds[100] == pytest.approx(440 * 20 / 30.8)  # of at least 30 seconds
