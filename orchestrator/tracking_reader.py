"""What MLflow knows of a sweep, read back in bulk: for figures where MLflow is all that is left.

The other half of ``tracking``. Three kinds of queries, whatever the number of runs:

* Runs, with their tags: ``search_runs``, a page of 1,000 runs a request.
* Histories of metrics. MLflow's client has none for many runs at once (mlflow#7365), and one request a run
  and metric takes a tenth of a second each. A database is asked by one SELECT a metric over the sweep's
  experiment, which sqlite answers from the primary key of MLflow's table ``metrics`` alone: with (key,
  timestamp, step, run_uuid, value, is_nan) it holds all of it. A server is asked by
  ``metrics/get-history-bulk-interval`` of its REST API, for 100 runs and one metric a request, a few requests
  at once; beyond 2,500 points of a run it thins them evenly.
* Small files: artifacts, from this machine's disk where the store says they are there, else a few requests
  at once.

How long a thousand runs of 300 updates take: tests/benchmarks/bench_tracking_reader.py.
"""

from __future__ import annotations

import gc
import json
import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlparse

import numpy as np
import numpy.typing as npt
import pandas as pd

from recrl.environments.cmdp import Floats
from recrl.orchestrator.errors import TrackingError
from recrl.orchestrator.spec import TrialSpec, TrialState
from recrl.orchestrator.tracking import ENVIRONMENT, PHASES_TAG, PROGRESS_TAG, SPEC_TAG, is_server

if TYPE_CHECKING:
    from mlflow.entities import Run
    from mlflow.tracking import MlflowClient

Ints = npt.NDArray[np.int64]

EXPERIMENTS = "recrl/"  # what the names of a sweep's experiment begin with
RUNS_A_REQUEST = 100  # of metric histories; a server takes no more
POINTS_A_RUN = 2_500  # likewise
REQUESTS_AT_ONCE = 4
HISTORY = "/api/2.0/mlflow/metrics/get-history-bulk-interval"
SELECT = """\
SELECT m.run_uuid, m.step, m.value, m.timestamp FROM metrics AS m
WHERE m.key = :key AND m.run_uuid IN (SELECT run_uuid FROM runs WHERE experiment_id = :experiment)"""


@dataclass(frozen=True)
class TrackedTrial:
    """What MLflow says of a trial.

    Attributes:
        spec: what it is.
        status: where it stands.
        error: why it failed, or empty.
        progress: the fields of the TrialRecord that are shown, by name.
        phases: of a complete trial, ``phase_totals``; else empty.
        run_id: the run that shows it.
        artifacts: where the run's files are.
        metrics: names of the metrics it has.
    """

    spec: TrialSpec
    status: TrialState
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
    _client: MlflowClient = field(repr=False)

    def histories(self, metrics: Sequence[str]) -> dict[str, History]:
        """Every point of each of some metrics."""
        collects = gc.isenabled()
        gc.disable()  # a million new tuples would make it walk through all of them again and again
        try:
            with ThreadPoolExecutor(REQUESTS_AT_ONCE) as pool:
                return dict(zip(metrics, pool.map(self._history, metrics), strict=True))
        finally:
            if collects:
                gc.enable()

    def _history(self, metric: str) -> History:
        read = self._from_server if is_server(self.uri) else self._from_database
        rows = pd.DataFrame.from_records(read(metric), columns=["run", "step", "value", "time"])
        numbers, known = pd.factorize(rows["run"])
        positions = {trial.run_id: position for position, trial in enumerate(self.trials)}
        trials = np.array([positions.get(run, -1) for run in known], dtype=np.int64)[numbers]
        steps = rows["step"].to_numpy(np.int64)
        order = np.lexsort((steps, trials))
        order = order[trials[order] >= 0]
        values, times = rows["value"].to_numpy(np.float64), rows["time"].to_numpy(np.int64)
        return History(trials[order], steps[order], values[order], times[order])

    def files(self, name: str) -> list[bytes | None]:
        """A file of every trial, None where it has none."""
        return _files([trial.artifacts for trial in self.trials], name, self.uri)

    def own_file(self, name: str) -> bytes | None:
        """A file of the sweep's own run, None where it has none."""
        return _files([self.parent_artifacts], name, self.uri)[0] if self.parent_artifacts else None

    def _from_database(self, metric: str) -> list[tuple[Any, ...]]:
        from sqlalchemy import text  # noqa: PLC0415  (MLflow's own way to its database)

        store: Any = self._client._tracking_client.store  # its engine knows the database
        with store.engine.connect() as connection:
            result = connection.execute(text(SELECT), {"key": metric, "experiment": int(self.experiment_id)})
            return list(result.cursor.fetchall())  # plain tuples: SQLAlchemy's rows take longer

    def _from_server(self, metric: str) -> list[tuple[Any, ...]]:
        runs = [trial.run_id for trial in self.trials if metric in trial.metrics]
        rows: list[tuple[Any, ...]] = []
        for start in range(0, len(runs), RUNS_A_REQUEST):
            points = self._ask_server(metric, runs[start : start + RUNS_A_REQUEST])
            rows += [
                (it["run_id"], it.get("step", 0), it.get("value", 0.0), it["timestamp"]) for it in points
            ]
        return rows

    def _ask_server(self, metric: str, runs: Sequence[str]) -> list[dict[str, Any]]:
        from mlflow.utils.rest_utils import http_request_safe  # noqa: PLC0415

        store: Any = self._client._tracking_client.store  # it knows the credentials
        asked = [("run_ids", run) for run in runs]
        asked += [("metric_key", metric), ("max_results", str(POINTS_A_RUN))]
        request: Any = http_request_safe  # not annotated
        reply = request(store.get_host_creds(), HISTORY, "GET", params=asked)
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
    client = _connect(uri)
    names = {
        str(each.name).removeprefix(EXPERIMENTS): str(each.experiment_id)
        for each in client.search_experiments(filter_string=f"name LIKE '{EXPERIMENTS}%'")
    }
    if name is None and len(names) == 1:
        (name,) = names
    if name not in names:
        listed = f"it shows {', '.join(sorted(names))}" if names else "it shows none"
        which = f"no sweep {name!r}" if name else f"{len(names)} sweeps; say which one"
        raise TrackingError(f"MLflow at {uri} shows {which}; {listed}")
    runs = _runs(client, names[name])
    parents = [run for run in runs if run.data.tags.get("recrl.kind") == "sweep"]
    newest = max(parents, key=lambda run: int(run.info.start_time or 0), default=None)
    if newest is not None:
        identity = newest.data.tags.get("recrl.sweep_id")
        runs = [run for run in runs if run.data.tags.get("recrl.sweep_id") == identity]
    members = [run for run in runs if run.data.tags.get("recrl.kind") == "trial"]
    told = [run for run in members if run.data.tags.get(SPEC_TAG)]
    return TrackedSweep(
        name=name,
        trials=tuple(sorted(map(_trial, told), key=lambda trial: trial.spec.folder_name)),
        untold=len(members) - len(told),
        uri=uri,
        experiment_id=names[name],
        parent_artifacts=str(newest.info.artifact_uri) if newest is not None else "",
        _client=client,
    )


def _connect(uri: str) -> MlflowClient:
    for key, value in ENVIRONMENT.items():
        os.environ.setdefault(key, value)
    from mlflow.exceptions import MlflowException  # noqa: PLC0415
    from mlflow.tracking import MlflowClient  # noqa: PLC0415  (takes seconds)

    if uri.startswith("sqlite:///") and not Path(uri.removeprefix("sqlite:///")).exists():
        raise TrackingError(f"{uri.removeprefix('sqlite:///')}: no such file; MLflow would make an empty one")
    try:
        client = MlflowClient(uri)
        client.search_experiments(max_results=1)
    except MlflowException as error:
        raise TrackingError(f"MLflow at {uri} cannot be read: {str(error).splitlines()[0]}") from error
    return client


def _runs(client: MlflowClient, experiment_id: str) -> list[Run]:
    found: list[Run] = []
    token: str | None = None
    while True:
        page = client.search_runs([experiment_id], max_results=1_000, page_token=token)
        found += page
        token = page.token
        if not token:
            return found


def _trial(run: Run) -> TrackedTrial:
    tags = run.data.tags
    return TrackedTrial(
        spec=TrialSpec.from_json(json.loads(tags[SPEC_TAG])),
        status=TrialState(tags.get("recrl.status", TrialState.WAITING)),
        error=tags.get("recrl.error", ""),
        progress=json.loads(tags.get(PROGRESS_TAG) or "{}"),
        phases=[_with_nan(row) for row in json.loads(tags.get(PHASES_TAG) or "[]")],
        run_id=str(run.info.run_id),
        artifacts=str(run.info.artifact_uri),
        metrics=frozenset(run.data.metrics),
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
    if name not in {file.path for file in repository.list_artifacts()}:
        return None
    folder.mkdir()
    return _read(Path(repository.download_artifacts(name, str(folder))))


def _read(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None
