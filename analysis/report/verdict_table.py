"""The table of verdicts: one row per task, agent and curriculum, as text."""

from __future__ import annotations

import pandas as pd

from recrl.analysis.report.table_formats import names_of, with_interval
from recrl.analysis.statistics.verdicts import costs_of, is_cost
from recrl.orchestrator.files.outcomes_file import FEASIBLE, INFEASIBLE, SOLVED
from recrl.orchestrator.number_texts import DASH, cost_with_error, number, with_error

DEPLOYMENT = "deployment phase (learning goes on)"
DIFFERENCE = "difference to none"
FAILED, PENDING, UNEVALUATED = "failed", "no result yet", "not evaluated"
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


def verdict_table(verdicts: pd.DataFrame) -> pd.DataFrame:
    """Return one row per task, agent and curriculum, as text; without a known optimum it has no such column.

    Args:
        verdicts: of ``verdict_counts.count_verdicts``.
    """
    costs = [str(name) for name in verdicts if is_cost(str(name))]
    warned = bool(verdicts[list(WARNINGS)].to_numpy().any())
    any_known = bool(verdicts["optimal_return"].notna().any())
    lines = []
    for _, row in verdicts.iterrows():
        line = names_of(row) | {"verdict": verdict_text(row)}
        if warned:
            line["warning"] = warning_text(row)
        for name in costs:
            which = "" if len(costs) == 1 else f" {_label(verdicts, name[5:])}"
            line[f"cost{which}"] = cost_with_error(row[name], row[f"{name}_se"], exact=row["exact"])
            line[f"limit{which}"] = number(row[f"deploy_limit_{name[5:]}"])
        line["return"] = with_error(row["episode_return"], row["episode_return_se"])
        if any_known:
            line["optimum"] = number(row["optimal_return"])
        line[DIFFERENCE] = _gain_text(row)
        line["n"] = str(row["seeds"])
        earned = with_error(row["deployment_return"], row["deployment_return_se"])
        paid = [
            cost_with_error(row[f"deployment_{it}"], row[f"deployment_{it}_se"], exact=False) for it in costs
        ]
        line[DEPLOYMENT] = f"return {earned}, cost {', '.join(paid)}"
        lines.append(line)
    return pd.DataFrame(lines)


def _gain_text(row: pd.Series) -> str:
    """Format the difference to none, with its n if that is not the row's; a dash where it is no gain."""
    if pd.isna(row["pairs"]) or row["feasible_pairs"] < row["pairs"]:
        return DASH
    fewer = f" (n = {row['pairs']})" if row["pairs"] < row["seeds"] else ""
    return with_interval(row, "return_difference") + fewer


def verdict_kinds(verdicts: pd.DataFrame) -> list[str]:
    """Return the kind of each row.

    It is INFEASIBLE or FAILED if any trial is. Without a final policy it is PENDING, or UNEVALUATED if all
    trials are complete. It is SOLVED if all trials are, else FEASIBLE.

    Args:
        verdicts: of ``verdict_counts.count_verdicts``.
    """
    return [_kind(row) for _, row in verdicts.iterrows()]


def _kind(row: pd.Series) -> str:
    if row["infeasible"]:
        return INFEASIBLE
    if row["failed"]:
        return FAILED
    if not row["seeds"]:
        return PENDING if row["pending"] else UNEVALUATED
    return SOLVED if row["solved"] == row["planned"] else FEASIBLE


def verdict_text(row: pd.Series) -> str:
    """Format one row's verdict: counts of its planned trials, and the largest excess of each cost.

    >>> counts = {"solved": 3, "feasible": 4, "seeds": 5, "deploy_limit_0": 5.0}
    >>> counts |= {"infeasible": 1, "planned": 5, "failed": 0, "pending": 0}
    >>> counts |= {"exceeded_0": 1, "excess_0_low": 0.4, "excess_0_high": 0.4}
    >>> verdict_text(pd.Series(counts))
    'solved 3 of 5; feasible, not solved 1 of 5; infeasible 1 of 5, by up to 0.40 (8%)'
    >>> verdict_text(pd.Series(counts | {"solved": 0, "feasible": 0, "seeds": 1, "planned": 1}))
    'infeasible by 0.40 (8%)'
    >>> verdict_text(pd.Series(counts | {"infeasible": 0, "planned": 9, "failed": 3, "pending": 1}))
    'solved 3 of 9; feasible, not solved 1 of 9; failed 3 of 9; no result yet 1 of 9'
    >>> close = {"solved": 0, "feasible": 0, "seeds": 1, "planned": 1}
    >>> verdict_text(pd.Series(counts | close | {"deploy_limit_0": 0.033, "excess_0_high": 0.0004}))
    'infeasible by 0.0004 (1.2%)'
    >>> second = {"deploy_limit_1": 1.0, "exceeded_1": 1, "excess_1_high": 1.2}
    >>> names = {"cost_name_0": "energy", "cost_name_1": "hazard"}
    >>> running = {"solved": 0, "feasible": 0, "seeds": 1, "pending": 4}
    >>> verdict_text(pd.Series(counts | second | names | running))
    'infeasible 1 of 5: energy by up to 0.40 (8%), hazard by up to 1.20 (120%); no result yet 4 of 5'
    """
    planned = int(row["planned"])
    excess = _excess_text(row)
    several = bool(cost_title(row, "0"))
    counts = {
        SOLVED: int(row["solved"]),
        FEASIBLE: int(row["feasible"] - row["solved"]),
        INFEASIBLE: int(row["infeasible"]),
        FAILED: int(row["failed"]),
        PENDING: int(row["pending"]),
        UNEVALUATED: unevaluated(row),
    }
    if counts[INFEASIBLE] == planned:
        return f"{INFEASIBLE}{':' * several} {excess}"
    if planned in counts.values():
        return next(kind for kind, count in counts.items() if count)
    names = {FEASIBLE: "feasible, not solved" if counts[SOLVED] else FEASIBLE}
    ends = {INFEASIBLE: f"{':' if several else ','} {excess}"}
    return "; ".join(
        f"{names.get(kind, kind)} {count} of {planned}{ends.get(kind, '')}"
        for kind, count in counts.items()
        if count
    )


def _excess_text(row: pd.Series) -> str:
    """Format the largest excess of each exceeded cost, as in ``energy by 3.16 (53%), hazard by 1.20 (120%)``.

    The excess of a missing cost is not known.
    """
    by = "by" if row["planned"] == 1 else "by up to"
    parts = []
    for i in costs_of(row):
        if row[f"exceeded_{i}"]:
            excess, limit = float(row[f"excess_{i}_high"]), float(row[f"deploy_limit_{i}"])
            share = f" ({_percent(excess / limit)})" if limit > 0.0 else ""
            parts.append(f"{cost_title(row, i)} {by} {number(excess)}{share}".lstrip())
    return ", ".join(parts) or "by an unknown amount"


def cost_title(row: pd.Series, i: str) -> str:
    """Return the name of cost i, or ``cost 1`` where only its number is known; empty for a task's only cost.

    Args:
        row: of ``verdict_counts.count_verdicts``.
        i: index of the cost.
    """
    name = str(row.get(f"cost_name_{i}", ""))
    return f"cost {name}" if name.isdigit() else name


def _percent(share: float) -> str:
    """Format a share; below 10% with a decimal, as it is compared with a tolerance of 1%."""
    return f"{share:.0%}" if share >= 0.095 or round(100.0 * share, 1).is_integer() else f"{share:.1%}"


def unevaluated(counts: pd.Series) -> int:
    """Return how many trials are complete without an evaluation of their final policy.

    Args:
        counts: planned, seeds, failed and pending, as in ``verdict_counts.count_verdicts``.
    """
    return int(counts["planned"] - counts["seeds"] - counts["failed"] - counts["pending"])


def _label(verdicts: pd.DataFrame, i: str) -> str:
    """Return the name of cost i if all rows with this cost agree, else its number, as in CSV files."""
    found = set(verdicts.loc[verdicts[f"deploy_limit_{i}"].notna(), f"cost_name_{i}"])
    return str(found.pop()) if len(found) == 1 and "" not in found else i


def warning_text(row: pd.Series) -> str:
    """One row's warnings about its curriculum, with counts where not all seeds have them.

    >>> warning_text(pd.Series({"seeds": 5, "no_curriculum": 1, "hard_landing": 5}))
    'curriculum without effect 1 of 5; hard landing'
    """
    seeds = row["seeds"]
    parts = [(name, row[flag]) for flag, (name, _) in WARNINGS.items() if row[flag]]
    return "; ".join(name if count == seeds else f"{name} {count} of {seeds}" for name, count in parts)
