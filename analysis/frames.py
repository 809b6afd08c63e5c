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

Episode files can hold 500,000 rows a trial. ``load`` reads them one at a time and keeps their sums
(``phases``); ``load_episodes`` gives the rows themselves to whoever wants them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from recrl.environments.cmdp import Phase
from recrl.environments.plugins import UnknownNameError
from recrl.environments.registry import optimal_return
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.store import (
    EPISODE_COLUMNS,
    EVALUATION_COLUMNS,
    UPDATE_COLUMNS,
    SweepStore,
    TrialStore,
)

KEY = ("task", "agent", "method", "seed")
GROUP = ("task", "agent", "method")
AGENT_ORDER = ("ppo-lag", "cpo")
METHOD_ORDER = ("none", "linear", "cosine", "exponential", "dynamic", "step", "unconstrained")
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
        task_options: the options of every task, by its label.
        agent_options: the options of every student, by its label.
        notes: sentences on what a reader of the frames must know, for example an unknown optimum.
    """

    name: str
    trials: pd.DataFrame
    phases: pd.DataFrame
    updates: pd.DataFrame
    evaluations: pd.DataFrame
    events: pd.DataFrame
    policies: pd.DataFrame
    task_options: Mapping[str, Mapping[str, Any]]
    agent_options: Mapping[str, Mapping[str, Any]]
    notes: tuple[str, ...] = ()

    @property
    def num_costs(self) -> int:
        """The largest k of the sweep's tasks; 0 for an empty sweep."""
        return int(self.trials["num_costs"].max()) if len(self.trials) else 0


@dataclass(frozen=True)
class _Member:
    """A trial with the labels it has in this sweep's frames."""

    store: TrialStore
    spec: TrialSpec
    method: str

    @property
    def key(self) -> tuple[str, str, str, int]:
        return (self.spec.task.label, self.spec.agent.label, self.method, self.spec.seed)


def load(store: SweepStore) -> Sweep:
    """Read a finished or running sweep: the trials of its last launch, or else all that are on disk.

    Args:
        store: the sweep's folder.
    """
    members, notes = _members(store)
    optima, unknown = _optima(members)
    costs = range(max((len(member.spec.deploy_limits) for member in members), default=0))
    cost_columns = [f"cost_{i}" for i in costs]
    limit_columns = [f"limit_{i}" for i in costs]
    phase_columns = [f"{name}_{i}{end}" for i in costs for name, end in PHASE_COST_COLUMNS]

    def frame(columns: Sequence[str], rows: Callable[[_Member], pd.DataFrame]) -> pd.DataFrame:
        return _keyed(members, [rows(member) for member in members], columns)

    return Sweep(
        name=store.name,
        trials=frame(TRIAL_COLUMNS, lambda member: _trial_row(member, optima[member.spec.trial_id])),
        phases=frame((*PHASE_COLUMNS, *phase_columns), _phase_rows),
        updates=frame((*UPDATE_COLUMNS, *cost_columns, *limit_columns), lambda it: it.store.updates()),
        evaluations=frame((*EVALUATION_COLUMNS, *cost_columns), lambda it: it.store.evaluation()),
        events=frame(EVENT_COLUMNS, lambda member: _event_rows(member.store)),
        policies=frame(("state",), lambda member: _policy_rows(member.store)),
        task_options={member.spec.task.label: member.spec.task.options for member in members},
        agent_options={member.spec.agent.label: member.spec.agent.options for member in members},
        notes=tuple(notes + unknown),
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
    members, _ = _members(store)

    def rows(member: _Member) -> pd.DataFrame:
        episodes = member.store.episodes()
        if phase is not None and len(episodes):
            episodes = episodes[episodes["phase"] == phase.value]
        return episodes if columns is None else episodes.reindex(columns=list(columns))

    return _keyed(members, [rows(member) for member in members], columns or EPISODE_COLUMNS)


def ordered(labels: Collection[str], first: Sequence[str]) -> list[str]:
    """Labels without duplicates: those of ``first`` in its order, then the others by name.

    >>> ordered(["dynamic", "mine", "none", "dynamic"], METHOD_ORDER)
    ['none', 'dynamic', 'mine']
    """
    present = set(labels)
    return [label for label in first if label in present] + sorted(present - set(first))


def _members(store: SweepStore) -> tuple[list[_Member], list[str]]:
    """The trials of a sweep, with labels that tell different groups apart.

    Two groups of trials may have the same labels but different settings (say, budgets). They must not be
    averaged: their method's name then carries the group.
    """
    specs = store.specs() or [trial.spec for trial in store.trials()]
    groups: dict[tuple[str, ...], set[str]] = {}
    for spec in specs:
        groups.setdefault(_labels(spec), set()).add(spec.group)
    notes = [
        f"{' '.join(labels)}: {len(found)} groups of trials have these labels but different settings; "
        f"they are kept apart as {labels[2]} [...]"
        for labels, found in sorted(groups.items())
        if len(found) > 1
    ]

    def method(spec: TrialSpec) -> str:
        several = len(groups[_labels(spec)]) > 1
        return f"{spec.method.label} [{spec.group}]" if several else spec.method.label

    return [_Member(store.trial(spec), spec, method(spec)) for spec in specs], notes


def _labels(spec: TrialSpec) -> tuple[str, str, str]:
    return (spec.task.label, spec.agent.label, spec.method.label)


def _optima(members: Sequence[_Member]) -> tuple[dict[str, float], list[str]]:
    """J*(d_d) by trial_id, NaN where unknown, and a note for each task that is not installed here."""
    optima: dict[str, float] = {}
    notes: dict[str, str] = {}
    for member in members:
        task = member.spec.task
        try:
            optimum = optimal_return(task.name, task.options, member.spec.deploy_limits)
        except UnknownNameError as error:
            optimum = None
            notes[task.label] = f"{task.label}: the optimum is unknown here, because {error}"
        optima[member.spec.trial_id] = math.nan if optimum is None else optimum
    return optima, list(notes.values())


def _trial_row(member: _Member, optimum: float) -> pd.DataFrame:
    spec, record = member.spec, member.store.record()
    size = spec.steps_per_update
    row: dict[str, Any] = {
        "trial_id": spec.trial_id,
        "group": spec.group,
        "status": record.status.value,
        "error": record.error,
        "task_name": spec.task.name,
        "agent_name": spec.agent.name,
        "method_name": spec.method.name,
        "num_costs": len(spec.deploy_limits),
        "train_steps": spec.train_steps,
        "boundary_step": -(-spec.train_steps // size) * size,
        "total_steps": spec.num_updates * size,
        "steps_per_update": size,
        "env_steps": record.env_steps,
        "cpu_seconds": record.cpu_seconds,
        "optimal_return": optimum,
    }
    start: Sequence[float | str] = record.start_limits or [math.nan] * len(spec.deploy_limits)
    for i, (train, deploy, measured) in enumerate(
        zip(spec.train_limits, spec.deploy_limits, start, strict=True)
    ):
        row |= {f"train_limit_{i}": train, f"deploy_limit_{i}": deploy, f"start_limit_{i}": float(measured)}
    return pd.DataFrame([row])


def _phase_rows(member: _Member) -> pd.DataFrame:
    """The sums over the trial's episodes, a row a phase that has any."""
    episodes = member.store.episodes()
    rows = []
    for phase in Phase if len(episodes) else ():
        chosen = episodes[episodes["phase"] == phase.value]
        if not len(chosen):
            continue
        row: dict[str, Any] = {
            "phase": phase.value,
            "episodes": len(chosen),
            "steps": int(chosen["length"].sum()),
            "episode_return": chosen["episode_return"].mean(),
            "episode_return_std": chosen["episode_return"].std(),
        }
        for i, limit in enumerate(member.spec.deploy_limits):
            costs = chosen[f"cost_{i}"].to_numpy()
            row |= {
                f"cost_{i}": costs.mean(),
                f"cost_{i}_std": chosen[f"cost_{i}"].std(),
                f"cost_{i}_total": costs.sum(),
                f"excess_{i}_total": np.maximum(costs - limit, 0.0).sum(),
            }
        rows.append(row)
    return pd.DataFrame(rows)


def _event_rows(store: TrialStore) -> pd.DataFrame:
    return pd.DataFrame([{name: event.get(name) for name in EVENT_COLUMNS} for event in store.events()])


def _policy_rows(store: TrialStore) -> pd.DataFrame:
    policy = store.policy()
    return policy.rename_axis("state").reset_index() if len(policy) else policy


def _keyed(
    members: Sequence[_Member], frames: Sequence[pd.DataFrame], columns: Sequence[str]
) -> pd.DataFrame:
    """The trials' frames below each other, behind KEY; ``columns`` exist even if no trial has a row."""
    filled = [frame for frame in frames if len(frame)]
    rows = (
        pd.concat(filled, ignore_index=True) if filled else pd.DataFrame(columns=list(columns), dtype=float)
    )
    keys = dict(zip(KEY, _repeated_keys(members, [len(frame) for frame in frames]), strict=True))
    rows = pd.concat([pd.DataFrame(keys), rows], axis=1)
    return rows.sort_values(list(KEY), kind="stable", ignore_index=True)


def _repeated_keys(members: Sequence[_Member], lengths: Sequence[int]) -> Iterator[Any]:
    """A column for each of KEY: every trial's value as often as it has rows."""
    orders: Mapping[str, Sequence[str]] = {"task": (), "agent": AGENT_ORDER, "method": METHOD_ORDER}
    for position, name in enumerate(KEY):
        values: list[Any] = [member.key[position] for member in members]
        if name not in orders:
            yield np.repeat(np.array(values, dtype=np.int64), lengths)
            continue
        categories = ordered(values, orders[name])
        codes = [categories.index(value) for value in values]
        yield pd.Categorical.from_codes(
            np.repeat(np.array(codes, dtype=np.int64), lengths), categories=pd.Index(categories), ordered=True
        )
