"""A snapshot holds what MLflow shows; one that was tampered with is refused before it can do harm."""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pytest

from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.files.store import SweepStore
from recrl.orchestrator.tracking import snapshot as snapshots
from recrl.orchestrator.tracking.points import points, rows_after, thinned
from recrl.orchestrator.tracking.snapshot import MEMBERS, Announcement, HeldRun, ShownTrial, Snapshot
from tests.faults.committing import commit_file

RUN = {"run_id": "a", "attempt": 1, "update": 2, "complete": False}
RUNS = {"format": 1, "runs": [RUN], "metrics": ["train/return"]}
TABLE = np.array([[0.0, 400.0, 1_700_000_000_000.0, -1.5], [0.0, 800.0, 1_700_000_000_250.0, math.nan]])
TEXTS = {"texts": ["{}"], "files": {"provenance.json": [0], "policy.csv": [None]}}


def archive(
    *, runs: object = RUNS, table: np.ndarray = TABLE, texts: object = TEXTS, names: Sequence[str] = MEMBERS
) -> bytes:
    members = (json.dumps(runs).encode(), table.astype("<f8").tobytes(), json.dumps(texts).encode())
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as file:
        for name, member in zip(names, members, strict=True):
            file.writestr(name, member)
    return data.getvalue()


def test_a_snapshot_says_what_is_in_it() -> None:
    snapshot = Snapshot.unpack(archive())
    assert snapshot.runs == (HeldRun(run_id="a", attempt=1, update=2, complete=False),)
    assert snapshot.files == {"provenance.json": ["{}"], "policy.csv": [None]}
    found = snapshot.points("train/return")
    assert ([found.run_ids[run] for run in found.runs], found.steps.tolist()) == (["a"], [400])
    assert (found.values.tolist(), found.milliseconds.tolist()) == ([-1.5], [1_700_000_000_000])
    assert len(snapshot.points("student/kl").values) == 0


def test_a_snapshot_taken_is_what_mlflow_was_sent(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(seeds=2, tasks=["a"], agents=["cpo"], methods=["dynamic", "unconstrained"])
    for trial in store.trials():
        commit_file(trial, "policy.csv", "action_0\n1.0\n")
        commit_file(trial, "events.jsonl", "")  # is not sent
        commit_file(trial, "provenance.json", "{}")
    shown = [
        ShownTrial(trial, f"run-{index}", 1, trial.record().committed["updates.csv"], complete=index != 1)
        for index, trial in enumerate(store.trials())
    ]
    snapshot = Snapshot.unpack(Snapshot.take(shown).pack())
    assert {run.update for run in snapshot.runs} == {40}
    assert snapshot.files["policy.csv"] == ["action_0\n1.0\n", None, "action_0\n1.0\n", "action_0\n1.0\n"]
    assert snapshot.files["provenance.json"] == ["{}"] * 4
    assert snapshot.files["events.jsonl"] == [None] * 4
    sent = {
        (it.run_id, point.key, point.step, point.value, point.milliseconds)
        for it in shown
        for _, row in thinned(rows_after(it.trial.updates_path.read_bytes(), 0), it.trial.spec.num_updates)
        for point in points(row, it.trial.spec)
    }
    held = set()
    for metric in snapshot.metrics:
        found = snapshot.points(metric)
        runs = [found.run_ids[run] for run in found.runs]
        numbers = (found.steps.tolist(), found.values.tolist(), found.milliseconds.tolist())
        held |= {(run, metric, *rest) for run, *rest in zip(runs, *numbers, strict=True)}
    assert held == sent
    assert Snapshot.take(shown).pack() == Snapshot.take(shown).pack()


def test_what_nobody_would_unpack_is_not_packed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snapshots, "MAX_BYTES", 10)
    with pytest.raises(TrackingError, match="may unpack to 10 bytes, this one has"):
        Snapshot().pack()


def changed(column: int, value: float) -> np.ndarray:
    table = TABLE.copy()
    table[1, column] = value
    return table


@pytest.mark.parametrize(
    ("parts", "sentence"),
    [
        ({"names": ("../runs.json", *MEMBERS[1:])}, "its members must be runs.json, points.f64, texts.json"),
        ({"names": (MEMBERS[0], MEMBERS[2], MEMBERS[1])}, "its members must be"),
        ({"runs": {**RUNS, "format": 2}}, "cannot be read: 1 validation error"),
        ({"runs": {**RUNS, "runs": [{**RUN, "update": -1}]}}, "cannot be read: 1 validation error"),
        ({"runs": {**RUNS, "runs": [{**RUN, "code": "1"}]}}, "cannot be read: 1 validation error"),
        ({"runs": {**RUNS, "metrics": ["a", "b", "c"]}}, "cannot reshape array"),
        ({"runs": {**RUNS, "runs": []}}, "points of more than its 0 runs"),
        ({"table": changed(0, 1.0)}, "points of more than its 1 runs"),
        ({"table": changed(0, -1.0)}, "steps or times that cannot be"),
        ({"table": changed(1, 0.5)}, "steps or times that cannot be"),
        ({"table": changed(1, math.nan)}, "steps or times that cannot be"),
        ({"table": changed(2, math.inf)}, "steps or times that cannot be"),
        ({"texts": {**TEXTS, "texts": []}}, "cannot be read: tuple index out of range"),
        ({"texts": {**TEXTS, "files": {"policy.csv": []}}}, "must say of each of its 1 runs"),
    ],
)
def test_a_snapshot_that_says_what_cannot_be_is_refused(parts: Mapping[str, object], sentence: str) -> None:
    with pytest.raises(TrackingError, match=sentence):
        Snapshot.unpack(archive(**parts))  # type: ignore[arg-type]


def test_a_snapshot_that_would_fill_the_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snapshots, "MAX_BYTES", 10_000)
    many = {**TEXTS, "texts": ["x" * 20_000]}
    with pytest.raises(TrackingError, match=r"it unpacks to 2\d+ bytes, at most 10000 are taken"):
        Snapshot.unpack(archive(texts=many))
    runs = [{**RUN, "run_id": str(index)} for index in range(20)]
    often = {"texts": ["x" * 1000], "files": {"policy.csv": [0] * 20}}
    with pytest.raises(TrackingError, match="files come to more than 10000 characters"):
        Snapshot.unpack(archive(runs={**RUNS, "runs": runs}, texts=often))


def test_every_single_damage_to_the_bytes_is_noticed() -> None:
    data = archive()
    digest = hashlib.sha256(data).hexdigest()
    announced = Announcement(name="a.zip", size=len(data), sha256=digest, trials=1, updates=2)
    assert announced.check(data) == data
    for index in range(0, len(data), 7):
        damaged = data[:index] + bytes([data[index] ^ 1]) + data[index + 1 :]
        with pytest.raises(TrackingError, match="SHA-256 differs"):
            announced.check(damaged)
        try:  # even where nobody had counted the bytes: an answer or a sentence
            Snapshot.unpack(damaged)
        except TrackingError:
            continue


@pytest.mark.parametrize(
    "tag", ["", "{}", '{"name": "../../x", "size": 1, "sha256": "", "trials": 1, "updates": 1}']
)
def test_a_tag_that_announces_nothing_is_named(tag: str) -> None:
    with pytest.raises(TrackingError, match=r"the tag recrl\.snapshot announces no snapshot"):
        Announcement.of(tag)


def test_a_snapshot_that_is_not_there_is_named() -> None:
    announced = Announcement(name="b.zip", size=1, sha256="", trials=1, updates=1)
    with pytest.raises(TrackingError, match=r"snapshot/b\.zip is not there"):
        announced.check(None)
