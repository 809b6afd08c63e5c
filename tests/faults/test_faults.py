"""What goes wrong with machines and numbers: each is made to happen, and nothing committed is lost."""

import fcntl
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO

import pytest

from recrl.environments.cmdp import CostLimits
from recrl.orchestrator.errors import LostLeaseError, StorageError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.scratch import EMPTY_SECONDS, LOCK, remove_dead, scratch_folder
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.run_sweep import SweepRunSettings, run_sweep
from recrl.orchestrator.spec import Choice, TrialSpec, TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.orchestrator.trial.attempt import run_recorded
from recrl.orchestrator.trial.heartbeat import Heartbeat

SPEC = TrialSpec(
    task=Choice("two-state", {"horizon": 10}),
    agent=Choice("ppo-lag", {"hidden_sizes": [128]}),
    method=Choice("linear"),
    train_limits=CostLimits((9.0,)),
    deploy_limits=CostLimits((3.0,)),
    train_steps=19 * 40,
    deploy_steps=40,
    num_envs=4,
    rollout_steps=10,
    evaluation_episodes=4,
    seed=0,
)

# A task of the user's own that takes long to make: until somebody has heard of its trial.
SLOW_TASK = """\
import time
from pathlib import Path
from recrl.environments.finite.two_state import TwoStateOptions, make_two_state
from recrl.environments.registry import Task

STATE = Path({state!r})
heard = False

def make(name, num_envs, options):
    global heard
    before, end = STATE.read_bytes(), time.monotonic() + 30.0
    while not heard and time.monotonic() < end:
        heard = STATE.read_bytes() != before
    return make_two_state("two-state", num_envs, options)

TASK = Task("Slow.", TwoStateOptions, make)
"""

# A task of the user's own whose rewards are no numbers from the twelfth step on.
POISONED_TASK = """\
import numpy as np
from recrl.environments.finite.two_state import TwoStateOptions, make_two_state
from recrl.environments.registry import Task

def make(name, num_envs, options):
    environments = make_two_state("two-state", num_envs, options)
    step, steps = environments.step, iter(range(1, 10**9))
    def poisoned(actions):
        observations, rewards, *rest = step(actions)
        return observations, rewards + (np.nan if next(steps) == 42 else 0.0), *rest
    environments.step = poisoned
    return environments

TASK = Task("Poisoned.", TwoStateOptions, make)
"""


def never() -> bool:
    return False


def after(updates: int) -> Iterator[bool]:
    """What ``should_stop`` answers, so that a trial stops after some updates."""
    yield from [False] * updates
    while True:
        yield True


def results(store: TrialStore) -> list[bytes]:
    return [path.read_bytes() for path in (store.episodes_path, store.events_path, store.evaluation_path)]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> TrialStore:
    store = SweepStore(tmp_path_factory.mktemp("undisturbed"), "sweep").trial(SPEC)
    assert run_recorded(SPEC, store, should_stop=never) is TrialStatus.COMPLETE
    return store


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if os.getuid() or subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("only root may mount a small file system to fill")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(folder: Path) -> Path:
    """Take all room of a file system, to the last byte."""
    path = folder / "ballast"
    with path.open("wb", buffering=0) as file:
        for size in (65_536, 4_096, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                pass
    return path


def test_a_trial_on_a_full_disk_waits_and_goes_on_exactly(small_disk: Path, undisturbed: TrialStore) -> None:
    store = SweepStore(small_disk, "sweep").trial(SPEC)
    answers = after(5)
    assert run_recorded(SPEC, store, should_stop=lambda: next(answers)) is TrialStatus.WAITING
    committed = store.episodes_path.read_bytes()
    ballast: list[Path] = []

    def fill_up_after(updates: Iterator[bool]) -> bool:
        if next(updates) and not ballast:
            ballast.append(fill(small_disk))
        return False

    answers = after(3)
    state = run_recorded(SPEC, store, should_stop=lambda: fill_up_after(answers), commit_seconds=0.0)
    assert state is TrialStatus.WAITING
    record = store.record()
    assert record.status is TrialStatus.WAITING  # the reserve had room for the last words
    assert record.error == (
        f"{SPEC.folder_name}: its files cannot be written (No space left on device); it goes on from "
        "update 8 when there is room and the sweep is launched again"
    )
    assert store.episodes()["index"].tolist() == list(range(8 * 4))
    assert store.episodes_path.read_bytes().startswith(committed)

    fill(small_disk)  # what the reserve gave up as well: not even an attempt can begin
    assert run_recorded(SPEC, store, should_stop=never) is TrialStatus.WAITING
    ballast[0].unlink()
    assert run_recorded(SPEC, store, should_stop=never) is TrialStatus.COMPLETE
    assert results(store) == results(undisturbed)
    assert store.record().error == ""
    assert not store.reserve_path.exists()


def test_what_a_full_disk_keeps_from_being_said_hides_nothing(
    small_disk: Path, caplog: pytest.LogCaptureFixture
) -> None:
    class Dying:
        def run(self, specs: object, place: SweepPlace, stop: threading.Event) -> None:
            place.store.trial(SPEC).begin(SPEC).store.reserve_path.unlink()
            fill(small_disk)
            raise ArithmeticError("the first error")

    from recrl.orchestrator.grid.checking import parse_grid  # noqa: PLC0415

    text = (
        "name: sweep\ntasks: [{name: two-state, options: {horizon: 10}, deploy_limits: 3}]\nagents: "
        "[{name: ppo-lag}]\nmethods: [linear]\nseeds: 1\nrun: {total_steps: 800, num_envs: 4}\n"
    )
    grid = parse_grid(text.encode(), source="grid.yaml")
    with pytest.raises(ArithmeticError, match="the first error"):
        place = SweepPlace(SweepStore(small_disk, "sweep"))
        run_sweep(SweepRunSettings(grid, place, Dying()), stop=threading.Event())
    with pytest.raises(StorageError, match=r"cannot be written \(No space left on device\); it starts anew"):
        SweepStore(small_disk, "sweep").trial(SPEC).set_status(TrialStatus.WAITING)


def test_a_limit_on_the_size_of_files_is_a_full_disk(tmp_path: Path, undisturbed: TrialStore) -> None:
    """Needs no rights: the checkpoint does not fit, and what was committed stays."""
    store = SweepStore(tmp_path, "sweep").trial(SPEC)
    answers = after(5)
    run_recorded(SPEC, store, should_stop=lambda: next(answers))
    checkpoint = store.checkpoints()[0]
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    room = max(checkpoint.stat().st_size - 1, 17_000)
    assert room < checkpoint.stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
    try:
        assert run_recorded(SPEC, store, should_stop=never, commit_seconds=0.0) is TrialStatus.WAITING
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "(File too large); it goes on from update 5 when" in store.record().error
    assert store.checkpoints() == [checkpoint]
    assert run_recorded(SPEC, store, should_stop=never) is TrialStatus.COMPLETE
    assert results(store) == results(undisturbed)


def test_numbers_that_break_down_are_located(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_poisoned_task.py").write_text(POISONED_TASK)
    monkeypatch.syspath_prepend(tmp_path)
    spec = replace(SPEC, task=Choice("my_poisoned_task:TASK", {"horizon": 10}))
    store = SweepStore(tmp_path, "sweep").trial(spec)
    assert run_recorded(spec, store, should_stop=never, commit_seconds=0.0) is TrialStatus.FAILED
    record = store.record()
    assert record.error == (
        "TaskOutputError: the task my_poisoned_task:TASK returned a reward of nan at step 1 of the rollout "
        "in environment 0 (4 of 40 numbers); all must be finite (in update 5; the last good checkpoint is "
        "that of update 4)"
    )
    assert "in update 5" in store.error_path.read_text()
    assert store.updates()["update"].tolist() == [1, 2, 3, 4]
    assert store.latest_checkpoint() is not None


def test_a_thread_that_works_is_heard_and_one_that_waits_is_not() -> None:
    heard = threading.Event()
    with Heartbeat(heard.set, seconds=0.005).beating():
        end = time.monotonic() + 30.0
        while not heard.is_set() and time.monotonic() < end:
            pass  # works
        assert heard.is_set()
    heard.clear()
    with Heartbeat(heard.set, seconds=0.05).beating():
        assert not heard.wait(0.5)


def test_a_trial_that_takes_long_to_begin_is_heard_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = replace(SPEC, task=Choice("my_slow_task:TASK", {"horizon": 10}))
    store = SweepStore(tmp_path, "sweep").trial(spec)
    (tmp_path / "my_slow_task.py").write_text(SLOW_TASK.format(state=str(store.state_path)))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("recrl.orchestrator.trial.attempt.HEARTBEAT_SECONDS", 0.01)
    assert run_recorded(spec, store, should_stop=lambda: True) is TrialStatus.WAITING
    assert sys.modules["my_slow_task"].heard


def test_a_trial_that_was_taken_over_learns_it_from_its_heartbeat() -> None:
    asked = threading.Event()

    def refuse() -> None:
        asked.set()
        raise LostLeaseError("another attempt runs this trial now")

    def work(heartbeat: Heartbeat) -> None:
        end = time.monotonic() + 30.0
        while time.monotonic() < end:
            heartbeat.check()

    heartbeat = Heartbeat(refuse, seconds=0.005)
    with heartbeat.beating(), pytest.raises(LostLeaseError):
        work(heartbeat)
    assert asked.is_set()


def test_folders_of_dead_processes_are_removed_and_no_others(tmp_path: Path) -> None:
    program = (
        "import os, signal, sys; from recrl.orchestrator.files.scratch import scratch_folder\n"
        "with scratch_folder(sys.argv[1]): os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False)
    [dead] = tmp_path.iterdir()
    (tmp_path / "recrl-demo").mkdir()  # a user's own, with the lock of a sweep
    (tmp_path / "recrl-demo" / "lock").touch()
    with scratch_folder(str(tmp_path)) as first, scratch_folder(str(tmp_path)) as second:
        assert not dead.exists()
        assert first.exists() and second.exists()
        with (first / LOCK).open("r+") as lock, pytest.raises(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    assert [path.name for path in tmp_path.iterdir()] == ["recrl-demo"]


def test_a_folder_with_a_prefix_of_its_own_is_removed_only_with_its_processes(tmp_path: Path) -> None:
    """A launch beside a killed one must not remove the only trace of the processes that Ray left."""
    program = (
        "import os, signal, sys; from recrl.orchestrator.files.scratch import scratch_folder\n"
        "with scratch_folder(sys.argv[1], prefix='recrl-ray-'): os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False)
    [dead] = tmp_path.iterdir()
    with scratch_folder(str(tmp_path)):
        assert dead.exists()
    ended: list[Path] = []
    with scratch_folder(str(tmp_path), prefix="recrl-ray-", before_removal=ended.append):
        assert not dead.exists()
    assert ended == [dead]


def test_a_scratch_folder_that_another_process_removes_before_it_is_locked_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = fcntl.flock

    def late(descriptor: IO[str], operation: int) -> None:
        monkeypatch.setattr(fcntl, "flock", lock)
        remove_dead(str(tmp_path))  # its lock is free
        lock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    with scratch_folder(str(tmp_path)) as folder:
        (folder / "file").touch()
        assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.parametrize("moment", ["before its lock was there", "while it was removed"])
def test_a_scratch_folder_whose_process_was_interrupted_is_removed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    """Ctrl-C, twice: the second one comes while the first is being answered."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(*((fcntl, "flock") if "before" in moment else (shutil, "rmtree")), interrupted)
        with scratch_folder(str(tmp_path)) as folder:
            (folder / "ray").mkdir()
            (folder / "ray" / "session").touch()
    [left] = tmp_path.glob("recrl-*")
    if "before" in moment:
        (left / LOCK).unlink()
    old = time.time() - 2 * EMPTY_SECONDS
    os.utime(left, (old, old))
    with scratch_folder(str(tmp_path)) as new:
        assert list(tmp_path.iterdir()) == [new]
    assert not list(tmp_path.iterdir())


def test_an_empty_folder_that_is_just_being_made_stays(tmp_path: Path) -> None:
    (tmp_path / "recrl-abcd1234").mkdir()
    with scratch_folder(str(tmp_path)):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["recrl-abcd1234"]


GRID = """\
name: small
tasks: [{name: two-state, deploy_limits: 3, options: {horizon: 10}}]
agents: [{name: ppo-lag, options: {hidden_sizes: [8]}}]
methods: [none, linear]
seeds: 1
run: {total_steps: 1e9, num_envs: 4, rollout_steps: 10, evaluation_episodes: 2}
resources: {cpus_per_trial: 0.5, max_concurrent: 2, silence_seconds: 6}
"""


def test_a_hung_trial_starts_again_and_a_signal_to_the_group_saves_them_all(tmp_path: Path) -> None:
    """A process is stopped and does not come back: it is killed. Then ``timeout`` signals everybody."""
    (tmp_path / "grid.yaml").write_text(GRID)
    command = [sys.executable, "-m", "recrl", "launch", "grid.yaml"]
    store = SweepStore(tmp_path / "runs", "small")
    process = subprocess.Popen(
        [*command, "--no-mlflow", "--no-figures"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "TMPDIR": str(tmp_path), "OMP_NUM_THREADS": "1"},
        start_new_session=True,  # its own process group, as a shell's job or timeout's child has
    )

    def wait_for(what: str) -> None:
        end = time.monotonic() + 300.0
        while not conditions[what]() and time.monotonic() < end:
            assert process.poll() is None, process.stdout and process.stdout.read()
            threading.Event().wait(0.05)
        assert conditions[what](), what

    def attempts() -> list[int]:
        return [trial.record().attempt for trial in store.trials()]

    conditions = {
        "both run": lambda: (
            len(attempts()) == 2 and all(trial.record().update >= 5 for trial in store.trials())
        ),
        "the hung one again": lambda: attempts()[0] > 1,
    }
    wait_for("both run")
    hung = store.trials()[0].record().pid
    os.kill(hung, signal.SIGSTOP)
    wait_for("the hung one again")
    assert not Path(f"/proc/{hung}").exists()
    os.killpg(process.pid, signal.SIGTERM)
    out, _ = process.communicate(timeout=60.0)
    assert process.returncode == ExitCode.STOPPED, out
    assert "Stopped; nothing is lost." in out
    for trial in store.trials():
        record = json.loads(trial.state_path.read_text())
        assert record["status"] == "waiting"
        assert record["update"] == len(trial.updates()) == trial.saved_update
    assert not list(tmp_path.glob("recrl-*"))
