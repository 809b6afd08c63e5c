"""``launch``: run incomplete trials, draw figures, film, and print the results."""

from __future__ import annotations

import contextlib
import logging
import shlex
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from rich.console import Console

from recrl.orchestrator.cli import display
from recrl.orchestrator.cli.output import say, short, show
from recrl.orchestrator.cli.plan import room, say_other_code, say_plan
from recrl.orchestrator.cli.requests import DEFAULT_ROOT, LaunchRequest
from recrl.orchestrator.cli.results import draw
from recrl.orchestrator.cli.status import say_failures
from recrl.orchestrator.cli.sweeps import wanted
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.executors import Executor, InlineExecutor
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.grid.grid import read_grid
from recrl.orchestrator.grid.grid_spec import GridSpec
from recrl.orchestrator.grid.plan import Plan
from recrl.orchestrator.places import SweepPlace
from recrl.orchestrator.redaction import redacted
from recrl.orchestrator.remote.opening import sweep_place
from recrl.orchestrator.report_refresh import refreshing
from recrl.orchestrator.sweep import BackgroundSync, LaunchSettings, SweepResult, launch, stopping_on_signals
from recrl.orchestrator.sweep_progress import DisplayStatus, SweepProgress, progress
from recrl.orchestrator.tracking.address import tracking_uri
from recrl.orchestrator.tracking.background_sync import start_sync
from recrl.orchestrator.tracking.mlflow_sync import last_report

if TYPE_CHECKING:
    from recrl.analysis.data.sweep_data import Sweep

SYNC_INTERVAL_SECONDS = 5.0

logger = logging.getLogger("recrl.sweep")


def run_launch(request: LaunchRequest, console: Console) -> ExitCode:
    """Run the incomplete trials of a grid file."""
    return launch_grid(read_grid(request.grid), request, console)


def launch_grid(grid: GridSpec, request: LaunchRequest, console: Console) -> ExitCode:
    """Run the incomplete trials of a checked grid; ``request.grid`` is not read."""
    from recrl.analysis.data import sweep_data  # noqa: PLC0415  (imports pandas)

    store = SweepStore(request.root, grid.name)
    only = wanted(request.only)
    place = sweep_place(store, request.storage)
    place.prepare()
    executor = _executor(grid, place, request)
    at_once, where = room(grid, request)
    uri = tracking_uri(store, request.tracking_uri) if request.mlflow else None
    stop = threading.Event()
    read: list[Sweep] = []  # at the end, if any trial is complete

    def watch(plan: Plan) -> None:
        say_plan(plan, grid, console, at_once=at_once, where=where)
        say_other_code(plan, console)
        if plan.to_do:
            if request.executor == "ray":
                _say_starting(request, console)
            chosen = [trial.spec for trial in plan.trials]
            shown.enter_context(display.live_progress(lambda: progress(chosen, store), console))
            if request.figures:
                shown.enter_context(refreshing(store))

    def finish(after: SweepProgress) -> None:
        shown.close()
        if not stop.is_set() and after.counts[DisplayStatus.COMPLETE]:
            read.append(sweep_data.load(store))
            if request.figures:
                _draw_at_end(read[0], store, console)
        if not stop.is_set():
            _film(grid, after, store, stop, console)

    def say_stopping() -> None:
        say(console, "Stopping: running trials save their state. Press again to stop at once.")

    with contextlib.ExitStack() as shown, _listening(stop, say_stopping):
        settings = LaunchSettings(
            grid,
            place,
            executor,
            only=only,
            retry_failed=request.retry_failed,
            rerun_damaged=request.rerun_damaged,
            rerun_changed=request.rerun_changed,
            start_sync=_sync_to(uri) if uri else None,
            watch=watch,
            finish=finish,
        )
        result = launch(settings, stop=stop)
    kept = f", a local copy of {place.address}" if place.address else ""
    say(console, f"Results    {short(store.folder)}{kept}")
    if uri:
        _say_synced(result, store, uri, request, console)
    for sweep in read:
        _say_results(sweep, console)
    report = store.figures_folder / "report.html"
    if read and request.figures and report.exists():
        say(console, f"Report     {short(report)}")
    return _say_result(result, store, request, console)


def _listening(stop: threading.Event, say_stopping: Callable[[], None]) -> AbstractContextManager[None]:
    """Stop on signals; only the main thread of a process can."""
    is_main = threading.current_thread() is threading.main_thread()
    return stopping_on_signals(stop, say_stopping) if is_main else contextlib.nullcontext()


def _executor(grid: GridSpec, place: SweepPlace, request: LaunchRequest) -> Executor:
    if request.ship_package and not request.address:
        raise RecrlError("--ship-package: needs an --address to ship to")
    if request.executor == "inline":
        return InlineExecutor()
    if place.uri.startswith("memory://"):
        raise RecrlError(f"{place.uri}: is memory of a single process; use --executor inline")
    from recrl.orchestrator.ray.executor import RayExecutor  # noqa: PLC0415  (imports ray)

    return RayExecutor(
        address=request.address,
        ship_package=request.ship_package,
        cpus_per_trial=grid.resources.cpus_per_trial,
        gpus_per_trial=grid.resources.gpus_per_trial,
        custom_per_trial=grid.resources.custom_per_trial,
        max_concurrent=request.max_concurrent or grid.resources.max_concurrent,
        teacher=grid.resources.teacher,
        silence_seconds=grid.resources.silence_seconds,
    )


def _sync_to(uri: str) -> Callable[[SweepStore], BackgroundSync]:
    return lambda store: start_sync(store, uri, interval_seconds=SYNC_INTERVAL_SECONDS)


def _say_starting(request: LaunchRequest, console: Console) -> None:
    where = f"Connecting to the Ray cluster at {request.address}" if request.address else "Starting Ray"
    say(console, f"{where} ...")


def _say_results(sweep: Sweep, console: Console) -> None:
    """Print return and cost of the final policies."""
    from recrl.analysis.data.validity import curriculum_warnings  # noqa: PLC0415
    from recrl.orchestrator.cli.result_table import CAPTION, result_table  # noqa: PLC0415

    table = result_table(sweep)
    if len(table):
        say(console, "")
        show(table, console)
        say(console, CAPTION)
        for sentence in curriculum_warnings(sweep):
            say(console, f"warning: {sentence}")
        say(console, "")


def _draw_at_end(sweep: Sweep, store: SweepStore, console: Console) -> None:
    """Draw a launch's figures. If that fails, log the error and continue: MLflow must still be updated."""
    try:
        draw(sweep, store.figures_folder, console)
    except (RecrlError, OSError):
        raise
    except Exception as error:
        logger.debug("figures of %s", store.name, exc_info=True)
        say(
            console,
            f"Figures    not all are drawn ({type(error).__name__}: {error}), because of a bug in recrl",
        )
        say(console, f"           for its traceback: recrl-sweep figures {store.name}")


def _film(
    grid: GridSpec, after: SweepProgress, store: SweepStore, stop: threading.Event, console: Console
) -> None:
    """Film complete trials without a video, if the grid requests it."""
    seeds = {"none": (), "first-seed": grid.seeds[:1], "all": grid.seeds}[grid.run.videos]
    complete = [trial.spec for trial in after.with_status(DisplayStatus.COMPLETE) if trial.spec.seed in seeds]
    unseen = [store.trial(spec) for spec in complete if not any(store.trial(spec).videos_folder.glob("*"))]
    if not unseen:
        return
    from recrl.agents.evaluation import FrozenPolicy  # noqa: PLC0415
    from recrl.orchestrator.trial.saved_policy import SavedTrial  # noqa: PLC0415  (imports torch)
    from recrl.orchestrator.trial.videos import VideoFormat  # noqa: PLC0415

    say(console, f"Videos     {short(store.trials_folder)}/*/{unseen[0].videos_folder.name}")
    for trial in unseen:
        if stop.is_set():
            return
        try:
            SavedTrial.load(trial).film(FrozenPolicy.STOCHASTIC, VideoFormat.GIF, seed=None)
        except RecrlError as error:  # a failed video is no failure of the sweep
            say(console, f"           no video: {error}")


def _say_synced(
    result: SweepResult, store: SweepStore, uri: str, request: LaunchRequest, console: Console
) -> None:
    """Print the address of the sweep in MLflow, the command to open it, and whether it is up to date."""
    place = [store.name]
    if request.root != DEFAULT_ROOT:
        place += ["--root", str(request.root)]
    if request.tracking_uri:
        place += ["--tracking-uri", redacted(request.tracking_uri)]
    where = redacted(uri) if request.tracking_uri else short(store.mlflow_database)
    say(console, f"MLflow     {where}")
    say(console, f"           {shlex.join(['recrl-sweep', 'ui', *place])}")
    if not result.synced:  # a sync that was killed leaves the report of an earlier pass
        report = last_report(store, uri)
        problem = f" ({report.problem})" if report and report.problem else ""
        again = shlex.join(["recrl-sweep", "sync", *place])
        say(console, f"           MLflow is not up to date{problem}; nothing is lost: {again}")


def _say_result(result: SweepResult, store: SweepStore, request: LaunchRequest, console: Console) -> ExitCode:
    """Print the result of a launch, and how to continue."""
    say(console, f"{store.name}: {display.status_sentence(result.progress)}")
    say_failures(result.progress, store, console)
    again = shlex.join(["recrl-sweep", *request.given])
    if result.progress.is_complete:
        return ExitCode.OK
    if result.stopped:
        say(console, f"Stopped; nothing is lost. Continue with: {again}")
        return ExitCode.STOPPED
    if damaged := result.progress.with_status(DisplayStatus.DAMAGED):
        them = f"{len(damaged)} damaged trial{'' if len(damaged) == 1 else 's'}"
        rerun = again if request.rerun_damaged else f"{again} --rerun-damaged"
        say(console, f"{them} left alone; to move the damaged files aside and run again: {rerun}")
    if result.failed:
        retry = again if request.retry_failed else f"{again} --retry-failed"
        say(console, f"Try what failed again with: {retry}")
    elif not damaged:
        say(console, f"Not everything could be finished. Continue with: {again}")
    return ExitCode.TRIALS_FAILED
