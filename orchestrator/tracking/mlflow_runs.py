"""The MLflow runs of one sweep: a parent run for the sweep and a child run for each trial."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recrl.orchestrator.errors import DamagedError
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.tracking.chart_view import view_tag
from recrl.orchestrator.tracking.client import EXPERIMENTS, connect, is_server, sqlite_path
from recrl.orchestrator.tracking.positions import Position, file_mark

if TYPE_CHECKING:
    from mlflow.entities import Run


class SweepRuns:
    """The experiment of a sweep and its runs.

    Attributes:
        client: MLflow's.
        experiment_id: the experiment of all sweeps of this name.
        parent_id: the sweep's own run.
        without_params: runs that still need their params.
    """

    def __init__(self, store: SweepStore, uri: str, *, rebuild: bool = False) -> None:
        """Find the runs; create the experiment and the parent run if they are missing.

        Args:
            store: the sweep.
            uri: of ``client.tracking_uri``.
            rebuild: first delete existing runs.
        """
        self.client = connect(uri)
        self.without_params: set[str] = set()
        self._store = store
        self._uri = uri
        self._tags = {"recrl.sweep": store.name, "recrl.sweep_id": _sweep_id(store)}
        self.experiment_id = self._find_experiment()
        self._offer_charts()
        self._artifacts: dict[str, str] = {}  # artifact location of each run
        self._of_trials = self._find_runs()
        if rebuild:
            for run_id in self._of_trials.values():
                self.delete(run_id)
            self._of_trials = {}
        found = self._of_trials.pop("", None)
        self.parent_id = found or self._create_parent()
        if found is None:  # a user may have deleted the parent only
            for run_id in self._of_trials.values():
                self.client.set_tag(run_id, "mlflow.parentRunId", self.parent_id, synchronous=True)

    def of_trial(self, trial_id: str) -> str | None:
        """Return the run of a trial, None if there is none.

        A run that is not known is searched for: another process may have created it since.
        """
        if trial_id not in self._of_trials:
            self._of_trials |= self._find_runs(f" and tags.`recrl.trial_id` = '{trial_id}'")
        return self._of_trials.get(trial_id)

    def create(self, trial: TrialStore, record: TrialRecord) -> str:
        """Create the run of a trial, and return its id."""
        spec = trial.spec
        tags = {
            **self._tags,
            "recrl.kind": "trial",
            "recrl.trial_id": spec.trial_id,
            "mlflow.parentRunId": self.parent_id,
        }
        run_id = self._create(spec.title, record.started_at, tags)
        self._of_trials[spec.trial_id] = run_id
        self.without_params.add(run_id)
        return run_id

    def delete(self, run_id: str) -> None:
        """Delete a run; ``mlflow gc`` removes it permanently."""
        self.client.delete_run(run_id)

    def set_status(self, run_id: str, status: str, end: float) -> None:
        """Set a run's status.

        A run that continues after an end keeps the old end time until the next end, because MLflow's client
        cannot clear it.
        """
        if status in ("RUNNING", "SCHEDULED"):
            self.client.update_run(run_id, status=status)
        else:
            self.client.set_terminated(run_id, status, end_time=_milliseconds(end))

    def delete_tags(self, run_id: str, names: set[str]) -> None:
        """Delete those tags of a run that it has; a pass that was interrupted may have deleted them."""
        for name in names & self.client.get_run(run_id).data.tags.keys():
            self.client.delete_tag(run_id, name)

    def send_files(self, position: Position, paths: Sequence[Path], folder: str | None = None) -> Position:
        """Upload files that exist, are not empty and have changed since their last upload."""
        from mlflow.store.artifact.artifact_repository_registry import (  # noqa: PLC0415
            get_artifact_repository,
        )

        # client.log_artifact would first request the whole run, to find this location
        repository: Any = get_artifact_repository(self._artifacts[position.run_id], self._uri)
        sent = dict(position.artifacts)
        for path in paths:
            with suppress(FileNotFoundError):
                place, mark = f"{folder or '.'}/{path.name}", file_mark(path)
                if sent.get(place) != mark and path.stat().st_size and path.is_file():
                    repository.log_artifact(str(path), folder)
                    sent[place] = mark
        return replace(position, artifacts=sent)

    def _find_experiment(self) -> str:
        name = f"{EXPERIMENTS}{self._store.name}"
        tags = {"mlflow.experimentKind": "custom_model_development"}
        experiment = self.client.get_experiment_by_name(name)
        if experiment is None:
            place = self._artifact_location()
            return str(self.client.create_experiment(name, artifact_location=place, tags=tags))
        if experiment.lifecycle_stage != "active":
            self.client.restore_experiment(experiment.experiment_id)
        for key, value in tags.items():
            if experiment.tags.get(key) != value:
                self.client.set_experiment_tag(experiment.experiment_id, key, value)
        return str(experiment.experiment_id)

    def _artifact_location(self) -> str | None:
        """Return where a new experiment keeps its files, None if MLflow's server knows.

        For a bare database MLflow's default would be the current folder. Sweeps of one name may share an
        experiment, so its files are beside the database, not in a folder of one of the sweeps.
        """
        if is_server(self._uri):
            return None
        database = sqlite_path(self._uri)
        return (database.parent / "mlartifacts" if database else self._store.mlflow_artifacts).as_uri()

    def _offer_charts(self) -> None:
        """Store the view of the charts; a server that refuses so long a tag still gets the runs."""
        from mlflow.exceptions import MlflowException  # noqa: PLC0415

        tags = self.client.get_experiment(self.experiment_id).tags
        for key, value in view_tag(_num_costs(self._store)).items():
            if tags.get(key) != value:
                with suppress(MlflowException):
                    self.client.set_experiment_tag(self.experiment_id, key, value)

    def _find_runs(self, condition: str = "") -> dict[str, str]:
        """Return runs by trial id, the parent by the empty id; the oldest if there are several.

        Args:
            condition: more of MLflow's query, from ``and`` on.
        """
        found: dict[str, str] = {}
        for run in sorted(self._own_runs(condition), key=lambda run: run.info.start_time or 0):
            run_id = str(run.info.run_id)
            found.setdefault(run.data.tags.get("recrl.trial_id", ""), run_id)
            self._artifacts[run_id] = str(run.info.artifact_uri)
        return found

    def _own_runs(self, condition: str) -> list[Run]:
        """Return the runs of this sweep that fulfil a condition; MLflow sends them in pages."""
        query = f"tags.`recrl.sweep_id` = '{self._tags['recrl.sweep_id']}'{condition}"
        runs: list[Run] = []
        token: str | None = None
        while token is None or token:
            page = self.client.search_runs([self.experiment_id], query, page_token=token)
            runs += page
            token = page.token or ""
        return runs

    def _create_parent(self) -> str:
        records = (trial.record() for trial in self._store.trials())
        begun = min((record.started_at for record in records if record.attempt), default=time.time())
        return self._create(self._store.name, begun, {**self._tags, "recrl.kind": "sweep"})

    def _create(self, name: str, start: float, tags: dict[str, str]) -> str:
        run = self.client.create_run(
            self.experiment_id, start_time=_milliseconds(start), run_name=name, tags=tags
        )
        self._artifacts[run.info.run_id] = str(run.info.artifact_uri)
        return str(run.info.run_id)


def _sweep_id(store: SweepStore) -> str:
    """Return ten hex digits: sweeps of one name, made at different times, are different sweeps."""
    created = str(store.info().get("created", ""))
    return hashlib.sha256(f"{store.name}\n{created}".encode()).hexdigest()[:10]


def _num_costs(store: SweepStore) -> int:
    """Return the largest number of costs of a task; 1 if the list of trials is damaged."""
    try:
        return max((len(spec.deploy_limits) for spec in store.specs()), default=0)
    except DamagedError:  # the pass over the sweep reports it
        return 1


def _milliseconds(seconds: float) -> int:
    return round(seconds * 1000)
