"""``bound`` and ``replay``: the cost of training against its bounds, and limits of other curricula."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError
from rich.console import Console

from recrl.environments.plugins import UnknownNameError, UntrustedNameError, WrongKindError
from recrl.orchestrator.cli.output import say, short, show
from recrl.orchestrator.cli.requests import BoundRequest, ReplayRequest
from recrl.orchestrator.cli.results import require_undamaged, say_warnings, source
from recrl.orchestrator.cli.sweeps import open_store
from recrl.orchestrator.errors import (
    TRUST_HINT,
    USERS_ERRORS,
    DamagedError,
    RecrlError,
    StorageError,
    described,
)
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.grid.only_selection import parse_only, select
from recrl.orchestrator.spec import Choice, TrialStatus
from recrl.orchestrator.validation_sentences import NotJsonError, ignored_keys, require_json, sentences
from recrl.teachers.registry import find_teacher, teacher_config

if TYPE_CHECKING:
    import pandas as pd

    from recrl.analysis.figures.curriculum_replay import Replayed


def run_bound(request: BoundRequest, console: Console) -> ExitCode:
    """Compare the cost of training with its bounds; estimate the largest d_t within a budget."""
    from recrl.analysis.data.cost_names import indices_of_cost  # noqa: PLC0415
    from recrl.analysis.report import text_tables  # noqa: PLC0415  (imports pandas and SciPy)
    from recrl.analysis.statistics import cumulative_cost  # noqa: PLC0415

    if request.budget is not None and not request.budget >= 0.0:
        raise RecrlError(f"--budget: must be at least 0, got {request.budget:g}")
    sweep, _ = source(request)
    say_warnings(sweep, console)
    require_undamaged(sweep)
    try:
        indices = indices_of_cost(sweep, request.cost)
    except ValueError as error:
        raise RecrlError(f"--cost: {error}") from error
    rows = cumulative_cost.cumulative_costs(sweep, cost=indices)
    if not len(rows):
        raise RecrlError(f"{sweep.name}: no trial has finished its training phase yet")
    show(text_tables.bound_table(rows), console)
    which = f"Cost {request.cost}, summed" if sweep.num_costs > 1 else "Summed"
    say(
        console,
        f"{which} over policies, one expected episode each; means over runs; undiscounted unless stated; "
        "–: not known for this agent or task.",
    )
    if request.budget is not None:
        allowed = cumulative_cost.admissible_limits(rows, sweep, budget=request.budget)
        say(
            console,
            f"\nThe largest training limit d_t within {request.budget:g} of net cost above the deployment "
            "limit d_d over all episodes:",
        )
        show(text_tables.admissible_table(allowed), console)
        say(
            console,
            "An estimate, not a bound: each policy is taken to exceed its limit as in the worst run. That "
            "overshoot is the positive part of each update's sampled mean. With few episodes per policy it "
            "is too large, and d_t too small. Each policy is taken to collect equally many episodes. For "
            "dynamic, d_t is taken to be in force throughout. "
            "unconstrained, cooling and curricula of your own are left out.",
        )
    return ExitCode.OK


def run_replay(request: ReplayRequest, console: Console) -> ExitCode:
    """Print the limits that another curriculum would have set on the recorded episodes."""
    import pandas as pd  # noqa: PLC0415  (commands that do not need it are quick to start)

    from recrl.analysis.figures.curriculum_replay import Replayed  # noqa: PLC0415
    from recrl.analysis.report.table_formats import write_csv  # noqa: PLC0415
    from recrl.analysis.report.text_tables import replay_summary  # noqa: PLC0415

    store = open_store(request)
    specs = select(store.specs(), parse_only(request.only))
    method = _teacher(store, request)
    folder, runs, summaries = store.folder / "replays", [], []
    damaged = []
    for trial in map(store.trial, specs):
        try:
            rows = _replay(trial, method)
        except StorageError as error:
            damaged.append(str(error))
            continue
        if rows is not None:
            write_csv(rows, folder / f"{trial.folder.name}__{method.file_name}.csv")
            runs.append(Replayed(trial.spec, rows))
            summaries.append(replay_summary(trial, rows))
    for sentence in damaged:
        say(console, f"damaged: {sentence}")
    if not runs:
        if len(damaged) == len(specs):
            raise DamagedError(f"{store.name}: all chosen trials are damaged")
        raise RecrlError(f"{store.name}: no chosen trial has a saved policy update yet")
    say(console, f"What {method.label} would have set on the recorded episodes, in the training phase:")
    show(pd.concat(summaries), console)
    say(
        console,
        "mean limit, replayed: means of the finite limits; reaches d_d: the share of the training phase "
        "after which the limit is the deployment limit.",
    )
    for file in _draw(runs, method, folder):
        say(console, f"Figure        {short(file)}")
    say(console, f"Every update  {short(folder)}")
    return ExitCode.OK


def _replay(trial: TrialStore, method: Choice) -> pd.DataFrame | None:
    """Return the limits on a trial's recorded episodes; None if it has no saved policy update.

    Raises:
        StorageError: the trial is damaged.
        RecrlError: the curriculum cannot be used with it, or its code raises an error.
    """
    from recrl.analysis.statistics.curriculum_replay import replay  # noqa: PLC0415

    record = trial.record()
    if record.status is TrialStatus.DAMAGED:
        raise StorageError(f"{trial.title}: {record.error}")
    if not record.committed.get(trial.updates_path.name, 0):
        return None
    try:
        return replay(trial, method)
    except RecrlError:
        raise
    except USERS_ERRORS as error:
        raise RecrlError(
            f"{method.label}: cannot be replayed on {trial.title}: {described(error)}"
        ) from error


def _draw(runs: Sequence[Replayed], method: Choice, folder: Path) -> Iterator[Path]:
    """Draw a figure a cost, and yield the files."""
    from recrl.analysis.figures import styles  # noqa: PLC0415
    from recrl.analysis.figures.curriculum_replay import replayed_limits  # noqa: PLC0415

    for i in range(max(len(run.spec.deploy_limits) for run in runs)):
        with_cost = [run for run in runs if len(run.spec.deploy_limits) > i]
        figure = replayed_limits(with_cost, method.label, cost=i)
        _, file = styles.save(figure, folder, f"{method.file_name}_cost-{i}" if i else method.file_name)
        yield file


def _teacher(store: SweepStore, request: ReplayRequest) -> Choice:
    """Return the curriculum: a method of the sweep by its label, or any curriculum by its name."""
    known = {spec.method.label: spec.method for spec in store.specs()}
    method = known.get(request.teacher, Choice(request.teacher))
    changed = {}
    for pair in request.option:
        key, equals, value = pair.partition("=")
        if not equals:
            raise RecrlError(f"--option: must look like window=8, got {pair!r}")
        changed[key] = _parsed(value)
    try:
        options = {**(_beside_preset(method) if "preset" in changed else method.options), **changed}
        require_json(options)
        teacher_config(method.name, options)
    except ValidationError as error:
        mistakes = list(sentences(error, find_teacher(method.name).config))
        text = "; ".join(f"{'.'.join(map(str, place))}: {sentence}" for place, sentence in mistakes)
        if all(place and place[0] in method.options.keys() - changed.keys() for place, _ in mistakes):
            raise RecrlError(
                f"{method.label}: recorded with options that this version does not have ({text}); "
                "replay it with the code of its commit"
            ) from error
        raise RecrlError(f"--option: {method.name}: {text}") from error
    except NotJsonError as error:
        raise RecrlError(f"--option: {error}") from error
    except UntrustedNameError as error:
        raise RecrlError(f"{error}; {TRUST_HINT}") from error
    except (UnknownNameError, WrongKindError) as error:
        raise RecrlError(str(error)) from error
    except USERS_ERRORS as error:
        raise RecrlError(f"teacher {method.name!r} cannot be used: {described(error)}") from error
    for place, sentence in ignored_keys(find_teacher(method.name).config, options):
        if place[0] in changed:  # others are as recorded
            raise RecrlError(f"--option: {method.name}: {place[0]}: {sentence}")
    return Choice(method.name, options, method.label)


def _beside_preset(method: Choice) -> dict[str, Any]:
    """Return the options of a method that differ from the defaults of its preset."""
    preset = {"preset": method.options["preset"]} if "preset" in method.options else {}
    defaults = teacher_config(method.name, preset).model_dump()
    return {key: value for key, value in method.options.items() if value != defaults.get(key)}


def _parsed(text: str) -> Any:
    """Parse a JSON value; other text stays text."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):  # no JSON, a number of too many digits, or nested too deeply
        return text
