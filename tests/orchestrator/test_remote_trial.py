"""A trial in an object store is there whole or as it was before, whoever writes, fails or comes back."""

import errno
import hashlib
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from recrl.orchestrator.errors import (
    DamagedError,
    LostLeaseError,
    OtherFormatError,
    RecrlError,
    StorageError,
)
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_files import FileKind, files_of
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.files.trial_writer import TrialWriter
from recrl.orchestrator.launch_plan import make_plan
from recrl.orchestrator.remote.commit_format import PREFIX_BYTES, Commit, pack, unpack
from recrl.orchestrator.remote.commit_upload import Upload, working_copy
from recrl.orchestrator.remote.object_store import ObjectStore
from recrl.orchestrator.remote.remote_trial import RemoteTrial
from recrl.orchestrator.spec import TrialStatus
from recrl.orchestrator.trial.attempt import run_recorded
from tests.faults.unreliable import Unreliable
from tests.orchestrator.trial_contents import SPEC, episode, tree


@pytest.fixture(params=["file", "memory", "unreliable"])
def remote(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[RemoteTrial]:
    Unreliable.plan.clear()
    yield RemoteTrial(ObjectStore(f"{request.param}://{tmp_path}/bucket"), SPEC.folder_name)


@pytest.fixture
def bucket(tmp_path: Path) -> RemoteTrial:
    """One whose objects are files below ``bucket``."""
    Unreliable.plan.clear()
    return RemoteTrial(ObjectStore(f"unreliable://{tmp_path}/bucket"), SPEC.folder_name)


class Machine:
    """A machine that takes the trial up: its folder, its writer and its upload."""

    def __init__(self, remote: RemoteTrial, folder: Path) -> None:
        self.trial = TrialStore(folder / SPEC.folder_name)
        remote.download_for_attempt(self.trial)
        self.upload = Upload(remote, self.trial)
        self.writer: TrialWriter = self.trial.begin(SPEC)
        self.restored = self.writer.restore()

    def work(self, update: int) -> None:
        """One update's rows, committed, and not yet sent."""
        self.writer.append_episode(episode(update))
        self.writer.append_update({"update": update, "limit_0": float("inf")})
        self.writer.commit(tree(update), update=update, env_steps=10 * update)


def local_copy(remote: RemoteTrial, folder: Path, *, checkpoints: bool = True) -> TrialStore:
    trial = TrialStore(folder / SPEC.folder_name)
    remote.download(trial, checkpoints=checkpoints)
    return trial


def commit_at(remote: RemoteTrial, key: str) -> Commit:
    data = remote.objects.read(key) or b""
    return unpack(lambda start, end: data[start:end])


def updates(trial: TrialStore) -> list[int]:
    """The committed updates of a trial whose files belong together."""
    frame = trial.updates()
    found = frame["update"].tolist() if len(frame) else []
    assert found == (trial.episodes()["index"].tolist() if len(frame) else [])
    checkpoint = trial.latest_checkpoint()
    assert (checkpoint["trial"]["update"] if checkpoint else 0) == len(found)
    assert found == list(range(1, len(found) + 1))
    return found


def test_a_trial_goes_on_elsewhere_with_what_was_sent_last(remote: RemoteTrial, tmp_path: Path) -> None:
    first = Machine(remote, tmp_path / "first")
    assert first.restored is None
    first.work(1)
    first.work(2)
    first.upload.push()
    first.work(3)  # dies before this is sent
    second = Machine(remote, tmp_path / "second")
    np.testing.assert_equal(second.restored, tree(2))
    assert second.trial.record().attempt == 2
    second.work(3)
    second.work(4)
    second.writer.close(TrialStatus.COMPLETE)
    second.upload.finish()
    there = local_copy(remote, tmp_path / "copy")
    assert updates(there) == [1, 2, 3, 4]
    assert there.record() == second.trial.record()
    for path in ("episodes_path", "updates_path", "spec_path"):
        assert getattr(there, path).read_bytes() == getattr(second.trial, path).read_bytes()


def test_every_file_of_a_trial_has_a_kind_and_is_sent(tmp_path: Path) -> None:
    spec = replace(SPEC, rollout_steps=50, evaluation_episodes=2)
    remote = RemoteTrial(ObjectStore(f"file://{tmp_path}/bucket"), spec.folder_name)
    with working_copy(remote, spec, lambda: False) as trial:
        assert run_recorded(spec, trial, should_stop=lambda: False) is TrialStatus.COMPLETE
        trial.error_path.write_text("of an attempt that failed")
        written = {path.name: path.read_bytes() for path in trial.folder.iterdir() if path.is_file()}
    sent = files_of(FileKind.ROWS, FileKind.LOG, FileKind.WHOLE)
    others = files_of(FileKind.RECORD, FileKind.LOCAL)
    assert set(sent) == set(written) - set(others)
    there = TrialStore(tmp_path / "copy" / spec.folder_name)
    remote.download(there, checkpoints=True)
    for name in sent:
        assert (there.folder / name).read_bytes() == written[name], name


def test_a_local_copy_follows_commit_by_commit(bucket: RemoteTrial, tmp_path: Path) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    for update in range(1, 8):
        machine.work(update)
        machine.upload.push()
        there = local_copy(bucket, tmp_path / "copy")
        assert updates(there) == list(range(1, update + 1))
        assert there.episodes_path.read_bytes() == machine.trial.episodes_path.read_bytes()


@pytest.mark.parametrize("name", files_of(FileKind.ROWS, FileKind.LOG, FileKind.WHOLE))
def test_a_link_in_a_local_copy_is_replaced_and_not_followed(
    bucket: RemoteTrial, tmp_path: Path, name: str
) -> None:
    diary = tmp_path / "diary.txt"
    machine = Machine(bucket, tmp_path / "machine")
    for update in (1, 2):
        machine.work(update)
        with (machine.trial.folder / name).open("ab") as file:
            file.write(b"a line\n" if name not in files_of(FileKind.ROWS) else b"")
        machine.upload.push()
        there = local_copy(bucket, tmp_path / "copy")
        if update == 1:
            data = (there.folder / name).read_bytes() + b"mine, and longer than the trial's file\n" * 100
            diary.write_bytes(data)
            (there.folder / name).unlink()
            (there.folder / name).symlink_to(diary)
    assert diary.read_bytes() == data
    assert not (there.folder / name).is_symlink()
    assert (there.folder / name).read_bytes() == (machine.trial.folder / name).read_bytes()


@pytest.mark.parametrize("place", ["trials", "trials/TRIAL", "trials/TRIAL/checkpoints"])
def test_a_link_in_place_of_a_folder_of_a_local_copy_is_refused(
    bucket: RemoteTrial, tmp_path: Path, place: str
) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    machine.work(1)
    machine.upload.push()
    mine = tmp_path / "mine"
    (mine / "checkpoints").mkdir(parents=True)
    for name in ("spec.json", "checkpoint-00000009.recrl", "checkpoints/checkpoint-00000009.recrl"):
        (mine / name).write_text("mine")
    link = tmp_path / "copy" / place.replace("TRIAL", SPEC.folder_name)
    link.parent.mkdir(parents=True)
    link.symlink_to(mine)
    with pytest.raises(
        DamagedError, match=rf"^{link}: is a link, it must be a folder; delete it, and it is "
    ):
        local_copy(bucket, tmp_path / "copy" / "trials")
    assert sorted(str(path.relative_to(mine)) for path in mine.rglob("*") if path.is_file()) == [
        "checkpoint-00000009.recrl",
        "checkpoints/checkpoint-00000009.recrl",
        "spec.json",
    ]
    assert {path.read_text() for path in mine.rglob("*") if path.is_file()} == {"mine"}


def test_a_local_copy_leaves_checkpoints_of_running_trials_where_they_are(
    bucket: RemoteTrial, tmp_path: Path
) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    machine.work(1)
    machine.upload.push()
    assert local_copy(bucket, tmp_path / "copy", checkpoints=False).checkpoints() == []
    assert len(local_copy(bucket, tmp_path / "copy", checkpoints=True).checkpoints()) == 1
    machine.work(2)
    machine.writer.close(TrialStatus.COMPLETE)
    machine.upload.finish()
    there = local_copy(bucket, tmp_path / "copy", checkpoints=False)
    assert [path.name for path in there.checkpoints()] == ["checkpoint-00000002.recrl"]


def test_a_folder_that_cannot_be_listed_for_once_is_not_taken_for_an_empty_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    remote = RemoteTrial(ObjectStore(f"file://{tmp_path}/bucket"), SPEC.folder_name)
    machine = Machine(remote, tmp_path / "machine")
    machine.work(1)
    machine.upload.push()
    attempt = next(iter(remote.objects.keys_in())).partition("/")[0]

    def stale(folder: str, **given: Any) -> Any:
        if folder.endswith(attempt):
            raise OSError(errno.ESTALE, "Stale file handle")
        return listed(folder, **given)

    listed = remote.objects._system.ls
    with monkeypatch.context() as away:
        away.setattr(remote.objects._system, "ls", stale)
        with pytest.raises(StorageError, match=r"cannot be listed \(OSError: .*Stale file handle\)"):
            remote.download_for_attempt(TrialStore(tmp_path / "other" / SPEC.folder_name))
    assert updates(local_copy(remote, tmp_path / "copy")) == [1]


def test_a_full_disk_of_this_machine_is_waited_for(
    bucket: RemoteTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    machine.work(1)
    machine.upload.push()

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as away:
        away.setattr("recrl.orchestrator.remote.remote_trial.write_atomically", full)
        with pytest.raises(StorageError, match=r"cannot be written \(No space left on device\)"):
            local_copy(bucket, tmp_path / "copy")
    with monkeypatch.context() as away:
        away.setattr("tempfile.mkdtemp", full)
        with (
            pytest.raises(StorageError, match=r"cannot be written \(No space left on device\)"),
            working_copy(bucket, SPEC, lambda: False),
        ):
            pass
    assert updates(local_copy(bucket, tmp_path / "copy")) == [1]


def test_many_commits_leave_few_objects(bucket: RemoteTrial, tmp_path: Path) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    for update in range(1, 33):
        machine.work(update)
        machine.upload.push()
    assert len(bucket.objects.keys_in()) < 2 * 7  # two commits, and those that hold log2(64) + 1 pieces
    assert updates(local_copy(bucket, tmp_path / "copy")) == list(range(1, 33))


def test_a_commit_that_broke_off_behind_its_checkpoint_takes_its_rows_along(
    bucket: RemoteTrial, tmp_path: Path
) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    machine.work(1)
    record = machine.trial.state_path.read_bytes()
    machine.work(2)
    machine.trial.state_path.write_bytes(record)  # the disk was full
    machine.upload.push()
    assert updates(local_copy(bucket, tmp_path / "copy")) == [1, 2]
    np.testing.assert_equal(Machine(bucket, tmp_path / "next").restored, tree(2))


def test_signs_of_life_say_how_far_a_trial_is_and_commit_nothing(bucket: RemoteTrial, tmp_path: Path) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    machine.work(1)
    machine.upload.push()
    machine.writer.heartbeat(update=7, env_steps=70, steps_per_second=3.0)
    machine.upload.follow()
    there = local_copy(bucket, tmp_path / "copy")
    assert (there.record().update, there.record().env_steps) == (7, 70)
    assert updates(there) == [1]
    machine.writer.close(TrialStatus.WAITING)
    machine.upload.finish()
    assert local_copy(bucket, tmp_path / "copy").record().status is TrialStatus.WAITING


def test_what_a_dead_node_writes_late_is_not_read(bucket: RemoteTrial, tmp_path: Path) -> None:
    orphan = Machine(bucket, tmp_path / "orphan")
    orphan.work(1)
    orphan.upload.push()
    successor = Machine(bucket, tmp_path / "successor")
    successor.upload.follow()
    orphan.work(2)
    orphan.work(3)
    with pytest.raises(LostLeaseError, match="another attempt runs this trial now"):
        orphan.upload.push()
    assert updates(local_copy(bucket, tmp_path / "copy")) == [1]


def test_not_even_what_was_under_way_when_it_was_declared_dead(bucket: RemoteTrial, tmp_path: Path) -> None:
    orphan = Machine(bucket, tmp_path / "orphan")
    orphan.work(1)
    orphan.upload.push()
    orphan.work(2)
    orphan.upload.push()
    late = {key: bucket.objects.read(key) for key in bucket.objects.keys_in()}
    successor = Machine(bucket, tmp_path / "successor")
    successor.work(3)
    successor.upload.push()
    for key, data in late.items():
        assert data is not None
        bucket.objects.write(key.replace("commit-0000000", "commit-0000009"), data)
    assert updates(local_copy(bucket, tmp_path / "copy")) == [1, 2, 3]
    third = Machine(bucket, tmp_path / "third")
    np.testing.assert_equal(third.restored, tree(3))
    assert third.trial.record().attempt == 3
    third.upload.push()
    assert not [key for key in bucket.objects.keys_in() if key.startswith(("000001-", "000002-"))]


def test_a_sign_of_life_of_an_attempt_before_the_commits_is_passed_over(
    bucket: RemoteTrial, tmp_path: Path
) -> None:
    first = Machine(bucket, tmp_path / "first")
    first.work(1)
    first.upload.follow()
    keys = bucket.objects.keys_in()
    [alive] = [key for key in keys if key.endswith("/alive.json")]
    sign = bucket.objects.read(alive)
    second = Machine(bucket, tmp_path / "second")
    second.writer.close(TrialStatus.COMPLETE)
    second.upload.finish()
    assert sign is not None
    bucket.objects.write(alive, sign)
    trial = TrialStore(tmp_path / "copy" / SPEC.folder_name)
    bucket.download(trial, keys, checkpoints=True)
    assert (trial.record().attempt, trial.record().status) == (2, TrialStatus.COMPLETE)


def test_of_two_attempts_at_once_all_agree_on_one(bucket: RemoteTrial, tmp_path: Path) -> None:
    machines = [Machine(bucket, tmp_path / name) for name in ("one", "other")]
    assert [machine.trial.record().attempt for machine in machines] == [1, 1]
    loser, winner = sorted(machines, key=lambda machine: machine.trial.record().token)
    winner.work(1)
    winner.upload.push()
    with pytest.raises(LostLeaseError):
        loser.upload.push()
    loser.upload.revoke()
    with pytest.raises(LostLeaseError):
        loser.writer.heartbeat(update=1, env_steps=10, steps_per_second=1.0)
    assert local_copy(bucket, tmp_path / "copy").record().token == winner.trial.record().token


@pytest.mark.parametrize("harm", ["header", "rows", "checkpoint", "cut", "cut to nothing", "gone"])
def test_a_commit_that_is_not_whole_is_not_there(bucket: RemoteTrial, tmp_path: Path, harm: str) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    machine.work(1)
    machine.upload.push()
    before = set(bucket.objects.keys_in())
    machine.work(2)
    machine.upload.push()
    new = set(bucket.objects.keys_in()) - before
    [key] = new
    path = tmp_path / "bucket" / key
    whole = path.read_bytes()
    files = commit_at(bucket, key).files
    [checkpoint] = [name for name in files if "checkpoint" in name]
    places = {
        "header": 100,
        "rows": files["updates.csv"][-1].offset,
        "checkpoint": files[checkpoint][0].offset,
    }
    if harm in places:
        at = places[harm]
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    elif harm == "gone":
        path.unlink()
    else:
        path.write_bytes(whole[:-3] if harm == "cut" else b"")
    assert updates(local_copy(bucket, tmp_path / "copy")) == [1]
    np.testing.assert_equal(Machine(bucket, tmp_path / "next").restored, tree(1))


def flip_headers(bucket: Path) -> None:
    """Change a bit in the header of every commit."""
    for path in bucket.rglob("commit-*"):
        whole = path.read_bytes()
        path.write_bytes(whole[:200] + bytes([whole[200] ^ 1]) + whole[201:])


def as_written_by_another_version(bucket: Path) -> None:
    """Give every commit another format, and its header the digest of that."""
    for path in bucket.rglob("commit-*"):
        whole = path.read_bytes()
        end = PREFIX_BYTES + int(whole[:PREFIX_BYTES].split()[1])
        header = whole[PREFIX_BYTES:end].replace(b'"format": 2', b'"format": 1', 1)
        digest = hashlib.sha256(header).hexdigest()
        path.write_bytes(f"{digest} {len(header):010d}\n".encode() + header + whole[end:])


@pytest.mark.parametrize(
    ("harm", "kind", "sentence"),
    [
        (
            flip_headers,
            DamagedError,
            "its header is not intact; no commit of the trial is intact, so it is left alone: restore its "
            "objects, or give the sweep another name",
        ),
        (
            as_written_by_another_version,
            OtherFormatError,
            "the commit has format 1, of another version of recrl, and this one reads format 2; the trial is "
            "left alone: use that version, or give the sweep another name",
        ),
    ],
)
def test_a_trial_without_a_commit_that_can_be_used_is_damaged_and_left_alone(
    bucket: RemoteTrial,
    tmp_path: Path,
    *,
    harm: Callable[[Path], None],
    kind: type[DamagedError],
    sentence: str,
) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    for update in (1, 2):
        machine.work(update)
        machine.upload.push()
    whole = {key: bucket.objects.read(key) or b"" for key in bucket.objects.keys_in()}
    harm(tmp_path / "bucket")
    newest = max(key for key in whole if "/commit-" in key)
    harmed = {key: bucket.objects.read(key) for key in bucket.objects.keys_in()}
    with (
        pytest.raises(kind, match=f"^{re.escape(f'{bucket.objects.uri}/{newest}: {sentence}')}$"),
        working_copy(bucket, SPEC, lambda: False),  # at once, and not after 15 minutes
    ):
        pass
    sweep = SweepStore(tmp_path, "copy")
    there = local_copy(bucket, sweep.trials_folder)
    assert there.record().status is TrialStatus.DAMAGED
    assert there.record().error == f"{bucket.objects.uri}/{newest}: {sentence}"
    assert there.damages() == [there.record().error]
    assert make_plan([SPEC], sweep).to_do == ()
    assert {key: bucket.objects.read(key) for key in bucket.objects.keys_in()} == harmed
    for key, data in whole.items():
        bucket.objects.write(key, data)
    assert updates(local_copy(bucket, sweep.trials_folder)) == [1, 2]
    assert there.record().status is TrialStatus.RUNNING


def test_a_commit_that_is_listed_but_not_found_is_waited_for(
    bucket: RemoteTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recrl.orchestrator.remote.retries.FIRST_PAUSE_SECONDS", 0.01)
    machine = Machine(bucket, tmp_path / "machine")
    machine.work(1)
    machine.upload.push()
    read, reads = ObjectStore.read_range, iter(range(99))

    def unsteady(store: ObjectStore, key: str, start: int | None, end: int | None) -> bytes | None:
        return None if "commit-" in key and next(reads) < 5 else read(store, key, start, end)

    monkeypatch.setattr(ObjectStore, "read_range", unsteady)
    with pytest.raises(StorageError, match=r"/commit-00000001: is listed, but not found when it is read$"):
        local_copy(bucket, tmp_path / "copy")
    with working_copy(bucket, SPEC, lambda: False) as trial:
        assert updates(trial) == [1]


def test_a_commit_that_was_not_read_is_kept_aside(bucket: RemoteTrial, tmp_path: Path) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    for update in (1, 2):
        machine.work(update)
        machine.upload.push()
    newest = max(bucket.objects.keys_in())
    path = tmp_path / "bucket" / newest
    path.write_bytes(path.read_bytes()[:-1])
    damaged = path.read_bytes()
    for update in (2, 3):
        successor = Machine(bucket, tmp_path / f"successor {update}")
        successor.work(update)
        successor.upload.push()
    aside = [key for key in bucket.objects.keys_in() if key.startswith("aside/")]
    assert aside == [f"aside/{newest}"]
    assert bucket.objects.read(f"aside/{newest}") == damaged
    assert {key.partition("-")[0] for key in bucket.objects.keys_in()} == {"000003", "aside/000001"}
    assert updates(local_copy(bucket, tmp_path / "copy")) == [1, 2, 3]


def test_a_commit_cannot_name_files_that_no_trial_has(bucket: RemoteTrial, tmp_path: Path) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    machine.upload.push()
    [key] = [key for key in bucket.objects.keys_in() if "commit" in key]
    commit = commit_at(bucket, key)
    assert commit.record == machine.trial.record()
    text = json.dumps(commit.to_json())
    assert Commit.from_json(json.loads(text)) == commit
    for wrong in (
        text.replace("spec.json", "../../evil"),
        text.replace('"format": 2', '"format": 1'),
        text.replace("commit-00000001", "../commit-00000001"),
        "[]",
        "{}",
    ):
        with pytest.raises(ValueError, match="commit"):
            Commit.from_json(json.loads(wrong))
    value = json.loads(text)
    value["files"]["spec.json"][0]["start"] = 1
    with pytest.raises(ValueError, match="leave a gap"):
        Commit.from_json(value)


@pytest.mark.parametrize("data", [b"", b"no commit", b"\xff" * 100, b"0" * 64 + b" 0000000002\n{}"])
def test_what_is_no_commit_is_a_value_error(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"that of a commit|not intact"):
        unpack(lambda start, end: data[start:end])


def test_a_long_header_is_read_whole() -> None:
    record = TrialRecord(error="x" * 20_000)
    commit, data = pack("commit-00000001", record, {"log.txt": ()}, {"log.txt": (0, b"a line")})
    assert unpack(lambda start, end: data[start:end]) == commit
    [piece] = commit.files["log.txt"]
    assert data[piece.offset : piece.offset + piece.length] == b"a line"


def test_each_byte_is_sent_about_log2_of_n_times_and_a_commit_is_one_write(
    bucket: RemoteTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    written: list[str] = []
    write = bucket.objects.write

    def note(key: str, data: bytes) -> None:
        written.append(key)
        write(key, data)

    monkeypatch.setattr(bucket.objects, "write", note)
    sent = 0
    for update in range(1, 65):
        machine.work(update)
        machine.upload.push()
        pieces = commit_at(bucket, written[-1]).files["episodes.csv"]
        sent += sum(piece.length for piece in pieces if written[-1].endswith(piece.commit))
    assert len(written) == 64
    assert sent < 7 * machine.trial.episodes_path.stat().st_size


def test_a_verdict_from_outside_stands_until_the_trial_speaks(bucket: RemoteTrial, tmp_path: Path) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    machine.work(1)
    machine.upload.follow()
    there = local_copy(bucket, tmp_path / "copy")
    there.set_status(TrialStatus.FAILED, error="its process died")
    assert local_copy(bucket, tmp_path / "copy").record().status is TrialStatus.FAILED
    successor = Machine(bucket, tmp_path / "successor")
    successor.upload.follow()
    assert local_copy(bucket, tmp_path / "copy").record().status is TrialStatus.RUNNING


def test_an_upload_that_failed_is_made_good_by_the_next(bucket: RemoteTrial, tmp_path: Path) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    machine.work(1)
    machine.upload.push()
    machine.work(2)
    Unreliable.plan += ["cut"]
    with pytest.raises(
        StorageError, match=r"^unreliable://.*/bucket: cannot be written \(OSError: the network is down\)$"
    ):
        machine.upload.push()
    assert updates(local_copy(bucket, tmp_path / "copy")) == [1]
    machine.work(3)
    machine.upload.push()
    assert updates(local_copy(bucket, tmp_path / "copy")) == [1, 2, 3]


def test_a_commit_whose_answer_was_lost_is_not_taken_for_the_next(
    bucket: RemoteTrial, tmp_path: Path
) -> None:
    machine = Machine(bucket, tmp_path / "machine")
    machine.work(1)
    Unreliable.plan += ["lost"]
    with pytest.raises(StorageError):
        machine.upload.push()
    assert updates(local_copy(bucket, tmp_path / "copy")) == [1]
    machine.writer.close(TrialStatus.COMPLETE)
    machine.upload.finish()
    assert local_copy(bucket, tmp_path / "copy").record().status is TrialStatus.COMPLETE
    commits = [key for key in bucket.objects.keys_in() if "/commit-" in key]
    assert [key.rpartition("/")[2] for key in commits] == ["commit-00000002"]


STEPS = st.lists(
    st.sampled_from(["work", "push", "push", "take over", "refused", "cut", "lost", "ok"]),
    min_size=1,
    max_size=20,
)


@given(steps=STEPS)
@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_fails_readers_see_one_commit_and_the_end_is_complete(
    steps: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("example")
    Unreliable.plan.clear()
    remote = RemoteTrial(ObjectStore(f"unreliable://{folder}/bucket"), SPEC.folder_name)
    machine = Machine(remote, folder / "0")
    seen = 0
    for number, step in enumerate([*steps, "end"]):
        update = machine.trial.record().update if machine.trial.checkpoints() else 0
        if step == "work":
            machine.work(update + 1)
        elif step == "take over":
            machine = Machine(remote, folder / str(number + 1))
        elif step in ("refused", "cut", "lost", "ok"):
            Unreliable.plan.append(step)
        elif step == "end":
            Unreliable.plan.clear()
            machine.writer.close(TrialStatus.COMPLETE)
            machine.upload.finish()
            assert updates(local_copy(remote, folder / "copy")) == list(range(1, update + 1))
            assert local_copy(remote, folder / "copy").record().status is TrialStatus.COMPLETE
        else:
            try:
                machine.upload.push()
                assert updates(local_copy(remote, folder / "copy")) == list(range(1, update + 1))
            except StorageError:
                pass
        found = updates(local_copy(remote, folder / f"copy at {number}"))
        assert len(found) >= seen  # what was once there stays
        seen = len(found)


def test_addresses_that_are_none_are_a_sentence() -> None:
    for wrong in ("bucket/folder", "s3://", "simplecache::s3://bucket/folder"):
        with pytest.raises(RecrlError) as error:
            ObjectStore(wrong)
        assert str(error.value) == (
            f"the storage must be an address such as s3://bucket/folder, got {wrong!r}"
        )
    for wrong in ("file://store", "local://./store"):
        with pytest.raises(RecrlError) as error:
            ObjectStore(wrong)
        assert str(error.value) == (
            f"{wrong}: the folder must be an absolute path, as in {wrong.partition(':')[0]}:///folder, so "
            "that it is the same from every directory"
        )
    with pytest.raises(RecrlError, match=r"^s4://bucket: no kind of storage is called 's4'; fsspec knows "):
        ObjectStore("s4://bucket")


def test_credentials_are_neither_taken_nor_shown() -> None:
    for uri, shown in (
        ("ftp://me:hunter2@host/folder", "ftp://host/folder"),
        ("s3://AKIA:hunter2/+x@bucket/folder", "s3://bucket/folder"),
        ("s3://bucket/x?key=hunter2", "s3://bucket/x"),
    ):
        with pytest.raises(RecrlError) as error:
            ObjectStore(uri)
        assert str(error.value).startswith(f"{shown}: credentials do not belong into the address; ")
        assert "hunter2" not in str(error.value)


def test_a_missing_package_is_named() -> None:
    fsspec.register_implementation("nowhere", "no_such_package.NowhereFileSystem", errtxt="?", clobber=True)
    with pytest.raises(RecrlError) as error:
        ObjectStore("nowhere://bucket/folder")
    assert str(error.value) == (
        "nowhere://bucket/folder: nowhere:// needs a package that is not installed: "
        "pip install no_such_package, on every machine"
    )


def test_a_probe_finds_what_is_wrong_and_leaves_nothing(tmp_path: Path) -> None:
    Unreliable.plan.clear()
    store = ObjectStore(f"unreliable://{tmp_path}/bucket")
    store.probe()
    assert store.keys_in() == []
    for fate in ("refused", "cut"):
        Unreliable.plan.append(fate)
        with pytest.raises(StorageError, match="the network is down"):
            store.probe()


def test_only_one_creates_an_object(remote: RemoteTrial) -> None:
    assert remote.objects.create("launch.json", b"first")
    assert not remote.objects.create("launch.json", b"second")
    assert remote.objects.read("launch.json") == b"first"
    remote.objects.delete(["launch.json", "launch.json"])
    assert remote.objects.read("launch.json") is None


def test_a_store_without_exclusive_writes_is_looked_at_first(bucket: RemoteTrial) -> None:
    Unreliable.plan.append("unsupported")
    assert bucket.objects.create("launch.json", b"first")
    Unreliable.plan.append("unsupported")
    assert not bucket.objects.create("launch.json", b"second")
    assert bucket.objects.read("launch.json") == b"first"


def test_who_cannot_create_exclusively_for_once_does_not_write_all_the_same(bucket: RemoteTrial) -> None:
    Unreliable.plan.append("refused")
    with pytest.raises(StorageError, match=r"/bucket: cannot be written \(OSError: the network is down\)$"):
        bucket.objects.create("launch.json", b"first")
    assert bucket.objects.read("launch.json") is None


def test_names_are_those_right_below(remote: RemoteTrial) -> None:
    for key in ("a/x", "a/b/y", "c"):
        remote.objects.write(key, b"1")
    assert remote.objects.keys_in() == ["a/b/y", "a/x", "c"]
    assert remote.objects.keys_in("a") == ["b/y", "x"]
    assert remote.objects.keys_in("nowhere") == []
    assert remote.objects.names("file") == ["c"]
    assert remote.objects.names("directory") == ["a"]
    assert remote.objects.below("a").read("x") == b"1"
