"""The verdicts in words: the first sentences and the first table of a report."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pandas as pd

from recrl.analysis.report.table_formats import DASH, number, with_error, with_interval
from recrl.analysis.statistics.verdicts import COST_TOLERANCE, SOLVED_GAP, is_cost

DEPLOYMENT = "deployment phase (learning goes on)"
BASELINE = "none"
SOLVED, FEASIBLE, INFEASIBLE = "solved", "feasible", "infeasible"
WARNINGS = {
    "no_curriculum": (
        "curriculum without effect",
        "Curriculum without effect: the measured d_t is not above d_d, so the limit was d_d from the start.",
    ),
    "hard_landing": (
        "hard landing",
        "Hard landing: more than 10% of the way from d_t to d_d was left when deployment began.",
    ),
}
NO_VERDICT = "No trial is complete yet: no verdict."


def explanation(verdicts: pd.DataFrame) -> list[str]:
    """Return sentences that define the words of the verdict table.

    Args:
        verdicts: of ``verdict_counts.count_verdicts``.
    """
    how = "computed exactly from the recorded policies"
    if not verdicts["exact"].all():
        sampled = int(verdicts.loc[~verdicts["exact"], "episodes"].min())
        how = f"means over {sampled} episodes, or exact where the task is finite"
    several = bool((verdicts["seeds"] > 1).any())
    interval = ", with its 95% interval (Student's t)" if several else ""
    errors = ["A return or cost is a mean over seeds ± its standard error."] if several else []
    return [
        f"The verdict, the return and the cost are those of the final policy, without learning: {how}.",
        *errors,
        f"Solved: feasible, and within {SOLVED_GAP} of the constrained optimum, where that is known.",
        f"Feasible: no mean cost exceeds its limit by more than {COST_TOLERANCE:.0%} or one standard error, "
        "whichever is larger.",
        "The return of an infeasible policy may be above the optimum: it is no success.",
        f"The difference to none is a mean over equal seeds{interval}; infeasible rows have none.",
        f"The {DEPLOYMENT} averages many policies. It never enters a verdict.",
        *(sentence for flag, (_, sentence) in WARNINGS.items() if verdicts[flag].any()),
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
        line["return"] = with_error(row["episode_return"], row["episode_return_se"])
        all_infeasible = row["infeasible"] == row["seeds"]  # more return is then no gain
        line["difference to none"] = DASH if all_infeasible else with_interval(row, "return_difference")
        line["optimum"] = number(row["optimal_return"])
        for name in costs:
            title = "cost" if len(costs) == 1 else f"cost {_label(verdicts, name[5:])}"
            line[title] = with_error(row[name], row[f"{name}_se"], digits=3)
            line[f"limit of {title}" if len(costs) > 1 else "limit"] = number(row[f"deploy_limit_{name[5:]}"])
        line["n"] = str(row["seeds"])
        earned = with_error(row["deployment_return"], row["deployment_return_se"])
        paid = [with_error(row[f"deployment_{it}"], row[f"deployment_{it}_se"], digits=3) for it in costs]
        line[DEPLOYMENT] = f"return {earned}, cost {', '.join(paid)}"
        lines.append(line)
    return pd.DataFrame(lines)


def verdict_kinds(verdicts: pd.DataFrame) -> list[str]:
    """Return the worst verdict of each row: SOLVED, FEASIBLE or INFEASIBLE."""
    return [
        INFEASIBLE if row["infeasible"] else SOLVED if row["solved"] == row["seeds"] else FEASIBLE
        for _, row in verdicts.iterrows()
    ]


def verdict_text(row: pd.Series) -> str:
    """Format one row's verdict: counts of seeds, and the largest violation.

    >>> counts = {"solved": 3, "feasible": 4, "seeds": 5, "worst_excess": 0.4, "worst_share": 0.08}
    >>> verdict_text(pd.Series(counts | {"infeasible": 1}))
    'solved 3 of 5; feasible, not solved 1 of 5; infeasible 1 of 5, by up to 0.40 (8%)'
    >>> verdict_text(pd.Series(counts | {"solved": 0, "feasible": 0, "infeasible": 1, "seeds": 1}))
    'infeasible by 0.40 (8%)'
    """
    seeds = int(row["seeds"])
    share = "" if math.isnan(row["worst_share"]) else f" ({row['worst_share']:.0%})"
    excess = f"{number(row['worst_excess'])}{share}"
    cost = row.get("worst_cost", "")
    cost = f"cost {cost}" if cost.isdigit() else cost
    counts = {
        SOLVED: int(row["solved"]),
        FEASIBLE: int(row["feasible"] - row["solved"]),
        INFEASIBLE: int(row["infeasible"]),
    }
    if counts[INFEASIBLE] == seeds:
        head = f"infeasible: {cost}" if cost else "infeasible"
        return f"{head} by {'' if row['seeds'] == 1 else 'up to '}{excess}"
    if seeds in (counts[SOLVED], counts[FEASIBLE]):
        return SOLVED if counts[SOLVED] else FEASIBLE
    names = {FEASIBLE: "feasible, not solved" if counts[SOLVED] else FEASIBLE}
    texts = [f"{names.get(kind, kind)} {count} of {seeds}" for kind, count in counts.items() if count]
    return "; ".join(texts) + (f", {f'{cost} ' * bool(cost)}by up to {excess}" if counts[INFEASIBLE] else "")


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

    Args:
        verdicts: of ``verdict_counts.count_verdicts``.
    """
    return [_answer(task, verdicts[verdicts["task"] == task]) for task in dict.fromkeys(verdicts["task"])]


def _answer(task: str, rows: pd.DataFrame) -> str:
    optimum = float(rows["optimal_return"].iloc[0])
    if optimum == -math.inf:
        return f"{task}: no policy keeps the limits."
    known = not math.isnan(optimum)
    column, one, many = (
        (SOLVED, "solves it", "solve it") if known else (FEASIBLE, "is feasible", "are feasible")
    )
    total, good = int(rows["seeds"].sum()), int(rows[column].sum())
    if good == total:
        return f"{task}: all {total} final policies {many}."
    head = f"none of {total} final policies {one}" if not good else f"{good} of {total} final policies {many}"
    parts = [head + (_best(rows, column) if good else ""), *_violations(rows)]
    return f"{task}: {'; '.join(parts)}."


def _best(rows: pd.DataFrame, column: str) -> str:
    """Describe the best curricula, and ``none``."""
    counts = rows.groupby("method", sort=False)[[column, "seeds"]].sum()
    shares = counts[column] / counts["seeds"]
    best = [str(method) for method in counts.index[shares == shares.max()]]
    if len(best) == len(counts):
        return ""
    each = " each" if len(best) > 1 else ""
    text = f", most often with {_listed(best)} ({_share(counts, best[0], column)}{each})"
    if BASELINE in counts.index and BASELINE not in best:
        text += f", against {_share(counts, BASELINE, column)} with {BASELINE}"
    return text


def _share(counts: pd.DataFrame, method: str, column: str) -> str:
    return f"{int(counts[column][method])} of {int(counts['seeds'][method])}"


def _violations(rows: pd.DataFrame) -> list[str]:
    broken = rows[rows["infeasible"] > 0]
    if not len(broken):
        return []
    methods = [str(method) for method in dict.fromkeys(rows["method"]) if method in set(broken["method"])]
    who = "every curriculum" if len(methods) == rows["method"].nunique() > 1 else _listed(methods)
    count, excess = int(broken["infeasible"].sum()), number(float(broken["worst_excess"].max()))
    return [f"{count} violate{'' if count > 1 else 's'} a limit, by up to {excess} (with {who})"]


def _listed(names: Sequence[str]) -> str:
    """Join names in a sentence.

    >>> _listed(["a"]), _listed(["a", "b", "c"])
    ('a', 'a, b and c')
    """
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]])) if names else DASH
