"""The result table of a launch: return and cost of the final policies, by task, agent and method."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from recrl.analysis.data.cost_names import cost_names, cost_suffix
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.data.sweep_warnings import curriculum_flags
from recrl.analysis.report.table_formats import names_of
from recrl.analysis.report.verdict_table import verdict_text
from recrl.analysis.report.verdict_terms import all_exact, measured_how, tolerance_sentence
from recrl.analysis.statistics.metrics import outcomes
from recrl.analysis.statistics.verdict_counts import count_verdicts
from recrl.analysis.statistics.verdicts import SOLVED_GAP
from recrl.orchestrator.number_texts import cost_with_error, number, with_error


def result_table(sweep: Sweep) -> tuple[pd.DataFrame, str]:
    """Return the results as text, one row per task, agent and method; empty without evaluations.

    Args:
        sweep: its complete trials are averaged; failed ones and those without a result are counted.

    Returns:
        The table, and its caption.
    """
    if sweep.evaluations.empty and sweep.exact.empty:
        return pd.DataFrame(), ""
    rows = count_verdicts(
        outcomes(sweep), pd.DataFrame(), curriculum_flags(sweep), sweep.trials, cost_names(sweep)
    )
    if not len(rows):  # the evaluated trials are not complete
        return pd.DataFrame(), ""
    suffixes = [cost_suffix(sweep, i) for i in range(sweep.num_costs)]
    return pd.DataFrame([_line(row, suffixes) for _, row in rows.iterrows()]), caption(rows)


def caption(rows: pd.DataFrame) -> str:
    """Return two lines: how the numbers were measured, and what the verdicts allow.

    Args:
        rows: of ``verdict_counts.count_verdicts``.
    """
    several = int(rows["seeds"].max()) > 1
    means = "means over n seeds ± standard error" if several else "one seed (n = 1): no intervals"
    return (
        f"Final policies (stochastic), without learning, {measured_how(rows)}; {means}.\n"
        f"Verdicts: solved (feasible, and within {SOLVED_GAP} of the optimum), feasible, or infeasible by "
        f"how much. {tolerance_sentence(rows, exact=all_exact(rows))}"
    )


def _line(row: pd.Series, suffixes: Sequence[str]) -> dict[str, str]:
    line = names_of(row) | {"n": str(row["seeds"])}
    line["return"] = with_error(row["episode_return"], row["episode_return_se"])
    for i, which in enumerate(suffixes):
        line[f"cost{which}"] = cost_with_error(row[f"cost_{i}"], row[f"cost_{i}_se"], exact=row["exact"])
        line[f"limit{which}"] = number(row[f"deploy_limit_{i}"])
    return line | {"verdict": verdict_text(row)}
