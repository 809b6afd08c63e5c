"""Copy a sweep's files to MLflow, one-way, without delaying any trial.

No trial's process imports mlflow: ``background_sync`` makes the passes in a separate process. A sweep's name
has one experiment (``recrl/<name>``). The sweep has one parent run with a note, and with figures and the
export file as artifacts. It has no metrics, so that it is in no chart. Each trial has one child run, whose
content is in ``run_content``. States of runs:

    the trial's files say                                       the run is
    waiting, never started                                      not there; the parent's note counts it
    waiting to be resumed                                       SCHEDULED during a launch, KILLED after it
    running                                                     RUNNING
    running, but its process is gone, or silent for too long    KILLED
    complete                                                    FINISHED
    failed, or damaged                                          FAILED, with the tag ``recrl.error``

``positions`` and ``trial_sync`` explain why no point is lost or duplicated. To get the data back, read the
export file (``export_download``): MLflow's points are only for its charts.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from recrl.orchestrator.errors import DamagedError, StorageError, first_line
from recrl.orchestrator.files.atomic_files import write_json
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.redaction import redacted
from recrl.orchestrator.spec import TrialStatus
from recrl.orchestrator.tracking.client import is_away, one_line
from recrl.orchestrator.tracking.export_file import ExportWriter
from recrl.orchestrator.tracking.final_outcomes import FinalOutcomes
from recrl.orchestrator.tracking.mlflow_runs import SweepRuns
from recrl.orchestrator.tracking.positions import exclusive, file_mark, sync_folder
from recrl.orchestrator.tracking.sweep_sync import SweepSync
from recrl.orchestrator.tracking.trial_sync import TrialSync

logger = logging.getLogger("recrl.mlflow")


@dataclass(frozen=True)
class SyncReport:
    """Report of one pass.

    Attributes:
        trials: trials that have begun.
        behind: begun trials that are not up to date in MLflow. A damaged one is, once its run is FAILED.
        points: points sent.
        problem: one line on why MLflow is not up to date, or empty.
        is_broken_off: whether the problem is of MLflow or of the pass, and not of a trial's files.
        remark: one line on why the export file could not be uploaded, or empty.
        experiment_id: the sweep's experiment, or empty if MLflow could not be reached.
    """

    trials: int = 0
    behind: int = 0
    points: int = 0
    problem: str = ""
    is_broken_off: bool = False
    remark: str = ""
    experiment_id: str = ""

    @property
    def is_up_to_date(self) -> bool:
        """Whether MLflow is up to date."""
        return not self.problem and not self.behind


def sync(
    store: SweepStore, uri: str, *, rebuild: bool = False, write_export: ExportWriter | None = None
) -> SyncReport:
    """Bring MLflow up to date with the sweep's files, once; do nothing if there is nothing new.

    While a launch on this machine runs the sweep, waiting trials are shown as SCHEDULED, as it shows them.

    Args:
        store: the sweep.
        uri: of ``client.tracking_uri``.
        rebuild: delete the sweep's runs in MLflow and send everything again.
        write_export: writes the sweep's export file, for its upload; None to upload none.

    Returns:
        The report of the pass; nothing is raised if MLflow is unreachable.
    """
    return Tracker(store, uri, write_export).bring_up_to_date(live=store.is_locked(), rebuild=rebuild)


def last_report(store: SweepStore, uri: str) -> SyncReport | None:
    """Return the report of the last finished pass of any process; None if there was none."""
    try:
        saved = json.loads(_report_path(store, uri).read_text())
        return SyncReport(**{key: saved[key] for key in SyncReport.__dataclass_fields__ if key in saved})
    except (OSError, ValueError, TypeError):
        return None


def report_mark(store: SweepStore, uri: str) -> str:
    """Return a value that changes with each pass; empty before the first."""
    try:
        return file_mark(_report_path(store, uri))
    except OSError:
        return ""


def _report_path(store: SweepStore, uri: str) -> Path:
    return sync_folder(store, uri) / "report.json"


def without_export(remark: str) -> str:
    """Return the sentence on an export file that could not be uploaded."""
    return f"without the export file ({remark}): MLflow still has the previous one"


class Tracker:
    """State of one process between its passes over a sweep."""

    def __init__(self, store: SweepStore, uri: str, write_export: ExportWriter | None = None) -> None:
        self.store = store
        self.uri = uri
        self._write_export = write_export
        self._view: _View | None = None

    def bring_up_to_date(self, *, live: bool, rebuild: bool = False) -> SyncReport:
        """Make one pass; errors of MLflow are in the report.

        Args:
            live: whether a launch runs that will resume waiting trials.
            rebuild: first delete the sweep's runs in MLflow.
        """
        trials = [trial for trial in self.store.trials() if _has_begun(trial.record())]
        points: list[int] = []  # of each trial that is shown
        problems: list[str] = []
        unreadable: list[str] = []  # why files of trials cannot be used
        remark = ""
        with exclusive(self.store, self.uri):
            view, self._view = self._view, None  # made anew after any error
            try:
                view = view or _View(self.store, self.uri, self._write_export, rebuild=rebuild)
                listed, silence = self._listed(), self.store.silence_seconds
                for trial in trials:
                    known = listed is None or trial.folder.name in listed
                    with _kept(problems, unreadable, trial):
                        sent = view.trials.show(trial, live=live, is_in_grid=known, silence_seconds=silence)
                        points.append(sent)
                remark = view.sweep.show(live=live)
            except Exception as error:
                logger.debug("MLflow runs of %s", self.store.name, exc_info=True)
                problems.append(one_line(error))
            report = SyncReport(
                trials=len(trials),
                behind=len(trials) - len(points),
                points=sum(points),
                problem=next(iter([*problems, *unreadable]), ""),
                is_broken_off=bool(problems),
                remark=remark,
                experiment_id=view.runs.experiment_id if view else "",
            )
            write_json(_report_path(self.store, self.uri), asdict(report))
        self._view = None if problems else view
        return report

    def _listed(self) -> set[str] | None:
        """Return the folder names of the last launch's grid; None if the file that lists them is damaged."""
        try:
            return {spec.folder_name for spec in self.store.specs()}
        except DamagedError:  # the parent run's update reports it
            return None


class _View:
    """The sweep's runs, in memory between the passes of one process."""

    def __init__(
        self, store: SweepStore, uri: str, write_export: ExportWriter | None, *, rebuild: bool
    ) -> None:
        self.runs = SweepRuns(store, uri, rebuild=rebuild)
        if rebuild:
            folder = sync_folder(store, uri)
            for path in (folder / "sweep.json", *folder.glob("trial-*.json")):
                path.unlink(missing_ok=True)
        self.trials = TrialSync(store, uri, self.runs, FinalOutcomes(store))
        self.sweep = SweepSync(store, uri, self.runs, write_export)


@contextmanager
def _kept(problems: list[str], unreadable: list[str], trial: TrialStore) -> Iterator[None]:
    """Record why a trial cannot be shown; this does not stop the others."""
    try:
        yield
    except StorageError as error:
        unreadable.append(redacted(first_line(error)))
    except Exception as error:
        if is_away(error):
            raise
        logger.debug("MLflow run of %s", trial.folder.name, exc_info=True)
        problems.append(f"{trial.folder.name}: {one_line(error)}")


def _has_begun(record: TrialRecord) -> bool:
    """Return whether there is, or was, a trial to show."""
    return record.attempt > 0 or record.status is TrialStatus.DAMAGED
