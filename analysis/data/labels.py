"""The labels of a sweep's trials, KEY, and their order in all tables and legends."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from recrl.orchestrator.spec import TrialSpec

KEY = ("task", "agent", "method", "seed")
GROUP = ("task", "agent", "method")
AGENT_ORDER = ("ppo-lag", "cpo")
METHOD_ORDER = (
    "none",
    "linear",
    "cosine",
    "exponential",
    "dynamic",
    "cooling",
    "step",
    "unconstrained",
)
TRIAL = "trial"  # in rows for ``assemble``: the position of their trial
DOUBLES = "groups of trials have these labels but different settings"


def ordered(labels: Collection[str], first: Sequence[str]) -> list[str]:
    """Sort labels without duplicates: first the labels in ``first``, then others by name, numbers by size.

    >>> ordered(["dynamic", "mine", "none", "dynamic"], METHOD_ORDER)
    ['none', 'dynamic', 'mine']
    >>> ordered(["map-10", "map-9"], ())
    ['map-9', 'map-10']
    """
    present = set(labels)
    return [label for label in first if label in present] + sorted(present - set(first), key=_numbers_by_size)


def _numbers_by_size(label: str) -> tuple[list[str | int], str]:
    """Return a sorting key: texts and integers in turn."""
    parts = re.split(r"([0-9]+)", label)
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], label


def occurring(labels: pd.Series) -> list[str]:
    """Return the categories that occur in a column of labels, in their order."""
    return ordered(labels.unique(), list(labels.cat.categories))


@dataclass(frozen=True, eq=False)
class Keys:
    """KEY of every trial.

    Attributes:
        labels: task, agent and method, one category per trial.
        seeds: int64, [number of trials].
    """

    labels: Mapping[str, pd.Categorical[str]]
    seeds: npt.NDArray[np.int64]

    def put_before(
        self, rows: pd.DataFrame, columns: Sequence[str], of_costs: Sequence[str] = ()
    ) -> pd.DataFrame:
        """Return the rows sorted by KEY, with KEY in place of TRIAL.

        ``columns`` and ``of_costs`` exist even without a row.
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


def keys_of(specs: Sequence[TrialSpec]) -> tuple[Keys, list[str]]:
    """Return the trials' labels, and notes on labels that had to be made unique.

    Two groups of trials may have the same labels but different settings (for example budgets). They must not
    be averaged, so the group is appended to the method's label.
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
    return Keys(labels, np.array([spec.seed for spec in specs], dtype=np.int64)), notes


def _labels(spec: TrialSpec) -> tuple[str, str, str]:
    return (spec.task.label, spec.agent.label, spec.method.label)
