"""A launch with all that belongs to it: the executor, the MLflow sync, the figures and the films.

The command line and the Python API both call ``launch_grid``. ``run_sweep.run_sweep`` does the part that runs
the trials. A listener is called at each step; that of the command line prints.
"""

from __future__ import annotations

import contextlib
import logging
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from recrl.orchestrator.capacity import trials_at_once, trials_on_gpus
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.executor_kind import ExecutorKind
from recrl.orchestrator.executors import Executor, InlineExecutor
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_files import of_update
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.file_models import Resources
from recrl.orchestrator.launch_plan import Plan, TrialSelection
from recrl.orchestrator.remote.remote_sweep import sweep_place
from recrl.orchestrator.report_refresh import refreshing
from recrl.orchestrator.run_sweep import (
    RunningSync,
    SweepResult,
    SweepRunSettings,
    run_sweep,
    stopping_on_signals,
)
from recrl.orchestrator.sweep_place import SweepPlace
from recrl.orchestrator.sweep_progress import DisplayStatus, SweepProgress
from recrl.orchestrator.tracking.background_sync import start_sync
from recrl.orchestrator.tracking.client import tracking_uri

if TYPE_CHECKING:
    from recrl.analysis.data.sweep_data import Sweep

SYNC_INTERVAL_SECONDS = 5.0

logger = logging.getLogger("recrl.sweep")


@dataclass(frozen=True)
class LaunchOptions:
    """The options of a launch.

    Attributes:
        root: the folder of all sweeps.
        storage: the address of an object store that keeps the sweep, or None.
        selection: the trials to run.
        max_concurrent: largest number of parallel trials; None for the grid's.
        address: of an existing Ray cluster; None to start one here.
        ship_package: whether to send recrl itself to that cluster.
        executor: where the trials run.
        mlflow: whether to log the sweep to MLflow.
        tracking_uri: of MLflow; None for the database in the sweep's folder.
        figures: whether to draw figures and the report, during the sweep and at its end.
    """

    root: Path
    storage: str | None = None
    selection: TrialSelection = field(default_factory=TrialSelection)
    max_concurrent: int | None = None
    address: str | None = None
    ship_package: bool = False
    executor: ExecutorKind = ExecutorKind.RAY
    mlflow: bool = True
    tracking_uri: str | None = None
    figures: bool = True


@dataclass(frozen=True)
class LaunchOutcome:
    """Result of ``launch_grid``.

    Attributes:
        result: of the trials.
        place: of the sweep's files.
        tracking_uri: of MLflow; None without MLflow.
        sweep: the data frames; None if the launch was stopped or no trial is complete.
    """

    result: SweepResult
    place: SweepPlace
    tracking_uri: str | None
    sweep: Sweep | None


class LaunchListener:
    """Callbacks of a launch, in this order; the methods here do nothing."""

    def planned(self, plan: Plan, *, at_once: int, where: str) -> AbstractContextManager[None]:
        """Called before the first trial; the block ends after the last one.

        Args:
            plan: of the launch.
            at_once: number of parallel trials.
            where: they run, in words.
        """
        return nullcontext()

    def stopping(self) -> None:
        """Called on the first signal to stop."""

    def drawing(self) -> None:
        """Called before the figures are drawn at the end."""

    def drawn(self, folder: Path) -> None:
        """Called after the figures are drawn to a folder."""

    def failed_to_draw(self, error: Exception) -> None:
        """Called if figures or tables cannot be made; the launch continues."""

    def failed_to_write_outcomes(self, error: Exception) -> None:
        """Called if, without figures, the outcomes for MLflow cannot be written; the launch continues."""

    def filming(self, trials: Sequence[TrialStore]) -> None:
        """Called before these trials are filmed."""

    def failed_to_film(self, error: RecrlError) -> None:
        """Called if a trial cannot be filmed; the launch continues."""


def launch_grid(grid: GridSpec, options: LaunchOptions, listener: LaunchListener) -> LaunchOutcome:
    """Run the incomplete trials of a checked grid; log them to MLflow, draw the figures, film.

    Raises:
        RecrlError: another process runs the sweep, or Ray, MLflow, the object store or the disk cannot be
            used, or the results cannot be read.
    """
    from recrl.analysis.data import sweep_data  # noqa: PLC0415  (imports pandas)

    store = SweepStore(options.root, grid.name)
    place = sweep_place(store, options.storage)
    executor = _executor(grid, place, options)
    at_once, where = room(
        grid.resources,
        address=options.address,
        max_concurrent=options.max_concurrent,
        inline=options.executor is ExecutorKind.INLINE,
    )
    uri = tracking_uri(store, options.tracking_uri) if options.mlflow else None
    stop = threading.Event()
    read: list[Sweep] = []  # at the end, if any trial is complete
    unreadable: list[Exception] = []  # raised when MLflow is up to date

    def watch(plan: Plan) -> None:
        during.enter_context(listener.planned(plan, at_once=at_once, where=where))
        if plan.to_do and options.figures:
            during.enter_context(refreshing(store))

    def finish(after: SweepProgress) -> None:
        during.close()
        if stop.is_set():
            return
        if after.counts[DisplayStatus.COMPLETE]:
            try:
                read.append(sweep_data.load(store))
            except Exception as error:
                unreadable.append(error)
        for sweep in read:
            if options.figures:
                _draw(sweep, store, listener)
            elif uri:
                _write_outcomes(sweep, store, listener)
        _film(grid, after, store, stop, listener)

    with contextlib.ExitStack() as during, _listening(stop, listener.stopping):
        settings = SweepRunSettings(
            grid,
            place,
            executor,
            selection=options.selection,
            start_sync=_sync_to(uri) if uri else None,
            watch=watch,
            finish=finish,
        )
        result = run_sweep(settings, stop=stop)
    for error in unreadable:
        raise error
    return LaunchOutcome(result, place, uri, read[0] if read else None)


def room(
    resources: Resources,
    *,
    address: str | None,
    max_concurrent: int | None,
    inline: bool = False,
    cores: int | None = None,
) -> tuple[int, str]:
    """Return the number of parallel trials, and where they run, in words.

    Args:
        resources: of a trial.
        address: of a Ray cluster, or None.
        max_concurrent: largest number of parallel trials; None for that of ``resources``.
        inline: whether the trials run in this process, one after the other.
        cores: number of cores instead of this machine's; not with an address.
    """
    most = 1 if inline else max_concurrent or resources.max_concurrent
    if address and not inline:
        from recrl.orchestrator.ray.ray_executor import room_on_cluster  # noqa: PLC0415  (imports ray)

        fitting = max(1, room_on_cluster(address, resources))
        return min(fitting, most or fitting), "on the cluster at present"
    if resources.gpus_per_trial and not inline and cores is None:
        from recrl.orchestrator.trial.device import usable_gpus  # noqa: PLC0415  (imports torch)

        most = min(most or sys.maxsize, max(1, trials_on_gpus(usable_gpus(), resources.gpus_per_trial)))
    fitting = trials_at_once(cpus_per_trial=resources.cpus_per_trial, max_concurrent=most, cores=cores)
    return fitting, f"on {cores} cores" if cores else "on this machine"


def _listening(stop: threading.Event, say_stopping: Callable[[], None]) -> AbstractContextManager[None]:
    """Stop on signals; only the main thread of a process can."""
    is_main = threading.current_thread() is threading.main_thread()
    return stopping_on_signals(stop, say_stopping) if is_main else nullcontext()


def _executor(grid: GridSpec, place: SweepPlace, options: LaunchOptions) -> Executor:
    if options.ship_package and not options.address:
        raise RecrlError("--ship-package: needs an --address to ship to")
    if options.executor is ExecutorKind.INLINE:
        return _inline_executor(grid, options)
    if place.uri.startswith("memory://"):
        raise RecrlError(f"{place.uri}: is memory of a single process; use --executor inline")
    from recrl.orchestrator.ray.ray_executor import RayExecutor  # noqa: PLC0415  (imports ray)

    most = options.max_concurrent or grid.resources.max_concurrent
    resources = grid.resources.model_copy(update={"max_concurrent": most})
    return RayExecutor(address=options.address, ship_package=options.ship_package, resources=resources)


def _inline_executor(grid: GridSpec, options: LaunchOptions) -> Executor:
    if options.address:
        raise RecrlError(f"the inline executor uses no cluster; leave out the address {options.address}")
    if (options.max_concurrent or 1) > 1:
        raise RecrlError(
            f"the inline executor runs one trial after the other, and not {options.max_concurrent} at once"
        )
    if on_gpu := grid.resources.gpus_per_trial > 0.0:
        from recrl.orchestrator.trial.device import require_gpu  # noqa: PLC0415  (imports torch)

        require_gpu()
    return InlineExecutor(on_gpu=on_gpu)


def _sync_to(uri: str) -> Callable[[SweepStore], RunningSync]:
    return lambda store: start_sync(store, uri, interval_seconds=SYNC_INTERVAL_SECONDS)


def _draw(sweep: Sweep, store: SweepStore, listener: LaunchListener) -> None:
    """Draw a launch's figures; if that fails, report the error: MLflow must still be updated."""
    from recrl.analysis.report import drawing  # noqa: PLC0415  (imports matplotlib)

    listener.drawing()
    try:
        drawing.draw(sweep, store.figures_folder)
    except Exception as error:
        logger.debug("figures of %s", store.name, exc_info=True)
        listener.failed_to_draw(error)
    else:
        listener.drawn(store.figures_folder)


def _write_outcomes(sweep: Sweep, store: SweepStore, listener: LaunchListener) -> None:
    """Write the outcomes of the final policies, which MLflow shows also without figures."""
    from recrl.analysis.report.table_files import write_outcomes  # noqa: PLC0415

    try:
        write_outcomes(sweep, store.figures_folder)
    except Exception as error:  # MLflow must still be updated
        logger.debug("outcomes of %s", store.name, exc_info=True)
        listener.failed_to_write_outcomes(error)


def _film(
    grid: GridSpec,
    after: SweepProgress,
    store: SweepStore,
    stop: threading.Event,
    listener: LaunchListener,
) -> None:
    """Film complete trials without a video, if the grid requests it."""
    seeds = {"none": (), "first-seed": grid.seeds[:1], "all": grid.seeds}[grid.run.videos]
    complete = [trial.spec for trial in after.with_status(DisplayStatus.COMPLETE) if trial.spec.seed in seeds]
    films = [(store.trial(spec), f"{of_update(spec.num_updates)}__*") for spec in complete]
    unseen = [trial for trial, name in films if not any(trial.videos_folder.glob(name))]
    if not unseen:
        return
    from recrl.agents.evaluation import PolicyKind  # noqa: PLC0415
    from recrl.orchestrator.trial.saved_policy import SavedTrial  # noqa: PLC0415  (imports torch)
    from recrl.orchestrator.trial.videos import VideoFormat  # noqa: PLC0415

    listener.filming(unseen)
    for trial in unseen:
        if stop.is_set():
            return
        try:
            SavedTrial.load(trial).film(PolicyKind.STOCHASTIC, VideoFormat.GIF, seed=None)
        except RecrlError as error:  # a failed video is no failure of the sweep
            listener.failed_to_film(error)
