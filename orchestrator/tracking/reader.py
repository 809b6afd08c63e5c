"""What MLflow knows of a sweep, read back in bulk: for figures where MLflow is all that is left.

The other half of ``tracking``. Three kinds of queries, whatever the number of runs:

* Runs, with their tags: a database is asked by one SELECT a table, a server by ``search_runs``, page by page.
* Histories of metrics: a database is asked by one SELECT a metric (``tracking_database``). A server hands
  over the sweep's snapshot (``tracking_snapshot``) and is asked only for what is newer. Its client has no
  request for many runs at once (mlflow#7365), so that goes by ``metrics/get-history-bulk-interval`` of its
  REST API, for some runs and one metric a request; beyond 2,500 points of a run it thins them evenly.
* Small files: from the snapshot as well; else artifacts, from this machine's disk where the store says they
  are there, or a few requests at once.

How long a thousand runs of 300 updates take: tests/benchmarks/bench_tracking_reader.py.
"""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol
from urllib.parse import unquote, urlparse

import numpy as np

from recrl.environments.cmdp import Floats
from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.redaction import redacted
from recrl.orchestrator.spec import TrialSpec, TrialState
from recrl.orchestrator.tracking.database import (
    Database,
    Ints,
    Points,
    ShownRun,
    points_of,
    unreadable,
)
from recrl.orchestrator.tracking.mlflow_sync import ENVIRONMENT, PHASES_TAG, PROGRESS_TAG, SPEC_TAG, is_server
from recrl.orchestrator.tracking.snapshot import (
    SNAPSHOT_FOLDER,
    SNAPSHOT_TAG,
    Announcement,
    Snapshot,
)

EXPERIMENTS = "recrl/"  # what the names of a sweep's experiment begin with
RUNS_A_PAGE = 200
RUNS_A_REQUEST = 25  # of metric histories; a server takes 100, which can keep it busy for long
POINTS_A_RUN = 2_500  # a server takes no more
REQUESTS_AT_ONCE = 4
PATIENCE = 120  # seconds that a server may think about a page of runs or histories
HISTORY = "/api/2.0/mlflow/metrics/get-history-bulk-interval"
LAST_STEP = 2**31 - 1  # that a server takes for the end of an interval
MAX_FILE_BYTES = 512 * 2**20  # of an artifact

logger = logging.getLogger("recrl.sweep")


@dataclass(frozen=True)
class TrackedTrial:
    """What MLflow says of a trial.

    Attributes:
        spec: what it is.
        status: where it stands.
        attempt: how often it was started.
        error: why it failed, or empty.
        progress: the fields of the TrialRecord that are shown, by name.
        phases: of a complete trial, ``phase_totals``; else empty.
        run_id: the run that shows it.
        artifacts: where the run's files are.
        metrics: names of the metrics it has.
    """

    spec: TrialSpec
    status: TrialState
    attempt: int
    error: str
    progress: dict[str, Any]
    phases: list[dict[str, Any]]
    run_id: str
    artifacts: str
    metrics: frozenset[str]


@dataclass(frozen=True, eq=False)
class History:
    """Points of one metric, of all trials; in order of steps for each trial.

    Attributes:
        trials: positions of the trials, [p].
        steps: environment steps, [p].
        values: [p].
        milliseconds: when, since 1970, [p].
    """

    trials: Ints
    steps: Ints
    values: Floats
    milliseconds: Ints


class Source(Protocol):
    """Where MLflow's runs are read from: a ``Database`` or a ``Server``."""

    def experiments(self) -> dict[str, str]:
        """The identity of every experiment of ours, by its name; others may be among them."""

    def runs(self, experiment_id: str) -> list[ShownRun]:
        """The runs of an experiment."""

    def points(self, metric: str, experiment_id: str) -> Points:
        """Every point of a metric in an experiment whose runs were asked for before."""


@dataclass(frozen=True, eq=False)
class TrackedSweep:
    """A sweep as MLflow shows it; of ``find_sweep``.

    Attributes:
        name: the sweep's name.
        trials: those that have begun and are shown.
        untold: runs without a spec: what an older version sent.
        uri: of the store.
        experiment_id: the sweep's experiment.
        parent_artifacts: where the sweep's own files are, or empty.
    """

    name: str
    trials: tuple[TrackedTrial, ...]
    untold: int
    uri: str
    experiment_id: str
    parent_artifacts: str
    _source: Source = field(repr=False)
    _snapshot: Snapshot = field(repr=False)

    def histories(self, metrics: Sequence[str]) -> dict[str, History]:
        """Every point of each of some metrics."""
        with ThreadPoolExecutor(REQUESTS_AT_ONCE) as pool:
            return dict(zip(metrics, pool.map(self._history, metrics), strict=True))

    def _history(self, metric: str) -> History:
        points = self._source.points(metric, self.experiment_id)
        positions = {trial.run_id: position for position, trial in enumerate(self.trials)}
        trials = np.array([positions.get(run, -1) for run in points.run_ids], dtype=np.int64)[points.runs]
        order = np.lexsort((points.steps, trials))
        order = order[trials[order] >= 0]
        return History(trials[order], points.steps[order], points.values[order], points.milliseconds[order])

    def files(self, name: str) -> list[bytes | None]:
        """A file of every trial, None where it has none."""
        found = _held_files(self._snapshot, self.trials, name)
        rest = [trial for trial in self.trials if trial.run_id not in found]
        asked = _files([trial.artifacts for trial in rest], name, self.uri)
        found |= dict(zip((trial.run_id for trial in rest), asked, strict=True))
        return [found[trial.run_id] for trial in self.trials]

    def own_file(self, name: str) -> bytes | None:
        """A file of the sweep's own run, None where it has none."""
        return _files([self.parent_artifacts], name, self.uri)[0] if self.parent_artifacts else None


class Server:
    """An MLflow server.

    Args:
        uri: its address.
    """

    def __init__(self, uri: str) -> None:
        for key, value in (ENVIRONMENT | {"MLFLOW_HTTP_REQUEST_TIMEOUT": str(PATIENCE)}).items():
            os.environ.setdefault(key, value)
        from mlflow.exceptions import MlflowException  # noqa: PLC0415
        from mlflow.tracking import MlflowClient  # noqa: PLC0415  (takes seconds)

        try:
            self._client = MlflowClient(uri)
            self._client.search_experiments(max_results=1)
        except MlflowException as error:
            raise unreadable(uri, error) from error
        self._uri = uri
        self._runs: list[ShownRun] = []
        self._snapshot = Snapshot()
        self._next_steps: dict[str, int] = {}
        self._last_step = 0

    def recall(self, snapshot: Snapshot, trials: Sequence[TrackedTrial]) -> None:
        """Take from a snapshot, from now on, what it holds; the server is asked for what is newer.

        Args:
            snapshot: of the sweep, taken at whatever time.
            trials: the sweep's trials as the server shows them now.
        """
        held = {run.run_id: run.update for run in snapshot.runs}
        self._snapshot = snapshot
        for trial in trials:
            if trial.run_id in held:
                is_new = int(trial.progress.get("update", LAST_STEP)) > held[trial.run_id]
                next_step = held[trial.run_id] * trial.spec.steps_per_update + 1
                self._next_steps[trial.run_id] = next_step if is_new else LAST_STEP
        self._last_step = max(it.spec.num_updates * it.spec.steps_per_update for it in trials)

    def experiments(self) -> dict[str, str]:
        """The identity of every experiment, by its name."""
        found = self._client.search_experiments(filter_string=f"name LIKE '{EXPERIMENTS}%'")
        return {str(it.name): str(it.experiment_id) for it in found}

    def runs(self, experiment_id: str) -> list[ShownRun]:
        """The runs of an experiment."""
        from mlflow.exceptions import MlflowException  # noqa: PLC0415

        found: list[ShownRun] = []
        token: str | None = None
        while True:
            try:
                page = self._client.search_runs([experiment_id], max_results=RUNS_A_PAGE, page_token=token)
            except MlflowException as error:
                raise unreadable(self._uri, error) from error
            found += [
                ShownRun(
                    run_id=str(run.info.run_id),
                    artifacts=str(run.info.artifact_uri),
                    start_time=int(run.info.start_time or 0),
                    tags=run.data.tags,
                    metrics=frozenset(run.data.metrics),
                )
                for run in page
            ]
            token = page.token
            if not token:
                break
        self._runs = found
        return found

    def points(self, metric: str, experiment_id: str) -> Points:
        """Every point of a metric in the experiment whose runs were asked for last."""
        held = self._snapshot.points(metric)
        after = self._next_steps if metric in self._snapshot.metrics else {}
        runs = [it.run_id for it in self._runs if metric in it.metrics and after.get(it.run_id) != LAST_STEP]
        rows: list[tuple[str, int, float, int]] = []
        for start in range(0, len(runs), RUNS_A_REQUEST):
            asked = runs[start : start + RUNS_A_REQUEST]
            points = self._ask(metric, asked, first_step=min(after.get(run, 0) for run in asked))
            rows += [
                (it["run_id"], step, it.get("value", 0.0), it["timestamp"])
                for it in points
                if (step := int(it.get("step", 0))) >= after.get(it["run_id"], 0)
            ]
        return held.followed_by(points_of(rows))

    def _ask(self, metric: str, runs: Sequence[str], *, first_step: int) -> list[dict[str, Any]]:
        from mlflow.exceptions import MlflowException  # noqa: PLC0415
        from mlflow.utils.rest_utils import http_request_safe  # noqa: PLC0415

        store: Any = self._client._tracking_client.store  # it knows the credentials
        asked = [("run_ids", run) for run in runs]
        asked += [("metric_key", metric), ("max_results", str(POINTS_A_RUN))]
        if 0 < first_step <= self._last_step < LAST_STEP:
            asked += [("start_step", str(first_step)), ("end_step", str(self._last_step))]
        request: Any = http_request_safe  # not annotated
        try:
            reply = request(store.get_host_creds(), HISTORY, "GET", params=asked, timeout=PATIENCE)
        except MlflowException as error:
            raise unreadable(self._uri, error) from error
        points: list[dict[str, Any]] = reply.json().get("metrics", [])
        return points


def find_sweep(uri: str, name: str | None) -> TrackedSweep:
    """The newest sweep of a name that MLflow shows.

    Args:
        uri: of ``tracking.tracking_uri``.
        name: of the sweep; None for the only one.

    Raises:
        TrackingError: MLflow cannot be reached, or shows no such sweep.
    """
    source: Source = Server(uri) if is_server(uri) else Database(uri)
    names = {
        title.removeprefix(EXPERIMENTS): identity
        for title, identity in source.experiments().items()
        if title.startswith(EXPERIMENTS)
    }
    if name is None and len(names) == 1:
        (name,) = names
    if name not in names:
        listed = f"it shows {', '.join(sorted(names))}" if names else "it shows none"
        which = f"no sweep {name!r}" if name else f"{len(names)} sweeps; say which one"
        raise TrackingError(f"MLflow at {redacted(uri)} shows {which}; {listed}")
    runs = source.runs(names[name])
    parents = [run for run in runs if run.tags.get("recrl.kind") == "sweep"]
    newest = max(parents, key=lambda run: run.start_time, default=None)
    if newest is not None:
        identity = newest.tags.get("recrl.sweep_id")
        runs = [run for run in runs if run.tags.get("recrl.sweep_id") == identity]
    members = [run for run in runs if run.tags.get("recrl.kind") == "trial"]
    told = [run for run in members if run.tags.get(SPEC_TAG)]
    trials = sorted(map(_trial, told), key=lambda trial: trial.spec.folder_name)
    snapshot = Snapshot()
    if isinstance(source, Server) and newest is not None and trials:
        snapshot = _snapshot(newest, uri)
        source.recall(snapshot, trials)
    return TrackedSweep(
        name=name,
        trials=tuple(trials),
        untold=len(members) - len(told),
        uri=uri,
        experiment_id=names[name],
        parent_artifacts=newest.artifacts if newest is not None else "",
        _source=source,
        _snapshot=snapshot,
    )


def _snapshot(parent: ShownRun, uri: str) -> Snapshot:
    """The sweep's snapshot; an empty one, and a warning, where the one that is announced cannot be used."""
    from mlflow.exceptions import MlflowException  # noqa: PLC0415

    tag = parent.tags.get(SNAPSHOT_TAG)
    if not tag:
        return Snapshot()
    try:
        announced = Announcement.of(tag)
        (data,) = _files([parent.artifacts], f"{SNAPSHOT_FOLDER}/{announced.name}", uri)
        return Snapshot.unpack(announced.check(data))
    except (TrackingError, MlflowException, OSError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        logger.warning("%s; MLflow is asked run by run instead, which takes longer", reason)
        return Snapshot()


def _held_files(snapshot: Snapshot, trials: Sequence[TrackedTrial], name: str) -> dict[str, bytes | None]:
    """A file by run, of those runs that have the same files as when the snapshot was taken."""
    texts = dict(zip(snapshot.runs, snapshot.files.get(name, ()), strict=False))
    held = {(run.run_id, run.attempt, run.complete): text for run, text in texts.items()}
    now = {it.run_id: (it.run_id, it.attempt, it.status is TrialState.COMPLETE) for it in trials}
    return {
        run_id: text.encode() if (text := held[state]) is not None else None
        for run_id, state in now.items()
        if state in held
    }


def _trial(run: ShownRun) -> TrackedTrial:
    tags = run.tags
    return TrackedTrial(
        spec=TrialSpec.from_json(json.loads(tags[SPEC_TAG])),
        status=TrialState(tags.get("recrl.status", TrialState.WAITING)),
        attempt=int(tags.get("recrl.attempt", "0")),
        error=tags.get("recrl.error", ""),
        progress=json.loads(tags.get(PROGRESS_TAG) or "{}"),
        phases=[_with_nan(row) for row in json.loads(tags.get(PHASES_TAG) or "[]")],
        run_id=run.run_id,
        artifacts=run.artifacts,
        metrics=run.metrics,
    )


def _with_nan(row: dict[str, Any]) -> dict[str, Any]:
    return {name: math.nan if value is None else value for name, value in row.items()}


def _files(places: Sequence[str], name: str, uri: str) -> list[bytes | None]:
    """A file from each of several artifact folders."""
    if all(urlparse(place).scheme in ("", "file") for place in places):
        return [_read(Path(unquote(urlparse(place).path)) / name) for place in places]
    with TemporaryDirectory() as folder, ThreadPoolExecutor(REQUESTS_AT_ONCE) as pool:
        folders = [Path(folder) / str(index) for index in range(len(places))]
        fetched = pool.map(lambda place, to: _fetch(place, name, uri, to), places, folders)
        return list(fetched)


def _fetch(place: str, name: str, uri: str, folder: Path) -> bytes | None:
    from mlflow.store.artifact.artifact_repository_registry import (  # noqa: PLC0415
        get_artifact_repository,
    )

    repository: Any = get_artifact_repository(place, uri)
    below = name.rpartition("/")[0] or None
    sizes = {file.path: file.file_size or 0 for file in repository.list_artifacts(below)}
    if name not in sizes:
        return None
    if sizes[name] > MAX_FILE_BYTES:
        raise TrackingError(f"{name} has {sizes[name]} bytes, at most {MAX_FILE_BYTES} are read")
    folder.mkdir()
    return _read(Path(repository.download_artifacts(name, str(folder))))


def _read(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None
