"""What the commands of ``recrl-sweep`` do and say; ``cli`` has what can be asked.

Each function takes the parsed arguments and a console, and returns an exit code. What a person can mend is
raised as a RecrlError, which ``cli`` turns into a sentence.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import re
import shlex
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError
from rich.console import Console

from recrl.environments.plugins import UnknownNameError, UntrustedNameError
from recrl.orchestrator.cli import display
from recrl.orchestrator.errors import (
    USERS_ERRORS,
    DamagedError,
    RecrlError,
    StorageError,
    TrackingError,
    UncalledError,
    described,
)
from recrl.orchestrator.executors import Executor, InlineExecutor
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.code_changes import has_other_code, no_curriculum_sentence, other_code_sentence
from recrl.orchestrator.files.store import SweepStore, TrialStore
from recrl.orchestrator.grid.grid import GridSpec, read_grid, read_name
from recrl.orchestrator.grid.plan import Plan, estimate, make_plan, select, trials_at_once
from recrl.orchestrator.places import SweepPlace
from recrl.orchestrator.redaction import redacted
from recrl.orchestrator.redaction import shown as text_shown
from recrl.orchestrator.remote.opening import sweep_place
from recrl.orchestrator.report_refresh import refreshing
from recrl.orchestrator.spec import Choice, TrialSpec, TrialState
from recrl.orchestrator.status import Standing, SweepProgress, TrialProgress, progress, standing_of
from recrl.orchestrator.sweep import (
    REQUEST_SECONDS,
    LaunchSettings,
    Mirror,
    SweepResult,
    launch,
    stopping_on_signals,
)
from recrl.orchestrator.tracking.address import checked_uri, tracking_uri
from recrl.orchestrator.tracking.background_sync import start_mirror
from recrl.orchestrator.tracking.export_file import write_in_own_process
from recrl.orchestrator.tracking.mlflow_sync import last_report, sync
from recrl.orchestrator.tracking.ui import open_ui
from recrl.orchestrator.validation import nearest
from recrl.teachers.registry import teacher_config

if TYPE_CHECKING:
    import pandas as pd

    from recrl.analysis.data.sweep_data import Sweep

DEFAULT_ROOT = Path("runs")
MIRROR_INTERVAL_SECONDS = 5.0
DEFAULT_EPISODES = 100  # of an evaluation, for trials that make none themselves

logger = logging.getLogger("recrl.sweep")

Command = Callable[[argparse.Namespace, Console], ExitCode]


def run_validate(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Check a grid file; nothing is started or written."""
    try:
        grid = read_grid(arguments.grid)
    except UncalledError as error:
        _say(console, f"{error}; all else is right")
        return ExitCode.OK
    sizes = (len(grid.tasks), len(grid.agents), len(grid.methods), len(grid.seeds))
    product = " x ".join(str(size) for size in sizes)
    _say(
        console,
        f"{arguments.grid}: {grid.name} is right: {len(grid.trials())} trials, from "
        f"tasks x agents x methods x seeds = {product}",
    )
    return ExitCode.OK


def run_plan(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Say what a launch would do; nothing is started, and nothing written but a mirror of what is kept."""
    grid, store = _grid_and_store(arguments)
    sweep_place(store, arguments.storage).refresh()
    plan = make_plan(
        grid.trials(),
        store,
        only=_only(arguments.only),
        retry_failed=arguments.retry_failed,
        rerun_damaged=arguments.rerun_damaged,
        rerun_changed=arguments.rerun_changed,
    )
    at_once, where = _room(grid, arguments)
    console.print(display.plan_table(plan))
    _say(console, "")
    _say_plan(plan, grid, console, at_once=at_once, where=where)
    for line in display.damages_of_plan(plan):
        _say(console, line)
    _say_other_code(plan, console)
    for problem in store.damages():
        _say(console, f"damaged: {problem}")
    for orphan in plan.orphans:
        _say(console, f"not in the grid any more, left alone: {_short(orphan.folder)}")
    return ExitCode.TRIALS_LEFT if arguments.check and plan.to_do else ExitCode.OK


def run_launch(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Work on everything in the grid that is not complete."""
    grid, store = _grid_and_store(arguments)
    only = _only(arguments.only)
    place = sweep_place(store, arguments.storage)
    place.prepare()
    executor = _executor(grid, place, arguments)
    at_once, where = _room(grid, arguments)
    uri = tracking_uri(store, arguments.tracking_uri) if arguments.mlflow else None
    stop = threading.Event()

    def watch(plan: Plan) -> None:
        _say_plan(plan, grid, console, at_once=at_once, where=where)
        if plan.to_do:
            chosen = [trial.spec for trial in plan.trials]
            shown.enter_context(display.live_progress(lambda: progress(chosen, store), console))
            if arguments.figures:
                shown.enter_context(refreshing(store))

    def finish(after: SweepProgress) -> None:
        shown.close()
        if arguments.figures and not stop.is_set() and after.counts[Standing.COMPLETE]:
            _draw_at_end(store, console)
        if not stop.is_set():
            _film(grid, after, store, stop, console)

    def say_stopping() -> None:
        _say(console, "Stopping: running trials save where they are. Once more to stop at once.")

    with contextlib.ExitStack() as shown, stopping_on_signals(stop, say_stopping):
        settings = LaunchSettings(
            grid,
            place,
            executor,
            only=only,
            retry_failed=arguments.retry_failed,
            rerun_damaged=arguments.rerun_damaged,
            rerun_changed=arguments.rerun_changed,
            start_mirror=_mirror_to(uri) if uri else None,
            watch=watch,
            finish=finish,
        )
        result = launch(settings, stop=stop)
    kept = f", a mirror of {place.address}" if place.address else ""
    _say(console, f"Results    {_short(store.folder)}{kept}")
    if uri:
        _say_mirrored(result, store, uri, arguments, console)
    return _say_result(result, store, arguments, console)


def run_status(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Say how far a sweep is, from its files alone."""
    store = _store(arguments)
    specs = store.specs()
    now = progress(specs, store)
    if not arguments.brief:
        console.print(display.status_table(now))
        _say(console, "")
    _say(console, f"{store.name}: {display.status_sentence(now)}")
    _say_failures(now, store, console)
    for problem in store.damages():
        _say(console, f"damaged: {problem}")
    _say_other_code(make_plan(specs, store), console)
    none = [
        trial.spec.title for trial in now.trials if trial.spec.is_no_curriculum(trial.record.start_limits)
    ]
    if sentence := no_curriculum_sentence(none):
        _say(console, f"warning: {sentence}")
    return ExitCode.OK


def run_check(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Hold every file of a sweep against what was committed; a line for each that is wrong."""
    store = _store(arguments)
    problems = [f"{store.name}: {problem}" for problem in store.damages()]
    with contextlib.suppress(StorageError):  # said above
        for spec in store.specs():
            problems += [f"{spec.title}: {problem}" for problem in store.trial(spec).damages()]
    listed = {spec.folder_name for spec in _listed(store)}
    orphans = [trial for trial in store.trials() if trial.folder.name not in listed]
    problems += [f"{trial.title}: {problem}" for trial in orphans for problem in trial.damages()]
    for problem in problems:
        _say(console, problem)
    trials = len(listed | {trial.folder.name for trial in orphans})
    _say(
        console,
        f"{store.name}: {trials} trials checked, {len(problems) or 'no'} wrong "
        f"file{'' if len(problems) == 1 else 's'}",
    )
    if problems:
        _say(console, "launch goes on with damaged trials from what is whole; complete ones: --rerun-damaged")
    return ExitCode.TRIALS_FAILED if problems else ExitCode.OK


def _listed(store: SweepStore) -> list[TrialSpec]:
    """The trials of the last launch, none where the file that lists them is damaged."""
    try:
        return store.specs()
    except StorageError:
        return []


def run_stop(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Ask the launch that runs a sweep to save its trials and end, and wait until it has."""
    store = _store(arguments)
    place = sweep_place(store, arguments.storage)
    still_runs = place.request_stop()
    if not still_runs():
        _say(console, f"{store.name}: no launch runs this sweep")
        return ExitCode.OK
    _say(console, f"{store.name}: its trials save where they are")
    while still_runs():
        time.sleep(REQUEST_SECONDS)
    place.refresh()
    _say(console, f"{store.name}: {display.status_sentence(progress(store.specs(), store))}")
    return ExitCode.OK


def run_logs(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Print a trial's log, or say where its folder is."""
    store = _store(arguments)
    trial = _trial(store, " ".join(arguments.trial))
    if arguments.folder:
        _say(console, str(_short(trial.folder)))
        return ExitCode.OK
    with contextlib.ExitStack() as following:
        if arguments.follow and not store.is_locked():
            place = sweep_place(store, arguments.storage)
            following.enter_context(place.mirrored(threading.Event()))
        for text in display.lines_of(trial, follow=arguments.follow):
            _say(console, text)
    return ExitCode.OK


def _trial(store: SweepStore, text: str) -> TrialStore:
    """The trial that a person means; the one that runs if they do not say."""
    found = store.find(text)
    if not text:
        now = time.time()
        found = [trial for trial in found if standing_of(trial.record(), now=now) is Standing.RUNNING]
    if len(found) == 1:
        return found[0]
    titles = [f"{trial.trial_id} {trial.title}" for trial in found[:10]]
    more = f" and {len(found) - 10} more" if len(found) > 10 else ""
    which = f"say which one, by its id or title: {', '.join(titles)}{more}" if found else "status names them"
    what = f"trials on disk begin with {text!r}" if text else "trials are running"
    raise RecrlError(f"{store.name}: {len(found) or 'no'} {what}; {which}")


def run_evaluate(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Run the frozen policies of trials for whole episodes, and film them where that is asked for."""
    import pandas as pd  # noqa: PLC0415

    from recrl.agents.evaluation import FrozenPolicy  # noqa: PLC0415  (imports gymnasium)
    from recrl.orchestrator.trial.saved_policy import FrozenTrial, summary  # noqa: PLC0415  (imports torch)
    from recrl.orchestrator.trial.videos import VideoFormat  # noqa: PLC0415

    store = _store(arguments, checkpoints=True)
    policies = tuple(FrozenPolicy) if arguments.policy == "both" else (FrozenPolicy(arguments.policy),)
    thawed, left_out = [], []
    for trial in _chosen(store, arguments):
        try:
            trial.require_whole()
            thawed.append(FrozenTrial.thaw(trial))
        except RecrlError as error:
            left_out.append(error)
    if not thawed:
        raise left_out[0]
    rows, written = [], []
    for frozen in thawed:
        num_episodes = arguments.episodes or frozen.spec.evaluation_episodes or DEFAULT_EPISODES
        episodes, path = frozen.evaluate(policies, num_episodes=num_episodes, seed=arguments.seed)
        rows += summary(episodes, frozen)
        written.append(path)
    _show(pd.DataFrame(rows), console)
    _say(console, "Means and standard errors; within: episodes in which no cost exceeded its d_d.")
    for path in written:
        _say(console, f"Episodes   {_short(path)}")
    for reason in left_out:
        _say(console, f"left out   {reason}")
    changed = [frozen for frozen in thawed if has_other_code(frozen.store, frozen.spec)]
    complete = sum(frozen.store.record().status is TrialState.COMPLETE for frozen in changed)
    if sentence := other_code_sentence(complete, len(changed) - complete):
        _say(console, f"warning: {sentence}; here their policies met the present code")
    if arguments.video:
        for frozen in thawed:
            for policy in policies:
                video = frozen.film(policy, VideoFormat(arguments.video), seed=arguments.seed)
                _say(console, f"Video      {_short(video)}")
    _tell_mlflow(store, arguments, console)
    return ExitCode.OK


def _chosen(store: SweepStore, arguments: argparse.Namespace) -> list[TrialStore]:
    """The trials on disk whose name begins so, and that ``--only`` leaves."""
    text = " ".join(arguments.trial)
    found = store.find(text)
    wanted = _only(arguments.only)
    specs, damaged = [], set()
    for trial in found:
        try:
            specs.append(trial.spec)
        except StorageError:
            damaged.add(trial.folder.name)
    kept = {spec.folder_name for spec in select(specs, wanted)} | (set() if wanted else damaged)
    if not kept:
        begin = f" begin with {text!r}" if text else ""
        raise RecrlError(f"{store.name}: no trials on disk{begin}; status names them")
    return [trial for trial in found if trial.folder.name in kept]


def _tell_mlflow(store: SweepStore, arguments: argparse.Namespace, console: Console) -> None:
    """Bring MLflow up to the files, if it was ever told of the sweep."""
    uri = tracking_uri(store, arguments.tracking_uri)
    if last_report(store, uri) is None:
        return
    report = sync(store, uri, write_export=write_in_own_process)
    if not report.is_up_to_date:
        _say(
            console, f"MLflow     is not up to date ({report.problem}); later: recrl-sweep sync {store.name}"
        )


def run_figures(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Draw the figures and tables of what is on disk, in a compact file or in MLflow."""
    sweep, folder = _source(arguments)
    _say_warnings(sweep, console)
    folder = arguments.to or folder
    try:
        _draw(sweep, folder, console, band=arguments.band, whole=not arguments.sketch)
    except (RecrlError, OSError):
        raise
    except Exception as error:
        if not str(arguments.sweep).endswith(".zip"):
            raise
        raise RecrlError(
            f"{arguments.sweep}: not all figures could be drawn ({described(error)}); the others are in "
            f"{folder}"
        ) from error
    return ExitCode.OK


def run_export(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Write the compact file of a sweep."""
    from recrl.analysis.data import export  # noqa: PLC0415  (imports pandas)

    sweep, _ = _source(arguments)
    _say_file(export.save(sweep, arguments.to or Path(f"{sweep.name}{export.SUFFIX}")), sweep, console)
    _say_warnings(sweep, console)
    return ExitCode.OK


def run_merge(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Join compact files into one."""
    from recrl.analysis.data import export, merging  # noqa: PLC0415  (imports pandas)

    for path in arguments.parts:
        if path.suffix != export.SUFFIX:
            raise RecrlError(f"{path}: merge joins files that export wrote (.zip): recrl-sweep export SWEEP")
    sweep = merging.merge([export.load(path) for path in arguments.parts])
    _say_file(export.save(sweep, arguments.to), sweep, console)
    for note in sweep.notes:
        _say(console, note)
    _say_warnings(sweep, console)
    return ExitCode.OK


def _say_warnings(sweep: Sweep, console: Console) -> None:
    """Say which trials nothing was made of, and what else speaks against the numbers."""
    from recrl.analysis.data.validity import damages, doubts  # noqa: PLC0415  (imports pandas)

    for sentence in damages(sweep):
        _say(console, f"damaged: {sentence}")
    for sentence in doubts(sweep):
        _say(console, f"warning: {sentence}")


def _say_file(path: Path, sweep: Sweep, console: Console) -> None:
    complete = sum(trial.status is TrialState.COMPLETE for trial in sweep.facts)
    size = f"{path.stat().st_size / 1000:,.0f} kB"
    _say(console, f"{_short(path)}: {len(sweep.facts)} trials, {complete} of them complete, {size}")


def _source(arguments: argparse.Namespace) -> tuple[Sweep, Path]:
    """The sweep that is meant, from its files, a compact file or MLflow; and a place for figures."""
    from recrl.analysis.data import export, from_mlflow, sweep_data  # noqa: PLC0415  (imports pandas and SciPy)

    given: str | None = arguments.sweep
    if arguments.tracking_uri is not None:
        name = read_name(Path(given)) if given and given.endswith((".yaml", ".yml")) else given
        sweep = from_mlflow.load(checked_uri(arguments.tracking_uri), name)
        return sweep, Path(f"{sweep.name}-figures")
    if given and given.endswith(export.SUFFIX):
        return export.load(Path(given)), Path(given).with_name("figures")
    store = _store(arguments)
    return sweep_data.load(store), store.figures_folder


def run_bound(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Say what training cost beside its bounds, and which d_t a budget would have allowed."""
    from recrl.analysis.statistics import cumulative_cost  # noqa: PLC0415  (imports pandas and SciPy)

    sweep, _ = _source(arguments)
    _say_warnings(sweep, console)
    if arguments.cost > sweep.num_costs:
        raise RecrlError(f"--cost: {sweep.name} has {sweep.num_costs} costs, got {arguments.cost}")
    rows = cumulative_cost.cumulative_costs(sweep, cost=arguments.cost - 1)
    if not len(rows):
        raise RecrlError(f"{sweep.name}: no trial has finished its training phase yet")
    _show(cumulative_cost.bound_table(rows), console)
    _say(
        console, "Summed over policies, one expected episode each; means over runs; undiscounted but for one."
    )
    if arguments.budget is not None:
        allowed = cumulative_cost.admissible_limits(rows, sweep, budget=arguments.budget)
        _say(console, f"\nThe largest d_t within {arguments.budget:g} of cost above d_d over all episodes:")
        _show(cumulative_cost.admissible_table(allowed), console)
    return ExitCode.OK


def run_replay(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Say what limits another teacher would have set on the recorded episodes."""
    import pandas as pd  # noqa: PLC0415  (commands that do not need it are quick to start)

    from recrl.analysis.figures import styles  # noqa: PLC0415
    from recrl.analysis.figures.curriculum_replay import Replayed, replayed_limits  # noqa: PLC0415
    from recrl.analysis.report_tables import write_csv  # noqa: PLC0415
    from recrl.analysis.statistics.curriculum_replay import replay, replay_summary  # noqa: PLC0415

    store = _store(arguments)
    specs = select(store.specs(), _only(arguments.only))
    method = _teacher(store, arguments)
    called = re.sub("[^A-Za-z0-9.+-]+", "-", method.label)
    folder, runs, summaries = store.folder / "replays", [], []
    damaged = []
    for trial in (store.trial(spec) for spec in specs):
        record = trial.record()
        if record.status is TrialState.DAMAGED:
            damaged.append(f"{trial.title}: {record.error}")
        elif record.update:
            try:
                rows = replay(trial, method)
            except DamagedError as error:
                damaged.append(str(error))
                continue
            write_csv(rows, folder / f"{trial.folder.name}__{called}.csv")
            runs.append(Replayed(trial.spec, rows))
            summaries.append(replay_summary(trial, rows))
    for sentence in damaged:
        _say(console, f"damaged: {sentence}")
    if not runs:
        raise RecrlError(f"{store.name}: none of the {len(specs)} chosen trials has a policy update yet")
    _say(console, f"What {method.label} would have set on the recorded episodes, in the training phase:")
    _show(pd.concat(summaries), console)
    for i in range(max(len(run.spec.deploy_limits) for run in runs)):
        figure = replayed_limits(runs, method.label, cost=i)
        _, picture = styles.save(figure, folder, called if i == 0 else f"{called}_cost-{i + 1}")
        _say(console, f"Figure        {_short(picture)}")
    _say(console, f"Every update  {_short(folder)}")
    return ExitCode.OK


def _teacher(store: SweepStore, arguments: argparse.Namespace) -> Choice:
    """The teacher to ask: a method of the sweep by its label, or any teacher by its name."""
    known = {spec.method.label: spec.method for spec in store.specs()}
    method = known.get(arguments.teacher, Choice(arguments.teacher))
    options = dict(method.options)
    for pair in arguments.option:
        key, equals, value = pair.partition("=")
        if not equals:
            raise RecrlError(f"--option: must look like window=8, got {pair!r}")
        options[key] = _parsed(value)
    try:
        teacher_config(method.name, options)
    except ValidationError as error:
        mistakes = "; ".join(f"{'.'.join(map(str, it['loc']))}: {it['msg']}" for it in error.errors())
        raise RecrlError(f"teacher {method.name}: {mistakes}, got {options}") from error
    except UntrustedNameError as error:
        raise RecrlError(f"{error}; if you trust it, add --trust") from error
    except UnknownNameError as error:
        raise RecrlError(str(error)) from error
    except USERS_ERRORS as error:
        raise RecrlError(f"teacher {method.name!r} cannot be used: {described(error)}") from error
    return Choice(method.name, options, method.label)


def _parsed(text: str) -> Any:
    """A JSON value, or the text itself."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def run_ui(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Open MLflow's pages about a sweep, on this machine only."""
    store = _store(arguments)
    ui = open_ui(store, tracking_uri(store, arguments.tracking_uri), port=arguments.port)
    _say(console, f"Open {ui.url}")
    if ui.process is not None:
        _say(console, "Ctrl-C ends it.")
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.default_int_handler)
        try:
            ui.process.wait()
        except KeyboardInterrupt:
            ui.close()
    return ExitCode.OK


def run_sync(arguments: argparse.Namespace, console: Console) -> ExitCode:
    """Bring MLflow up to the files."""
    store = _store(arguments)
    uri = tracking_uri(store, arguments.tracking_uri)
    report = sync(store, uri, rebuild=arguments.rebuild, write_export=write_in_own_process)
    if not report.is_up_to_date:
        raise TrackingError(
            f"MLflow is behind by {report.behind} of {report.trials} trials: {report.problem}"
        )
    _say(console, f"MLflow shows all {report.trials} trials of {store.name}; {report.points} points were new")
    if report.remark:
        _say(console, f"without the export file ({report.remark}): readers of MLflow get the last one")
    return ExitCode.OK


def sweep_store(root: Path, sweep: str | None, storage: str | None = None) -> SweepStore:
    """The sweep that a person means.

    Args:
        root: the folder of all sweeps.
        sweep: its name, or its grid file; None for the only one there.
        storage: the address of an object store to look at; None to look at ``root``.

    Raises:
        RecrlError: there is no such sweep, or more than one that could be meant.
    """
    place: str | Path = storage or root
    if storage:
        from recrl.orchestrator.remote.remote_sweep import sweeps_at  # noqa: PLC0415  (imports fsspec)

        names = sweeps_at(storage)
    else:
        said = (*root.glob("*/sweep.json"), *root.glob("*/trials.jsonl"))
        names = sorted({path.parent.name for path in said})
    if sweep is None:
        if len(names) == 1:
            return SweepStore(root, names[0])
        listed = f"say which one: {', '.join(names)}" if names else "launch one first"
        raise RecrlError(f"{place}: holds {len(names)} sweeps; {listed}")
    if sweep.endswith((".yaml", ".yml")):
        sweep = read_name(Path(sweep))
    if sweep not in names:
        listed = f" (there: {', '.join(names)})" if names else ", nothing was launched there yet"
        raise RecrlError(f"{place}: holds no sweep {sweep!r}{nearest(sweep, names)}{listed}")
    return SweepStore(root, sweep)


def _grid_and_store(arguments: argparse.Namespace) -> tuple[GridSpec, SweepStore]:
    grid = read_grid(arguments.grid)
    return grid, SweepStore(arguments.root, grid.name)


def _only(pairs: Sequence[str]) -> dict[str, list[str]]:
    """``["method=none,linear", "seed=0"]`` as what ``plan.select`` reads."""
    wanted: dict[str, list[str]] = {}
    for pair in pairs:
        key, equals, values = pair.partition("=")
        if not equals or not values:
            raise RecrlError(f"--only: must look like method=dynamic or seed=0,1, got {pair!r}")
        wanted.setdefault(key, []).extend(values.split(","))
    return wanted


def _executor(grid: GridSpec, place: SweepPlace, arguments: argparse.Namespace) -> Executor:
    if arguments.ship_package and not arguments.address:
        raise RecrlError("--ship-package: needs an --address to ship to")
    if arguments.executor == "inline":
        return InlineExecutor()
    if place.uri.startswith("memory://"):
        raise RecrlError(
            f"{place.uri}: is one process's memory, which others do not see; see --executor inline"
        )
    from recrl.orchestrator.ray.executor import RayExecutor  # noqa: PLC0415  (imports ray)

    return RayExecutor(
        address=arguments.address,
        ship_package=arguments.ship_package,
        cpus_per_trial=grid.resources.cpus_per_trial,
        gpus_per_trial=grid.resources.gpus_per_trial,
        custom_per_trial=grid.resources.custom_per_trial,
        max_concurrent=arguments.max_concurrent or grid.resources.max_concurrent,
        teacher=grid.resources.teacher,
        silence_seconds=grid.resources.silence_seconds,
    )


def _mirror_to(uri: str) -> Callable[[SweepStore], Mirror]:
    return lambda store: start_mirror(store, uri, interval_seconds=MIRROR_INTERVAL_SECONDS)


def _draw(sweep: Sweep, folder: Path, console: Console, *, band: str = "mean", whole: bool = True) -> None:
    from recrl.analysis.report import averagings, draw, sketch  # noqa: PLC0415  (imports matplotlib)

    (draw if whole else sketch)(sweep, folder, averaging=averagings()[band])
    _say(console, f"Figures    {_short(folder)}")


def _draw_at_end(store: SweepStore, console: Console) -> None:
    """Draw a launch's figures; a mistake in drawing them is told, as the trials are run and MLflow waits."""
    from recrl.analysis.data import sweep_data  # noqa: PLC0415  (imports pandas)

    try:
        _draw(sweep_data.load(store), store.figures_folder, console)
    except (RecrlError, OSError):
        raise
    except Exception as error:
        logger.debug("figures of %s", store.name, exc_info=True)
        _say(
            console, f"Figures    not all are drawn ({type(error).__name__}: {error}), by a mistake in recrl"
        )
        _say(console, f"           for its traceback: recrl-sweep figures {store.name}")


def _film(
    grid: GridSpec, after: SweepProgress, store: SweepStore, stop: threading.Event, console: Console
) -> None:
    """Film the complete trials that the grid wants filmed and that have no video yet."""
    seeds = {"none": (), "first-seed": grid.seeds[:1], "all": grid.seeds}[grid.run.videos]
    complete = [trial.spec for trial in after.standing(Standing.COMPLETE) if trial.spec.seed in seeds]
    unseen = [store.trial(spec) for spec in complete if not any(store.trial(spec).videos_folder.glob("*"))]
    if not unseen:
        return
    from recrl.agents.evaluation import FrozenPolicy  # noqa: PLC0415
    from recrl.orchestrator.trial.saved_policy import FrozenTrial  # noqa: PLC0415  (imports torch)
    from recrl.orchestrator.trial.videos import VideoFormat  # noqa: PLC0415

    _say(console, f"Videos     {_short(store.trials_folder)}/*/{unseen[0].videos_folder.name}")
    for trial in unseen:
        if stop.is_set():
            return
        try:
            FrozenTrial.thaw(trial).film(FrozenPolicy.STOCHASTIC, VideoFormat.GIF, seed=None)
        except RecrlError as error:  # a picture is no reason to call a finished sweep broken
            _say(console, f"           no video: {error}")


def _show(table: pd.DataFrame, console: Console) -> None:
    """A table of finished text."""
    console.print(display.text_table(list(map(str, table)), table.to_numpy().tolist()))


def _room(grid: GridSpec, arguments: argparse.Namespace) -> tuple[int, str]:
    """How many trials run at once, and where that is so: on a cluster if there is an address, else here."""
    inline = arguments.command == "launch" and arguments.executor == "inline"
    most = 1 if inline else arguments.max_concurrent or grid.resources.max_concurrent
    if arguments.address and not inline:
        from recrl.orchestrator.ray.executor import room_on_cluster  # noqa: PLC0415  (imports ray)

        room = room_on_cluster(arguments.address, grid.resources)
        return most or max(1, room), "on the cluster as it is now"
    cores = arguments.cores if arguments.command == "plan" else None
    room = trials_at_once(cpus_per_trial=grid.resources.cpus_per_trial, max_concurrent=most, cores=cores)
    return room, f"on {cores} cores" if cores else "on this machine"


def _say_plan(plan: Plan, grid: GridSpec, console: Console, *, at_once: int, where: str) -> None:
    _say(console, f"{grid.name}: {display.plan_sentence(plan)}")
    _say(console, display.estimate_sentence(estimate(plan, concurrent=at_once), where))


def _say_other_code(plan: Plan, console: Console) -> None:
    """Say how many trials ran other code than is installed now."""
    changed = plan.other_code
    complete = sum(trial.record.status is TrialState.COMPLETE for trial in changed)
    if sentence := other_code_sentence(complete, len(changed) - complete):
        _say(console, f"warning: {sentence}")


def _say_failures(now: SweepProgress, store: SweepStore, console: Console) -> None:
    def folder_of(trial: TrialProgress) -> str:
        return str(_short(store.trial(trial.spec).folder))

    broken = [
        *now.standing(Standing.FAILED, Standing.DAMAGED),
        *(t for t in now.standing(Standing.STOPPED) if t.record.error),
    ]
    for line in display.failures(broken, folder_of):
        _say(console, line)


def _say_mirrored(
    result: SweepResult, store: SweepStore, uri: str, arguments: argparse.Namespace, console: Console
) -> None:
    """Say where MLflow's view is and how to open it, and whether it is up to date."""
    place = [store.name]
    if arguments.root != DEFAULT_ROOT:
        place += ["--root", str(arguments.root)]
    if arguments.tracking_uri:
        place += ["--tracking-uri", redacted(arguments.tracking_uri)]
    where = redacted(uri) if arguments.tracking_uri else _short(store.mlflow_database)
    _say(console, f"MLflow     {where}")
    _say(console, f"           {shlex.join(['recrl-sweep', 'ui', *place])}")
    if not result.mirrored:  # a mirror that came to no end leaves the report of an earlier pass
        report = last_report(store, uri)
        problem = f" ({report.problem})" if report and report.problem else ""
        again = shlex.join(["recrl-sweep", "sync", *place])
        _say(console, f"           MLflow is not up to date{problem}; nothing is lost: {again}")


def _say_result(
    result: SweepResult, store: SweepStore, arguments: argparse.Namespace, console: Console
) -> ExitCode:
    """Say what came of a launch, and how to go on."""
    _say(console, f"{store.name}: {display.status_sentence(result.progress)}")
    _say_failures(result.progress, store, console)
    again = shlex.join(["recrl-sweep", *arguments.given])
    if result.progress.is_complete:
        return ExitCode.OK
    if result.stopped:
        _say(console, f"Stopped; nothing is lost. Go on with: {again}")
        return ExitCode.STOPPED
    if damaged := result.progress.standing(Standing.DAMAGED):
        them = f"{len(damaged)} damaged trial{'' if len(damaged) == 1 else 's'}"
        rerun = again if arguments.rerun_damaged else f"{again} --rerun-damaged"
        _say(console, f"{them} left alone; what is damaged is moved aside and run again with: {rerun}")
    if result.failed:
        retry = again if arguments.retry_failed else f"{again} --retry-failed"
        _say(console, f"Try what failed again with: {retry}")
    elif not damaged:
        _say(console, f"Not everything could be finished. Go on with: {again}")
    return ExitCode.TRIALS_FAILED


def _store(arguments: argparse.Namespace, *, checkpoints: bool = False) -> SweepStore:
    """The folder of the sweep that is meant, up to date also where it is a mirror."""
    store = sweep_store(arguments.root, arguments.sweep, arguments.storage)
    sweep_place(store, arguments.storage).refresh(checkpoints=checkpoints)
    return store


def _short(path: Path) -> Path:
    """The path as seen from here, where it is below."""
    with contextlib.suppress(ValueError):
        return path.relative_to(Path.cwd())
    return path


def _say(console: Console, sentence: str) -> None:
    """One line as it is, but for secrets and control characters: no markup, no colours, no wrapping."""
    console.print(text_shown(sentence), markup=False, highlight=False, soft_wrap=True)


COMMANDS: Mapping[str, Command] = {
    "launch": run_launch,
    "plan": run_plan,
    "validate": run_validate,
    "status": run_status,
    "check": run_check,
    "stop": run_stop,
    "logs": run_logs,
    "evaluate": run_evaluate,
    "figures": run_figures,
    "export": run_export,
    "merge": run_merge,
    "bound": run_bound,
    "replay": run_replay,
    "ui": run_ui,
    "sync": run_sync,
}
