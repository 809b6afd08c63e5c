"""The verdicts in words: the first sentences and the first table of a report."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pandas as pd

from recrl.analysis.data.cost_names import cost_suffix
from recrl.analysis.data.labels import BASELINE
from recrl.analysis.data.number_texts import DASH, number, with_error
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.report.table_formats import not_corrected, with_interval
from recrl.analysis.statistics.verdicts import COST_TOLERANCE, SOLVED_GAP, is_cost
from recrl.environments.registry import TASKS
from recrl.orchestrator.files.outcomes_file import FAILED, FEASIBLE, INFEASIBLE, PENDING, SOLVED
from recrl.orchestrator.spec import TrialStatus
from recrl.teachers.registry import may_measure_start

DEPLOYMENT = "deployment phase (learning goes on)"
DIFFERENCE = "difference to none"
UNEVALUATED = "not evaluated"
WARNINGS = {
    "no_curriculum": (
        "curriculum without effect",
        "Curriculum without effect: the measured d_t is not above d_d, so the limit was d_d after that.",
    ),
    "hard_landing": (
        "hard landing",
        "Hard landing: more than 10% of the way from d_t to d_d, and of d_d, was left when deployment began.",
    ),
}
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
    interval = ", with its 95% interval (Student's t)" if several else ""
    errors = ["A return or cost is a mean over seeds ± its standard error."] if several else []
    intervals = not_corrected(verdict_table(verdicts)[[DIFFERENCE]])
    return [
        f"The verdict, the return and the cost are those of the final policy, without learning: "
        f"{measured_how(verdicts)}.",
        *errors,
        f"Solved: feasible, and within {SOLVED_GAP} of the constrained optimum, where that is known.",
        tolerance_sentence(exact=all_exact(verdicts)),
        "The return of an infeasible policy may be above the optimum: it is no success.",
        *([failed] if verdicts["failed"].any() else []),
        *([pending] if verdicts["pending"].any() else []),
        f"The difference to 'none' is a mean over the seeds that both have{interval}. It is left out where "
        "one of these policies is infeasible, with the curriculum or with 'none'.",
        *([intervals] if intervals else []),
        f"The {DEPLOYMENT} averages many policies. It never enters a verdict.",
        *(sentence for flag, (_, sentence) in WARNINGS.items() if verdicts[flag].any()),
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
    return f"{sampled}, but computed exactly on {_listed(tasks)}" if tasks else sampled


def tolerance_sentence(*, exact: bool) -> str:
    """Say how far above its limit the mean cost of a feasible policy may be.

    Args:
        exact: whether all costs were computed, not sampled.
    """
    sampled = " or, where it is sampled, one standard error, whichever is larger"
    error = "" if exact else sampled
    return f"Feasible: no mean cost exceeds its limit by more than {COST_TOLERANCE:.0%}{error}."


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
    'allowed 0.01 (as the limit is 0, exact)'
    """
    most = limit + COST_TOLERANCE * (limit if limit > 0.0 else 1.0)
    share = f"{COST_TOLERANCE:.0%}" if limit > 0.0 else "as the limit is 0"
    how = f" ({share}, exact)" if exact else f", or {limit:g} + SE if that is more"
    return f"allowed {most:g}{how}"


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


def verdict_table(verdicts: pd.DataFrame) -> pd.DataFrame:
    """Return one row per task, agent and curriculum, as text.

    Args:
        verdicts: of ``verdict_counts.count_verdicts``.
    """
    costs = [str(name) for name in verdicts if is_cost(str(name))]
    warned = bool(verdicts[list(WARNINGS)].to_numpy().any())
    lines = []
    for _, row in verdicts.iterrows():
        line = {"task": str(row["task"]), "agent": str(row["agent"]), "curriculum": str(row["method"])}
        line["verdict"] = verdict_text(row)
        if warned:
            line["warning"] = warning_text(row)
        for name in costs:
            which = "" if len(costs) == 1 else f" {_label(verdicts, name[5:])}"
            line[f"cost{which}"] = with_error(row[name], row[f"{name}_se"], digits=3)
            line[f"limit{which}"] = number(row[f"deploy_limit_{name[5:]}"])
        line["return"] = with_error(row["episode_return"], row["episode_return_se"])
        line["optimum"] = number(row["optimal_return"])
        line[DIFFERENCE] = _difference_text(row)
        line["n"] = str(row["seeds"])
        earned = with_error(row["deployment_return"], row["deployment_return_se"])
        paid = [with_error(row[f"deployment_{it}"], row[f"deployment_{it}_se"], digits=3) for it in costs]
        line[DEPLOYMENT] = f"return {earned}, cost {', '.join(paid)}"
        lines.append(line)
    return pd.DataFrame(lines)


def _difference_text(row: pd.Series) -> str:
    """Format the difference to none, with its n if that is not the row's; a dash where it is no gain."""
    if pd.isna(row["pairs"]) or row["feasible_pairs"] < row["pairs"]:
        return DASH
    fewer = f" (n = {row['pairs']})" if row["pairs"] < row["seeds"] else ""
    return with_interval(row, "return_difference") + fewer


def verdict_kinds(verdicts: pd.DataFrame) -> list[str]:
    """Return the kind of each row: INFEASIBLE or FAILED if any trial is, SOLVED if all are, else FEASIBLE."""
    return [
        INFEASIBLE
        if row["infeasible"]
        else FAILED
        if row["failed"]
        else SOLVED
        if row["solved"] == row["planned"]
        else FEASIBLE
        for _, row in verdicts.iterrows()
    ]


def verdict_text(row: pd.Series) -> str:
    """Format one row's verdict: counts of its planned trials, and the largest violation.

    >>> counts = {"solved": 3, "feasible": 4, "seeds": 5, "worst_excess": 0.4, "worst_share": 0.08}
    >>> counts |= {"infeasible": 1, "planned": 5, "failed": 0, "pending": 0}
    >>> verdict_text(pd.Series(counts))
    'solved 3 of 5; feasible, not solved 1 of 5; infeasible 1 of 5, by up to 0.40 (8%)'
    >>> verdict_text(pd.Series(counts | {"solved": 0, "feasible": 0, "seeds": 1, "planned": 1}))
    'infeasible by 0.40 (8%)'
    >>> verdict_text(pd.Series(counts | {"infeasible": 0, "planned": 9, "failed": 3, "pending": 1}))
    'solved 3 of 9; feasible, not solved 1 of 9; failed 3 of 9; no result yet 1 of 9'
    >>> close = {"solved": 0, "feasible": 0, "seeds": 1, "planned": 1}
    >>> verdict_text(pd.Series(counts | close | {"worst_excess": 0.0004, "worst_share": 0.012}))
    'infeasible by 0.0004 (1.2%)'
    """
    planned = int(row["planned"])
    share = "" if math.isnan(row["worst_share"]) else f" ({_percent(row['worst_share'])})"
    excess = f"{_small(row['worst_excess'])}{share}"
    cost = _cost(row.get("worst_cost", ""))
    counts = {
        SOLVED: int(row["solved"]),
        FEASIBLE: int(row["feasible"] - row["solved"]),
        INFEASIBLE: int(row["infeasible"]),
        FAILED: int(row["failed"]),
        PENDING: int(row["pending"]),
        UNEVALUATED: _unevaluated(row),
    }
    if counts[INFEASIBLE] == planned:
        head = f"infeasible: {cost}" if cost else "infeasible"
        return f"{head} by {'' if planned == 1 else 'up to '}{excess}"
    if planned in counts.values():
        return next(kind for kind, count in counts.items() if count)
    names = {FEASIBLE: "feasible, not solved" if counts[SOLVED] else FEASIBLE}
    ends = {INFEASIBLE: f", {f'{cost} ' * bool(cost)}by up to {excess}"}
    return "; ".join(
        f"{names.get(kind, kind)} {count} of {planned}{ends.get(kind, '')}"
        for kind, count in counts.items()
        if count
    )


def _percent(share: float) -> str:
    """Format a share; below 10% with a decimal, as it is compared with a tolerance of 1%."""
    return f"{share:.0%}" if share >= 0.095 or round(100.0 * share, 1).is_integer() else f"{share:.1%}"


def _small(value: float) -> str:
    """Format a value; below 0.01 with two digits that are not 0."""
    return f"{value:.2g}" if 0.0 < abs(value) < 0.01 else number(value)


def _unevaluated(row: pd.Series) -> int:
    """Return how many trials are complete without an evaluation of their final policy."""
    return int(row["planned"] - row["seeds"] - row["failed"] - row["pending"])


def _label(verdicts: pd.DataFrame, i: str) -> str:
    """Return the name of cost i if all rows with a name agree, else its number, as in CSV files."""
    column = f"cost_name_{i}"
    found = set(verdicts[column]) - {""} if column in verdicts else set()
    return str(found.pop()) if len(found) == 1 else i


def warning_text(row: pd.Series) -> str:
    """One row's warnings about its curriculum, with counts where not all seeds have them.

    >>> warning_text(pd.Series({"seeds": 5, "no_curriculum": 1, "hard_landing": 5}))
    'curriculum without effect 1 of 5; hard landing'
    """
    seeds = row["seeds"]
    parts = [(name, row[flag]) for flag, (name, _) in WARNINGS.items() if row[flag]]
    return "; ".join(name if count == seeds else f"{name} {count} of {seeds}" for name, count in parts)


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
    failed, pending, unevaluated = int(counts["failed"]), int(counts["pending"]), _unevaluated(counts)
    parts = []
    if failed:
        parts.append(f"all {failed} trials failed" if failed == counts["planned"] else f"{failed} failed")
    if pending:
        have = "trial has" if pending == 1 else "trials have"
        parts.append(f"the sweep is incomplete: {pending} {have} no result yet")
    if unevaluated:
        were = "final policy was" if unevaluated == 1 else "final policies were"
        parts.append(f"{unevaluated} {were} not evaluated: set run.evaluation_episodes")
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
    """Describe the best curricula, and ``none``, by their shares of the trials that have ended."""
    counts = _by_method(rows)
    counts = counts[counts["ended"] > 0]
    shares = counts[column] / counts["ended"]
    best = [str(method) for method in counts.index[shares == shares.max()]]
    if len(best) == len(counts):
        return ""
    each = " each" if len(best) > 1 else ""
    if len({_share(counts, method, column) for method in best}) > 1:  # equal shares of unequal numbers
        text = f", most often with {_listed([f'{it!r} ({_share(counts, it, column)})' for it in best])}"
    else:
        text = f", most often with {_listed(map(repr, best))} ({_share(counts, best[0], column)}{each})"
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
        who = "every curriculum" if len(always) == len(counts) > 1 else _listed(map(repr, always))
        total = int(chosen["seeds"].sum())
        verb = "exceed" if len(always) > 1 and who != "every curriculum" else "exceeds"
        what = "policy" if total == 1 else "policies"
        parts.append(f"{who} {verb} {_exceeded(chosen, limit)} ({total} of {total} {what})")
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


def _exceeded(rows: pd.DataFrame, limit: str) -> str:
    """Say which limit infeasible policies exceed, and by how much; with several costs, name each."""
    if limit != SOME_LIMIT:
        return f"{limit} by {_excess(rows)}"
    costs = [f"{_cost(str(cost))} by {_excess(of_cost)}" for cost, of_cost in rows.groupby("worst_cost")]
    return f"{limit}: {_listed(costs)}"


def _cost(name: str) -> str:
    """Return a cost's name, or ``cost 1`` where only its number is known."""
    return f"cost {name}" if name.isdigit() else name


def _excess(rows: pd.DataFrame) -> str:
    """Format by how much infeasible policies exceed their limit: a range, if each row is one policy."""
    low, high = (_small(float(value)) for value in (rows["worst_excess"].min(), rows["worst_excess"].max()))
    if (rows["infeasible"] > 1).any():
        return f"up to {high}"
    return high if low == high else f"{low} to {high}"


def _listed(parts: Iterable[str]) -> str:
    """Join names in a sentence.

    >>> _listed(["a"]), _listed(["a", "b", "c"])
    ('a', 'a, b and c')
    """
    names = list(parts)
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]])) if names else DASH
