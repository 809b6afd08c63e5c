"""A sweep as tidy pandas data frames, the basis of metrics, figures, tables and notebooks.

Every data frame begins with the columns KEY = task, agent, method, seed. The first three are ordered
categories, so that every table and legend has the same order: tasks by name, agents and methods by
AGENT_ORDER and METHOD_ORDER. i counts the costs, 0 ... k-1. If tasks of a sweep have different k, the columns
that a task lacks are NaN. All returns and costs are undiscounted sums over an episode.

    trials       one row per trial of the sweep's last launch, started or not:
                 KEY, trial_id, group, status (as recorded in its files: waiting, running, complete,
                 failed or damaged; what recrl-sweep status calls stopped is waiting here, and what it
                 calls interrupted is running), error, task_name, agent_name, method_name, num_costs,
                 train_steps, boundary_step (the first step under d_d: B rounded up to a policy update),
                 total_steps (rounded up likewise), steps_per_update, env_steps (taken so far),
                 cpu_seconds, train_limit_i, deploy_limit_i, start_limit_i (the d_t with which the
                 curriculum started, measured or as given; infinite if it has none, NaN if it does not say),
                 optimal_return (J*(d_d), or NaN if unknown)
    phases       one row per trial and phase with at least one episode, summed over its episodes:
                 KEY, phase, episodes, steps, episode_return and cost_i (means), episode_return_std and
                 cost_i_std (over episodes, NaN for one), cost_i_total, excess_i_total: the sum of
                 max(0, C_i - d_d,i), the cost above the deployment limit
    updates      one row per policy update: KEY, UPDATE_COLUMNS, cost_i, limit_i (in force when the
                 batch was collected), then the agents' own metrics
    evaluations  one row per episode of the final policy: KEY, EVALUATION_COLUMNS, cost_i
    events       one row per event: KEY, update, end_step, event
    policies     one row per state of a finite task: KEY, state, action_j, the final policy's pi(j | state)

Two sources give the same data frames: the trials' files (``load``, here) and the export file of a sweep
(``recrl.analysis.data.export``), which MLflow has as well (``recrl.analysis.data.from_mlflow``). Each calls
``assemble`` with the trials and the rows of the other data frames.

Episode files may have 500,000 rows per trial. ``load`` reads them one at a time and keeps their sums
(``phases``); ``load_episodes`` returns the rows themselves.
"""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from recrl.analysis.data.exact_values import MISFIT, exact_values, finite_model, misfit_note
from recrl.analysis.data.labels import DOUBLES, GROUP, KEY, TRIAL, keys_of
from recrl.analysis.data.optima import NO_OPTIMUM, UNKNOWN_OPTIMUM, optima_of
from recrl.analysis.data.phase_totals import phase_totals
from recrl.environments.cmdp import Phase
from recrl.environments.finite.finite_cmdp import FiniteCMDP
from recrl.environments.plugins import nearest
from recrl.orchestrator.counting import counted
from recrl.orchestrator.errors import RecrlError, StorageError
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_files import EPISODE_COLUMNS, EVALUATION_COLUMNS, UPDATE_COLUMNS
from recrl.orchestrator.files.trial_reader import TrialReader
from recrl.orchestrator.spec import TrialSpec, TrialStatus
from recrl.orchestrator.untrusted import check_name

TRIAL_COLUMNS = (
    "trial_id",
    "group",
    "status",
    "error",
    "task_name",
    "agent_name",
    "method_name",
    "num_costs",
    "train_steps",
    "boundary_step",
    "total_steps",
    "steps_per_update",
    "env_steps",
    "cpu_seconds",
    "optimal_return",
)
PHASE_COLUMNS = ("phase", "episodes", "steps", "episode_return", "episode_return_std")
PHASE_COST_COLUMNS = (("cost", ""), ("cost", "_std"), ("cost", "_total"), ("excess", "_total"))
EVENT_COLUMNS = ("update", "end_step", "event")
ROWS = ("phases", "updates", "evaluations", "events", "policies")  # the data frames that it receives

# The agents' metrics in figures, tables and exports; docs/reference/files.md lists them.
EXPORTED_METRICS = re.compile(
    r"(multiplier|cost_advantage_max)_\d+|explained_variance_(reward|cost_\d+)|kl|case"
)

logger = logging.getLogger("recrl.sweep_data")


@dataclass(frozen=True)
class TrialFacts:
    """Facts of a whole trial.

    Attributes:
        spec: of the trial.
        status: in its files.
        error: one line with the reason of a failure, or empty.
        env_steps: environment steps taken so far.
        cpu_seconds: CPU time so far.
        start_limits: the d_t with which its curriculum started, measured or as given, [k], or None.
        provenance: versions, commit, machine and digests of the code of each attempt, as in its file; empty
            if unknown.
    """

    spec: TrialSpec
    status: TrialStatus
    error: str = ""
    env_steps: int = 0
    cpu_seconds: float = 0.0
    start_limits: Sequence[float | str] | None = None
    provenance: str = ""

    @property
    def attempts(self) -> list[dict[str, Any]]:
        """The provenance of each attempt, the first one first; empty if it is unknown or of another form."""
        try:
            found = json.loads(self.provenance)
        except ValueError:
            return []
        attempts = found.get("attempts") if isinstance(found, dict) else None
        return [it for it in attempts if isinstance(it, dict)] if isinstance(attempts, list) else []


@dataclass(frozen=True, repr=False)
class Sweep:
    """The data frames of one sweep; the module's docstring lists their columns.

    Attributes:
        name: the sweep's name.
        trials: one row per trial.
        phases: one row per trial and phase.
        updates: one row per policy update.
        evaluations: one row per episode of the final policy.
        events: one row per event.
        policies: one row per state of a complete trial's final policy.
        facts: the trials themselves, in the order of the grid.
        grid: the grid file of the last launch, or empty.
        notes: remarks for readers of the data frames, for example an unknown optimum.
        folder: of the sweep's files, or None if the data are from an export or from MLflow.
    """

    name: str
    trials: pd.DataFrame
    phases: pd.DataFrame
    updates: pd.DataFrame
    evaluations: pd.DataFrame
    events: pd.DataFrame
    policies: pd.DataFrame
    facts: tuple[TrialFacts, ...] = ()
    grid: str = ""
    notes: tuple[str, ...] = ()
    folder: Path | None = None

    def __repr__(self) -> str:
        statuses = ", ".join(
            f"{count} {name}" for name, count in self.trials["status"].value_counts().items()
        )
        trials = f"{counted(len(self.trials), 'trial')}{f' ({statuses})' if statuses else ''}"
        return f"<Sweep {self.name}: {trials}; data frames trials, {', '.join(ROWS)}>"

    @property
    def num_costs(self) -> int:
        """Largest k of the sweep's tasks; 0 for an empty sweep."""
        return int(self.trials["num_costs"].max()) if len(self.trials) else 0

    @cached_property
    def groups(self) -> Sequence[tuple[str, str, str]]:
        """GROUP of every trial, in the order of ``facts``; a label of its spec may have a digest appended."""
        keys, _ = keys_of([it.spec for it in self.facts])
        task, agent, method = (keys.labels[name].tolist() for name in GROUP)
        return list(zip(task, agent, method, strict=True))

    @property
    def task_labels(self) -> Sequence[str]:
        """Label of every trial's task in the data frames, in the order of ``facts``."""
        return [task for task, _, _ in self.groups]

    @cached_property
    def task_options(self) -> Mapping[str, Mapping[str, Any]]:
        """The options of every task, by its label in the data frames."""
        return {label: it.spec.task.options for label, it in zip(self.task_labels, self.facts, strict=True)}

    @cached_property
    def models(self) -> Mapping[str, FiniteCMDP | None]:
        """The model of each task with policy tables, by its label; None if it cannot be built here."""
        tabulated = {str(label) for label in self.policies["task"].unique()}
        tasks = dict(zip(self.task_labels, (it.spec.task for it in self.facts), strict=True))
        return {label: finite_model(it.name, it.options) for label, it in tasks.items() if label in tabulated}

    @cached_property
    def exact(self) -> pd.DataFrame:
        """Exact values of the final policies of finite tasks, from ``exact_values``."""
        return exact_values(self.policies, self.models)

    @cached_property
    def agent_options(self) -> Mapping[tuple[str, str], Mapping[str, Any]]:
        """The options of every agent, by the labels of its task and itself in the data frames."""
        return {
            (task, agent): it.spec.agent.options
            for (task, agent, _), it in zip(self.groups, self.facts, strict=True)
        }

    def rows(self, name: str) -> pd.DataFrame:
        """Return one of the data frames ROWS for ``assemble``: with TRIAL instead of KEY."""
        frame: pd.DataFrame = getattr(self, name)
        of = [self._positions[key] for key in zip(*(frame[label] for label in KEY), strict=True)]
        rows = frame.drop(columns=list(KEY))
        rows.insert(0, TRIAL, np.array(of, dtype=np.int64))
        return rows

    @cached_property
    def _positions(self) -> Mapping[tuple[Any, ...], int]:
        """Return every trial's position in ``facts``, by its KEY."""
        return {
            (*group, it.spec.seed): position
            for position, (group, it) in enumerate(zip(self.groups, self.facts, strict=True))
        }


def load(store: SweepStore) -> Sweep:
    """Read a finished or running sweep: the trials of its last launch, or else all on disk.

    Every file is checked against its committed length and digest. A damaged trial has only a row in
    ``trials``, with the status ``damaged`` and a sentence in ``error``.

    Args:
        store: the sweep's folder.

    Raises:
        DamagedError: the file that lists the trials is damaged.
    """
    read = [_read(spec, store.trial(spec)) for spec in store.specs()]
    grid, problem = store.grid_text()
    sweep = assemble(
        store.name,
        [facts for facts, _ in read],
        {name: concatenated([rows[name] for _, rows in read]) for name in ROWS},
        grid=grid,
        notes=[problem] if problem else [],
    )
    return replace(sweep, folder=store.folder)


def load_episodes(
    sweep: Sweep | SweepStore, *, columns: Sequence[str] | None = None, phase: Phase | None = None
) -> pd.DataFrame:
    """Read all episodes of training: KEY, EPISODE_COLUMNS, cost_i, limit_i; one row per episode.

    Args:
        sweep: that ``recrl.load_sweep`` read from its folder, or its files.
        columns: only these columns besides KEY.
        phase: only the episodes that ended in this phase.

    Raises:
        RecrlError: the sweep is from an export or from MLflow, which have no single episodes of training.
        ValueError: there is no such column.
    """
    if isinstance(sweep, Sweep):
        if sweep.folder is None:
            raise RecrlError(
                f"{sweep.name}: an export and MLflow hold no single episodes of training; load the sweep "
                "from the folder it ran in"
            )
        store, specs = SweepStore(sweep.folder.parent, sweep.folder.name), [it.spec for it in sweep.facts]
    else:
        store, specs = sweep, sweep.specs()

    chosen = None if columns is None else [it for it in dict.fromkeys(columns) if it not in KEY]

    def rows(trial: TrialReader) -> pd.DataFrame:
        try:
            episodes = trial.episodes()
        except StorageError as error:
            logger.warning("%s; its episodes are left out", error)
            return pd.DataFrame()
        if phase is not None and len(episodes):
            episodes = episodes[episodes["phase"] == phase.value]
        return episodes if chosen is None else episodes.reindex(columns=chosen)

    num_costs = max((len(spec.deploy_limits) for spec in specs), default=0)
    known = [*EPISODE_COLUMNS, *(f"{name}_{i}" for name in ("cost", "limit") for i in range(num_costs))]
    for column in chosen or ():
        if specs and column not in known:
            raise ValueError(
                f"no column {column!r}{nearest(column, known)} (episodes have {', '.join(known)})"
            )
    keys, _ = keys_of(specs)
    return keys.put_before(
        concatenated([rows(store.trial(spec)) for spec in specs]),
        EPISODE_COLUMNS if chosen is None else chosen,
    )


def assemble(
    name: str,
    facts: Sequence[TrialFacts],
    rows: Mapping[str, pd.DataFrame],
    *,
    grid: str = "",
    notes: Sequence[str] = (),
) -> Sweep:
    """Return the tables of a sweep from a source's data.

    Args:
        name: of the sweep.
        facts: its trials, in the order of the grid.
        rows: the tables ROWS, in order for each trial, with a column TRIAL instead of KEY.
        grid: the grid file, or empty.
        notes: of the source; those of ``is_made_again`` are left out.
    """
    keys, doubles = keys_of([it.spec for it in facts])
    try:
        check_name(name)
    except ValueError as error:
        raise RecrlError(str(error)) from error
    tabulated = rows["policies"][TRIAL].unique() if len(rows["policies"]) else ()
    labels = keys.labels["task"].tolist()
    optima, unknown = optima_of([it.spec for it in facts], labels, finite={labels[int(i)] for i in tabulated})
    costs = range(max((len(it.spec.deploy_limits) for it in facts), default=0))
    cost_columns, limit_columns = [f"cost_{i}" for i in costs], [f"limit_{i}" for i in costs]
    phase_columns = [f"{kind}_{i}{end}" for i in costs for kind, end in PHASE_COST_COLUMNS]
    trials = [
        _trial_row(it, optimum) | {TRIAL: i}
        for i, (it, optimum) in enumerate(zip(facts, optima, strict=True))
    ]
    sweep = Sweep(
        name=name,
        trials=keys.put_before(pd.DataFrame(trials), TRIAL_COLUMNS),
        phases=keys.put_before(rows["phases"], PHASE_COLUMNS, phase_columns),
        updates=keys.put_before(rows["updates"], UPDATE_COLUMNS, (*cost_columns, *limit_columns)),
        evaluations=keys.put_before(rows["evaluations"], EVALUATION_COLUMNS, cost_columns),
        events=keys.put_before(rows["events"], EVENT_COLUMNS),
        policies=keys.put_before(rows["policies"], ("state",)),
        facts=tuple(facts),
        grid=grid,
        notes=tuple(dict.fromkeys((*(it for it in notes if not is_made_again(it)), *doubles, *unknown))),
    )
    misfit = misfit_note(sweep.policies, sweep.models)
    return replace(sweep, notes=(*sweep.notes, misfit)) if misfit else sweep


def is_made_again(note: str) -> bool:
    """Whether ``assemble`` made a note from the trials, and will make it again if it still holds."""
    return any(text in note for text in (DOUBLES, UNKNOWN_OPTIMUM, NO_OPTIMUM, MISFIT))


def concatenated(frames: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Concatenate the trials' data frames, with the column TRIAL: their position in ``frames``."""
    filled = [frame for frame in frames if len(frame)]
    rows = pd.concat(filled, ignore_index=True) if filled else pd.DataFrame()
    return rows.assign(**{TRIAL: np.repeat(np.arange(len(frames)), [len(frame) for frame in frames])})


def drawn_columns(columns: Iterable[str]) -> list[str]:
    """Return the columns of ``updates`` in figures and tables: all except timing and other metrics.

    >>> drawn_columns(["update", "time", "collect_seconds", "cost_0", "limit_0", "entropy", "kl"])
    ['update', 'cost_0', 'limit_0', 'kl']
    >>> drawn_columns(["explained_variance_reward", "explained_variance_cost_0", "value_loss_reward"])
    ['explained_variance_reward', 'explained_variance_cost_0']
    """
    kept = {*KEY, *UPDATE_COLUMNS} - {"time", "collect_seconds", "update_seconds"}
    return [
        name
        for name in columns
        if name in kept or re.fullmatch(r"(cost|limit)_\d+", name) or EXPORTED_METRICS.fullmatch(name)
    ]


def _trial_row(trial: TrialFacts, optimum: float) -> dict[str, Any]:
    spec = trial.spec
    size = spec.steps_per_update
    row: dict[str, Any] = {
        "trial_id": spec.trial_id,
        "group": spec.group,
        "status": trial.status.value,
        "error": trial.error,
        "task_name": spec.task.name,
        "agent_name": spec.agent.name,
        "method_name": spec.method.name,
        "num_costs": len(spec.deploy_limits),
        "train_steps": spec.train_steps,
        "boundary_step": -(-spec.train_steps // size) * size,
        "total_steps": spec.num_updates * size,
        "steps_per_update": size,
        "env_steps": trial.env_steps,
        "cpu_seconds": trial.cpu_seconds,
        "optimal_return": optimum,
    }
    start: Sequence[float | str] = trial.start_limits or [math.nan] * len(spec.deploy_limits)
    for i, (train, deploy, measured) in enumerate(
        zip(spec.train_limits, spec.deploy_limits, start, strict=True)
    ):
        row |= {f"train_limit_{i}": train, f"deploy_limit_{i}": deploy, f"start_limit_{i}": float(measured)}
    return row


def _read(spec: TrialSpec, trial: TrialReader) -> tuple[TrialFacts, dict[str, pd.DataFrame]]:
    """Return a trial's facts and its rows of the data frames ROWS; no rows for a damaged trial."""
    record = trial.record()
    if record.status is not TrialStatus.DAMAGED:
        try:
            rows = {
                "phases": pd.DataFrame(phase_totals(trial.episodes(), spec.deploy_limits.values)),
                "updates": trial.updates(),
                "evaluations": trial.evaluation(),
                "events": _event_rows(trial),
                "policies": _policy_rows(trial),
            }
            facts = TrialFacts(
                spec=spec,
                status=record.status,
                error=record.error,
                env_steps=record.env_steps,
                cpu_seconds=record.cpu_seconds,
                start_limits=record.start_limits,
                provenance=trial.committed_bytes(trial.provenance_path).decode(),
            )
            return facts, rows
        except StorageError as error:
            record = replace(record, error=str(error).removeprefix(f"{trial.folder.name}: "))
    damaged = TrialFacts(spec=spec, status=TrialStatus.DAMAGED, error=record.error)
    return damaged, {name: pd.DataFrame() for name in ROWS}


def _event_rows(trial: TrialReader) -> pd.DataFrame:
    return pd.DataFrame([{name: event.get(name) for name in EVENT_COLUMNS} for event in trial.events()])


def _policy_rows(trial: TrialReader) -> pd.DataFrame:
    policy = trial.policy()
    return policy.rename_axis("state").reset_index() if len(policy) else policy
