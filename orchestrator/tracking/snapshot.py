"""What MLflow shows of a sweep, in one file: a server hands it over at once, instead of run by run.

The mirror adds it to the artifacts of the sweep's own run (``tracking``); whoever reads a server
(``tracking_reader``) takes from it what has not changed since and asks the server for the rest. It changes
how long reading takes and nothing else: without it, or with one that is old or damaged, the same is read.

A zip archive of three members:

    runs.json     for each run: its identity, attempt, updates and whether it is complete; then the names of
                  the metrics
    points.f64    little-endian float64, [p, 3 + number of metrics]: position of the run in runs.json,
                  environment steps, milliseconds since 1970, then the metrics of ``tracking_points.points``;
                  NaN where there is no point
    texts.json    the runs' small files: ``texts``, each different one; ``files``, for each name and run the
                  position of its text, or null where the run has no such file

What comes from a server is checked before it is used: sizes before anything is unpacked, every count and
position against the others. Nothing is written to disk under a name from the archive.

Letters: p rows of points, one for each run and shown update.
"""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from recrl.environments.cmdp import Floats
from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.files.archives import UNREADABLE, unpacked
from recrl.orchestrator.files.store import TrialStore
from recrl.orchestrator.tracking.database import Points
from recrl.orchestrator.tracking.points import points, rows_after, thinned

SNAPSHOT_TAG = "recrl.snapshot"  # of the sweep's own run: an ``Announcement``
SNAPSHOT_FOLDER = "snapshot"  # among its artifacts
SNAPSHOT_NAMES = ("a.zip", "b.zip")  # they take turns: nobody replaces what another one reads
FROM_THE_BEGINNING = ("provenance.json",)
AT_THE_END = ("evaluation.csv", "events.jsonl", "policy.csv")

MAX_BYTES = 512 * 2**20  # unpacked
MEMBERS = ("runs.json", "points.f64", "texts.json")
NUMBERS = "<f8"
BEFORE_METRICS = 3  # columns of the points
LARGEST = 2**53  # below which float64 holds every integer
LONG_AGO = (1980, 1, 1, 0, 0, 0)  # the time of every member: equal snapshots give equal bytes

STRICT = ConfigDict(frozen=True, extra="forbid")
Count = Annotated[int, Field(ge=0, lt=LARGEST)]


class Announcement(BaseModel):
    """What the tag of the sweep's run says of the snapshot.

    Attributes:
        name: of the artifact, in SNAPSHOT_FOLDER.
        size: bytes.
        sha256: of its bytes, in hex.
        trials: how many it holds.
        updates: policy updates that they had made, all together.
    """

    model_config = STRICT

    name: Literal["a.zip", "b.zip"]
    size: Annotated[int, Field(ge=0, le=MAX_BYTES)]
    sha256: str
    trials: Count
    updates: Count

    @classmethod
    def of(cls, tag: str) -> Announcement:
        """The announcement that a tag holds.

        Raises:
            TrackingError: it holds none.
        """
        try:
            return cls.model_validate_json(tag)
        except ValidationError as error:
            raise TrackingError(f"the tag {SNAPSHOT_TAG} announces no snapshot: {tag[:100]!r}") from error

    def check(self, data: bytes | None) -> bytes:
        """The artifact, if it is the one that was announced.

        Raises:
            TrackingError: it is not there, is another one, or only a part of it.
        """
        if data is None:
            raise TrackingError(f"{SNAPSHOT_FOLDER}/{self.name} is not there")
        if len(data) != self.size:
            raise TrackingError(f"{SNAPSHOT_FOLDER}/{self.name} must have {self.size} bytes, got {len(data)}")
        if hashlib.sha256(data).hexdigest() != self.sha256:
            raise TrackingError(
                f"{SNAPSHOT_FOLDER}/{self.name} is not what was announced: its SHA-256 differs"
            )
        return data


class HeldRun(BaseModel):
    """How much of a run a snapshot holds.

    Attributes:
        run_id: MLflow's identity of the run. A run's points only ever grow: where a trial's rows were cut
            back behind what MLflow shows, the mirror makes a new run.
        attempt: of the trial, when its small files were read.
        update: policy updates made by then; the points shown of them are there.
        complete: whether the trial was, so that all of its small files are there.
    """

    model_config = STRICT

    run_id: str
    attempt: Count
    update: Count
    complete: bool


class _Runs(BaseModel):
    """``runs.json``."""

    model_config = STRICT

    format: Literal[1] = 1
    runs: tuple[HeldRun, ...]
    metrics: tuple[str, ...]


class _Texts(BaseModel):
    """``texts.json``."""

    model_config = STRICT

    texts: tuple[str, ...]
    files: dict[str, tuple[Count | None, ...]]


@dataclass(frozen=True)
class ShownTrial:
    """A trial and what MLflow shows of it.

    Attributes:
        trial: its files.
        run_id: the run.
        attempt: that the run shows.
        committed: bytes of ``updates.csv`` that it shows.
        complete: whether it shows the trial as complete.
    """

    trial: TrialStore
    run_id: str
    attempt: int
    committed: int
    complete: bool


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What MLflow shows of some runs.

    Attributes:
        runs: those that it holds.
        metrics: names of the metrics.
        table: the points, [p, 3 + number of metrics], as ``points.f64`` has them.
        files: for each name of a small file that of every run; None where it has none.
    """

    runs: tuple[HeldRun, ...] = ()
    metrics: tuple[str, ...] = ()
    table: Floats = field(default_factory=lambda: np.empty((0, BEFORE_METRICS)))
    files: Mapping[str, Sequence[str | None]] = field(default_factory=dict)

    @classmethod
    def take(cls, shown: Sequence[ShownTrial]) -> Snapshot:
        """What MLflow shows of these trials, from their files."""
        runs: list[HeldRun] = []
        tables: list[Floats] = []
        columns: dict[str, int] = {}
        for position, it in enumerate(shown):
            update, table = _shown_rows(it, position, columns)
            tables.append(table)
            runs.append(HeldRun(run_id=it.run_id, attempt=it.attempt, update=update, complete=it.complete))
        whole = np.full((sum(map(len, tables)), BEFORE_METRICS + len(columns)), math.nan)
        start = 0
        for table in tables:
            whole[start : start + len(table), : table.shape[1]] = table
            start += len(table)
        files = {name: [_text(it, name) for it in shown] for name in (*FROM_THE_BEGINNING, *AT_THE_END)}
        return cls(tuple(runs), tuple(columns), whole, files)

    def points(self, metric: str) -> Points:
        """Every point of a metric that it holds; none where it does not know the metric."""
        rows, values = self.table[:0], self.table[:0, 0]
        if metric in self.metrics:
            column = self.table[:, BEFORE_METRICS + self.metrics.index(metric)]
            there = ~np.isnan(column)
            rows, values = self.table[there], column[there]
        runs, steps, milliseconds = rows[:, :BEFORE_METRICS].astype(np.int64).T
        return Points([run.run_id for run in self.runs], runs, steps, values, milliseconds)

    def pack(self) -> bytes:
        """The archive; equal snapshots give equal bytes.

        Raises:
            TrackingError: nobody would unpack it, as it is too large.
        """
        texts: dict[str, int] = {}
        files = {
            name: tuple(None if text is None else texts.setdefault(text, len(texts)) for text in of_runs)
            for name, of_runs in self.files.items()
        }
        members = (
            _Runs(runs=self.runs, metrics=self.metrics).model_dump_json().encode(),
            self.table.astype(NUMBERS).tobytes(),
            _Texts(texts=tuple(texts), files=files).model_dump_json().encode(),
        )
        size = sum(map(len, members))
        if size > MAX_BYTES:
            raise TrackingError(f"a snapshot may unpack to {MAX_BYTES} bytes, this one has {size}")
        data = io.BytesIO()
        with zipfile.ZipFile(data, "w") as archive:
            for name, member in zip(MEMBERS, members, strict=True):
                told = zipfile.ZipInfo(name, LONG_AGO)
                archive.writestr(told, member, zipfile.ZIP_DEFLATED, compresslevel=1)
        return data.getvalue()

    @classmethod
    def unpack(cls, data: bytes) -> Snapshot:
        """The snapshot in an archive that somebody else may have made.

        Raises:
            TrackingError: it is damaged, too large, or says what cannot be.
        """
        try:
            told_runs, told_points, told_texts = _members(data)
            told = _Runs.model_validate_json(told_runs)
            texts = _Texts.model_validate_json(told_texts)
            table = np.frombuffer(told_points, NUMBERS).reshape(-1, BEFORE_METRICS + len(told.metrics))
            files = {
                name: [None if at is None else texts.texts[at] for at in of_runs]
                for name, of_runs in texts.files.items()
            }
        except UNREADABLE as error:
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            raise TrackingError(f"the snapshot cannot be read: {reason}") from error
        found = cls(told.runs, told.metrics, table, files)
        found._check()
        return found

    def _check(self) -> None:
        """Hold every count and position against the others."""
        before = self.table[:, :BEFORE_METRICS]
        if not ((before >= 0.0) & (before < LARGEST) & (before == np.floor(before))).all():
            raise TrackingError("the snapshot has points at steps or times that cannot be")
        if (before[:, 0] >= len(self.runs)).any():
            raise TrackingError(f"the snapshot has points of more than its {len(self.runs)} runs")
        if any(len(of_runs) != len(self.runs) for of_runs in self.files.values()):
            raise TrackingError(
                f"the snapshot must say of each of its {len(self.runs)} runs what files it has"
            )
        if sum(len(text) for of_runs in self.files.values() for text in of_runs if text) > MAX_BYTES:
            raise TrackingError(f"the snapshot's files come to more than {MAX_BYTES} characters")


def _shown_rows(shown: ShownTrial, position: int, columns: dict[str, int]) -> tuple[int, Floats]:
    """A trial's policy updates, and the rows of its points.

    Args:
        shown: the trial.
        position: of its run.
        columns: position of each metric among the metrics; grows by those that are new.
    """
    spec, path = shown.trial.spec, shown.trial.updates_path
    data = b""
    if shown.committed:
        with path.open("rb") as file:
            data = file.read(shown.committed)
    rows: list[dict[int, float]] = []
    for _, row in thinned(rows_after(data, 0), spec.num_updates):
        found = points(row, spec)
        cells = {columns.setdefault(point.key, len(columns)): point.value for point in found}
        before = {0: position, 1: found[0].step, 2: found[0].milliseconds}
        rows.append(before | {BEFORE_METRICS + column: value for column, value in cells.items()})
    table = np.full((len(rows), BEFORE_METRICS + len(columns)), math.nan)
    for index, cells in enumerate(rows):
        table[index, list(cells)] = list(cells.values())
    last_line = data.rfind(b"\n", 0, max(0, len(data) - 1)) + 1
    updates = [int(row["update"]) for _, row in rows_after(data, last_line)]
    return max(updates, default=0), table


def _text(shown: ShownTrial, name: str) -> str | None:
    """A small file of a trial, if MLflow has it: empty ones are not sent."""
    if name in AT_THE_END and not shown.complete:
        return None
    path = shown.trial.folder / name
    return (path.read_bytes().decode() or None) if path.exists() else None


def _members(data: bytes) -> list[bytes]:
    """The archive's members, if they are those of a snapshot and small enough.

    Raises:
        ValueError: they are not; what else is wrong with the archive, ``zipfile`` says.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if tuple(archive.namelist()) != MEMBERS:
            raise ValueError(f"its members must be {', '.join(MEMBERS)}")
        return unpacked(archive, MEMBERS, max_bytes=MAX_BYTES)
