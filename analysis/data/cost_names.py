"""Names of a task's costs for titles and verdicts, from the provenance of its trials.

A task with one cost needs none. Where the names are unknown, as for trials of earlier versions, costs have
the numbers of the CSV files' columns: cost 0, cost 1.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import zip_longest

from recrl.analysis.data.sweep_data import Sweep, TrialFacts
from recrl.environments.plugins import nearest
from recrl.orchestrator.redaction import printable

LONGEST_NAME = 60
INDEX = re.compile("[0-9]{1,6}")


def cost_names(sweep: Sweep) -> Mapping[str, tuple[str, ...]]:
    """Return the names of the k costs of each task with k > 1, by the task's label; numbers if unknown."""
    names: dict[str, tuple[str, ...]] = {}
    for label, trial in zip(sweep.task_labels, sweep.facts, strict=True):
        num_costs = len(trial.spec.deploy_limits)
        if num_costs > 1 and not _is_named(names.get(label, ())):
            numbers = tuple(str(i) for i in range(num_costs))
            names[label] = _recorded(trial, num_costs) or names.get(label, numbers)
    return names


def cost_suffix(sweep: Sweep, i: int, task: str | None = None) -> str:
    """Return what follows the word cost in a title: `` fuel``, or nothing where there is one cost.

    Args:
        sweep: its trials have the names.
        i: index of the cost.
        task: label of the task that is shown; None for all tasks, which may name cost i differently: then
            the number is used.
    """
    number_of = {label: number for label, number in _numbers_of_costs(sweep).items() if task in (None, label)}
    if max(number_of.values(), default=1) == 1:
        return ""
    names = cost_names(sweep)
    labels = {label for label, number in number_of.items() if number > i}
    found = {names[label][i] if label in names else str(i) for label in labels}
    return f" {found.pop()}" if len(found) == 1 else f" {i}"


def indices_of_cost(sweep: Sweep, wanted: str) -> Mapping[str, int]:
    """Return the index of a cost in each task that has it, by the task's label.

    Args:
        sweep: its trials have the names.
        wanted: the cost's index, counted from 0, or its name; two tasks may have the name at different
            indices.

    Returns:
        Empty if the sweep has no trials.

    Raises:
        ValueError: no task of the sweep has the cost.
    """
    names = {label: ("",) * number for label, number in _numbers_of_costs(sweep).items()}
    names |= cost_names(sweep)
    if INDEX.fullmatch(wanted):
        found = {task: int(wanted) for task, each in names.items() if int(wanted) < len(each)}
    else:
        found = {task: each.index(wanted) for task, each in names.items() if wanted and wanted in each}
    if names and not found:
        costs = [dict.fromkeys(filter(_is_name, each)) for each in zip_longest(*names.values(), fillvalue="")]
        texts = [f"{i} ({' or '.join(called)})" if called else str(i) for i, called in enumerate(costs)]
        has = "only the cost" if len(costs) == 1 else "the costs"
        hint = nearest(wanted, [name for called in costs for name in called])
        raise ValueError(f"{sweep.name} has {has} {', '.join(texts)}, got {wanted!r}{hint}")
    return found


def _numbers_of_costs(sweep: Sweep) -> dict[str, int]:
    """Return k of each task, by the task's label."""
    return {
        label: len(it.spec.deploy_limits) for label, it in zip(sweep.task_labels, sweep.facts, strict=True)
    }


def _is_name(text: str) -> bool:
    return bool(text) and not INDEX.fullmatch(text)


def _is_named(names: tuple[str, ...]) -> bool:
    return bool(names) and names != tuple(str(i) for i in range(len(names)))


def _recorded(trial: TrialFacts, num_costs: int) -> tuple[str, ...]:
    """Return the names that the last attempt recorded; empty if there are none of the right form."""
    attempts = trial.attempts
    names = attempts[-1].get("cost_names") if attempts else None
    if not isinstance(names, list) or len(names) != num_costs:
        return ()
    texts = tuple(name for name in names if isinstance(name, str) and 0 < len(name) <= LONGEST_NAME)
    return texts if len(texts) == num_costs and all(printable(it) == it for it in texts) else ()
