"""Sentences under the table of verdicts: what its words and the numbers of each task mean."""

from __future__ import annotations

import numpy as np
import pandas as pd

from recrl.analysis.data.cost_names import cost_suffix
from recrl.analysis.data.labels import BASELINE, joined
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.report.table_formats import not_corrected
from recrl.analysis.report.verdict_table import DEPLOYMENT, DIFFERENCE, WARNINGS, verdict_table
from recrl.analysis.statistics.verdicts import COST_TOLERANCE, SOLVED_GAP
from recrl.environments.registry import TASKS
from recrl.orchestrator.number_texts import number
from recrl.teachers.registry import may_measure_start


def all_exact(verdicts: pd.DataFrame) -> bool:
    """Whether there are final policies, and the numbers of all of them were computed, not sampled.

    Args:
        verdicts: of ``verdict_counts.count_verdicts``.
    """
    evaluated = verdicts[verdicts["seeds"] > 0]
    return bool(len(evaluated) and evaluated["exact"].all())


def explanation(verdicts: pd.DataFrame) -> list[str]:
    """Return sentences that define the words of the verdict table.

    Args:
        verdicts: of ``verdict_counts.count_verdicts``.
    """
    failed = (
        "Failed: the trial has no final policy. It counts as neither solved nor feasible; the means are over "
        "the n others."
    )
    pending = "No result yet: the trial waits, runs or is damaged. The verdicts may still change."
    several = bool((verdicts["seeds"] > 1).any())
    interval = (
        ", with its 95% interval (Student's t), if their differences are not all equal" if several else ""
    )
    errors = ["A return or cost is a mean over seeds ± its standard error."] if several else []
    intervals = not_corrected(verdict_table(verdicts)[[DIFFERENCE]])
    any_known = bool(verdicts["optimal_return"].notna().any())
    solved = f"Solved: feasible, and within {SOLVED_GAP} of the constrained optimum, where that is known."
    above = "The return of an infeasible policy may be above the optimum: it is no success."
    return [
        f"The verdict, the return and the cost are those of the final policy, without learning: "
        f"{measured_how(verdicts)}.",
        *errors,
        *([solved] if any_known else []),
        tolerance_sentence(verdicts, exact=all_exact(verdicts)),
        *_only_by_error(verdicts),
        *([above] if any_known else []),
        *([failed] if verdicts["failed"].any() else []),
        *([pending] if verdicts["pending"].any() else []),
        f"The difference to 'none' is a mean over the seeds that both have{interval}. It is left out where "
        "one of these policies is infeasible, with the curriculum or with 'none'.",
        *([intervals] if intervals else []),
        f"The {DEPLOYMENT} averages many policies. It never enters a verdict.",
        *(sentence for flag, (_, sentence) in WARNINGS.items() if verdicts[flag].any()),
    ]


def _only_by_error(verdicts: pd.DataFrame) -> list[str]:
    """Say how many policies are feasible only because of the standard errors of their costs."""
    count, feasible = int(verdicts["feasible_by_error"].sum()), int(verdicts["feasible"].sum())
    if not count:
        return []
    return [
        f"Feasible only because of a standard error: {count} of {feasible}. Their mean cost is more than "
        f"{COST_TOLERANCE:.0%} above a limit; more evaluation episodes would tell."
    ]


def measured_how(verdicts: pd.DataFrame) -> str:
    """Say how the numbers of the final policies were found: computed, or averaged over episodes.

    Args:
        verdicts: of ``verdict_counts.count_verdicts``.
    """
    if all_exact(verdicts):
        return "computed exactly from the recorded policies"
    verdicts = verdicts[verdicts["seeds"] > 0]
    sampled = f"means over {int(verdicts.loc[~verdicts['exact'], 'episodes'].min())} episodes"
    tasks = [str(task) for task in dict.fromkeys(verdicts.loc[verdicts["exact"], "task"])]
    return f"{sampled}, but computed exactly on {joined(tasks)}" if tasks else sampled


def tolerance_sentence(rows: pd.DataFrame, *, exact: bool) -> str:
    """Say how far above its limit the mean cost of a feasible policy may be.

    Args:
        rows: the policies, with deploy_limit_i.
        exact: whether all costs were computed, not sampled.
    """
    sampled = " or, where it is sampled, one standard error, whichever is larger"
    error = "" if exact else sampled
    has_zero = (rows.filter(regex=r"^deploy_limit_[0-9]+$") == 0.0).to_numpy().any()
    zero = f", and a limit of 0 by more than {COST_TOLERANCE:g}" if has_zero else ""
    return f"Feasible: no mean cost exceeds its limit by more than {COST_TOLERANCE:.0%}{error}{zero}."


def task_sentences(sweep: Sweep, verdicts: pd.DataFrame) -> list[str]:
    """Return what the numbers of each task mean: its costs, limits and tolerance, and the limits d_t.

    Args:
        sweep: of the tasks.
        verdicts: of ``verdict_counts.count_verdicts``.
    """
    sentences = []
    for task in dict.fromkeys(verdicts["task"]):
        trials = sweep.trials[sweep.trials["task"] == task]
        exact = all_exact(verdicts[verdicts["task"] == task])
        name = str(trials["task_name"].iloc[0])
        parts = [TASKS[name].summary] if name in TASKS else []
        for i in range(int(trials["num_costs"].max())):
            suffix = cost_suffix(sweep, i, task)
            which = f" of cost{suffix}" if suffix else ""
            limit = float(trials[f"deploy_limit_{i}"].iloc[0])
            parts.append(f"Limit{which}: {limit:g} per episode, {_allowed(limit, exact=exact)}.")
            if relaxed := _training_limits(trials, i):
                parts.append(f"Training limit d_t{which}: {relaxed}.")
        sentences.append(f"{task}: {' '.join(parts)}")
    return [*sentences, *_rounded_steps(sweep)]


def _allowed(limit: float, *, exact: bool) -> str:
    """Say which mean cost counts as feasible.

    >>> _allowed(1.0, exact=True), _allowed(25.0, exact=False)
    ('allowed 1.01 (1%, exact)', 'allowed 25.25, or 25 + SE if that is more')
    >>> _allowed(0.0, exact=True)
    'allowed 0.01 (as the limit is 0)'
    """
    if limit == 0.0:
        return f"allowed {COST_TOLERANCE:g} (as the limit is 0)"
    how = f" ({COST_TOLERANCE:.0%}, exact)" if exact else f", or {limit:g} + SE if that is more"
    return f"allowed {(1.0 + COST_TOLERANCE) * limit:g}{how}"


def _training_limits(trials: pd.DataFrame, i: int) -> str:
    """Say which finite d_t the curricula of a task began with, and whether they measured it; may be empty.

    ``start_limit`` is there for a given d_t, too, so only ``train_limit`` says which one was measured.
    """
    trials = trials[trials["method_name"] != BASELINE]  # without a curriculum the limit is d_d throughout
    given, start = trials[f"train_limit_{i}"], trials[f"start_limit_{i}"]
    measures = trials["method_name"].map(may_measure_start).astype(bool)
    measured = start[measures & np.isinf(given) & np.isfinite(start)]
    given = given[np.isfinite(given)]
    parts = [(measured, "measured at the start of training"), (given, "from the grid")]
    return ", and ".join(f"{_range(values)}, {how}" for values, how in parts if len(values))


def _range(values: pd.Series[float]) -> str:
    low, high = number(float(values.min())), number(float(values.max()))
    return low if low == high else f"{low} to {high}"


def _rounded_steps(sweep: Sweep) -> list[str]:
    """Say that trials took more steps than the grid asks for, because updates are whole."""
    sizes = {(it.spec.total_steps, it.spec.steps_per_update, it.spec.num_updates) for it in sweep.facts}
    return [
        f"A trial has {updates} policy updates of {size:,} steps, {updates * size:,} steps, to cover the "
        f"total_steps of {total:,}."
        for total, size, updates in sorted(sizes)
        if updates * size != total
    ]
