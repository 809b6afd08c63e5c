"""Training and sweeps from Python: the same checks, files and results as ``recrl-sweep launch``."""

from __future__ import annotations

import inspect
import logging
import re
import sys
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from recrl._results import Policy, following, load_sweep, policy_of
from recrl.environments.plugins import modules_here
from recrl.orchestrator.errors import NO_PATH, NO_ROOM, GridError, RecrlError, StorageError, described
from recrl.orchestrator.executor_kind import ExecutorKind
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.scratch import scratch_folder
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_files import DEFAULT_ROOT
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.checking import parse_grid, read_grid
from recrl.orchestrator.launch_grid import LaunchListener, LaunchOptions, launch_grid
from recrl.orchestrator.launch_plan import Plan, TrialSelection
from recrl.orchestrator.located_yaml import dump
from recrl.orchestrator.spec import TrialStatus

if TYPE_CHECKING:
    import pandas as pd

    from recrl.analysis.data.sweep_data import Sweep
    from recrl.orchestrator.files.trial_store import TrialStore

Grid: TypeAlias = str | Path | Mapping[str, Any]
Chosen: TypeAlias = str | Mapping[str, Any]
SOURCE = "grid"
LINE_SECONDS = 60.0  # at most between two lines of progress


def validate(grid: Grid, *, trust: bool = False) -> GridSpec:
    """Check a whole grid without running its trials.

    Args:
        grid: the path of a grid file, or its content as a dictionary.
        trust: whether to import what the grid names by an import path, and to run its first updates on each
            task, with a restart. Do so only with grids whose author you trust.

    Returns:
        The checked grid with all defaults; ``trials()`` has its trials.

    Raises:
        GridError: one sentence for each mistake, also in ``problems``.
        RecrlError: no mistake was found, but an import path was not followed; see ``trust``.

    Warns:
        UserWarning: an episode of a task may be endless, or longer than the training; no update falls into
            deployment; or a curriculum relaxes no limit.

    Example:
        >>> import recrl
        >>> grid = {"name": "g", "tasks": [{"name": "two-state", "deploy_limits": 2}], "agents": ["cpo"],
        ...         "methods": ["none"], "seeds": 3, "run": {"total_steps": 10_000}}
        >>> len(recrl.validate(grid).trials())
        3
    """
    with following(trust):
        checked = _checked(grid, build=True)
    _warn(checked.warnings(checked.trials()))
    return checked


def launch(
    grid: Grid,
    *,
    root: str | Path = DEFAULT_ROOT,
    executor: str = "ray",
    address: str | None = None,
    max_concurrent: int | None = None,
    retry_failed: bool = False,
    mlflow: bool = True,
    figures: bool = True,
    progress: bool = True,
) -> Sweep:
    """Run every trial of a grid that is neither complete nor failed, as ``recrl-sweep launch`` does.

    The same call continues after a crash or Ctrl-C. It follows the grid's import paths.

    Args:
        grid: the path of a grid file, or its content as a dictionary.
        root: the folder of all sweeps.
        executor: ``ray``, in parallel on all cores or a cluster; or ``inline``, one after the other in this
            process.
        address: of an existing Ray cluster; by default one is started here. Not with ``inline``.
        max_concurrent: largest number of parallel trials, at least 1; by default as many as fit.
        retry_failed: whether to run failed trials again, from their last checkpoints.
        mlflow: whether to log the sweep to MLflow.
        figures: whether to draw figures and the report at the end.
        progress: whether to print progress and results.

    Returns:
        The sweep, as from ``load_sweep``. Its table ``trials`` shows which trials are complete.

    Raises:
        GridError: the grid is wrong; nothing was started.
        RecrlError: another argument is wrong, another process runs the sweep, or Ray, MLflow or the disk
            cannot be used.
        KeyboardInterrupt: Ctrl-C, SIGTERM or ``recrl-sweep stop`` stopped it before its end; the same call
            continues.

    Warns:
        UserWarning: without ``progress``, which prints them: as ``validate`` does; trials ran other code, or
            the grid no longer has them; a curriculum had no effect or ended far above d_d.
    """
    from recrl.analysis.data.sweep_warnings import curriculum_warnings  # noqa: PLC0415

    # of the command line only what prints is used
    from recrl.orchestrator.cli.launch import launch_and_print  # noqa: PLC0415
    from recrl.orchestrator.cli.output import TextConsole  # noqa: PLC0415

    if executor not in list(ExecutorKind):
        raise RecrlError(f"executor: must be 'ray' or 'inline', got {executor!r}")
    if max_concurrent is not None and max_concurrent < 1:
        raise RecrlError(f"max_concurrent: must be at least 1, got {max_concurrent}")
    options = LaunchOptions(
        root=Path(root),
        selection=TrialSelection(retry_failed=retry_failed),
        max_concurrent=max_concurrent,
        address=address,
        executor=ExecutorKind(executor),
        mlflow=mlflow,
        figures=figures,
    )
    with modules_here(), _disk_in_words(Path(root)):
        checked = _checked(grid)
        if progress:
            given = ("launch", str(grid) if isinstance(grid, str | Path) else "GRID.yaml")
            stopped = launch_and_print(checked, options, TextConsole(), given=given) is ExitCode.STOPPED
        else:
            result = launch_grid(checked, options, _PlanWarnings(checked)).result
            stopped = result.stopped and not result.progress.is_complete
        if stopped:
            raise KeyboardInterrupt
        sweep = load_sweep(Path(root) / checked.name, trust=True)
        if not progress:
            _warn(curriculum_warnings(sweep))
        return sweep


class _PlanWarnings(LaunchListener):
    """Listener that warns of what the plan of a launch shows."""

    def __init__(self, grid: GridSpec) -> None:
        self._grid = grid

    def planned(self, plan: Plan, *, at_once: int, where: str) -> AbstractContextManager[None]:
        """Warn before the first trial."""
        sentences = (*self._grid.warnings(plan.to_do), *plan.code_warnings, plan.left_out_sentence)
        _warn(filter(None, sentences))
        return nullcontext()

    def failed_to_draw(self, error: Exception) -> None:
        """Warn of figures that could not be drawn."""
        _warn([f"not all figures are drawn ({described(error)})"])

    def failed_to_write_outcomes(self, error: Exception) -> None:
        """Warn of outcomes that MLflow lacks."""
        _warn([f"MLflow has no outcomes of the final policies ({described(error)})"])


def _warn(sentences: Iterable[str]) -> None:
    """Warn of each sentence, at the line that called recrl."""
    modules = [str(it.frame.f_globals.get("__name__")) for it in inspect.stack(0)]
    ours = [depth for depth, name in enumerate(modules, 1) if name.startswith("recrl.")]
    for sentence in sentences:
        warnings.warn(sentence, stacklevel=max(ours) + 1)


def train(
    task: Chosen,
    agent: Chosen = "ppo-lag",
    method: Chosen = "none",
    *,
    total_steps: int,
    deploy_limits: float | list[float],
    train_limits: float | list[float] | str = "auto",
    seed: int = 0,
    folder: str | Path | None = None,
    progress: bool = True,
    **run: Any,
) -> Training:
    """Train one agent on one task under one curriculum, in this process and on one core.

    Meanwhile PyTorch uses one thread, which is much faster for small networks. The result equals that of a
    sweep's trial with these settings, byte for byte.

    Args:
        task: its name, or a mapping with ``name`` and ``options``. The name of your own code is its import
            path, ``my_module:ENTRY``.
        agent: likewise.
        method: the curriculum, likewise; ``none`` trains under the deployment limits from the start.
        total_steps: environment steps of both phases, over all environments.
        deploy_limits: deployment limits d_d, undiscounted cost per episode: one number for all costs, or a
            list with one number per cost.
        train_limits: training limits d_t at the start, at least d_d, likewise; ``auto`` measures them.
        seed: of the trial, at least 0.
        folder: for the files, as a sweep of one trial; the same call continues from there, also after an
            error. None for no files.
        progress: whether to show return and cost: in place on a terminal, elsewhere in one line per tenth of
            the updates.
        **run: other settings of a grid's section ``run``: ``deploy_fraction``, ``num_envs``,
            ``rollout_steps``, ``evaluation_episodes``.

    Returns:
        The data frames and the policy.

    Raises:
        GridError: an argument is wrong; one sentence for each mistake.
        RecrlError: the trial failed, and its traceback is a note of the error; or the disk cannot be used.
        KeyboardInterrupt: Ctrl-C or SIGTERM stopped it before its end; with a ``folder`` the same call
            continues.

    Warns:
        UserWarning: as ``launch`` does.

    Example:
        >>> import recrl
        >>> training = recrl.train("two-state", "cpo", total_steps=2_000, deploy_limits=2, num_envs=8,
        ...                        rollout_steps=20, evaluation_episodes=8, progress=False)
        >>> list(training.updates["cost_0"].round(1).head(1))           # doctest: +SKIP
        >>> training.policy.act([1.0, 0.0], deterministic=True) in (0, 1)
        True
    """
    with modules_here(), ExitStack() as stack:
        place = Path(folder) if folder is not None else _scratch(stack)
        grid = {
            "name": place.name,
            "tasks": [task],
            "agents": [agent],
            "methods": [method],
            "seeds": [seed],
            "train_limits": train_limits,
            "deploy_limits": deploy_limits,
            "run": {"total_steps": total_steps, **run},
        }
        with shown_progress(progress):
            try:
                sweep = launch(
                    grid,
                    root=place.parent,
                    executor="inline",
                    retry_failed=True,
                    mlflow=False,
                    figures=False,
                    progress=False,
                )
            except GridError as error:  # the grid's name is that of the folder
                raise GridError([re.sub("^name: ", "folder: ", it) for it in error.problems]) from error
        store = SweepStore(place.parent, place.name)
        (spec,) = store.specs()
        trial = store.trial(spec)
        _require_complete(trial, spec.title)
        policy = policy_of(trial, seed=seed)
        if folder is None:
            return Training(replace(sweep, folder=None), policy, None)
        return Training(sweep, policy, trial.folder)


def _require_complete(trial: TrialStore, title: str) -> None:
    """Raise the error of a trial that failed, with its traceback as a note."""
    record = trial.record()
    if record.status is TrialStatus.COMPLETE:
        return
    failed = RecrlError(f"{title}: {record.error or 'is not complete'}")
    if trial.error_path.exists():
        failed.add_note(trial.error_path.read_text())
    raise failed


@dataclass(frozen=True, eq=False, repr=False)
class Training:
    """Result of ``train``.

    Attributes:
        sweep: the data frames, as ``load_sweep`` describes them.
        policy: the final policy.
        folder: the trial's folder, or None without files.
    """

    sweep: Sweep
    policy: Policy
    folder: Path | None

    def __repr__(self) -> str:
        place = f" in {self.folder}" if self.folder else ""
        return f"<Training of {self.policy.spec.title}, {len(self.updates)} updates{place}>"

    @property
    def updates(self) -> pd.DataFrame:
        """One row per policy update: end_step, episode_return, cost_i, limit_i, and the agent's metrics."""
        return self.sweep.updates

    @property
    def evaluations(self) -> pd.DataFrame:
        """One row per episode of the final policy, stochastic and deterministic: episode_return, cost_i."""
        return self.sweep.evaluations


def _scratch(stack: ExitStack) -> Path:
    return stack.enter_context(scratch_folder(tempfile.gettempdir())) / "trial"


@contextmanager
def _disk_in_words(root: Path) -> Iterator[None]:
    """Say of a path that cannot be used, and of a disk that is full or lost, what it is.

    Args:
        root: the folder of all sweeps.

    Raises:
        StorageError: there was such an error.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in (*NO_ROOM, *NO_PATH):
            raise
        raise StorageError(f"{error.filename or root}: {error.strerror}; saved results are kept") from error


def _checked(grid: Grid, *, build: bool = False) -> GridSpec:
    """Read the grid of a file or of a dictionary; mistakes in a dictionary have no line numbers."""
    if isinstance(grid, str | Path):
        return read_grid(Path(grid), build=build)
    try:
        data = dump(grid)
    except TypeError as error:
        raise GridError(
            [
                f"{SOURCE}: must hold plain values only ({error}); give code by its import path, "
                "my_module:ENTRY"
            ]
        ) from error
    try:
        return parse_grid(data, source=SOURCE, build=build)
    except GridError as error:
        problems = [re.sub(rf"^{SOURCE}:\d+: ", "", problem) for problem in error.problems]
        raise GridError(problems) from error


class _LineInPlace(logging.Handler):
    """Handler that shows the newest line of a trial's log in place, on a terminal."""

    def emit(self, record: logging.LogRecord) -> None:
        sys.stderr.write(f"\r{record.getMessage():<79.79}")
        sys.stderr.flush()


class _PlainLines(logging.Handler):
    """Handler that prints an update's line in a trial's log for each tenth of them, and after each minute."""

    def __init__(self) -> None:
        super().__init__()
        self._tenth, self._printed = -1, time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        progress, now = getattr(record, "progress", None), time.monotonic()
        if progress is None:  # not the line of an update
            return
        tenth = int(10 * progress + 1e-9)
        if tenth > self._tenth or now > self._printed + LINE_SECONDS:
            print(record.getMessage(), file=sys.stderr, flush=True)
            self._tenth, self._printed = tenth, now


@contextmanager
def shown_progress(wanted: bool) -> Iterator[None]:
    """Show the progress of a trial in this process on the standard error: in place, or in plain lines."""
    if not wanted:
        yield
        return
    in_place = sys.stderr.isatty()
    trial, line = logging.getLogger("recrl.trial"), _LineInPlace() if in_place else _PlainLines()
    line.addFilter(lambda record: record.levelno == logging.INFO)
    trial.addHandler(line)
    try:
        yield
    finally:
        trial.removeHandler(line)
        if in_place:
            sys.stderr.write("\n")
