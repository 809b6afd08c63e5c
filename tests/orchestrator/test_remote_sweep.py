"""A sweep in an object store is the sweep of a folder, from whatever machine it is run or looked at."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import fsspec
import numpy as np
import pytest

import recrl
from recrl.analysis.data import export
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import (
    LostLeaseError,
    RecrlError,
    StorageError,
    SweepBusyError,
)
from recrl.orchestrator.executors import InlineExecutor
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.grid.file_models import Resources
from recrl.orchestrator.launch_plan import TrialSelection
from recrl.orchestrator.ray.ray_executor import RayExecutor
from recrl.orchestrator.remote.commit_upload import Upload
from recrl.orchestrator.remote.launch_lease import SILENT_SECONDS
from recrl.orchestrator.remote.object_store import ObjectStore
from recrl.orchestrator.remote.remote_sweep import RemoteSweep
from recrl.orchestrator.remote.stop_object import StopObject
from recrl.orchestrator.run_sweep import SweepResult, SweepRunSettings, run_sweep
from recrl.orchestrator.spec import TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.orchestrator.trial.attempt import run_recorded
from recrl.orchestrator.trial.trial import Trial
from tests.faults.unreliable import Unreliable
from tests.orchestrator.launches import INLINE

GRID = """\
name: small
tasks: [{name: two-state, deploy_limits: 2}]
agents: [ppo-lag]
methods: [none, linear]
seeds: 1
run: {total_steps: 320, num_envs: 4, rollout_steps: 10, evaluation_episodes: 2}
"""


@dataclass(frozen=True)
class Machine:
    """A machine that shares nothing with others but the object store.

    Attributes:
        store: the local copy in its own folder.
        storage: the sweep, as it reaches it.
    """

    store: SweepStore
    storage: RemoteSweep

    def launch(self, *, stop: threading.Event | None = None, retry_failed: bool = False) -> SweepResult:
        self.storage.mark()
        settings = SweepRunSettings(
            grid(), self.storage, InlineExecutor(), TrialSelection(retry_failed=retry_failed)
        )
        return run_sweep(settings, stop=stop or threading.Event())


def grid() -> GridSpec:
    return parse_grid(GRID.encode(), source="grid.yaml")


def never() -> bool:
    return False


def machine(folder: Path, name: str, kind: str = "file") -> Machine:
    store = SweepStore(folder / name, "small")
    return Machine(store, RemoteSweep(f"{kind}://{folder}/bucket", store))


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> SweepStore:
    """The same sweep in a folder."""
    store = SweepStore(tmp_path_factory.mktemp("local"), "small")
    run_sweep(SweepRunSettings(grid(), SweepPlace(store), InlineExecutor()), stop=threading.Event())
    return store


@pytest.fixture(autouse=True)
def reliable() -> Iterator[None]:
    Unreliable.plan.clear()
    yield
    Unreliable.plan.clear()


def assert_equal(ours: SweepStore, theirs: SweepStore) -> None:
    """That both hold the same complete trials: rows byte for byte, parameters number for number."""
    assert [trial.spec for trial in ours.trials()] == [trial.spec for trial in theirs.trials()] != []
    for trial in theirs.trials():
        assert_equal_trial(ours.trial(trial.spec), trial)


def assert_equal_trial(ours: TrialStore, theirs: TrialStore) -> None:
    assert ours.record().status is TrialStatus.COMPLETE
    assert ours.episodes_path.read_bytes() == theirs.episodes_path.read_bytes()
    assert ours.evaluation_path.read_bytes() == theirs.evaluation_path.read_bytes()
    assert ours.events_path.read_bytes() == theirs.events_path.read_bytes()
    mine, other = ours.latest_checkpoint(), theirs.latest_checkpoint()
    assert mine is not None and other is not None
    np.testing.assert_equal(mine["trial"], other["trial"])


def test_a_sweep_in_an_object_store_is_the_sweep_of_a_folder(tmp_path: Path, local: SweepStore) -> None:
    one = machine(tmp_path, "one")
    result = one.launch()
    assert result.progress.is_complete
    assert_equal(one.store, local)
    other = machine(tmp_path, "other")
    other.storage.mark()
    other.storage.pull()
    assert_equal(other.store, local)
    assert other.store.specs() == local.specs()
    again = other.launch()
    assert again.plan.to_do == ()
    assert not [key for key in one.storage.objects.keys_in() if "probe" in key or "launch" in key]


def test_a_damaged_local_copy_says_that_it_is_one(
    tmp_path: Path, local: SweepStore, capsys: pytest.CaptureFixture[str]
) -> None:
    one = machine(tmp_path, "one")
    one.launch()
    other = machine(tmp_path, "other")
    other.storage.mark()
    other.storage.pull()
    trial = other.store.trial(grid().trials()[0])
    whole = trial.episodes_path.read_bytes()
    trial.episodes_path.write_bytes(whole[:-1])
    assert trial.record().error == (
        f"episodes.csv has {len(whole) - 1:,} of its {len(whole):,} committed bytes; the sweep's folder is "
        "only a local copy: delete it, and it is fetched again"
    )
    trial.episodes_path.write_bytes(bytes(len(whole)))  # of the right length, so it is not fetched again
    assert main(["check", str(other.store.folder)]) == ExitCode.TRIALS_FAILED
    said = capsys.readouterr().out.splitlines()[-1]
    assert said == "the folder is only a local copy: delete it, and it is fetched again"
    shutil.rmtree(other.store.folder)
    again = machine(tmp_path, "other")
    again.storage.mark()
    again.storage.pull()
    assert_equal(again.store, local)


def test_trials_in_an_object_store_are_not_run_again(tmp_path: Path) -> None:
    here = machine(tmp_path, "here")
    with pytest.raises(RecrlError, match="trials of a sweep in an object store are not run again: "):
        settings = SweepRunSettings(
            grid(), here.storage, InlineExecutor(), TrialSelection(rerun_damaged=True)
        )
        run_sweep(settings, stop=threading.Event())
    assert not here.store.folder.exists()
    (tmp_path / "grid.yaml").write_bytes(grid().text)
    plan = ["plan", str(tmp_path / "grid.yaml"), "--storage", here.storage.uri, "--root", str(tmp_path / "x")]
    assert main([*plan, "--rerun-changed"]) == ExitCode.WRONG_INPUT


@pytest.mark.parametrize(
    "mistake", [("--only", "method=nonsense"), ("--rerun-changed",), ("--address", "auto")]
)
def test_a_refused_launch_does_not_make_the_folder_a_copy(tmp_path: Path, mistake: tuple[str, ...]) -> None:
    (tmp_path / "grid.yaml").write_bytes(grid().text)
    launch = ["launch", str(tmp_path / "grid.yaml"), "--root", str(tmp_path / "runs"), *INLINE]
    storage = ("--storage", (tmp_path / "bucket").as_uri())
    assert main([*launch, *storage, *mistake]) == ExitCode.WRONG_INPUT
    assert not (tmp_path / "runs" / "small" / "storage.json").exists()
    assert not (tmp_path / "bucket").exists()


def test_a_trial_is_not_ended_before_its_signs_of_life_can_arrive(tmp_path: Path) -> None:
    here = machine(tmp_path, "here").storage
    assert here.shortest_silence_seconds == 50.0  # as the option's description says
    executor = RayExecutor(resources=Resources(silence_seconds=5.0))
    assert executor.silence_of(here) == 50.0
    assert executor.silence_of(SweepPlace(here.store)) == 5.0


def test_a_trial_stopped_again_and_again_on_other_machines_equals_itself(
    tmp_path: Path, local: SweepStore
) -> None:
    spec = grid().trials()[1]
    for number, updates in enumerate((1, 0, 3, 99)):
        here = machine(tmp_path, f"machine {number}")
        answers = iter([False] * updates + [True] * 99)
        with here.storage.working_copy(spec, never) as trial:
            run_recorded(spec, trial, should_stop=partial(next, answers))
        assert not trial.folder.exists()  # what a machine had is gone
    seen = machine(tmp_path, "seen")
    seen.storage.pull()
    assert seen.store.trial(spec).record().attempt == 4
    assert_equal_trial(seen.store.trial(spec), local.trial(spec))


def test_a_worker_that_gets_sigterm_sends_its_last_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = grid().trials()[0]
    advance, updates = Trial.advance, iter(range(3))

    def interrupted(trial: Trial) -> None:
        if next(updates, None) is None:
            raise SystemExit(1)
        advance(trial)

    monkeypatch.setattr(Trial, "advance", interrupted)
    with (
        pytest.raises(SystemExit),
        machine(tmp_path, "ended").storage.working_copy(spec, never) as trial,
    ):
        run_recorded(spec, trial, should_stop=never, is_interrupted=lambda: True, commit_seconds=0.0)
        raise SystemExit(1)  # a signal in the last instants
    seen = machine(tmp_path, "seen")
    seen.storage.pull(checkpoints=True)
    there = seen.store.trial(spec)
    assert (there.record().status, there.saved_update) == (TrialStatus.WAITING, 3)


def test_a_trial_killed_on_one_machine_goes_on_on_another(tmp_path: Path, local: SweepStore) -> None:
    spec = grid().trials()[0]
    program = (
        "import json, sys, threading\n"
        "from pathlib import Path\n"
        "from recrl.orchestrator.files.sweep_store import SweepStore\n"
        "from recrl.orchestrator.remote.remote_sweep import sweep_place\n"
        "from recrl.orchestrator.spec import TrialSpec\n"
        "from recrl.orchestrator.trial.attempt import run_recorded\n"
        "spec = TrialSpec.from_json(json.loads(sys.argv[2]))\n"
        "asked = iter(range(99))\n"
        "hang = lambda: next(asked) >= 3 and threading.Event().wait()\n"
        "place = sweep_place(SweepStore(Path('nowhere'), 'small'), sys.argv[1])\n"
        "with place.working_copy(spec, hang) as trial:\n"
        "    run_recorded(spec, trial, should_stop=hang, commit_seconds=0.0)\n"
    )
    first, seen = machine(tmp_path, "first"), machine(tmp_path, "seen")
    arguments = [first.storage.uri, json.dumps(spec.to_json())]
    process = subprocess.Popen([sys.executable, "-c", program, *arguments])
    deadline = time.monotonic() + 300.0  # torch is imported
    while seen.store.trial(spec).saved_update < 3 and time.monotonic() < deadline:
        with suppress(subprocess.TimeoutExpired):
            process.wait(0.1)
        seen.storage.pull(checkpoints=True)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert seen.store.trial(spec).record().status is TrialStatus.RUNNING  # it had no time to say otherwise
    second = machine(tmp_path, "second")
    second.launch()
    assert second.store.trial(spec).record().attempt == 2
    assert "resumed after update 3" in second.store.trial(spec).log_path.read_text()
    assert_equal(second.store, local)


def test_a_storage_that_is_down_for_a_while_loses_nothing(
    tmp_path: Path, local: SweepStore, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recrl.orchestrator.remote.retries.FIRST_PAUSE_SECONDS", 0.01)
    here = machine(tmp_path, "here", "unreliable")
    spec = grid().trials()[1]
    with here.storage.working_copy(spec, never) as trial:
        Unreliable.plan += ["refused", "cut"] * 4
        run_recorded(spec, trial, should_stop=never, commit_seconds=0.0)
    assert "cannot be written (OSError: the network is down); it is tried again for 15 minutes" in caplog.text
    here.storage.pull()
    assert_equal_trial(here.store.trial(spec), local.trial(spec))


def test_a_storage_that_stays_down_is_given_up_and_the_trial_goes_on_later(
    tmp_path: Path, local: SweepStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recrl.orchestrator.remote.retries.RETRY_SECONDS", 0.0)
    here = machine(tmp_path, "here", "unreliable")
    spec = grid().trials()[1]
    with (
        pytest.raises(StorageError, match="the network is down"),
        here.storage.working_copy(spec, never) as trial,
    ):
        Unreliable.plan += ["refused"] * 1000
        run_recorded(spec, trial, should_stop=never)
    Unreliable.plan.clear()
    here.storage.pull()
    assert here.store.trial(spec).record().status is not TrialStatus.COMPLETE
    here.launch()
    assert_equal(here.store, local)


def test_an_attempt_that_was_taken_over_ends_itself(tmp_path: Path) -> None:
    spec = grid().trials()[0]
    here, there = machine(tmp_path, "here"), machine(tmp_path, "there")
    with here.storage.working_copy(spec, never) as orphan:
        writer = orphan.begin(spec)
        deadline = time.monotonic() + 120.0
        while not here.storage.objects.keys_in("trials") and time.monotonic() < deadline:
            time.sleep(0.01)
        with there.storage.working_copy(spec, never) as successor:
            successor.begin(spec)
        writer.commit({}, update=1, env_steps=40)
        while orphan.record().token and time.monotonic() < deadline:
            time.sleep(0.01)
        with pytest.raises(LostLeaseError):
            writer.commit({}, update=2, env_steps=80)
    there.storage.pull()
    assert there.store.trial(spec).record().update == 0


def test_one_launch_at_a_time_and_a_dead_one_frees_the_sweep(tmp_path: Path) -> None:
    one, other = machine(tmp_path, "one"), machine(tmp_path, "other")
    with one.storage.held(threading.Event()):
        assert other.storage.lease.is_held()
        with pytest.raises(SweepBusyError) as error, other.storage.held(threading.Event()):
            pass
        assert str(error.value).startswith(
            f"file://{tmp_path}/bucket/small: this sweep is already being run by process {os.getpid()} on "
        )
        assert str(error.value).endswith("the sweep is free after 90 seconds of silence)")
    assert not other.storage.lease.is_held()
    elsewhere = {"host": "elsewhere", "pid": 1, "token": "1", "boot": "1"}
    for holder, free in (
        ({**elsewhere, "at": time.time()}, False),
        ({**elsewhere, "at": time.time() - SILENT_SECONDS + 10.0}, False),
        ({**elsewhere, "at": time.time() - SILENT_SECONDS - 1.0}, True),
        ({**elsewhere, "at": time.time() + SILENT_SECONDS - 10.0}, False),  # a clock that is a little ahead
        ({**elsewhere, "at": time.time() + SILENT_SECONDS + 10.0}, True),  # one that was far ahead
        ({}, True),
    ):
        one.storage.objects.write("launch.json", json.dumps(holder).encode())
        assert other.storage.lease.is_held() is not free
        if free:
            with other.storage.held(threading.Event()):
                assert other.storage.lease.is_held()


def test_a_launch_that_is_taken_over_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recrl.orchestrator.remote.launch_lease.LEASE_CHECK_SECONDS", 0.01)
    monkeypatch.setattr("recrl.orchestrator.remote.launch_lease.BEAT_SECONDS", 0.01)
    here, stop = machine(tmp_path, "here"), threading.Event()
    with here.storage.held(stop):
        taken = json.dumps(
            {"host": "elsewhere", "pid": 1, "token": "1", "boot": "", "at": time.time()}
        ).encode()
        end = time.monotonic() + 120.0
        while not stop.is_set() and time.monotonic() < end:
            here.storage.objects.write("launch.json", taken)
            stop.wait(0.05)
    assert stop.is_set()
    assert here.storage.lease.is_held()  # by the other one


def test_a_launch_is_stopped_from_another_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recrl.orchestrator.remote.launch_lease.LEASE_CHECK_SECONDS", 0.01)
    here, there, stop = machine(tmp_path, "here"), machine(tmp_path, "there"), threading.Event()
    assert not there.storage.request_stop()()
    with here.storage.held(stop):
        still_runs = there.storage.request_stop()
        assert stop.wait(30.0)
        assert still_runs()
    assert not still_runs()
    assert here.storage.objects.keys_in() == []


def test_a_trial_whose_commits_are_damaged_is_left_alone_and_the_others_go_on(
    tmp_path: Path,
    local: SweepStore,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    damaged, other = grid().trials()
    here, fresh = machine(tmp_path, "here"), machine(tmp_path, "fresh")
    with here.storage.working_copy(damaged, never) as trial:
        run_recorded(damaged, trial, should_stop=never)
    commits = [key for key in here.storage.objects.keys_in() if "/commit-" in key]
    for key in commits:
        here.storage.objects.write(key, b"damaged")
    InlineExecutor().run([damaged], fresh.storage, threading.Event())
    assert "no commit of the trial is intact, so it is left alone" in caplog.text
    result = fresh.launch()
    assert result.plan.to_do == (other,)
    assert fresh.store.trial(damaged).record().status is TrialStatus.DAMAGED
    assert_equal_trial(fresh.store.trial(other), local.trial(other))
    (tmp_path / "grid.yaml").write_text(GRID)
    arguments = [str(tmp_path / "grid.yaml"), *INLINE, "--root", str(tmp_path / "fresh")]
    assert main(["launch", *arguments]) == ExitCode.TRIALS_FAILED
    assert capsys.readouterr().out.endswith("\n1 damaged trial left alone\n")
    assert {here.storage.objects.read(key) for key in commits} == {b"damaged"}


def test_a_local_copy_is_too_old_to_judge_a_silence_by_a_third_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recrl.orchestrator.remote.remote_sweep.PULL_SECONDS", 0.0)
    here = machine(tmp_path, "here")
    assert here.storage.is_out_of_touch(0.0)
    assert not here.storage.is_out_of_touch(300.0)


def test_workers_hear_of_the_end_of_their_own_run_and_of_all_earlier_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    objects = ObjectStore(f"unreliable://{tmp_path}/bucket/small")
    with StopObject.open(objects) as earlier:
        assert not StopObject(objects, earlier.place).is_set()
        with StopObject.open(objects) as made:
            assert StopObject(objects, earlier.place).is_set()
            worker = StopObject(objects, made.place)
            assert not worker.is_set()
            Unreliable.plan.append("refused")
            made.set()
            assert not made.is_set()
            made.set()
            assert not worker.is_set()  # it asked a moment ago
            monkeypatch.setattr(StopObject, "poll_seconds", 0.0)
            assert worker.is_set()
    assert objects.keys_in() == []


def test_what_only_the_launch_knows_of_a_trial_is_seen_elsewhere(tmp_path: Path) -> None:
    here, there = machine(tmp_path, "here"), machine(tmp_path, "there")
    crashed, silent = grid().trials()
    for spec in (crashed, silent):
        with here.storage.working_copy(spec, never) as trial:
            trial.begin(spec)
    here.storage.pull()
    here.store.trial(crashed).set_status(TrialStatus.FAILED, error="failures of its process: 4")
    here.store.trial(silent).set_status(TrialStatus.WAITING)
    here.storage.send_dead_trials([crashed, silent])
    there.storage.pull()
    record = there.store.trial(crashed).record()
    assert (record.status, record.error) == (TrialStatus.FAILED, "failures of its process: 4")
    assert there.store.trial(silent).record().status is TrialStatus.WAITING


def test_damage_in_a_local_copy_is_not_sent_with_the_status_of_a_dead_trial(
    tmp_path: Path, local: SweepStore
) -> None:
    here, there = machine(tmp_path, "here"), machine(tmp_path, "there")
    spec = grid().trials()[0]
    answers = iter([False] * 3 + [True] * 99)
    with here.storage.working_copy(spec, never) as trial:
        run_recorded(spec, trial, should_stop=partial(next, answers))
        whole = trial.updates_path.read_bytes()
    with here.storage.working_copy(spec, never) as trial:
        trial.begin(spec)  # its process dies here
    here.storage.pull(checkpoints=True)
    copy = here.store.trial(spec)
    for path in (copy.updates_path, *copy.checkpoints()):
        data = path.read_bytes()
        path.write_bytes(data[:-2] + bytes([data[-2] ^ 1]) + data[-1:])
    copy.set_status(TrialStatus.FAILED, error="its process died")
    here.storage.send_dead_trials([spec])
    there.storage.mark()
    there.storage.pull()
    seen = there.store.trial(spec)
    assert (seen.record().status, seen.record().error) == (TrialStatus.FAILED, "its process died")
    assert seen.damages() == []
    assert seen.updates_path.read_bytes() == whole
    there.launch(retry_failed=True)
    assert_equal(there.store, local)


def test_a_launch_that_was_taken_over_leaves_the_trials_of_the_other_alone(tmp_path: Path) -> None:
    here, there = machine(tmp_path, "here"), machine(tmp_path, "there")
    spec = grid().trials()[0]
    trial = TrialStore(tmp_path / spec.folder_name)
    upload = Upload(there.storage.trial(spec.folder_name), trial)
    with there.storage.held(threading.Event()):
        trial.begin(spec)
        upload.push()
        here.storage.pull()
        here.store.trial(spec).set_status(TrialStatus.WAITING)
        here.storage.send_dead_trials([spec])
        upload.push()
    here.storage.send_dead_trials([spec])
    with pytest.raises(LostLeaseError):  # of a launch that is over
        upload.push()


def test_the_command_line_takes_the_address_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grid.yaml").write_text(GRID)
    uri = f"file://{tmp_path}/bucket"
    sweep = ["--only", "method=none"]
    assert main(["launch", "grid.yaml", *INLINE, *sweep, "--storage", uri]) == ExitCode.OK
    assert f"Results    runs/small, a local copy of {uri}/small\n" in capsys.readouterr().out
    elsewhere = ["--root", "elsewhere"]
    assert main(["status", "--brief", "--storage", uri, *elsewhere]) == ExitCode.OK
    assert capsys.readouterr().out == "small: 1 of 2 complete, 0 running, 1 waiting, 0 failed; 50%\n"
    assert main(["launch", "grid.yaml", *INLINE, *elsewhere]) == ExitCode.OK
    seen_here = recrl.load_sweep("small").trials["status"]
    assert seen_here.tolist() == ["complete", "complete"]  # the second ran on the other machine
    capsys.readouterr()
    assert main(["status", "--brief"]) == ExitCode.OK
    assert capsys.readouterr().out == "small: 2 of 2 complete, 0 running, 0 waiting, 0 failed\n"
    assert main(["logs", "small", "two-state ppo-lag linear", *elsewhere]) == ExitCode.OK
    assert "complete: 8 updates" in capsys.readouterr().out
    assert main(["stop", "small", *elsewhere]) == ExitCode.OK
    assert capsys.readouterr().out == "small: no launch runs this sweep\n"
    assert main(["evaluate", "small", "two-state ppo-lag none", "--root", "third", "--storage", uri]) == 0


def test_commands_that_read_take_the_address_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grid.yaml").write_text(GRID)
    uri = f"file://{tmp_path}/bucket"
    launch = ["launch", "grid.yaml", *INLINE, "--only", "method=none"]
    assert main([*launch, "--storage", uri]) == ExitCode.OK

    def read(*arguments: str) -> str:
        """What a command shows on a machine that has seen nothing of the sweep."""
        capsys.readouterr()
        root = Path("machine", arguments[0])
        assert main([*arguments, "--root", str(root), "--storage", uri]) == ExitCode.OK
        assert len(SweepStore(root, "small").trials()) == 1
        return capsys.readouterr().out

    assert "small: " in read("check", "small")
    assert "complete: 8 updates" in read("logs", "small", "two-state ppo-lag none")
    read("figures", "small", "--sketch", "--to", "drawn")
    assert list(Path("drawn").glob("learning-curves*.png"))
    read("export", "small", "--to", "small.zip")
    assert export.load(Path("small.zip")).trials["status"].tolist() == ["complete", "waiting"]


def test_a_launch_says_that_the_store_does_not_have_the_sweep_of_its_local_copy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grid.yaml").write_text(GRID)
    uri = f"file://{tmp_path}/bucket"
    some = ["launch", "grid.yaml", *INLINE, "--only", "method=none"]
    assert main([*some, "--storage", uri]) == ExitCode.OK
    (tmp_path / "bucket").rename(tmp_path / "moved")
    capsys.readouterr()
    sentence = (
        f"{uri}/small: there is no such sweep, although {tmp_path}/runs/small is a copy of its trials; "
        "restore the store, or give the sweep another name or another --root"
    )
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.CANNOT_RUN
    assert capsys.readouterr().err == f"recrl-sweep: {sentence}\n"
    assert ObjectStore(uri).keys_in() == []
    assert main(["status", "--brief"]) == ExitCode.OK
    shown = capsys.readouterr()
    assert sentence in shown.err
    assert shown.out.startswith("small: 1 of 2 complete")
    shutil.rmtree(tmp_path / "bucket")
    (tmp_path / "moved").rename(tmp_path / "bucket")
    assert main(["launch", "grid.yaml", *INLINE]) == ExitCode.OK


def test_a_folder_is_the_local_copy_of_one_address_or_none(tmp_path: Path, local: SweepStore) -> None:
    here = machine(tmp_path, "here")
    with pytest.raises(RecrlError, match=r": this sweep is kept in that folder, not at file://"):
        RemoteSweep(here.storage.uri, local).mark()
    here.storage.mark()
    here.storage.mark()
    with pytest.raises(RecrlError, match=r": this sweep is kept at file://.*/bucket, not at file:///other; "):
        RemoteSweep("file:///other", here.store).mark()


def test_a_folder_of_objects_is_not_its_own_local_copy(tmp_path: Path) -> None:
    """Deleting a damaged local copy would delete the sweep."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "runs")
    with pytest.raises(
        RecrlError, match=r"runs/small: the object store and its local copy cannot be the same"
    ):
        RemoteSweep(f"file://{tmp_path}/link", SweepStore(tmp_path / "runs", "small")).mark()
    assert not (tmp_path / "runs" / "small").exists()
    RemoteSweep(f"file://{tmp_path}/link/inside", SweepStore(tmp_path / "runs", "small")).mark()


@pytest.mark.parametrize(
    ("storage", "code", "sentence"),
    [
        (
            "bucket",
            ExitCode.WRONG_INPUT,
            "the storage must be an address such as s3://bucket/folder, got 'bucket'",
        ),
        (
            "lacking://b/x",
            ExitCode.WRONG_INPUT,
            "lacking://b/x: lacking:// needs a package that is not installed: ",
        ),
        (
            "file://store",
            ExitCode.WRONG_INPUT,
            "file://store: the folder must be an absolute path, as in file:///folder, so that it ",
        ),
        (
            "unreliable:///b",
            ExitCode.CANNOT_RUN,
            "unreliable:///b/small: cannot be written (OSError: the network is",
        ),
    ],
)
def test_what_cannot_be_used_is_a_sentence_before_any_work(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    *,
    storage: str,
    code: ExitCode,
    sentence: str,
) -> None:
    fsspec.register_implementation("lacking", "no_such_package.LackingFileSystem", errtxt="?", clobber=True)
    Unreliable.plan += ["refused"]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grid.yaml").write_text(GRID)
    assert main(["launch", "grid.yaml", *INLINE, "--storage", storage]) == code
    assert capsys.readouterr().err.startswith(f"recrl-sweep: {sentence}")
    assert [path.name for path in tmp_path.iterdir()] == ["grid.yaml"]


def test_memory_is_for_one_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grid.yaml").write_text(GRID)
    assert main(["launch", "grid.yaml", "--storage", "memory://bucket"]) == ExitCode.WRONG_INPUT
    assert "is memory of a single process" in capsys.readouterr().err
