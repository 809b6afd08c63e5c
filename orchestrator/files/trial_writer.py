"""The writer of a trial: it holds the lease, and commits rows together with a checkpoint.

Only ``TrialWriter.commit`` appends rows. It syncs them, then writes a checkpoint with the files' lengths and
digests, then ``state.json``. After a crash in between, a restart truncates the files to the newest intact
checkpoint, and no row is duplicated. A lease is a token in ``state.json``. Once another attempt has taken
over the trial, all writes of this one are refused.
"""

from __future__ import annotations

import json
import logging
import operator
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recrl.environments.cmdp import EpisodeStats
from recrl.orchestrator.errors import CheckpointError, LostLeaseError, RowError
from recrl.orchestrator.files import checkpoint_format
from recrl.orchestrator.files.atomic_files import write_atomically, write_sealed
from recrl.orchestrator.files.row_files import Extent, RowFile, csv_line, rows_text
from recrl.orchestrator.files.trial_files import EPISODE_COLUMNS
from recrl.orchestrator.files.trial_record import TrialRecord, as_fields
from recrl.orchestrator.spec import TrialSpec, TrialStatus

if TYPE_CHECKING:
    from recrl.orchestrator.files.trial_store import TrialStore

COMMIT_SECONDS = 20.0  # between two commits
KEPT_CHECKPOINTS = 2
PROVENANCE_FORMAT = 2

_episode_values = operator.attrgetter(*EPISODE_COLUMNS)

logger = logging.getLogger("recrl.trial")


class TrialWriter:
    """Writer with the lease on a trial: buffers its rows and commits them together with a checkpoint.

    Attributes:
        store: the trial's folder.
        record: the last record this writer wrote.
    """

    def __init__(self, store: TrialStore, record: TrialRecord, spec: TrialSpec) -> None:
        self.store = store
        self.record = record
        self._agent = f"agent {spec.agent.label}"
        self._task = f"task {spec.task.label}"
        self._episodes = RowFile(store.episodes_path)
        self._updates = RowFile(store.updates_path)
        self._events = RowFile(store.events_path)
        self._rows = (self._episodes, self._updates, self._events)
        names = (
            store.spec_path.name,
            store.provenance_path.name,
        )  # other files are written anew, or resumed by ``restore``
        self._whole = {name: extent for name, extent in record.extents.items() if name in names}
        self._cpu_origin = time.process_time()
        self._cpu_before = record.cpu_seconds

    @property
    def cpu_seconds(self) -> float:
        """CPU time of all attempts of this trial so far."""
        return self._cpu_before + time.process_time() - self._cpu_origin

    def restore(self) -> dict[str, Any] | None:
        """Load the newest usable checkpoint and truncate the row files to it; None to start anew.

        A checkpoint is usable if it is intact, of this trial, and its rows exist. Otherwise it is renamed to
        ``*.damaged``, and the one before it is tried.

        Raises:
            StorageError: a file cannot be read at present, so whether it is intact is not known.
        """
        with self._lease():
            path, tree = self._newest_usable()
            state = tree["trial"] if tree else {}
            if tree is None:
                for file in self._rows:
                    file.resume_after(Extent())
            for file in self._rows:
                if self._rows_before(file.path) > file.length:
                    self.store.move_aside(file.path, copy=True)
            self._cpu_before = float(tree["cpu_seconds"]) if tree else 0.0
            self._cpu_origin = time.process_time()
            self._write_record(  # before the truncation: readers must not see files that are too short
                **as_fields(self._extents()),
                checkpoint=path.name if path else "",
                update=state.get("update", 0),
                env_steps=state.get("env_steps", 0),
            )
            for file in self._rows:
                if file.path.exists():
                    os.truncate(file.path, file.length)
        return tree["trial"] if tree else None

    def _rows_before(self, path: Path) -> int:
        """Return the bytes of rows that must not be lost: the committed ones, or all if the record was lost.

        A damaged file that the record named has been copied aside already.
        """
        is_lost = not any(file.path.name in self.record.committed for file in self._rows)
        if is_lost and path.exists():
            return path.stat().st_size
        return self.record.committed.get(path.name, 0)

    def _newest_usable(self) -> tuple[Path | None, dict[str, Any] | None]:
        """Return path and content of the newest usable checkpoint; unusable ones are renamed."""
        found: tuple[Path | None, dict[str, Any] | None] = (None, None)
        for path in self.store.checkpoints():
            try:
                tree = self.store.load_checkpoint(path)
            except CheckpointError as error:
                logger.warning("%s; it is renamed", error)
            else:
                if found[0] is not None:
                    continue
                if all(file.resume_after(_extent_in(tree, file.path.name)) for file in self._rows):
                    found = path, tree
                    continue
                logger.warning("%s: its rows are missing; it is renamed", path)
            damaged = path.with_suffix(".damaged")
            if os.path.lexists(damaged):
                self.store.move_aside(damaged)
            path.rename(damaged)
        return found

    def append_episode(self, episode: EpisodeStats) -> None:
        """Add an episode's row to the next commit.

        Raises:
            RowError: it has another number of costs than earlier episodes.
        """
        costs, limits = len(episode.costs), len(episode.limits)
        if not self._episodes.has_header:
            names = (f"cost_{i}" for i in range(costs)), (f"limit_{i}" for i in range(limits))
            self._episodes.columns = (*EPISODE_COLUMNS, *names[0], *names[1])
            self._episodes.add_text(csv_line(self._episodes.columns))
        if len(EPISODE_COLUMNS) + costs + limits != len(self._episodes.columns) or costs != limits:
            raise RowError(
                f"{self._task}: an episode has {costs} costs and {limits} limits, earlier ones had "
                f"{len(self._episodes.columns) - len(EPISODE_COLUMNS)} together"
            )
        cells = (*_episode_values(episode), *episode.costs, *episode.limits.values)
        self._episodes.add_text(csv_line(cells))

    def append_update(self, row: Mapping[str, Any]) -> None:
        """Add an update's row to the next commit; all rows of a trial have the same keys, in any order.

        Raises:
            RowError: the keys differ; the sentence names the agent.
        """
        self._updates.add_row(row, of=self._agent)

    def append_event(self, event: Mapping[str, Any]) -> None:
        """Add an event's line to the next commit."""
        self._events.add_text(json.dumps(event) + "\n")

    def write_evaluation(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write the final evaluations as a whole; at least one row, all with the same keys."""
        self._write_csv(self.store.evaluation_path, rows)

    def write_policy(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write the whole table of the final policy: one row per state, all with the same keys."""
        self._write_csv(self.store.policy_path, rows)

    def add_provenance(self, provenance: Mapping[str, Any]) -> None:
        """Add values to the provenance of this attempt, which stands after that of earlier ones."""
        with self._lease():
            name = self.store.provenance_path.name
            before = self.store.provenance() if name in self._whole else []
            if name not in self._whole:
                self.store.move_aside(self.store.provenance_path)
            attempt = self.record.attempt
            earlier = [it for it in before if it["attempt"] != attempt]
            values = next((it for it in before if it["attempt"] == attempt), {"attempt": attempt})
            attempts = [*earlier, {**values, **provenance}]
            write_sealed(self.store.provenance_path, {"attempts": attempts}, version=PROVENANCE_FORMAT)
            self._whole[name] = Extent.of(self.store.provenance_path.read_bytes())
            committed = {**self.record.extents, name: self._whole[name]}
            self._write_record(**as_fields(committed))

    def commit(self, tree: dict[str, Any], *, update: int, env_steps: int, **changes: Any) -> None:
        """Commit everything appended so far, and the trial's state.

        Args:
            tree: the trial's whole state after ``update``.
            update: policy updates done.
            env_steps: environment steps taken.
            changes: further fields of the TrialRecord to set.

        Raises:
            LostLeaseError: another attempt runs the trial now; nothing was written.
            StorageError: the disk is full or gone, or a file was truncated meanwhile; the previous commit is
                intact.
        """
        with self._lease():
            written = [file.write() for file in self._rows]
            extents = {
                file.path.name: Extent(length, digest.hexdigest())
                for file, (length, digest) in zip(self._rows, written, strict=True)
            }
            cpu_seconds = self.cpu_seconds
            data = checkpoint_format.encode(
                {
                    "trial_id": self.store.trial_id,
                    "trial": tree,
                    "files": {name: extent.length for name, extent in extents.items()},
                    "digests": {name: extent.sha256 for name, extent in extents.items()},
                    "cpu_seconds": cpu_seconds,
                }
            )
            name = f"checkpoint-{update:08d}.recrl"
            write_atomically(self.store.checkpoints_folder / name, data)
            self._write_record(
                **as_fields({**self._whole, **extents}),
                checkpoint=name,
                update=update,
                env_steps=env_steps,
                cpu_seconds=cpu_seconds,
                **changes,
            )
            for file, done in zip(self._rows, written, strict=True):
                file.mark_committed(done)
            for old in self.store.checkpoints()[KEPT_CHECKPOINTS:]:
                old.unlink()

    def heartbeat(self, *, update: int, env_steps: int, steps_per_second: float) -> None:
        """Record a sign of life and the progress; commits nothing.

        Raises:
            LostLeaseError: another attempt runs the trial now.
        """
        with self._lease():
            self._write_record(update=update, env_steps=env_steps, steps_per_second=steps_per_second)

    def close(self, status: TrialStatus, *, error: str = "", traceback: str = "") -> None:
        """End this attempt: complete, failed with an error, or waiting to be resumed."""
        with self._lease():
            self.store.reserve_path.unlink(missing_ok=True)
            if traceback:
                write_atomically(self.store.error_path, traceback.encode())
            self._write_record(status=status, error=error, steps_per_second=0.0)

    @contextmanager
    def _lease(self) -> Iterator[None]:
        with self.store.writing(), self.store.locked():
            if self.store.stored_record().token != self.record.token:
                raise LostLeaseError(f"{self.store.folder.name}: another attempt runs this trial now")
            yield

    def _extents(self) -> dict[str, Extent]:
        """Return the committed extents of all files."""
        return {**self._whole, **{file.path.name: file.extent for file in self._rows}}

    def _write_record(self, **changes: Any) -> None:
        self.record = replace(self.record, heartbeat=time.time(), **changes)
        self.store.write_record(self.record)

    def _write_csv(self, path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
        with self._lease():
            text = rows_text(rows)
            if path.exists() and path.read_bytes() != text:
                self.store.move_aside(path)
            write_atomically(path, text)
            self._whole[path.name] = Extent.of(text)


def _extent_in(tree: Mapping[str, Any], name: str) -> Extent:
    """Return the committed extent of a row file according to a checkpoint."""
    return Extent(int(tree["files"].get(name, 0)), tree["digests"].get(name, Extent().sha256))
