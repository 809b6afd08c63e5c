"""``validate`` and ``plan``: check a grid, and show what a launch would do."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence

from rich.console import Console

from recrl.orchestrator.cli import display
from recrl.orchestrator.cli.output import print_table, say, short
from recrl.orchestrator.cli.requests import GridRequest, PlanRequest, ValidateRequest
from recrl.orchestrator.counting import counted
from recrl.orchestrator.errors import UntrustedGridError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.checking import read_grid
from recrl.orchestrator.grid.only_selection import parse_only
from recrl.orchestrator.launch_grid import room
from recrl.orchestrator.launch_plan import Plan, TrialSelection, estimate, kind_of, make_plan, unmeasured
from recrl.orchestrator.remote.remote_sweep import sweep_place
from recrl.orchestrator.spec import TrialSpec


def run_validate(request: ValidateRequest, console: Console) -> ExitCode:
    """Check a grid file; nothing is started or written."""
    try:
        grid = read_grid(request.grid, build=True)
    except UntrustedGridError as error:
        say(console, f"{error}; nothing else is wrong so far, but what depends on that code is not checked")
        return ExitCode.OK
    sizes = (len(grid.tasks), len(grid.agents), len(grid.methods), len(grid.seeds))
    product = " x ".join(str(size) for size in sizes)
    say(
        console,
        f"{request.grid}: {grid.name} is right: {counted(len(grid.trials()), 'trial')}, from "
        f"tasks x agents x methods x seeds = {product}",
    )
    for line in display.update_counts(grid.trials()):
        say(console, line)
    _print_warnings(grid, grid.trials(), console)
    return ExitCode.OK


def selection_of(request: GridRequest) -> TrialSelection:
    """Return the trials that a request selects."""
    return TrialSelection(
        parse_only(request.only), request.retry_failed, request.rerun_damaged, request.rerun_changed
    )


def run_plan(request: PlanRequest, console: Console) -> ExitCode:
    """Print what a launch would do; nothing is started, and only the copy of an object store is written."""
    grid = read_grid(request.grid)
    store = SweepStore(request.root, grid.name)
    place = sweep_place(store, request.storage)
    selection = selection_of(request)
    if selection.reruns:
        place.require_reruns()
    place.refresh()
    plan = make_plan(grid.trials(), store, selection)
    at_once, where = room(
        grid.resources, address=request.address, max_concurrent=request.max_concurrent, cores=request.cores
    )
    print_table(display.plan_table(plan), console)
    say(console, "")
    speeds = _measured(plan, console) if request.measure else {}
    say_plan(plan, grid, console, at_once=at_once, where=where, speeds=speeds)
    if not request.measure and unmeasured(plan):
        again = shlex.join(["recrl-sweep", *request.given, "--measure"])
        say(console, f"To measure about a second of each: {again}")
    for line in display.damages_of_plan(plan):
        say(console, line)
    say_other_code(plan, console)
    for problem in store.damages():
        say(console, f"damaged: {problem}")
    for orphan in plan.orphans:
        say(console, f"no longer in the grid, not touched: {short(orphan.folder)}")
    is_left = plan.to_do or plan.other_code
    return ExitCode.TRIALS_LEFT if request.check and is_left else ExitCode.OK


def _measured(plan: Plan, console: Console) -> dict[str, float]:
    """Measure each task and agent without a known speed for about a second; return speeds by kind."""
    from recrl.orchestrator.trial.speed import measured_speed  # noqa: PLC0415  (imports torch)

    speeds = {}
    for spec in unmeasured(plan):
        speed = measured_speed(spec)
        say(console, f"{spec.task.label} {spec.agent.label}: {speed:,.0f} steps/s on one core")
        speeds[kind_of(spec)] = speed
    return speeds


def say_plan(
    plan: Plan,
    grid: GridSpec,
    console: Console,
    *,
    at_once: int,
    where: str,
    speeds: Mapping[str, float] | None = None,
) -> None:
    """Print what a launch would do, and its estimated time and memory."""
    say(console, f"{grid.name}: {display.plan_sentence(plan)}")
    for line in display.update_counts(plan.to_do):
        say(console, line)
    say(console, display.estimate_sentence(estimate(plan, concurrent=at_once, speeds=speeds), where))
    _print_warnings(grid, plan.to_do, console)


def _print_warnings(grid: GridSpec, specs: Sequence[TrialSpec], console: Console) -> None:
    """Print the grid's warnings about horizons, steps and limits."""
    for sentence in grid.warnings(specs):
        say(console, f"warning: {sentence}")


def say_other_code(plan: Plan, console: Console) -> None:
    """Print the numbers of trials that ran other code or libraries than now, or code that is not found."""
    for sentence in plan.code_warnings:
        say(console, f"warning: {sentence}")
