"""A sweep as tidy pandas frames: the one thing that metrics, figures, tables and notebooks start from.

Every frame begins with the columns KEY = task, agent, method, seed. The first three are ordered categories
(tasks by name, agents and methods in the order of AGENT_ORDER and METHOD_ORDER), so that every table and
legend has one order. i counts the costs, 0 ... k-1; where tasks of a sweep have different k, the columns a
task lacks are NaN. All returns and costs are undiscounted sums over an episode.

    trials       a row a trial of the sweep's last launch, started or not:
                 KEY, trial_id, group, status, error, task_name, agent_name, method_name, num_costs,
                 train_steps, boundary_step (the first step under d_d: B rounded up to a policy update),
                 total_steps (rounded up likewise), steps_per_update, env_steps (taken so far),
                 cpu_seconds, train_limit_i, deploy_limit_i, start_limit_i (measured d_t, or NaN),
                 optimal_return (J*(d_d), or NaN where nobody knows it)
    phases       a row a trial and phase with at least one episode, summed over its episodes:
                 KEY, phase, episodes, steps, episode_return and cost_i (means), episode_return_std and
                 cost_i_std (over episodes, NaN for one), cost_i_total, excess_i_total: the sum of
                 max(0, C_i - d_d,i), what went over the deployment limit
    updates      a row a policy update: KEY, store.UPDATE_COLUMNS, cost_i, limit_i (in force when the
                 batch was collected), then the students' own metrics
    evaluations  a row an episode of the frozen policy: KEY, store.EVALUATION_COLUMNS, cost_i
    events       a row an event: KEY, update, end_step, event
    policies     a row a state of a finite task: KEY, state, action_j, the final policy's pi(j | state)

Two sources give the same frames: the trials' files (``load``, here) and the export file of a sweep
(``recrl.analysis.data.export``), which MLflow has as well (``recrl.analysis.data.from_mlflow``). Each tells
``assemble`` the trials and, for each of the other frames, its rows.

Episode files can hold 500,000 rows a trial. ``load`` reads them one at a time and keeps their sums
(``phases``); ``load_episodes`` gives the rows themselves to whoever wants them.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from recrl.environments.cmdp import Phase
from recrl.environments.plugins import UnknownNameError, UntrustedNameError
from recrl.environments.registry import optimal_return
from recrl.orchestrator.errors import USERS_ERRORS, DamagedError, RecrlError, described
from recrl.orchestrator.files.store import (
    EPISODE_COLUMNS,
    EVALUATION_COLUMNS,
    UPDATE_COLUMNS,
    SweepStore,
    TrialStore,
)
from recrl.orchestrator.spec import TrialSpec, TrialState
from recrl.orchestrator.trial.phase_totals import phase_totals
from recrl.orchestrator.untrusted import checked_name

KEY = ("task", "agent", "method", "seed")
GROUP = ("task", "agent", "method")
AGENT_ORDER = ("ppo-lag", "cpo")
METHOD_ORDER = (
    "none",
    "linear",
    "cosine",
    "exponential",
    "dynamic",
    "annealed",
    "cooling",
    "step",
    "unconstrained",
)
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
TRIAL = "trial"  # in rows given to ``assemble``: the position of the trial they are of
ROWS = ("phases", "updates", "evaluations", "events", "policies")  # the frames that are given to it

# Notes of ``assemble`` say one of these.
DOUBLES = "groups of trials have these labels but different settings"
UNKNOWN_OPTIMUM = "the optimum is unknown here, because"

# The students' metrics that figures and tables read; MLflow and the compact file give no others.
DRAWN_METRICS = re.compile(r"(multiplier|cost_advantage_max)_\d+|kl|case")


logger = logging.getLogger("recrl.frames")


@dataclass(frozen=True)
class TrialFacts:
    """What is known of a trial as a whole.

    Attributes:
        spec: what it is.
        status: where it stands.
        error: one line saying why it failed, or empty.
        env_steps: environment steps taken so far.
        cpu_seconds: CPU time so far.
        start_limits: the d_t that its teacher measured, [k], or None.
        provenance: of each attempt versions, commit, machine and digests of the code, as its file has them;
            empty if unknown.
    """

    spec: TrialSpec
    status: TrialState
    error: str = ""
    env_steps: int = 0
    cpu_seconds: float = 0.0
    start_limits: Sequence[float | str] | None = None
    provenance: str = ""


@dataclass(frozen=True)
class Sweep:
    """The frames of one sweep; the module's docstring lists their columns.

    Attributes:
        name: the sweep's name.
        trials: a row a trial.
        phases: a row a trial and phase.
        updates: a row a policy update.
        evaluations: a row an episode of the frozen policy.
        events: a row an event.
        policies: a row a state of a complete trial's final policy.
        facts: the trials themselves, in the order of the grid.
        grid: the grid file of the last launch, or empty.
        notes: sentences on what a reader of the frames must know, for example an unknown optimum.
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

    @property
    def num_costs(self) -> int:
        """The largest k of the sweep's tasks; 0 for an empty sweep."""
        return int(self.trials["num_costs"].max()) if len(self.trials) else 0

    @cached_property
    def task_options(self) -> Mapping[str, Mapping[str, Any]]:
        """The options of every task, by its label."""
        return {it.spec.task.label: it.spec.task.options for it in self.facts}

    @cached_property
    def agent_options(self) -> Mapping[str, Mapping[str, Any]]:
        """The options of every student, by its label."""
        return {it.spec.agent.label: it.spec.agent.options for it in self.facts}

    def rows(self, name: str) -> pd.DataFrame:
        """One of the frames ROWS as ``assemble`` takes it: TRIAL, a position in ``facts``, instead of KEY."""
        frame: pd.DataFrame = getattr(self, name)
        of = [self._positions[key] for key in zip(*(frame[label] for label in KEY), strict=True)]
        rows = frame.drop(columns=list(KEY))
        rows.insert(0, TRIAL, np.array(of, dtype=np.int64))
        return rows

    @cached_property
    def _positions(self) -> Mapping[tuple[Any, ...], int]:
        """The position in ``facts`` of every trial, by its KEY; a method's label may carry its group."""
        keys = {row[0]: row[1:] for row in self.trials[["trial_id", *KEY]].itertuples(index=False, name=None)}
        return {keys[it.spec.trial_id]: position for position, it in enumerate(self.facts)}


def load(store: SweepStore) -> Sweep:
    """Read a finished or running sweep: the trials of its last launch, or else all that are on disk.

    Every file is held against its committed length and digest. Of a damaged trial there is only its row in
    ``trials``, with the status ``damaged`` and a sentence in ``error``.

    Args:
        store: the sweep's folder.

    Raises:
        DamagedError: the file that lists the trials is damaged.
    """
    specs, trials = _trials(store)
    read = [_read(spec, trial) for spec, trial in zip(specs, trials, strict=True)]
    grid, problem = store.grid_text()
    return assemble(
        store.name,
        [facts for facts, _ in read],
        **{name: joined([rows[name] for _, rows in read]) for name in ROWS},
        grid=grid,
        notes=[problem] if problem else [],
    )


def load_episodes(
    store: SweepStore, *, columns: Sequence[str] | None = None, phase: Phase | None = None
) -> pd.DataFrame:
    """The episodes themselves: KEY, store.EPISODE_COLUMNS, cost_i, limit_i; a row an episode.

    Args:
        store: the sweep's folder.
        columns: only these columns beside KEY.
        phase: only the episodes that ended in this phase.
    """
    specs, trials = _trials(store)

    def rows(trial: TrialStore) -> pd.DataFrame:
        try:
            episodes = trial.episodes()
        except DamagedError as error:
            logger.warning("%s; its episodes are left out", error)
            return pd.DataFrame()
        if phase is not None and len(episodes):
            episodes = episodes[episodes["phase"] == phase.value]
        return episodes if columns is None else episodes.reindex(columns=list(columns))

    keys, _ = _keys(specs)
    return keys.put_before(joined([rows(trial) for trial in trials]), columns or EPISODE_COLUMNS)


def assemble(
    name: str,
    facts: Sequence[TrialFacts],
    *,
    phases: pd.DataFrame,
    updates: pd.DataFrame,
    evaluations: pd.DataFrame,
    events: pd.DataFrame,
    policies: pd.DataFrame,
    grid: str = "",
    notes: Sequence[str] = (),
) -> Sweep:
    """The frames from what a source knows; those but ``trials`` are given as rows, in order for each trial.

    Args:
        name: of the sweep.
        facts: its trials, in the order of the grid.
        phases: rows with a column TRIAL, the position in ``facts``, and the frame's own but KEY.
        updates: likewise.
        evaluations: likewise.
        events: likewise.
        policies: likewise.
        grid: the grid file, or empty.
        notes: what the source has to say.
    """
    keys, doubles = _keys([it.spec for it in facts])
    try:
        checked_name(name)
    except ValueError as error:
        raise RecrlError(str(error)) from error
    optima, unknown = _optima([it.spec for it in facts])
    costs = range(max((len(it.spec.deploy_limits) for it in facts), default=0))
    cost_columns, limit_columns = [f"cost_{i}" for i in costs], [f"limit_{i}" for i in costs]
    phase_columns = [f"{kind}_{i}{end}" for i in costs for kind, end in PHASE_COST_COLUMNS]
    rows = [
        _trial_row(it, optimum) | {TRIAL: i}
        for i, (it, optimum) in enumerate(zip(facts, optima, strict=True))
    ]
    return Sweep(
        name=name,
        trials=keys.put_before(pd.DataFrame(rows), TRIAL_COLUMNS),
        phases=keys.put_before(phases, PHASE_COLUMNS, phase_columns),
        updates=keys.put_before(updates, UPDATE_COLUMNS, (*cost_columns, *limit_columns)),
        evaluations=keys.put_before(evaluations, EVALUATION_COLUMNS, cost_columns),
        events=keys.put_before(events, EVENT_COLUMNS),
        policies=keys.put_before(policies, ("state",)),
        facts=tuple(facts),
        grid=grid,
        notes=tuple(dict.fromkeys((*notes, *doubles, *unknown))),
    )


def is_made_again(note: str) -> bool:
    """Whether ``assemble`` made a note from the trials, and will from others if it is still true."""
    return DOUBLES in note or UNKNOWN_OPTIMUM in note


def joined(frames: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """The trials' frames below each other, with the column TRIAL: their position among ``frames``."""
    filled = [frame for frame in frames if len(frame)]
    rows = pd.concat(filled, ignore_index=True) if filled else pd.DataFrame()
    return rows.assign(**{TRIAL: np.repeat(np.arange(len(frames)), [len(frame) for frame in frames])})


def drawn_columns(columns: Iterable[str]) -> list[str]:
    """Those columns of ``updates`` that figures and tables read: all but timing and other metrics.

    >>> drawn_columns(["update", "time", "collect_seconds", "cost_0", "limit_0", "entropy", "kl"])
    ['update', 'cost_0', 'limit_0', 'kl']
    """
    kept = {*KEY, *UPDATE_COLUMNS} - {"time", "collect_seconds", "update_seconds"}
    return [
        name
        for name in columns
        if name in kept or re.fullmatch(r"(cost|limit)_\d+", name) or DRAWN_METRICS.fullmatch(name)
    ]


def ordered(labels: Collection[str], first: Sequence[str]) -> list[str]:
    """Labels without duplicates: those of ``first`` in its order, then the others by name, numbers by size.

    >>> ordered(["dynamic", "mine", "none", "dynamic"], METHOD_ORDER)
    ['none', 'dynamic', 'mine']
    >>> ordered(["map-10", "map-9"], ())
    ['map-9', 'map-10']
    """
    present = set(labels)
    return [label for label in first if label in present] + sorted(present - set(first), key=_numbers_by_size)


def _numbers_by_size(label: str) -> tuple[list[str | int], str]:
    """A key to sort by: texts and whole numbers by turns."""
    parts = re.split(r"([0-9]+)", label)
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], label


def occurring(labels: pd.Series) -> list[str]:
    """The categories of a column of labels that occur in it, in their order."""
    return ordered(labels.unique(), list(labels.cat.categories))


@dataclass(frozen=True, eq=False)
class _Keys:
    """KEY of every trial.

    Attributes:
        labels: task, agent and method, a category a trial.
        seeds: int64, [number of trials].
    """

    labels: Mapping[str, pd.Categorical[str]]
    seeds: npt.NDArray[np.int64]

    def put_before(
        self, rows: pd.DataFrame, columns: Sequence[str], of_costs: Sequence[str] = ()
    ) -> pd.DataFrame:
        """The rows sorted by KEY, behind KEY instead of TRIAL.

        ``columns`` exist even if there is no row, ``of_costs`` also where no trial with so many has one.
        """
        if not len(rows):
            rows = pd.DataFrame(columns=[TRIAL, *columns, *of_costs], dtype=float).astype({TRIAL: np.int64})
        rows = rows.assign(**{name: math.nan for name in of_costs if name not in rows})
        codes = [self.labels[name].codes for name in GROUP]
        rank = np.empty(len(self.seeds), dtype=np.int64)
        rank[np.lexsort((self.seeds, *reversed(codes)))] = np.arange(len(rank))
        of = rows[TRIAL].to_numpy(np.int64)
        order = np.argsort(rank[of], kind="stable")
        of = of[order]
        keys = {name: self.labels[name].take(of) for name in GROUP} | {"seed": self.seeds[of]}
        others = rows.drop(columns=TRIAL).iloc[order].reset_index(drop=True)
        return pd.concat([pd.DataFrame(keys), others], axis=1)


def _keys(specs: Sequence[TrialSpec]) -> tuple[_Keys, list[str]]:
    """The trials' labels, and notes on those that had to be told apart.

    Two groups of trials may have the same labels but different settings (say, budgets). They must not be
    averaged: their method's name then carries the group.
    """
    groups: dict[tuple[str, ...], set[str]] = {}
    identities = [spec.group for spec in specs]
    for spec, group in zip(specs, identities, strict=True):
        groups.setdefault(_labels(spec), set()).add(group)
    notes = [
        f"{' '.join(labels)}: {len(found)} {DOUBLES}; they are kept apart as {labels[2]} [...]"
        for labels, found in sorted(groups.items())
        if len(found) > 1
    ]
    methods = [
        f"{spec.method.label} [{group}]" if len(groups[_labels(spec)]) > 1 else spec.method.label
        for spec, group in zip(specs, identities, strict=True)
    ]
    columns: dict[str, tuple[list[str], Sequence[str]]] = {
        "task": ([spec.task.label for spec in specs], ()),
        "agent": ([spec.agent.label for spec in specs], AGENT_ORDER),
        "method": (methods, METHOD_ORDER),
    }
    labels = {
        name: pd.Categorical(values, categories=ordered(values, first), ordered=True)
        for name, (values, first) in columns.items()
    }
    return _Keys(labels, np.array([spec.seed for spec in specs], dtype=np.int64)), notes


def _labels(spec: TrialSpec) -> tuple[str, str, str]:
    return (spec.task.label, spec.agent.label, spec.method.label)


def _optima(specs: Sequence[TrialSpec]) -> tuple[list[float], list[str]]:
    """J*(d_d) of every trial, NaN where unknown, and a note for each task that is not installed here."""
    optima: list[float] = []
    notes: dict[str, str] = {}
    for spec in specs:
        task = spec.task
        try:
            optimum = optimal_return(task.name, task.options, spec.deploy_limits)
        except (UnknownNameError, UntrustedNameError) as error:
            optimum = None
            notes[task.label] = f"{task.label}: {UNKNOWN_OPTIMUM} {error}"
        except USERS_ERRORS as error:
            optimum = None
            notes[task.label] = f"{task.label}: {UNKNOWN_OPTIMUM} {described(error)}"
        optima.append(math.nan if optimum is None else optimum)
    return optima, list(notes.values())


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


def _trials(store: SweepStore) -> tuple[list[TrialSpec], list[TrialStore]]:
    """The trials of the sweep's last launch, or else all that are on disk."""
    specs = store.specs() or [trial.spec for trial in store.trials()]
    return specs, [store.trial(spec) for spec in specs]


def _read(spec: TrialSpec, trial: TrialStore) -> tuple[TrialFacts, dict[str, pd.DataFrame]]:
    """A trial's facts and its rows of the frames ROWS; none of a damaged one."""
    record = trial.record()
    if record.status is not TrialState.DAMAGED:
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
        except DamagedError as error:
            record = replace(record, error=str(error).removeprefix(f"{trial.folder.name}: "))
    damaged = TrialFacts(spec=spec, status=TrialState.DAMAGED, error=record.error)
    return damaged, {name: pd.DataFrame() for name in ROWS}


def _event_rows(trial: TrialStore) -> pd.DataFrame:
    return pd.DataFrame([{name: event.get(name) for name in EVENT_COLUMNS} for event in trial.events()])


def _policy_rows(trial: TrialStore) -> pd.DataFrame:
    policy = trial.policy()
    return policy.rename_axis("state").reset_index() if len(policy) else policy
