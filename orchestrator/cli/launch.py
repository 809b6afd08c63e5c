"""``launch``: run incomplete trials, draw figures, film, and print the results."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from recrl.orchestrator.cli import display
from recrl.orchestrator.cli.output import say, short, show
from recrl.orchestrator.cli.plan import say_other_code, say_plan, selection_of
from recrl.orchestrator.cli.requests import LaunchRequest
from recrl.orchestrator.cli.status import say_failures
from recrl.orchestrator.cli.sweeps import command_line
from recrl.orchestrator.counting import counted
from recrl.orchestrator.errors import RecrlError, described
from recrl.orchestrator.executor_kind import ExecutorKind
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.checking import read_grid
from recrl.orchestrator.launch_grid import LaunchListener, LaunchOptions, LaunchOutcome, launch_grid
from recrl.orchestrator.launch_plan import Plan
from recrl.orchestrator.redaction import redacted
from recrl.orchestrator.run_sweep import SweepResult
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.orchestrator.sweep_progress import DisplayStatus, SweepProgress, progress
from recrl.orchestrator.tracking.client import tracking_uri
from recrl.orchestrator.tracking.mlflow_sync import last_report, report_mark, without_export

if TYPE_CHECKING:
    from recrl.analysis.data.sweep_data import Sweep


def run_launch(request: LaunchRequest, console: Console) -> ExitCode:
    """Run the incomplete trials of a grid file."""
    grid = read_grid(request.grid)
    options = LaunchOptions(
        root=request.root,
        storage=request.storage,
        selection=selection_of(request),
        max_concurrent=request.max_concurrent,
        address=request.address,
        ship_package=request.ship_package,
        executor=ExecutorKind(request.executor),
        mlflow=request.mlflow,
        tracking_uri=request.tracking_uri,
        figures=request.figures,
    )
    return launch_and_print(grid, options, console, given=request.given)


def launch_and_print(
    grid: GridSpec, options: LaunchOptions, console: Console, *, given: Sequence[str]
) -> ExitCode:
    """Run the incomplete trials of a checked grid, and print progress and results.

    Args:
        grid: the grid.
        options: of the launch.
        console: where to print.
        given: the arguments of ``recrl-sweep`` that continue the launch.
    """
    outcome = launch_grid(grid, options, _Printer(grid, options, console))
    place, store = outcome.place, outcome.place.store
    kept = f", a local copy of {place.address}" if place.address else ""
    say(console, f"Results    {short(store.folder)}{kept}")
    if outcome.tracking_uri:
        _say_synced(outcome, outcome.tracking_uri, options, console)
    if outcome.sweep:
        _say_results(outcome.sweep, console)
    report = store.figures_folder / "report.html"
    if outcome.sweep and options.figures and report.exists():
        say(console, f"Report     {short(report)}")
    return _say_result(outcome.result, place, options, given, console)


class _Printer(LaunchListener):
    """Listener that prints what a launch does."""

    def __init__(self, grid: GridSpec, options: LaunchOptions, console: Console) -> None:
        self._grid = grid
        self._options = options
        self._console = console
        self._store = SweepStore(options.root, grid.name)
        self._mlflow = MlflowWarning(self._store, options) if options.mlflow else None
        self._has_run = False  # whether all trials have ended

    @contextmanager
    def planned(self, plan: Plan, *, at_once: int, where: str) -> Iterator[None]:
        """Print the plan; show the progress while trials run."""
        say_plan(plan, self._grid, self._console, at_once=at_once, where=where)
        say_other_code(plan, self._console)
        if plan.left_out_sentence:
            say(self._console, plan.left_out_sentence)
        if not plan.to_do:
            self._has_run = True
            yield
            return
        if self._options.executor is ExecutorKind.RAY:
            address = self._options.address
            doing = f"Connecting to the Ray cluster at {address}" if address else "Starting Ray"
            say(self._console, f"{doing} ...")
        chosen = [trial.spec for trial in plan.trials]
        with display.live_progress(lambda: self._progress(chosen), self._console):
            yield
        self._has_run = True

    def _progress(self, specs: Sequence[TrialSpec]) -> SweepProgress:
        """Read the progress; print once why MLflow is behind, if it is."""
        if sentence := self._mlflow and self._mlflow.once():
            say(self._console, f"warning: {sentence}")
        return progress(specs, self._store)

    def stopping(self) -> None:
        """Print that trials save their state, or that they have ended."""
        what = "running trials save their state"
        if self._has_run:
            what = "no trial runs any more, figures or MLflow may be left out"
        say(self._console, f"Stopping: {what}. Press again to stop at once.")

    def drawing(self) -> None:
        """Print that figures are being drawn: it takes long."""
        say(self._console, "Drawing figures ...")

    def drawn(self, folder: Path) -> None:
        """Print the place of the figures."""
        say(self._console, f"Figures    {short(folder)}")

    def failed_to_draw(self, error: Exception) -> None:
        """Print the error, and how to see its traceback."""
        say(self._console, f"Figures    not all are drawn ({described(error)})")
        if isinstance(error, RecrlError | OSError):
            say(self._console, f"           to draw them later: {command_line('figures', self._store)}")
        else:
            again = command_line("figures", self._store)
            say(self._console, f"           this is a bug in recrl; for its traceback: {again}")

    def failed_to_write_outcomes(self, error: Exception) -> None:
        """Print the error, and how to try again."""
        say(self._console, f"MLflow     has no outcomes of the final policies ({described(error)})")
        say(self._console, f"           to send them later: {command_line('sync', self._store)}")

    def filming(self, trials: Sequence[TrialStore]) -> None:
        """Print the place of the videos."""
        folder = short(self._store.trials_folder)
        say(self._console, f"Videos     {folder}/*/{trials[0].videos_folder.name}")

    def failed_to_film(self, error: RecrlError) -> None:
        """Print the error."""
        say(self._console, f"           no video: {error}")


class MlflowWarning:
    """What keeps MLflow behind during a launch, said once: a wrong password, for example."""

    def __init__(self, store: SweepStore, options: LaunchOptions) -> None:
        self._store = store
        self._uri = tracking_uri(store, options.tracking_uri)
        self._before = report_mark(store, self._uri)  # of an earlier launch
        self._is_said = False

    def once(self) -> str:
        """Return the sentence after the first pass of this launch that was broken off, else an empty text."""
        if self._is_said or report_mark(self._store, self._uri) == self._before:
            return ""
        report = last_report(self._store, self._uri)
        if report is None or not report.is_broken_off:
            return ""
        self._is_said = True
        return f"MLflow is behind ({report.problem}); training goes on, and it is tried again"


def _say_results(sweep: Sweep, console: Console) -> None:
    """Print return and cost of the final policies."""
    from recrl.analysis.data.sweep_warnings import curriculum_warnings  # noqa: PLC0415
    from recrl.orchestrator.cli.result_table import result_table  # noqa: PLC0415

    table, caption = result_table(sweep)
    if len(table):
        say(console, "")
        show(table, console)
        say(console, caption)
    sentences = curriculum_warnings(sweep)
    for sentence in sentences:
        say(console, f"warning: {sentence}")
    if len(table) or sentences:
        say(console, "")


def _say_synced(outcome: LaunchOutcome, uri: str, options: LaunchOptions, console: Console) -> None:
    """Print the address of the sweep in MLflow, the command to open it, and whether it is up to date."""
    store = outcome.place.store
    where = redacted(uri) if options.tracking_uri else short(store.mlflow_database)
    say(console, f"MLflow     {where}")
    say(console, f"           {command_line('ui', store, options.tracking_uri)}")
    report = last_report(store, uri)
    if report and report.remark:
        say(console, f"           {without_export(report.remark)}")
    if not outcome.result.synced:  # a sync that was killed leaves the report of an earlier pass
        problem = f" ({report.problem})" if report and report.problem else ""
        again = command_line("sync", store, options.tracking_uri)
        say(console, f"           MLflow is not up to date{problem}; nothing is lost: {again}")


def _say_result(
    result: SweepResult, place: SweepPlace, options: LaunchOptions, given: Sequence[str], console: Console
) -> ExitCode:
    """Print the result of a launch, and how to continue."""
    store = place.store
    say(console, f"{store.name}: {display.status_sentence(result.progress)}")
    say_failures(result.progress, store, console)
    again = shlex.join(["recrl-sweep", *given])
    if result.progress.is_complete:
        return ExitCode.OK
    if result.stopped:
        say(console, f"Stopped; nothing is lost. Continue with: {again}")
        return ExitCode.STOPPED
    if damaged := result.progress.with_status(DisplayStatus.DAMAGED):
        rerun = again if options.selection.rerun_damaged else f"{again} --rerun-damaged"
        how = "" if place.uri else f"; to move the damaged files aside and run again: {rerun}"
        say(console, f"{counted(len(damaged), 'damaged trial')} left alone{how}")
    if result.failed:
        retry = again if options.selection.retry_failed else f"{again} --retry-failed"
        say(console, f"Try what failed again with: {retry}")
    elif not damaged:
        say(console, f"Not everything could be finished. Continue with: {again}")
    return ExitCode.TRIALS_FAILED
