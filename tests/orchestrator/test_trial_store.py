"""Nothing committed is ever lost, nothing is there twice, and one attempt at a time may write."""

import errno
import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recrl.orchestrator.errors import DamagedError, LostLeaseError, StorageError, SweepBusyError
from recrl.orchestrator.files.atomic_files import write_atomically
from recrl.orchestrator.files.locks import opened_lock
from recrl.orchestrator.files.move_aside import move_aside
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.files.trial_writer import TrialWriter
from recrl.orchestrator.spec import TrialStatus
from tests.orchestrator.trial_contents import SPEC, episode, tree


@pytest.fixture
def store(tmp_path: Path) -> TrialStore:
    return SweepStore(tmp_path, "sweep").trial(SPEC)


def work(writer: TrialWriter, update: int) -> None:
    """One update's rows, committed."""
    writer.append_episode(episode(update))
    writer.append_update({"update": update, "limit_0": float("inf"), "kl": float("nan")})
    writer.append_event({"update": update, "end_step": 10 * update, "event": "noise"})
    writer.commit(tree(update), update=update, env_steps=10 * update)


def test_committed_rows_read_back_exactly(store: TrialStore) -> None:
    writer = store.begin(SPEC)
    work(writer, 1)
    work(writer, 2)
    assert store.spec == SPEC
    assert store.episodes()["episode_return"].tolist() == [0.1, 0.2]
    assert store.episodes()["cost_0"].tolist() == [1.0 / 3.0] * 2
    assert store.episodes()["limit_0"].tolist() == [float("inf")] * 2
    assert store.updates()["update"].tolist() == [1, 2]
    assert [event["update"] for event in store.events()] == [1, 2]
    assert store.record().env_steps == 20


def test_uncommitted_rows_are_invisible(store: TrialStore) -> None:
    writer = store.begin(SPEC)
    work(writer, 1)
    writer.append_episode(episode(2))
    assert len(store.episodes()) == 1


def test_restore_cuts_rows_back_to_the_checkpoint(store: TrialStore) -> None:
    work(store.begin(SPEC), 1)
    with store.episodes_path.open("a") as file:
        file.write("a row whose commit never came\n")
    writer = store.begin(SPEC)
    restored = writer.restore()
    np.testing.assert_equal(restored, tree(1))
    work(writer, 2)
    assert store.episodes()["index"].tolist() == [1, 2]


def test_damaged_checkpoint_falls_back_to_the_one_before(store: TrialStore) -> None:
    writer = store.begin(SPEC)
    for update in (1, 2, 3):
        work(writer, update)
    newest = store.checkpoints()[0]
    newest.write_bytes(newest.read_bytes()[:-1])
    writer = store.begin(SPEC)
    np.testing.assert_equal(writer.restore(), tree(2))
    assert store.episodes()["index"].tolist() == [1, 2]
    assert newest.with_suffix(".damaged").exists()
    assert store.damages() == []
    assert store.record().checkpoint == store.checkpoints()[0].name
    assert (store.record().update, store.record().env_steps) == (2, 20)


@pytest.mark.parametrize("code", [errno.EIO, errno.EMFILE, errno.ESTALE, errno.EACCES])
@pytest.mark.parametrize("pattern", ["*.recrl", "*.csv"])
def test_what_cannot_be_read_for_a_moment_is_not_taken_for_damaged(
    store: TrialStore, monkeypatch: pytest.MonkeyPatch, code: int, pattern: str
) -> None:
    for update in (1, 2):
        work(store.begin(SPEC), update)
    before = {path: path.read_bytes() for path in (*store.checkpoints(), store.episodes_path)}
    whole = Path.open

    def away(path: Path, mode: str = "r", *further: Any, **options: Any) -> Any:
        if path.match(pattern) and mode == "rb":
            raise OSError(code, os.strerror(code))
        return whole(path, mode, *further, **options)

    with monkeypatch.context() as broken:
        broken.setattr(Path, "open", away)
        with pytest.raises(StorageError, match=re.escape(f"cannot be read ({os.strerror(code)})")):
            store.begin(SPEC).restore()
        assert any(f"cannot be read ({os.strerror(code)})" in found for found in store.damages())
        if pattern == "*.csv":
            with pytest.raises(StorageError, match=re.escape(os.strerror(code))) as found:
                store.episodes()
            assert not isinstance(found.value, DamagedError)
            with pytest.raises(StorageError, match="; try again when the disk can be read") as found:
                store.require_whole()
            assert not isinstance(found.value, DamagedError)
            assert store.verified_record().is_unreadable
    assert {path: path.read_bytes() for path in before} == before
    np.testing.assert_equal(store.begin(SPEC).restore(), tree(2))


def test_without_record_and_checkpoints_the_rows_are_kept_aside(store: TrialStore) -> None:
    work(store.begin(SPEC), 1)
    rows = store.episodes_path.read_bytes()
    store.state_path.unlink()
    for path in store.checkpoints():
        path.write_bytes(b"")
    assert store.begin(SPEC).restore() is None
    (kept,) = store.aside_folder.glob("*-episodes.csv")
    assert kept.read_bytes() == rows


def test_without_an_intact_checkpoint_the_trial_starts_afresh(store: TrialStore) -> None:
    work(store.begin(SPEC), 1)
    for path in store.checkpoints():
        path.write_bytes(b"")
    writer = store.begin(SPEC)
    assert writer.restore() is None
    assert store.episodes().empty


def test_what_a_killed_process_was_writing_is_removed(store: TrialStore) -> None:
    work(store.begin(SPEC), 1)
    left = [
        store.folder / ".state.json.4711.0123abcd",
        store.checkpoints_folder / ".checkpoint-00000002.recrl.4711.89abcdef",
    ]
    kept = store.folder / ".nfs.notes"
    for path in (*left, kept):
        path.write_bytes(b"half")
    store.begin(SPEC)
    assert [path.exists() for path in (*left, kept)] == [False, False, True]


def test_two_checkpoints_are_kept(store: TrialStore) -> None:
    writer = store.begin(SPEC)
    for update in range(1, 6):
        work(writer, update)
    assert [path.name for path in store.checkpoints()] == [
        "checkpoint-00000005.recrl",
        "checkpoint-00000004.recrl",
    ]


def test_the_newest_checkpoint_is_that_of_the_largest_number(store: TrialStore) -> None:
    writer = store.begin(SPEC)
    for update in (99_999_998, 99_999_999, 100_000_000, 100_000_001):
        work(writer, update)
    assert [path.name for path in store.checkpoints()] == [
        "checkpoint-100000001.recrl",
        "checkpoint-100000000.recrl",
    ]
    assert store.saved_update == 100_000_001
    np.testing.assert_equal(store.begin(SPEC).restore(), tree(100_000_001))


def test_only_the_newest_attempt_may_write(store: TrialStore) -> None:
    orphan = store.begin(SPEC)
    work(orphan, 1)
    heir = store.begin(SPEC)
    heir.restore()
    before = store.episodes_path.read_bytes()
    orphan.append_episode(episode(2))
    writes: list[Callable[[], None]] = [
        lambda: orphan.commit(tree(2), update=2, env_steps=20),
        lambda: orphan.heartbeat(update=2, env_steps=20, steps_per_second=1.0),
        lambda: orphan.close(TrialStatus.COMPLETE),
        lambda: orphan.write_evaluation([{"policy": "stochastic"}]),
    ]
    for write in writes:
        with pytest.raises(LostLeaseError, match="another attempt runs this trial now"):
            write()
    assert store.episodes_path.read_bytes() == before
    assert store.record().attempt == 2
    work(heir, 2)
    assert store.record().status is TrialStatus.RUNNING


def test_a_commit_that_fails_leaves_the_one_before(store: TrialStore) -> None:
    writer = store.begin(SPEC)
    work(writer, 1)
    writer.append_episode(episode(2))
    with pytest.raises(TypeError):
        writer.commit({"bad": object()}, update=2, env_steps=20)
    assert store.episodes()["index"].tolist() == [1]
    writer.commit(tree(2), update=2, env_steps=20)  # the rows were not lost, and are there once
    assert store.episodes()["index"].tolist() == [1, 2]


def test_cpu_seconds_add_up_over_attempts(store: TrialStore) -> None:
    writer = store.begin(SPEC)
    work(writer, 1)
    first = store.record().cpu_seconds
    writer = store.begin(SPEC)
    writer.restore()
    assert first <= writer.cpu_seconds < first + 5.0


def test_atomic_write_leaves_no_litter(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_atomically(path, b"old")
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_state_is_strict_json(store: TrialStore) -> None:
    store.begin(SPEC)

    def refuse(token: str) -> float:
        raise AssertionError(token)

    json.loads(store.state_path.read_text(), parse_constant=refuse)
    json.loads(store.spec_path.read_text(), parse_constant=refuse)


def test_one_process_at_a_time_runs_a_sweep(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "sweep")
    sentence = rf"already being run by process .*; .* end it with: recrl-sweep stop {store.folder}$"
    with store.lock(), pytest.raises(SweepBusyError, match=sentence), store.lock():
        pass
    with store.lock():
        pass


@pytest.mark.parametrize("ending", ["pass", "os._exit(0)"])
def test_a_process_that_a_users_code_forked_keeps_no_lock(tmp_path: Path, ending: str) -> None:
    code = f"""
import os, sys, time
from pathlib import Path
from recrl.orchestrator.files.locks import locked
from recrl.orchestrator.files.sweep_store import SweepStore
with SweepStore(Path(sys.argv[1]), "sweep").lock(), locked(Path(sys.argv[1]) / "lock"):
    child = os.fork()
    if not child:
        os.close(1)
        os.close(2)  # else the test waits until this process has ended, and finds no lock in any case
        time.sleep(600)
        os._exit(0)
    print(child, flush=True)
    {ending}
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True)
    try:
        os.kill(int(done.stdout), 0)  # it is there
        assert not SweepStore(tmp_path, "sweep").is_locked()
        with opened_lock(tmp_path / "lock") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    finally:
        os.kill(int(done.stdout), signal.SIGKILL)


def test_a_lock_ends_with_its_block_although_another_descriptor_shares_it(tmp_path: Path) -> None:
    with opened_lock(tmp_path / "lock") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        shared = os.dup(file.fileno())
    with opened_lock(tmp_path / "lock") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(shared)


def test_who_only_looks_whether_a_sweep_runs_keeps_nobody_from_running_it(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "sweep")
    with store.lock():
        pass
    over = threading.Event()

    def look_all_the_time() -> None:
        while not over.is_set():
            store.is_locked()

    with ThreadPoolExecutor(3) as pool:
        looking = [pool.submit(look_all_the_time) for _ in range(3)]
        try:
            for _ in range(200):
                with store.lock():
                    pass
        finally:
            over.set()
        for each in looking:
            each.result()


def test_trials_on_disk_are_found(tmp_path: Path, store: TrialStore) -> None:
    sweep = SweepStore(tmp_path, "sweep")
    assert sweep.trials() == []
    store.begin(SPEC)
    assert [trial.spec for trial in sweep.trials()] == [SPEC]


def test_files_moved_aside_never_replace_each_other(tmp_path: Path) -> None:
    aside = tmp_path / "aside"
    for text in ("one", "two", "three"):
        (tmp_path / "a.csv").write_text(text)
        move_aside(tmp_path / "a.csv", aside)
        if text == "two":
            (aside / "001-a.csv").unlink()
    assert sorted(path.read_text() for path in aside.iterdir()) == ["three", "two"]


def test_the_provenance_of_an_attempt_that_was_killed_over_it_is_kept(
    store: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.begin(SPEC).add_provenance({"code": "first"})
    writer = store.begin(SPEC)
    with monkeypatch.context() as killed:
        killed.setattr(TrialWriter, "_write_record", _killed)
        with pytest.raises(KeyboardInterrupt):
            writer.add_provenance({"code": "second"})
    store.begin(SPEC).add_provenance({"code": "third"})
    assert [attempt["code"] for attempt in store.provenance()] == ["first", "second", "third"]
    assert not store.damages()


def _killed(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_the_traceback_of_an_earlier_attempt_is_moved_aside(store: TrialStore) -> None:
    store.begin(SPEC).close(TrialStatus.FAILED, error="no luck", traceback="Traceback of the first")
    store.begin(SPEC).close(TrialStatus.COMPLETE)
    assert not store.error_path.exists()
    assert [path.read_text() for path in store.aside_folder.iterdir()] == ["Traceback of the first"]


def test_a_sweep_without_its_own_files_is_damaged_and_not_empty(tmp_path: Path) -> None:
    sweep = SweepStore(tmp_path, "sweep")
    assert sweep.specs() == []
    sweep.trial(SPEC).begin(SPEC)
    with pytest.raises(DamagedError, match=r"trials\.jsonl is missing; launching its grid again"):
        sweep.specs()
