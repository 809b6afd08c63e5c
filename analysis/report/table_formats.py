"""Tables of the trials' outcomes: CSV with every digit for programs, Markdown and LaTeX for people.

In the tables for people a value is "mean ± standard error" over seeds, or one seed's value. A share of seeds
is "3 of 5", from five seeds on with Wilson's 95% interval in percent.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from recrl.analysis.data.labels import GROUP
from recrl.analysis.statistics.intervals import share_text
from recrl.analysis.statistics.metrics import Measure
from recrl.orchestrator.files.atomic_files import write_atomically
from recrl.orchestrator.number_texts import DASH, cost_with_error, number, with_error
from recrl.orchestrator.redaction import printable

TOO_FEW = "†"
CORRECTED = "p of return, corrected"
INTERVAL = re.compile(r"[\[(][^\[\]()]*\d(?:, | to |–)[^\[\]()]*\d%?[\])]")
LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "&": r"\&",
    "%": r"\%",
    "_": r"\_",
    "#": r"\#",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "±": r"$\pm$",
    "≤": r"$\leq$",
    TOO_FEW: r"$\dagger$",
}


def outcome_table(summary: pd.DataFrame, measure: Measure, suffixes: Sequence[str]) -> pd.DataFrame:
    """Format return, costs, regret and fractions of feasible and solved seeds.

    The regret, J*(d_d) minus the return, is left out if a seed is infeasible, because its return may be above
    J*(d_d). Failed trials are in the fractions, as neither feasible nor solved; n counts the others. Where no
    optimum is known, the table has no optimum, regret and fraction of solved seeds.

    Args:
        summary: of ``metrics.summary``.
        measure: which of the three outcomes.
        suffixes: of ``cost_suffix`` for each cost.
    """
    rows = summary[summary["measure"] == measure.value]
    costs = [name for name in map(str, rows) if f"{name}_se" in rows and name.startswith("cost_")]
    any_failed = bool((rows["failed"] > 0).any())
    any_known = bool(rows["optimal_return"].notna().any())
    lines = []
    for _, row in rows.iterrows():
        line = names_of(row) | {"n": str(row["seeds"])}
        if any_failed:
            line["failed"] = str(row["failed"])
        for name in costs:
            which = _suffix_of(name, suffixes)
            line[f"cost{which}"] = cost_with_error(row[name], row[f"{name}_se"], exact=row["exact"])
            line[f"limit{which}"] = number(row[f"deploy_limit_{name[5:]}"])
        line["return"] = with_error(row["episode_return"], row["episode_return_se"])
        seeds, feasible = int(row["seeds"]), int(row["feasible_seeds"])
        ended = seeds + int(row["failed"])
        if any_known:
            line["optimum"] = number(row["optimal_return"])
            line["regret"] = with_error(row["gap"], row["gap_se"]) if feasible == seeds else DASH
        line["feasible"] = share_text(feasible, ended, row["feasible_low"], row["feasible_high"])
        if any_known:
            found = share_text(int(row["optimal_seeds"]), ended, row["optimal_low"], row["optimal_high"])
            line["solved"] = DASH if math.isnan(row["optimal_return"]) else found
        lines.append(line)
    return pd.DataFrame(lines)


def row_kinds(rows: pd.DataFrame) -> list[str]:
    """Return ``infeasible`` for each row with an infeasible seed, else an empty text.

    Args:
        rows: seeds and feasible_seeds, as in ``metrics.summary``.
    """
    return ["infeasible" if infeasible else "" for infeasible in rows["feasible_seeds"] < rows["seeds"]]


def names_of(row: pd.Series) -> dict[str, str]:
    """Return the labels of a row's task, agent and curriculum."""
    return {"task": str(row["task"]), "agent": str(row["agent"]), "curriculum": str(row["method"])}


def compared_rows(comparisons: pd.DataFrame, summary: pd.DataFrame, measure: Measure) -> pd.DataFrame:
    """Return the comparisons of one measure, with ``seeds``, ``feasible_seeds`` and ``failed``.

    The first two are of the curriculum, failed trials of both sides.

    Args:
        comparisons: of ``comparisons.comparisons``.
        summary: of ``metrics.summary``.
        measure: which of the three outcomes.
    """
    rows = comparisons[comparisons["measure"] == measure.value]
    counts = summary[[*GROUP, "measure", "seeds", "feasible_seeds", "failed"]]
    beside = counts.drop(columns=["seeds", "feasible_seeds"])
    beside = beside.rename(columns={"method": "baseline", "failed": "baseline_failed"})
    merged = rows.merge(counts, on=[*GROUP, "measure"], how="left", sort=False)
    merged = merged.merge(beside, on=["task", "agent", "baseline", "measure"], how="left", sort=False)
    return merged.assign(failed=merged["failed"] + merged["baseline_failed"])


def comparison_table(rows: pd.DataFrame, suffixes: Sequence[str]) -> pd.DataFrame:
    """Format paired differences to the agent without a curriculum.

    More return is no gain if a policy of a pair is infeasible, with the curriculum or with none. Such a row
    has no gain, only its added cost and the number of feasible pairs.

    Without a p value of such a gain the table has no column of them.

    Args:
        rows: of ``compared_rows``.
        suffixes: as for ``outcome_table``.
    """
    costs = [name for name in map(str, rows) if name.startswith("cost_") and name.endswith("_difference")]
    feasible = rows["feasible_pairs"] == rows["pairs"]
    any_tested = bool((feasible & rows["return_difference_p"].notna()).any())
    any_failed = bool((rows["failed"] > 0).any())
    lines = []
    for _, row in rows.iterrows():
        line = names_of(row) | {"n": str(row["pairs"])}
        if any_failed:
            line["failed"] = str(row["failed"])
        no_gain = row["feasible_pairs"] < row["pairs"]
        line["feasible pairs"] = f"{row['feasible_pairs']} of {row['pairs']}"
        line["return gained"] = DASH if no_gain else with_interval(row, "return_difference")
        if any_tested:
            line[CORRECTED] = DASH if no_gain else p_value(row["return_difference_p_corrected"])
        for name in costs:
            title = f"cost{_suffix_of(name, suffixes)} added"
            line[title] = with_interval(row, name)
        mark = TOO_FEW if row["too_few_seeds"] and not math.isnan(row["improvement_low"]) else ""
        line["P(higher return)"] = DASH if no_gain else with_interval(row, "improvement") + mark
        lines.append(line)
    return pd.DataFrame(lines)


def _suffix_of(column: str, suffixes: Sequence[str]) -> str:
    return suffixes[int(column.split("_")[1])]


def with_interval(row: pd.Series, name: str) -> str:
    """Format estimate [low, high] from the three columns of an interval; without ends if they are NaN.

    It has two digits after the point; more if the interval excludes 0 and an end would look like 0.
    """
    values = [float(row[f"{name}{end}"]) for end in ("", "_low", "_high")]
    estimate, low, high = values
    texts = [f"{value:z.2f}" for value in values]  # z: no -0.00
    if (low > 0.0 or high < 0.0) and "0.00" in texts[1:]:
        texts = [number(value) for value in values]
    ends = "" if math.isnan(low) else f" [{texts[1]}, {texts[2]}]"
    return DASH if math.isnan(estimate) else f"{texts[0]}{ends}"


def p_value(value: float) -> str:
    """Format a p value, so that it can be compared with 0.05; empty if there is none.

    >>> p_value(0.0123), p_value(0.4), p_value(0.0496), p_value(3e-7), p_value(math.nan)
    ('0.012', '0.40', '0.0496', '< 0.001', '')
    """
    if math.isnan(value):
        return ""
    if value < 0.001:
        return "< 0.001"
    text = f"{value:.3f}" if value < 0.0995 else f"{value:.2f}"
    return f"{value:.4f}" if text == "0.050" else text


def not_corrected(table: pd.DataFrame) -> str:
    """Return how many intervals a finished table has, and that they are not corrected; empty for at most one.

    >>> not_corrected(pd.DataFrame({"share": ["4 of 5 (38–96%)", "–"], "gain": ["2 [1, 3]", "1 (n = 1)"]}))
    'Intervals in this table: 2, of 95% each, not corrected for their number.'
    """
    count = sum(len(INTERVAL.findall(cell)) for cell in table.astype(str).to_numpy().ravel())
    return f"Intervals in this table: {count}, of 95% each, not corrected for their number." * (count > 1)


def markdown(table: pd.DataFrame) -> str:
    """Format a Markdown table; repeated labels in the first columns stay, for sorting and searching.

    >>> print(markdown(pd.DataFrame({"task": ["1a"], "return": ["9.50"]})))
    | task | return |
    | --- | --- |
    | 1a | 9.50 |
    """
    lines = [list(map(str, table)), ["---"] * len(table.columns), *table.astype(str).to_numpy().tolist()]
    return "\n".join("| " + " | ".join(map(markdown_text, line)) + " |" for line in lines)


def markdown_text(text: str) -> str:
    r"""Escape HTML, links and cell separators in a text for Markdown.

    >>> markdown_text("<img src=x> [a](b) | c")
    '&lt;img src=x&gt; [a]\\(b) \\| c'
    """
    text = " ".join(printable(text).split())
    for mark, escaped in {"<": "&lt;", ">": "&gt;", "](": r"]\(", "|": r"\|"}.items():
        text = text.replace(mark, escaped)
    return text


def latex(table: pd.DataFrame) -> str:
    """Format a LaTeX tabular for the package booktabs, with a rule between tasks."""
    lines = [r"\begin{tabular}{" + "l" * len(table.columns) + "}", r"\toprule"]
    lines += [_latex_line(list(map(str, table))), r"\midrule"]
    before = None
    for cells in table.astype(str).to_numpy().tolist():
        if before is not None and cells[0] != before:
            lines.append(r"\midrule")
        before = cells[0]
        lines.append(_latex_line(cells))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def csv_bytes(frame: pd.DataFrame) -> bytes:
    """Return a data frame as CSV; floats as the shortest exact text."""
    return frame.to_csv(index=False, lineterminator="\n").encode()


def write_csv(frame: pd.DataFrame, path: Path) -> Path:
    """Write a data frame as CSV, as ``csv_bytes`` has it."""
    return _written(csv_bytes(frame), path)


def write_text(text: str, path: Path) -> Path:
    """Write a text file that ends with a line feed."""
    return _written((text.rstrip("\n") + "\n").encode(), path)


def _written(data: bytes, path: Path) -> Path:
    """Write a file; in place of a link, and not through it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, data)
    return path


def _latex_line(cells: Sequence[str]) -> str:
    escaped = ["".join(LATEX.get(letter, letter) for letter in cell.replace("–", "--")) for cell in cells]
    if escaped[0].startswith(("[", "*")):  # after \\ they would be its arguments
        escaped[0] = "{}" + escaped[0]
    return " & ".join(escaped) + r" \\"
