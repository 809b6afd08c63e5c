"""The MLflow view of a sweep: a one-way mirror of its files that may be away without anyone waiting for it.

The only module that imports mlflow, and never in a trial's process: ``tracking_mirror`` makes one pass after
the other in a process of its own, politely scheduled. One experiment for a sweep's name (``recrl/<name>``),
one parent run for the sweep (a note, and figures as artifacts; no metrics, so that no chart shows it), one
child run for a trial. What a run shows is in ``tracking_points``. Run states are true:

    the trial's files say                                       the run is
    waiting, never started                                      not there; the parent's note counts it
    waiting to be resumed                                       SCHEDULED during a launch, KILLED after it
    running                                                     RUNNING
    running, but its process is gone, or silent for 5 minutes   KILLED
    complete                                                    FINISHED
    failed                                                      FAILED, with the tag ``recrl.error``

Three tags hold JSON, so that MLflow alone is enough to draw the figures (``tracking_reader``):
``recrl.spec``, the TrialSpec; ``recrl.progress``, where the trial stands; and of a complete trial
``recrl.phases``, what its episodes come to (``phase_totals``).

A run that goes on after an end is RUNNING again; its old end time stays until the next end, as MLflow's
client has no way to clear it.

Why nothing is lost and nothing is there twice: only committed rows are sent. How far a trial has been sent is
in a position file of its own, written after MLflow's reply. Killed between the two, the next pass sends the
same points again, with the timestamps of their rows, and MLflow keeps one of each. A lost or damaged position
means that everything is sent again, into the run that bears the trial's tag. Should a trial's file have been
cut back behind its position (its newest checkpoint was damaged), MLflow holds points that no longer are: the
run is deleted and a new one is made from the files, as for every run in ``sync(rebuild=True)``.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import os
import re
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recrl.orchestrator.errors import DamagedError, TrackingError
from recrl.orchestrator.files.locks import open_lock
from recrl.orchestrator.files.row_files import Extent
from recrl.orchestrator.files.small_files import write_atomically, write_json
from recrl.orchestrator.files.store import SweepStore, TrialRecord, TrialStore
from recrl.orchestrator.redaction import redacted
from recrl.orchestrator.spec import TrialState
from recrl.orchestrator.status import Standing, standing_of
from recrl.orchestrator.tracking.database import Database, OtherTables, ShownRun
from recrl.orchestrator.tracking.points import (
    VIEW,
    VIEW_STATE,
    Point,
    Row,
    Summary,
    charts_page,
    final_points,
    note,
    params,
    points,
    rows_after,
    thinned,
)
from recrl.orchestrator.tracking.snapshot import (
    SNAPSHOT_FOLDER,
    SNAPSHOT_NAMES,
    SNAPSHOT_TAG,
    Announcement,
    ShownTrial,
    Snapshot,
)
from recrl.orchestrator.trial.phase_totals import phase_totals

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

MAX_ERROR = 5_000  # characters of a failed trial's error
MAX_TAG = 8_000  # characters; MLflow cuts longer ones off, and half a JSON value is none
SNAPSHOT_SECONDS = 600.0  # between two snapshots of a sweep that runs, at least
SNAPSHOT_REST = 100.0  # times as long as the last one took
SPEC_TAG, PROGRESS_TAG, PHASES_TAG = "recrl.spec", "recrl.progress", "recrl.phases"
PROGRESS = ("update", "env_steps", "cpu_seconds", "start_limits")  # of the TrialRecord

# Read by mlflow when it is imported. A lost server must cost seconds, not MLflow's own four minutes; the
# mirror tries again by itself. A user's own settings stand.
ENVIRONMENT = {
    "DO_NOT_TRACK": "true",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
    "MLFLOW_LOGGING_LEVEL": "CRITICAL",
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
}


@dataclass(frozen=True)
class SyncReport:
    """What one pass did.

    Attributes:
        trials: trials that have begun.
        behind: those of them that MLflow does not show as their files are.
        points: points sent.
        problem: one line saying what kept MLflow from being up to date, or empty.
        remark: one line saying why reading a server will take longer than it could, or empty.
        finished_at: when the pass ended, seconds since 1970.
        experiment_id: the sweep's experiment, or empty if MLflow could not be reached.
        parent_run_id: the sweep's run, likewise.
    """

    trials: int = 0
    behind: int = 0
    points: int = 0
    problem: str = ""
    remark: str = ""
    finished_at: float = 0.0
    experiment_id: str = ""
    parent_run_id: str = ""

    @property
    def is_up_to_date(self) -> bool:
        """Whether MLflow showed all there was to show."""
        return not self.problem and not self.behind


def tracking_uri(store: SweepStore, given: str | None) -> str:
    """Where MLflow keeps the sweep: a database in the sweep's folder unless the user names a place.

    Args:
        store: the sweep.
        given: a server's address or a database's, as MLflow takes them, or None.

    Raises:
        TrackingError: MLflow has no such kind of store.
    """
    return f"sqlite:///{store.mlflow_database}" if given is None else checked_uri(given)


def checked_uri(given: str) -> str:
    """The address, made absolute, if MLflow takes it.

    Raises:
        TrackingError: MLflow has no such kind of store.
    """
    if not given.isprintable() or " " in given:
        raise TrackingError("the tracking address must hold no spaces and no control characters")
    scheme, separator, rest = given.partition("://")
    if scheme != "sqlite" and re.search("[/?#].*@", rest):  # others would take a part of it for a host
        raise TrackingError(
            "the tracking address must have no @ behind its host; in a password write %2F for /, %3F for ?, "
            "%23 for # and %40 for @"
        )
    if scheme == "sqlite" and rest.startswith("/") and len(rest) > 1:
        return f"sqlite:///{Path(rest.removeprefix('/')).absolute()}"
    if separator and rest and scheme.partition("+")[0] in ("http", "https", "postgresql", "mysql", "mssql"):
        return given
    raise TrackingError(
        "the tracking address must be http(s)://host:port, sqlite:///file.db or another database that MLflow "
        f"takes (postgresql, mysql, mssql), got {redacted(given)!r}"
    )


def sync(store: SweepStore, uri: str, *, rebuild: bool = False) -> SyncReport:
    """Bring MLflow up to date with the sweep's files, once; does nothing where nothing is new.

    Args:
        store: the sweep.
        uri: of ``tracking_uri``.
        rebuild: delete what MLflow has of the sweep and send everything anew.

    Returns:
        What was done, or why it could not be: nothing is raised when MLflow is away.
    """
    return Tracker(store, uri).bring_up_to_date(live=False, rebuild=rebuild)


def last_report(store: SweepStore, uri: str) -> SyncReport | None:
    """The report of the last pass that ended, in whatever process; None if there was none."""
    try:
        return SyncReport(**json.loads((mirror_folder(store, uri) / "report.json").read_text()))
    except (OSError, ValueError, TypeError):
        return None


class Tracker:
    """What one process knows of MLflow between its passes over a sweep."""

    def __init__(self, store: SweepStore, uri: str) -> None:
        self.store = store
        self.uri = uri
        self._view: _View | None = None

    def bring_up_to_date(self, *, live: bool, rebuild: bool = False) -> SyncReport:
        """One pass; whatever MLflow raises ends up in the report.

        Args:
            live: whether a launch is there that will resume what waits.
            rebuild: delete what MLflow has of the sweep first.
        """
        trials = [trial for trial in self.store.trials() if _has_begun(trial.record())]
        sent, done, problems, remark = 0, 0, list[str](), ""
        with _alone(self.store, self.uri):
            view, self._view = self._view, None  # to be asked anew should anything go wrong
            try:
                view = view or _View(self.store, self.uri, rebuild=rebuild)
                for trial in trials:
                    try:
                        sent += view.show_trial(trial, live=live)
                        done += 1
                    except Exception as error:
                        if _is_away(error):
                            raise
                        problems.append(f"{trial.folder.name}: {_one_line(error)}")
                view.show_sweep(live=live)
                remark = view.show_snapshot(live=live)
            except Exception as error:
                problems.append(_one_line(error))
            report = SyncReport(
                trials=len(trials),
                behind=len(trials) - done,
                points=sent,
                problem=problems[0] if problems else "",
                remark=remark,
                finished_at=time.time(),
                experiment_id=view.experiment_id if view else "",
                parent_run_id=view.parent_run_id if view else "",
            )
            write_json(mirror_folder(self.store, self.uri) / "report.json", asdict(report))
        self._view = None if problems else view
        return report


@dataclass(frozen=True)
class Position:
    """How far a trial has been sent.

    Attributes:
        run_id: the run that shows it.
        offset: the byte of ``updates.csv`` behind the last row sent.
        last_row: that row; if the file says otherwise, it was cut back and written anew.
        shown: the status, attempt, committed bytes, error and later additions that the run shows.
        artifacts: name, size and time of the files sent.
        summary: the means a complete trial ended with.
    """

    run_id: str
    offset: int = 0
    last_row: str = ""
    shown: Mapping[str, Any] = field(default_factory=dict)
    artifacts: Sequence[str] = ()
    summary: Mapping[str, float] = field(default_factory=dict)

    def fits(self, data: bytes) -> bool:
        """Whether the committed rows still are those that were sent."""
        return data[self.offset - len(self.last_row) : self.offset] == self.last_row.encode()


class _View:
    """MLflow's side of a sweep, in memory between the passes of one process."""

    def __init__(self, store: SweepStore, uri: str, *, rebuild: bool = False) -> None:
        self.store = store
        self.client = _connect(uri)
        self._uri = uri
        self._folder = mirror_folder(store, uri)
        self._sweep_tags = {"recrl.sweep": store.name, "recrl.sweep_id": _sweep_id(store)}
        self.experiment_id = self._find_experiment()
        self._places: dict[str, str] = {}  # of the runs' artifacts
        self._without_params: set[str] = set()  # runs that were just made, or whose maker died over them
        self._runs = self._find_runs()
        if rebuild:
            for run_id in self._runs.values():
                self._delete_run(run_id)
            for path in (self._parent_path, *self._folder.glob("trial-*.json")):
                path.unlink(missing_ok=True)
            self._runs = {}
        self._positions: dict[str, Position] = {}
        found = self._runs.get("")
        parent = _read_position(self._parent_path)
        if parent is None or parent.run_id != found:
            parent = Position(found or self._create_parent())
        self._parent = parent
        self._snapshot_due = time.monotonic() + SNAPSHOT_SECONDS
        if found is None:  # somebody may have deleted the parent alone
            for run_id in self._runs.values():
                self.client.set_tag(run_id, "mlflow.parentRunId", parent.run_id)

    @property
    def parent_run_id(self) -> str:
        """The sweep's own run."""
        return self._parent.run_id

    @property
    def _parent_path(self) -> Path:
        return self._folder / "sweep.json"

    def show_trial(self, trial: TrialStore, *, live: bool) -> int:
        """Bring the trial's run up to date; returns the number of points sent.

        In as few requests as MLflow allows, because each costs the server, or this process, about 10 ms.
        """
        from mlflow.entities import Metric, Param, RunTag  # noqa: PLC0415  (mlflow takes seconds to import)

        record = trial.record()
        if record.status is TrialState.DAMAGED:
            raise DamagedError(record.error)
        status = run_status(record, live=live)
        committed = record.committed.get(trial.updates_path.name, 0)
        added = _added_afterwards(trial)
        shown = {
            "status": status,
            "attempt": record.attempt,
            "committed": committed,
            "error": record.error,
            "added": [_mark(path) for path in added],
        }
        position = self._position(trial, record)
        if position.shown == shown:
            return 0
        data = _head(trial.updates_path, committed)
        if len(data) < committed:
            return 0  # the file is being cut back at this moment; the next pass sees how it went
        if Extent.of(data) != record.extents.get(trial.updates_path.name, Extent()):
            raise DamagedError(f"{trial.updates_path.name} is not what was committed: its checksum differs")
        if not position.fits(data):
            self._delete_run(position.run_id)
            position = Position(self._create_run(trial, record))
        if status == "FINISHED":
            trial.require_whole()
        new_points, position = _new_points(trial, data, position)
        if status == "FINISHED" and position.last_row:
            last = final_points(trial.updates(), trial.evaluation(), _last_row(data, position))
            summary = {point.key: point.value for point in last if point.key.startswith("summary/")}
            new_points, position = [*new_points, *last], replace(position, summary=summary)
        metrics = [Metric(point.key, point.value, point.milliseconds, point.step) for point in new_points]
        is_new = position.run_id in self._without_params
        told = [Param(key, value) for key, value in params(trial.spec).items()] if is_new else []
        try:
            position = self._send_results(trial, record, position)
            for path in added:
                position = self._send_files(position, [path], path.parent.name)
        except OSError:  # where there is no room for files there may be some for the curves
            self.client.log_batch(position.run_id, metrics=metrics, params=told)
            raise
        tags = [RunTag(key, value) for key, value in _state_tags(trial, record).items() if value]
        self.client.log_batch(position.run_id, metrics=metrics, params=told, tags=tags)
        self._without_params.discard(position.run_id)
        if position.shown.get("error") and not record.error:
            self.client.delete_tag(position.run_id, "recrl.error")
        if position.shown.get("status") != status:
            self._set_status(position.run_id, status, record.heartbeat)
        self._save(trial, replace(position, shown=shown))
        return len(metrics)

    def show_sweep(self, *, live: bool) -> None:
        """Bring the parent run up to date: its note, its status, the grid and the figures."""
        from mlflow.entities import RunTag  # noqa: PLC0415

        records = {trial.folder.name: trial.record() for trial in self.store.trials()}
        records |= {
            spec.folder_name: TrialRecord() for spec in self.store.specs() if spec.folder_name not in records
        }
        counts = Counter(standing_of(record, now=time.time()) for record in records.values())
        status = _sweep_status(counts, live=live)
        position = self._parent
        text = note(
            self.store.name,
            {standing: counts[standing] for standing in Standing},
            self._summaries(),
            charts=f"#{charts_page(self.experiment_id)}",
        )
        if position.shown.get("note") != text:
            self.client.log_batch(position.run_id, tags=[RunTag("mlflow.note.content", text)])
        if position.shown.get("status") != status:
            last = max((record.heartbeat for record in records.values()), default=0.0)
            self._set_status(position.run_id, status, last or time.time())
        position = self._send_files(position, [self.store.grid_path, self.store.info_path])
        position = self._send_files(position, sorted(self.store.figures_folder.glob("*")), "figures")
        position = replace(position, shown={**position.shown, "note": text, "status": status})
        if position != self._parent:
            write_json(self._parent_path, asdict(position))
            self._parent = position

    def show_snapshot(self, *, live: bool) -> str:
        """Bring the sweep's snapshot up to date; while a launch is there, only now and then.

        Returns:
            Why it could not be, or nothing; MLflow shows everything without it.
        """
        if live and time.monotonic() < self._snapshot_due:
            return ""
        shown = self._shown_trials()
        known = [(it.run_id, it.attempt, it.committed, it.complete) for it in shown]
        mark = hashlib.sha256(repr(known).encode()).hexdigest()
        last = self._parent.shown.get("snapshot", {})
        if not shown or last.get("mark") == mark:
            return ""
        began = time.monotonic()
        name = next(name for name in SNAPSHOT_NAMES if name != last.get("name"))
        try:
            self._send_snapshot(name, Snapshot.take(shown))
        except Exception as error:  # a server may take small files only
            return _one_line(error)
        finally:
            now = time.monotonic()
            self._snapshot_due = now + max(SNAPSHOT_SECONDS, SNAPSHOT_REST * (now - began))
        sent = {"mark": mark, "name": name}
        self._parent = replace(self._parent, shown={**self._parent.shown, "snapshot": sent})
        write_json(self._parent_path, asdict(self._parent))
        return ""

    def _shown_trials(self) -> list[ShownTrial]:
        """The trials as MLflow shows them, but for those whose files were cut back since."""
        found = []
        for trial in self.store.trials():
            position = self._positions.get(trial.folder.name)
            if position and position.shown:
                committed = int(position.shown["committed"])
                if position.fits(_head(trial.updates_path, committed)):
                    attempt, complete = position.shown["attempt"], position.shown["status"] == "FINISHED"
                    found.append(ShownTrial(trial, position.run_id, attempt, committed, complete))
        return found

    def _send_snapshot(self, name: str, snapshot: Snapshot) -> None:
        """Add the file, and only then say that it is there."""
        from mlflow.entities import RunTag  # noqa: PLC0415

        data = snapshot.pack()
        path = self._folder / name
        write_atomically(path, data)
        try:
            self.client.log_artifact(self.parent_run_id, str(path), SNAPSHOT_FOLDER)
        finally:
            path.unlink()
        announced = Announcement(
            name=name,
            size=len(data),
            sha256=hashlib.sha256(data).hexdigest(),
            trials=len(snapshot.runs),
            updates=sum(run.update for run in snapshot.runs),
        )
        self.client.log_batch(self.parent_run_id, tags=[RunTag(SNAPSHOT_TAG, announced.model_dump_json())])

    def _summaries(self) -> list[Summary]:
        summaries = []
        for trial in self.store.trials():
            position = self._positions.get(trial.folder.name)
            if position and position.summary:
                spec = trial.spec
                group = (spec.task.label, spec.agent.label, spec.method.label)
                summaries.append(Summary(group, position.summary))
        return summaries

    def _find_experiment(self) -> str:
        name = f"recrl/{self.store.name}"
        tags = {
            "mlflow.experimentKind": "custom_model_development",
            f"mlflow.sharedViewState.{VIEW}": json.dumps(VIEW_STATE),
        }
        experiment = self.client.get_experiment_by_name(name)
        if experiment is None:
            # A server knows where it keeps artifacts; a bare database would take the current folder.
            place = None if is_server(self._uri) else self.store.mlflow_artifacts.as_uri()
            return str(self.client.create_experiment(name, artifact_location=place, tags=tags))
        if experiment.lifecycle_stage != "active":
            self.client.restore_experiment(experiment.experiment_id)
        for key, value in tags.items():
            if experiment.tags.get(key) != value:
                self.client.set_experiment_tag(experiment.experiment_id, key, value)
        return str(experiment.experiment_id)

    def _find_runs(self) -> dict[str, str]:
        """Run by trial id, and the parent by the empty id; the oldest where there are several."""
        runs: dict[str, str] = {}
        for run in sorted(self._shown_runs(), key=lambda run: run.start_time):
            if run.tags.get("recrl.sweep_id") == self._sweep_tags["recrl.sweep_id"]:
                runs.setdefault(run.tags.get("recrl.trial_id", ""), run.run_id)
                self._places[run.run_id] = run.artifacts
        return runs

    def _shown_runs(self) -> Iterable[ShownRun]:
        """The experiment's runs, without the points: MLflow's client would take 5 ms for each of them."""
        if not is_server(self._uri):
            return Database(self._uri, OtherTables(self._uri)).runs(self.experiment_id)
        found: list[ShownRun] = []
        token: str | None = None
        while token is None or token:
            page = self.client.search_runs(
                [self.experiment_id],
                filter_string=f"tags.`recrl.sweep_id` = '{self._sweep_tags['recrl.sweep_id']}'",
                page_token=token,
            )
            found += [
                ShownRun(
                    str(run.info.run_id),
                    str(run.info.artifact_uri),
                    run.info.start_time,
                    run.data.tags,
                    frozenset(run.data.metrics),
                )
                for run in page
            ]
            token = page.token or ""
        return found

    def _create_parent(self) -> str:
        records = (trial.record() for trial in self.store.trials())
        begun = min((record.started_at for record in records if record.attempt), default=time.time())
        run = self.client.create_run(
            self.experiment_id,
            start_time=_milliseconds(begun),
            run_name=self.store.name,
            tags={**self._sweep_tags, "recrl.kind": "sweep"},
        )
        self._places[run.info.run_id] = str(run.info.artifact_uri)
        return str(run.info.run_id)

    def _create_run(self, trial: TrialStore, record: TrialRecord) -> str:
        spec = trial.spec
        tags = {
            **self._sweep_tags,
            "recrl.kind": "trial",
            "recrl.trial_id": spec.trial_id,
            SPEC_TAG: _json_tag(spec.to_json()),
            "recrl.group": f"{spec.method.label}, {spec.agent.label}, {spec.task.label}",
            "mlflow.parentRunId": self.parent_run_id,
        }
        run = self.client.create_run(
            self.experiment_id, start_time=_milliseconds(record.started_at), run_name=spec.title, tags=tags
        )
        run_id = str(run.info.run_id)
        self._runs[spec.trial_id] = run_id
        self._places[run_id] = str(run.info.artifact_uri)
        self._without_params.add(run_id)
        return run_id

    def _delete_run(self, run_id: str) -> None:
        """Take a run out of sight; ``mlflow gc`` removes it for good."""
        self.client.delete_run(run_id)

    def _position(self, trial: TrialStore, record: TrialRecord) -> Position:
        """How far the trial has been sent, as far as MLflow still has the run."""
        name = trial.folder.name
        if name not in self._positions:
            position = _read_position(self._position_path(trial))
            found = self._runs.get(trial.spec.trial_id)
            if position is None or position.run_id != found:
                position = Position(found or self._create_run(trial, record))
                if found and not self.client.get_run(found).data.params:
                    self._without_params.add(found)
            self._positions[name] = position
        return self._positions[name]

    def _position_path(self, trial: TrialStore) -> Path:
        return self._folder / f"trial-{trial.folder.name}.json"

    def _save(self, trial: TrialStore, position: Position) -> None:
        write_json(self._position_path(trial), asdict(position))
        self._positions[trial.folder.name] = position

    def _set_status(self, run_id: str, status: str, end: float) -> None:
        if status in ("RUNNING", "SCHEDULED"):
            self.client.update_run(run_id, status=status)
        else:
            self.client.set_terminated(run_id, status, end_time=_milliseconds(end))

    def _send_results(self, trial: TrialStore, record: TrialRecord, position: Position) -> Position:
        """Send the trial's small files, and at the end what it learnt."""
        paths = [trial.spec_path, trial.provenance_path]
        if record.status is TrialState.COMPLETE:
            paths += [trial.evaluation_path, trial.events_path, trial.policy_path, *trial.checkpoints()[:1]]
        if record.status is TrialState.FAILED:
            paths += [trial.error_path]
        return self._send_files(position, paths)

    def _send_files(self, position: Position, paths: Sequence[Path], folder: str | None = None) -> Position:
        """Add those of the files that are there, not empty, and not sent as they are now."""
        from mlflow.store.artifact.artifact_repository_registry import (  # noqa: PLC0415
            get_artifact_repository,
        )

        # client.log_artifact would ask for the whole run first, to know this place
        repository: Any = get_artifact_repository(self._places[position.run_id], self._uri)
        sent = list(position.artifacts)
        for path in paths:
            with suppress(FileNotFoundError):
                mark = _mark(path)
                if mark not in sent and path.stat().st_size and path.is_file():
                    repository.log_artifact(str(path), folder)
                    sent.append(mark)
        return replace(position, artifacts=sent)


def _state_tags(trial: TrialStore, record: TrialRecord) -> dict[str, str]:
    """How a run is marked for where its trial stands; empty where there is nothing to say."""
    tags = {
        "recrl.status": str(record.status),
        "recrl.attempt": str(record.attempt),
        "recrl.host": record.host,
        "recrl.error": record.error[:MAX_ERROR],
        PROGRESS_TAG: _json_tag({name: getattr(record, name) for name in PROGRESS}),
    }
    if record.status is TrialState.COMPLETE:
        totals = phase_totals(trial.episodes(), trial.spec.deploy_limits.values)
        tags[PHASES_TAG] = _json_tag(totals)
    return tags


def _added_afterwards(trial: TrialStore) -> list[Path]:
    """What was measured and filmed of the trial's frozen policy, for artifacts in folders of these names."""
    folders = (trial.evaluations_folder, trial.videos_folder)
    return [path for folder in folders for path in sorted(folder.glob("update-*"))]


def _mark(path: Path) -> str:
    """What tells a file from what it was before."""
    stat = path.stat()
    return f"{path.name} {stat.st_size} {stat.st_mtime_ns}"


def run_status(record: TrialRecord, *, live: bool) -> str:
    """What MLflow calls the state of a trial that has begun.

    Args:
        record: of the trial; ``attempt`` is at least 1.
        live: whether a launch is there that will resume what waits.
    """
    match standing_of(record, now=time.time()):
        case Standing.COMPLETE:
            return "FINISHED"
        case Standing.FAILED | Standing.DAMAGED:
            return "FAILED"
        case Standing.RUNNING:
            return "RUNNING"
        case Standing.INTERRUPTED:
            return "KILLED"
        case Standing.STOPPED | Standing.WAITING:
            return "SCHEDULED" if live else "KILLED"


def _sweep_status(counts: Mapping[Standing, int], *, live: bool) -> str:
    if live or counts[Standing.RUNNING]:
        return "RUNNING"
    if counts[Standing.FAILED]:
        return "FAILED"
    complete = counts[Standing.COMPLETE] == sum(counts.values())
    return "FINISHED" if complete else "KILLED"


def _new_points(trial: TrialStore, data: bytes, position: Position) -> tuple[list[Point], Position]:
    """The points behind a position, and the position behind them."""
    found: list[Point] = []
    end = position.offset
    for end, row in thinned(rows_after(data, position.offset), trial.spec.num_updates):  # noqa: B007
        found += points(row, trial.spec)
    start = data.rfind(b"\n", 0, max(0, end - 1)) + 1
    return found, replace(position, offset=end, last_row=data[start:end].decode())


def _has_begun(record: TrialRecord) -> bool:
    """Whether there is, or was, something to show."""
    return record.attempt > 0 or record.status is TrialState.DAMAGED


def _last_row(data: bytes, position: Position) -> Row:
    return next(row for _, row in rows_after(data, position.offset - len(position.last_row.encode())))


def _read_position(path: Path) -> Position | None:
    """The position in a file; None if there is none, or none that makes sense."""
    try:
        position = Position(**json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return None
    kinds = (str, int, str, dict, list, dict)
    values = (getattr(position, name) for name in Position.__dataclass_fields__)
    return position if all(map(isinstance, values, kinds)) else None


def _is_away(error: Exception) -> bool:
    """Whether asking MLflow for the next trial would fail in the same way."""
    from mlflow.exceptions import MlflowException  # noqa: PLC0415

    about_the_trial = ("INVALID_PARAMETER_VALUE", "BAD_REQUEST", "RESOURCE_DOES_NOT_EXIST")
    return isinstance(error, MlflowException) and error.error_code not in about_the_trial


def _connect(uri: str) -> MlflowClient:
    """A client for a store that is there, or has just been made.

    Raises:
        Exception: whatever mlflow raises if the store cannot be used.
    """
    for key, value in ENVIRONMENT.items():
        os.environ.setdefault(key, value)
    from mlflow.tracking import MlflowClient  # noqa: PLC0415

    if uri.startswith("sqlite:///"):
        path = Path(uri.removeprefix("sqlite:///"))
        if not path.exists():
            # Fifty migrations, not in one transaction: killed in their midst they would leave half a
            # database for ever. So they run beside.
            path.parent.mkdir(parents=True, exist_ok=True)
            beside = path.with_name(f".{path.name}.{os.getpid()}")
            beside.unlink(missing_ok=True)
            MlflowClient(f"sqlite:///{beside}").search_experiments(max_results=1)
            beside.replace(path)
        elif _head(path, 16) != b"SQLite format 3\0":
            raise TrackingError(f"{path}: not a sqlite database; delete it to have it made anew")
    return MlflowClient(uri)


@contextmanager
def _alone(store: SweepStore, uri: str) -> Iterator[None]:
    """Wait until no other process tells this store about this sweep; two would make every run twice."""
    folder = mirror_folder(store, uri)
    folder.mkdir(parents=True, exist_ok=True)
    with open_lock(folder / "lock") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def mirror_folder(store: SweepStore, uri: str) -> Path:
    """The positions for one MLflow store; the address itself may hold a password."""
    return store.mirror_folder / hashlib.sha256(uri.encode()).hexdigest()[:10]


def _sweep_id(store: SweepStore) -> str:
    """Ten hex digits: sweeps of one name, made at different times, are different sweeps."""
    created = str(store.info().get("created", ""))
    return hashlib.sha256(f"{store.name}\n{created}".encode()).hexdigest()[:10]


def _head(path: Path, length: int) -> bytes:
    if length == 0:
        return b""
    with path.open("rb") as file:
        return file.read(length)


def is_server(uri: str) -> bool:
    """Whether the address is that of a running MLflow server."""
    return uri.startswith(("http://", "https://"))


def _json_tag(value: Any) -> str:
    """JSON without blanks; NaN is null; empty where MLflow would cut it off."""
    text = json.dumps(_without_nan(value), separators=(",", ":"), allow_nan=False)
    return text if len(text) <= MAX_TAG else ""


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_without_nan(each) for each in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _milliseconds(seconds: float) -> int:
    return round(seconds * 1000)


def _one_line(error: Exception) -> str:
    return " ".join(redacted(f"{type(error).__name__}: {error}").split())[:500]
