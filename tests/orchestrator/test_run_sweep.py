"""A launch makes what is on disk match the grid: nothing is lost, nothing runs twice, failures stay alone."""

import os
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest

from recrl.orchestrator.errors import ClusterError, RecrlError, SweepBusyError
from recrl.orchestrator.executors import Executor, InlineExecutor
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.launch_plan import Plan, PlannedAction, TrialSelection
from recrl.orchestrator.run_sweep import (
    ONE_SIGNAL_SECONDS,
    SweepResult,
    SweepRunSettings,
    run_sweep,
    stopping_on_signals,
)
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.orchestrator.sweep_progress import SweepProgress

GRID = """\
name: small
tasks: [{name: two-state, deploy_limits: 2}]
agents: [ppo-lag]
methods: [none, linear]
seeds: 1
run: {total_steps: 120, num_envs: 4, rollout_steps: 10, evaluation_episodes: 2}
"""

# A user's own agent that breaks down as long as a file called "broken" is in the working directory.
FRAGILE_AGENT = """\
from pathlib import Path
from recrl.agents.algorithms.own_options import PPOLagConfig
from recrl.agents.algorithms.ppo_lag import make_ppo_lag
from recrl.agents.registry import AgentEntry

def make(cmdp, config, seed):
    agent = make_ppo_lag(cmdp, config, seed)
    learn = agent.update

    def update(*arguments):
        if Path("broken").exists():
            raise ArithmeticError("the policy is no longer finite")
        return learn(*arguments)

    agent.update = update
    return agent

ENTRY = AgentEntry("A fragile agent.", PPOLagConfig, make)
"""


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    return SweepStore(tmp_path / "runs", "small")


def _grid(text: str = GRID) -> GridSpec:
    return parse_grid(text.encode(), source="grid.yaml")


def _launch(store: SweepStore, grid: GridSpec | None = None, *, retry_failed: bool = False) -> SweepResult:
    stop = threading.Event()
    settings = SweepRunSettings(
        grid or _grid(), SweepPlace(store), InlineExecutor(), TrialSelection(retry_failed=retry_failed)
    )
    return run_sweep(settings, stop=stop)


def _results(store: SweepStore) -> dict[str, bytes]:
    """The episodes and evaluations of every trial."""
    return {
        str(path.relative_to(store.folder)): path.read_bytes()
        for trial in store.trials()
        for path in (trial.episodes_path, trial.evaluation_path)
    }


@dataclass(frozen=True)
class StopAfterOne:
    """An executor during which someone asks to stop while the first trial runs."""

    def run(self, specs: Sequence[TrialSpec], place: SweepPlace, stop: threading.Event) -> None:
        InlineExecutor().run(specs[:1], place, stop)
        stop.set()
        InlineExecutor().run(specs[1:], place, stop)


@dataclass(frozen=True)
class Unavailable:
    """An executor that dies with a trial in its hands."""

    def run(self, specs: Sequence[TrialSpec], place: SweepPlace, stop: threading.Event) -> None:
        place.store.trial(specs[0]).begin(specs[0])
        raise ClusterError("the cluster is gone")


@dataclass
class Bystander:
    """A sync that records the timeouts it was given."""

    patience: list[float] = field(default_factory=list)

    def stop(self, timeout: float) -> bool:
        self.patience.append(timeout)
        return True


def test_a_second_launch_has_nothing_to_do(store: SweepStore) -> None:
    first = _launch(store)
    assert first.progress.is_complete
    assert not first.failed
    before = _results(store)
    second = _launch(store)
    assert second.plan.to_do == ()
    assert second.progress.is_complete
    assert _results(store) == before
    assert all(trial.record().attempt == 1 for trial in store.trials())


def test_more_seeds_run_and_the_rest_stays(store: SweepStore) -> None:
    _launch(store)
    before = _results(store)
    result = _launch(store, _grid(GRID.replace("seeds: 1", "seeds: 2")))
    assert {spec.seed for spec in result.plan.to_do} == {1}
    assert before.items() < _results(store).items()


def test_the_folder_says_what_was_launched(store: SweepStore) -> None:
    result = _launch(store)
    assert store.grid_path.read_text() == GRID
    assert tuple(store.specs()) == _grid().trials()
    assert result.plan.counts[PlannedAction.NEW] == 2
    text = store.info_path.read_text()
    assert '"name": "small"' in text and '"created": ' in text


def test_a_stopped_sweep_goes_on_with_the_same_call(store: SweepStore, tmp_path: Path) -> None:
    stopped = run_sweep(SweepRunSettings(_grid(), SweepPlace(store), StopAfterOne()), stop=threading.Event())
    assert stopped.stopped
    assert not stopped.progress.is_complete
    again = _launch(store)
    assert [spec.method.label for spec in again.plan.to_do] == ["linear"]
    straight = SweepStore(tmp_path / "straight", "small")
    _launch(straight)
    assert _results(store) == _results(straight)


def test_one_trial_that_fails_leaves_the_others_alone(
    store: SweepStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_fragile_agent.py").write_text(FRAGILE_AGENT)
    (tmp_path / "broken").touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    agent = "{name: 'my_fragile_agent:ENTRY', label: fragile}"
    grid = _grid(GRID.replace("[ppo-lag]", f"[{agent}, ppo-lag]").replace("[none, linear]", "[none]"))
    result = _launch(store, grid)
    assert [trial.spec.agent.label for trial in result.failed] == ["fragile"]
    record, files = result.failed[0].record, store.trial(result.failed[0].spec)
    assert record.error == (
        "ArithmeticError: the policy is no longer finite (my_fragile_agent.py, line 12, in update) "
        "(in update 1; no checkpoint before it)"
    )
    assert "Traceback" in files.error_path.read_text()
    assert [trial.record.status for trial in result.progress.trials] == [
        TrialStatus.FAILED,
        TrialStatus.COMPLETE,
    ]
    (tmp_path / "broken").unlink()
    assert _launch(store, grid).plan.to_do == ()  # not tried again by itself
    assert _launch(store, grid, retry_failed=True).progress.is_complete


def test_what_a_dead_launch_left_running_is_resumed(store: SweepStore) -> None:
    spec = _grid().trials()[0]
    left = store.trial(spec).begin(spec)
    result = _launch(store)
    assert result.progress.is_complete
    assert [trial.action for trial in result.plan.trials] == [PlannedAction.RESUME, PlannedAction.NEW]
    with pytest.raises(RecrlError, match="another attempt runs this trial now"):
        left.heartbeat(update=1, env_steps=1, steps_per_second=1.0)


def test_two_launches_of_a_sweep_at_once_are_refused(store: SweepStore) -> None:
    with store.lock(), pytest.raises(SweepBusyError, match="this sweep is already being run by process"):
        _launch(store)
    assert store.trials() == []


def test_a_wrong_selection_leaves_no_trace(store: SweepStore) -> None:
    with pytest.raises(RecrlError, match="--only: no trial has method 'dynamic'"):
        only = {"method": ["dynamic"]}
        settings = SweepRunSettings(_grid(), SweepPlace(store), InlineExecutor(), TrialSelection(only=only))
        run_sweep(settings, stop=threading.Event())
    assert not store.folder.exists()


def test_the_sync_gets_its_full_timeout_after_the_figures(store: SweepStore) -> None:
    sync = Bystander()
    order: list[str] = []

    def watch(plan: Plan) -> None:
        order.append(f"{len(plan.to_do)} to do")

    def finish(after: SweepProgress) -> None:
        order.append(f"complete: {after.is_complete}, sync stopped: {bool(sync.patience)}")

    settings = SweepRunSettings(
        _grid(),
        SweepPlace(store),
        InlineExecutor(),
        start_sync=lambda _: sync,
        watch=watch,
        finish=finish,
    )
    result = run_sweep(settings, stop=threading.Event())
    assert order == ["2 to do", "complete: True, sync stopped: False"]
    assert result.synced
    assert sync.patience == [120.0]


@pytest.mark.parametrize("executor", [Unavailable(), StopAfterOne()])
def test_the_sync_gets_a_short_timeout_otherwise(store: SweepStore, executor: Executor) -> None:
    sync = Bystander()
    try:
        settings = SweepRunSettings(_grid(), SweepPlace(store), executor, start_sync=lambda _: sync)
        run_sweep(settings, stop=threading.Event())
    except ClusterError:
        assert isinstance(executor, Unavailable)
    assert sync.patience == [10.0]
    assert all(trial.record().status is not TrialStatus.RUNNING for trial in store.trials())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_signal_stops_gently_and_a_second_at_once(number: signal.Signals) -> None:
    stop, said = threading.Event(), []
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), stopping_on_signals(stop, lambda: said.append("stopping")):
        os.kill(os.getpid(), number)
        assert stop.wait(10.0)
        os.kill(os.getpid(), number)  # as `timeout` does, which also signals the process's group
        threading.Event().wait(2 * ONE_SIGNAL_SECONDS)
        os.kill(os.getpid(), number)
        threading.Event().wait(10.0)
    assert said == ["stopping"]
    assert signal.getsignal(number) is before


def test_a_second_signal_may_come_twice_as_well() -> None:
    stop = threading.Event()
    with pytest.raises(KeyboardInterrupt), stopping_on_signals(stop, lambda: None):
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(2 * ONE_SIGNAL_SECONDS)
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            threading.Event().wait(10.0)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)  # would end this process


def test_signals_at_the_same_time_are_one(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(monotonic=lambda: 0.0, sleep=lambda _: None)
    monkeypatch.setattr("recrl.orchestrator.run_sweep.time", clock)
    stop = threading.Event()
    with stopping_on_signals(stop, lambda: None):
        for _ in range(50):
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(10.0)


def test_the_first_signal_is_gentle_also_if_another_terminal_had_asked_to_stop() -> None:
    stop = threading.Event()
    stop.set()
    with stopping_on_signals(stop, lambda: None):
        os.kill(os.getpid(), signal.SIGINT)


def test_what_is_said_of_a_signal_does_not_interrupt_a_write_of_the_main_thread() -> None:
    """A buffered stream raises if a handler writes to it while the interrupted write still holds it."""
    stop, threads = threading.Event(), []
    with stopping_on_signals(stop, lambda: threads.append(threading.current_thread())):
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.wait(10.0)
    assert len(threads) == 1
    assert threads[0] is not threading.main_thread()
