"""The first sentences of a report: how many final policies solve each task, by which curricula."""

from __future__ import annotations

import math

import pandas as pd

from recrl.analysis.data.labels import BASELINE, joined
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.report.verdict_table import cost_title, unevaluated
from recrl.analysis.statistics.verdicts import costs_of
from recrl.orchestrator.files.outcomes_file import FEASIBLE, INFEASIBLE, SOLVED
from recrl.orchestrator.number_texts import DASH, number
from recrl.orchestrator.spec import TrialStatus

ONE_SEED = "One seed (n = 1): no intervals, and another seed may give another verdict."
ONE_RESULT = "No row has more than one final policy: no intervals."
SOME_LIMIT = "a limit"
NO_VERDICT = "No trial is complete yet: no verdict."
NOT_EVALUATED = "No final policy was evaluated: set run.evaluation_episodes."


def no_verdict(sweep: Sweep) -> str:
    """Say why there is no verdict.

    Args:
        sweep: without an evaluated final policy.
    """
    status = sweep.trials["status"]
    if (status == TrialStatus.COMPLETE.value).any():
        return NOT_EVALUATED
    failed = int((status == TrialStatus.FAILED.value).sum())
    if failed == len(status):
        all_trials = f"all {failed} trials" if failed > 1 else "the only trial"
        return f"No verdict: {all_trials} failed."
    return f"{NO_VERDICT} {failed} of {len(status)} failed." if failed else NO_VERDICT


def answers(verdicts: pd.DataFrame) -> list[str]:
    """Return one sentence per task: how many final policies solve it, by which curricula, and which violate.

    The first sentence says so if there is only one seed.

    Args:
        verdicts: of ``verdict_counts.count_verdicts``.
    """
    tasks = dict.fromkeys(verdicts["task"])
    first = []
    if len(verdicts) and verdicts["seeds"].max() == 1:
        first = [ONE_SEED if verdicts["planned"].max() == 1 else ONE_RESULT]
    return [*first, *(_answer(task, verdicts[verdicts["task"] == task]) for task in tasks)]


def _answer(task: str, rows: pd.DataFrame) -> str:
    optimum = float(rows["optimal_return"].iloc[0])
    if optimum == -math.inf:
        return f"{task}: no policy keeps the limits."
    column, one, many = (
        (FEASIBLE, "is feasible", "are feasible")
        if math.isnan(optimum)
        else (SOLVED, "solves it", "solve it")
    )
    counts = rows[["planned", "seeds", "failed", "pending", column]].sum().astype(int)
    planned, good = counts["planned"], counts[column]
    if not counts["seeds"]:
        return f"{task}: no verdict; {'; '.join(_without_policy(counts))}."
    what = "final policies" if counts["seeds"] == planned else "trials"  # a failed trial has no policy
    policies = f"{planned} {what}{_product(rows)}"
    if good == planned:
        return f"{task}: all {policies} {many}."
    head = f"none of {policies} {one}" if not good else f"{good} of {policies} {many}"
    head += " so far" if counts["pending"] else ""
    parts = [head + (_best(rows, column) if good else "")]
    return f"{task}: {'; '.join([*parts, *_without_policy(counts), *_violations(rows, column)])}."


def _without_policy(counts: pd.Series) -> list[str]:
    """Say how many trials of a task have no evaluated final policy, and why.

    >>> numbers = {"planned": 10, "seeds": 5, "failed": 3, "pending": 1}
    >>> _without_policy(pd.Series(numbers))[:2]
    ['3 failed', 'the sweep is incomplete: 1 trial has no result yet']
    >>> _without_policy(pd.Series(numbers | {"seeds": 0, "failed": 10, "pending": 0}))
    ['all 10 trials failed']
    """
    failed, pending, missing = int(counts["failed"]), int(counts["pending"]), unevaluated(counts)
    parts = []
    if failed:
        parts.append(f"all {failed} trials failed" if failed == counts["planned"] else f"{failed} failed")
    if pending:
        have = "trial has" if pending == 1 else "trials have"
        parts.append(f"the sweep is incomplete: {pending} {have} no result yet")
    if missing:
        were = "final policy was" if missing == 1 else "final policies were"
        parts.append(f"{missing} {were} not evaluated: set run.evaluation_episodes")
    return parts


def _product(rows: pd.DataFrame) -> str:
    """Say what the trials of a task are: one per agent, curriculum and seed.

    >>> rows = pd.DataFrame({"agent": ["cpo", "cpo"], "method": ["none", "step"], "planned": [3, 3]})
    >>> _product(rows), _product(rows.assign(planned=[3, 2]))
    (' (1 agent x 2 curricula x 3 seeds)', '')
    """
    agents, methods, seeds = rows["agent"].nunique(), rows["method"].nunique(), int(rows["planned"].max())
    if agents * methods * seeds != rows["planned"].sum():  # not every combination is in the grid
        return ""
    numbers = ((agents, "agent", "agents"), (methods, "curriculum", "curricula"), (seeds, "seed", "seeds"))
    return f" ({' x '.join(f'{count} {one if count == 1 else many}' for count, one, many in numbers)})"


def _best(rows: pd.DataFrame, column: str) -> str:
    """Describe the best curricula, and ``none``, by their shares of the trials that have ended.

    Nothing is said if an agent has more such trials under one curriculum than under another, and there are
    several agents: then a share would depend on which agents it has.
    """
    ended = rows.assign(ended=rows["planned"] - rows["pending"])
    by_agent = ended.pivot_table("ended", "agent", "method", aggfunc="sum", fill_value=0, observed=True)
    by_agent = by_agent.loc[:, by_agent.any()]
    if len(by_agent) > 1 and (by_agent.nunique(axis=1) > 1).any():
        return ""
    counts = _by_method(rows)
    counts = counts[counts["ended"] > 0]
    shares = counts[column] / counts["ended"]
    best = [str(method) for method in counts.index[shares == shares.max()]]
    if len(best) == len(counts):
        return ""
    each = " each" if len(best) > 1 else ""
    if len({_share(counts, method, column) for method in best}) > 1:  # equal shares of unequal numbers
        text = f", most often with {joined([f'{it!r} ({_share(counts, it, column)})' for it in best])}"
    else:
        text = f", most often with {joined(map(repr, best))} ({_share(counts, best[0], column)}{each})"
    if BASELINE in counts.index and BASELINE not in best:
        text += f", against {_share(counts, BASELINE, column)} with {BASELINE!r}"
    return text


def _by_method(rows: pd.DataFrame) -> pd.DataFrame:
    """Sum the counts of a task's rows by curriculum; ``ended`` are the trials that are not pending."""
    names = [SOLVED, FEASIBLE, INFEASIBLE, "seeds", "planned", "failed", "pending"]
    counts = rows.groupby("method", sort=False)[names].sum()
    return counts.assign(ended=counts["planned"] - counts["pending"])


def _share(counts: pd.DataFrame, method: str, column: str) -> str:
    return f"{int(counts[column][method])} of {int(counts['ended'][method])}"


def _violations(rows: pd.DataFrame, column: str) -> list[str]:
    """Name the curricula of which every policy is infeasible, then each one of which only some are."""
    counts = _by_method(rows)
    violating = counts["infeasible"] > 0
    always = [str(method) for method in counts.index[violating & (counts["infeasible"] == counts["seeds"])]]
    sometimes = counts[violating & (counts["infeasible"] < counts["seeds"])]
    parts, limit = [], _limit_text(rows)
    if always:
        chosen = rows[rows["method"].isin(always) & (rows["infeasible"] > 0)]
        who = "every curriculum" if len(always) == len(counts) > 1 else joined(map(repr, always))
        total = int(chosen["seeds"].sum())
        verb = "exceed" if len(always) > 1 and who != "every curriculum" else "exceeds"
        parts.append(f"{who} {verb} {_exceeded(chosen, limit, f' ({total} of {_policies(total)})')}")
        limit = "it" if limit != SOME_LIMIT else limit
    for method, count in sometimes.iterrows():
        chosen = rows[(rows["method"] == method) & (rows["infeasible"] > 0)]
        done = "solves" if column == SOLVED else "is feasible in"
        bad, total = int(count["infeasible"]), int(count["ended"])
        others = "the other exceeds" if total == 2 and count[column] else f"{bad} exceed{'s' * (bad == 1)}"
        parts.append(
            f"{str(method)!r} {done} {int(count[column])} of {total}, {others} {_exceeded(chosen, limit)}"
        )
        limit = "it" if limit != SOME_LIMIT else limit
    return parts


def _limit_text(rows: pd.DataFrame) -> str:
    """Name the limit of a task, or say ``a limit`` if it has several costs."""
    limits = rows.filter(regex="^deploy_limit_").dropna(axis=1, how="all").iloc[0].astype(float).tolist()
    return f"the limit of {limits[0]:g}" if len(limits) == 1 else SOME_LIMIT


def _exceeded(rows: pd.DataFrame, limit: str, count: str = "") -> str:
    """Say which limits infeasible policies exceed, and by how much: a range over the policies.

    Args:
        rows: of infeasible policies.
        limit: name of the only limit, or SOME_LIMIT: then each exceeded cost is named, with the number of
            policies if not all of them exceed its limit.
        count: follows the name of the limit or the range; may be empty.
    """
    if limit != SOME_LIMIT:
        return f"{limit} by {_range(rows, '0')}{count}"
    exceeded = {i: int(rows[f"exceeded_{i}"].sum()) for i in costs_of(rows)}
    exceeded = {i: policies for i, policies in exceeded.items() if policies}
    differ = set(exceeded.values()) != {int(rows["infeasible"].sum())}
    costs = [
        f"{cost_title(rows.iloc[0], i)} by {_range(rows, i)}{f' in {_policies(policies)}' * differ}"
        for i, policies in exceeded.items()
    ]
    return f"{limit}{count}: {joined(costs or [DASH])}"


def _policies(count: int) -> str:
    return f"{count} {'policy' if count == 1 else 'policies'}"


def _range(rows: pd.DataFrame, i: str) -> str:
    """Format the least and the largest excess of cost i; that of a missing cost is not known."""
    if rows[f"excess_{i}_high"].isna().all():
        return "an unknown amount"
    low, high = number(float(rows[f"excess_{i}_low"].min())), number(float(rows[f"excess_{i}_high"].max()))
    return low if low == high else f"{low} to {high}"
