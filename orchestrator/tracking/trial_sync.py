"""Update the MLflow runs of trials from the trials' files.

Only committed rows are sent. If a trial's file was truncated to before its position (its newest checkpoint
was damaged), MLflow has points that no longer exist. Then the run is deleted and created again.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import TrialStatus
from recrl.orchestrator.tracking.final_outcomes import FinalOutcome, FinalOutcomes, trial_note
from recrl.orchestrator.tracking.mlflow_runs import SweepRuns
from recrl.orchestrator.tracking.positions import Position, file_mark, read_position, sync_folder
from recrl.orchestrator.tracking.run_content import (
    GROUP_TAG,
    Point,
    Row,
    final_points,
    group_tag,
    params,
    points,
    rows_after,
    single_values,
    thinned,
)
from recrl.orchestrator.tracking.run_status import state_tags, trial_run_status

if TYPE_CHECKING:
    from mlflow.entities import Metric


class TrialSync:
    """Sync of trials to their runs; it keeps the sent positions between passes."""

    def __init__(self, store: SweepStore, uri: str, runs: SweepRuns, outcomes: FinalOutcomes) -> None:
        self._runs = runs
        self._outcomes = outcomes
        self._folder = sync_folder(store, uri)
        self._positions: dict[str, Position] = {}

    def show(self, trial: TrialStore, *, live: bool, is_in_grid: bool, silence_seconds: float) -> int:
        """Update the trial's run; return the number of points sent.

        Args:
            trial: has begun.
            live: whether a launch runs that will resume waiting trials.
            is_in_grid: whether it is one of the last launch's grid.
            silence_seconds: of ``SweepStore.silence_seconds``.

        Raises:
            StorageError: a file of the trial differs from its commit, or cannot be read.
        """
        record = trial.record()
        if record.status is TrialStatus.DAMAGED:
            if record.is_unreadable or not self._show_damaged(trial, record):
                raise StorageError(f"{trial.folder.name}: {record.error}")
            return 0
        outcome = self._outcomes.of(trial.spec, record)
        status = trial_run_status(record, live=live, silence_seconds=silence_seconds)
        shown = _shown(trial, record, outcome, status=status, is_in_grid=is_in_grid)
        position = self._position(trial, record)
        if position.shown == shown:
            return 0
        data = trial.committed_bytes(trial.updates_path)
        if not position.fits(data):
            self._runs.delete(position.run_id)
            position = Position(self._runs.create(trial, record))
        new_points, position = _points_to_send(
            trial, data, position, outcome, is_finished=shown["status"] == "FINISHED"
        )
        position = self._send(trial, record, position, new_points, outcome, group=shown["group"])
        if position.shown.get("status") != shown["status"]:
            self._runs.set_status(position.run_id, shown["status"], record.heartbeat)
        self._save(trial, replace(position, shown=shown))
        return len(new_points)

    def _show_damaged(self, trial: TrialStore, record: TrialRecord) -> bool:
        """Give the run of a damaged trial its state and the error; its points stay, its outcome goes.

        Returns:
            Whether it has a run; none is made, because its parameters may be damaged, too.
        """
        from mlflow.entities import RunTag  # noqa: PLC0415

        position = self._positions.get(trial.folder.name) or read_position(self._path(trial))
        if position is None or position.run_id != self._runs.of_trial(trial.trial_id):
            return False
        shown = {"status": "FAILED", "attempt": record.attempt, "error": record.error}
        if position.shown != shown:
            client, run_id = self._runs.client, position.run_id
            tags = [RunTag(key, value) for key, value in state_tags(record).items()]
            client.log_batch(run_id, tags=tags, synchronous=True)
            self._runs.delete_tags(run_id, {"recrl.verdict", "mlflow.note.content"})
            self._runs.set_status(run_id, "FAILED", record.heartbeat or time.time())
            self._save(trial, replace(position, shown=shown))
        return True

    def _send(
        self,
        trial: TrialStore,
        record: TrialRecord,
        position: Position,
        new_points: Sequence[Point],
        outcome: FinalOutcome | None,
        *,
        group: str,
    ) -> Position:
        """Send points, params, tags and files.

        This uses as few requests as possible: each takes the server, or this process, about 10 ms.
        """
        from mlflow.entities import Metric, Param, RunTag  # noqa: PLC0415

        client, run_id = self._runs.client, position.run_id
        metrics: list[Metric] = [Metric(it.key, it.value, it.milliseconds, it.step) for it in new_points]
        is_new = run_id in self._runs.without_params
        new_params = [Param(key, value) for key, value in params(trial.spec).items()] if is_new else []
        try:
            position = self._runs.send_files(position, _result_files(trial, record))
            for path in _added_afterwards(trial):
                position = self._runs.send_files(position, [path], path.parent.name)
        except Exception:  # points may fit without room for files, or without the files' own store
            client.log_batch(run_id, metrics=metrics, params=new_params, synchronous=True)
            raise
        tag_values = {**state_tags(record), GROUP_TAG: group}
        if outcome is not None:
            start = record.start_limits or list(trial.spec.train_limits)
            text = trial_note(outcome, [float(limit) for limit in start])
            tag_values |= {"recrl.verdict": outcome.verdict, "mlflow.note.content": text}
        tags = [RunTag(key, value) for key, value in tag_values.items()]
        client.log_batch(run_id, metrics=metrics, params=new_params, tags=tags, synchronous=True)
        self._runs.without_params.discard(run_id)
        if position.shown.get("error") and not record.error:
            self._runs.delete_tags(run_id, {"recrl.error"})
        return position

    def _position(self, trial: TrialStore, record: TrialRecord) -> Position:
        """Return the position of the trial, if MLflow still has the run."""
        name = trial.folder.name
        if name not in self._positions:
            position = read_position(self._path(trial))
            found = self._runs.of_trial(trial.spec.trial_id)
            if position is None or position.run_id != found:
                position = Position(found or self._runs.create(trial, record))
                if found and not self._runs.client.get_run(found).data.params:
                    self._runs.without_params.add(found)
            self._positions[name] = position
        return self._positions[name]

    def _path(self, trial: TrialStore) -> Path:
        return self._folder / f"trial-{trial.folder.name}.json"

    def _save(self, trial: TrialStore, position: Position) -> None:
        position.write(self._path(trial))
        self._positions[trial.folder.name] = position


def _shown(
    trial: TrialStore, record: TrialRecord, outcome: FinalOutcome | None, *, status: str, is_in_grid: bool
) -> dict[str, Any]:
    """Return the content of the run besides points; nothing is sent while it does not change."""
    known = {} if outcome is None else {"outcome": repr(outcome)}
    return known | {
        "status": status,
        "group": group_tag(trial.spec, is_in_grid=is_in_grid),
        "attempt": record.attempt,
        "committed": record.committed.get(trial.updates_path.name, 0),
        "error": record.error,
        "added": [file_mark(path) for path in _added_afterwards(trial)],
    }


def _points_to_send(
    trial: TrialStore, data: bytes, position: Position, outcome: FinalOutcome | None, *, is_finished: bool
) -> tuple[list[Point], Position]:
    """Return the points after a position, those of a finished trial's end, and the new position."""
    if is_finished:
        trial.require_whole()
    found, position = _new_points(trial, data, position)
    if is_finished and position.last_row:
        row = _last_row(data, position)
        last = final_points(trial.updates(), trial.evaluation(), row)
        if outcome is not None:
            last += single_values(outcome.metrics, time.time())  # measured again: the newest counts
        found += last
    return found, position


def _new_points(trial: TrialStore, data: bytes, position: Position) -> tuple[list[Point], Position]:
    found: list[Point] = []
    end = position.offset
    for end, row in thinned(rows_after(data, position.offset), trial.spec.num_updates):  # noqa: B007
        found += points(row, trial.spec)
    start = data.rfind(b"\n", 0, max(0, end - 1)) + 1
    return found, replace(position, offset=end, last_row=data[start:end].decode())


def _last_row(data: bytes, position: Position) -> Row:
    return next(row for _, row in rows_after(data, position.offset - len(position.last_row.encode())))


def _result_files(trial: TrialStore, record: TrialRecord) -> list[Path]:
    """Return the trial's small files, and at its end its policy."""
    paths = [trial.spec_path, trial.provenance_path]
    if record.status is TrialStatus.COMPLETE:
        paths += [trial.evaluation_path, trial.events_path, trial.policy_path, *trial.checkpoints()[:1]]
    if record.status is TrialStatus.FAILED:
        paths += [trial.error_path]
    return paths


def _added_afterwards(trial: TrialStore) -> list[Path]:
    """Return evaluations and videos made by ``evaluate``, for artifacts in folders of these names."""
    folders = (trial.evaluations_folder, trial.videos_folder)
    return [path for folder in folders for path in sorted(folder.glob("update-*"))]
