"""The labels of a sweep's trials, KEY, and their order in all tables and legends."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from recrl.orchestrator.spec import TrialSpec

KEY = ("task", "agent", "method", "seed")
GROUP = ("task", "agent", "method")
BASELINE = "none"  # the method that others are compared with, where nothing else is said
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
DOUBLES = "but different settings; they are kept apart as"
SHOWN = 3  # largest number of meanings of a label in a note, and of settings of each
LONGEST_VALUE = 40  # characters of a setting in a note

Settings = Mapping[str, Any]


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

    In a grid, a label has one meaning. In merged sweeps it may have several: tasks with another horizon,
    limit or budget, or agents and curricula of a task with other options. Their trials must not be averaged
    or compared. So a digest of the settings is appended to such a label.
    """
    meanings = [_meanings(spec) for spec in specs]
    labels, notes = {}, []
    within = [""] * len(specs)  # trials of different tasks are never averaged or compared
    for name, (nouns, first) in {
        "task": ("tasks", ()),
        "agent": ("agents", AGENT_ORDER),
        "method": ("curricula", METHOD_ORDER),
    }.items():
        of_name = [meaning[name] for meaning in meanings]
        values, found = _unique_labels(of_name, within, nouns)
        variants: dict[str, set[str]] = {}
        for meaning, value in zip(of_name, values, strict=True):
            variants.setdefault(meaning["label"], set()).add(value)
        categories = [value for label in ordered(variants, first) for value in sorted(variants[label])]
        labels[name] = pd.Categorical(values, categories=categories, ordered=True)
        notes += found
        if name == "task":
            within = values
    return Keys(labels, np.array([spec.seed for spec in specs], dtype=np.int64)), notes


def _meanings(spec: TrialSpec) -> dict[str, Settings]:
    """Return the settings behind the labels of a trial's task, agent and curriculum.

    Limits and run settings belong to the task: a grid has them once for each task.
    """
    values = spec.to_json()
    agent, method = values.pop("agent"), values.pop("method")
    return {
        "task": {**values.pop("task"), **{name: it for name, it in values.items() if name != "seed"}},
        "agent": agent,
        "method": method,
    }


def _unique_labels(
    meanings: Sequence[Settings], within: Sequence[str], nouns: str
) -> tuple[list[str], list[str]]:
    """Return a label for every trial, unique to its settings, and a note for each label that was not.

    Args:
        meanings: the settings behind the label of each trial, ``label`` included.
        within: the task of each trial in which its label is to be unique; empty for all trials.
        nouns: for the notes, for example ``tasks``.
    """
    texts = [json.dumps(meaning, sort_keys=True) for meaning in meanings]
    by_label: dict[tuple[str, str], dict[str, Settings]] = {}
    for text, task, meaning in zip(texts, within, meanings, strict=True):
        by_label.setdefault((task, meaning["label"]), {})[text] = meaning
    unique: dict[tuple[str, str], str] = {}
    notes = []
    for (task, label), found in sorted(by_label.items()):
        several = len(found) > 1
        unique |= {(task, text): f"{label} [{_digest(text)}]" if several else label for text in found}
        if several:
            different = _differences(list(found.values()))
            kept = [f"{unique[task, text]} ({it})" for text, it in zip(found, different, strict=True)]
            where = f" on {task}" if task else ""
            notes.append(
                f"{len(found)} {nouns} have the label {label}{where} {DOUBLES} {listed(kept, SHOWN)}"
            )
    return [unique[task, text] for task, text in zip(within, texts, strict=True)], notes


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def _differences(meanings: Sequence[Settings]) -> list[str]:
    """Describe each of several meanings by the settings that are not the same in all: ``horizon 12``."""
    flat: list[dict[tuple[str, str], str]] = [
        {("", name): json.dumps(value) for name, value in it.items() if name != "options"}
        | {("options", name): json.dumps(value) for name, value in it["options"].items()}
        for it in meanings
    ]
    names = dict.fromkeys(name for each in flat for name in each)
    differing = [name for name in names if len({each.get(name) for each in flat}) > 1]
    return [listed([_setting(name[1], each.get(name)) for name in differing], SHOWN) for each in flat]


def _setting(name: str, value: str | None) -> str:
    if value is None:
        return f"no {name}"
    return f"{name} {value if len(value) <= LONGEST_VALUE else value[:LONGEST_VALUE] + '...'}"


def listed(texts: Sequence[str], most: int) -> str:
    """Return the first texts with commas, and the number of the others.

    >>> listed(["a", "b", "c", "d"], 2)
    'a, b and 2 more'
    """
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return f"{', '.join(texts[:most])}{more}"


def joined(texts: Iterable[str]) -> str:
    """Join all texts in a sentence.

    >>> joined(["a"]), joined(["a", "b", "c"])
    ('a', 'a, b and c')
    """
    *first, last = texts
    return f"{', '.join(first)} and {last}" if first else last
