"""The tables of a sweep: files, and text for the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from recrl.analysis.data.cost_names import cost_names, cost_suffix
from recrl.analysis.data.labels import GROUP
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.data.sweep_warnings import curriculum_flags
from recrl.analysis.report import html_page, table_formats
from recrl.analysis.report.text_tables import bound_table, claims_table
from recrl.analysis.report.verdict_terms import tolerance_sentence
from recrl.analysis.statistics import claims, metrics
from recrl.analysis.statistics.comparisons import comparisons
from recrl.analysis.statistics.cumulative_cost import cumulative_costs
from recrl.analysis.statistics.intervals import ENOUGH_RUNS
from recrl.analysis.statistics.metrics import Measure
from recrl.analysis.statistics.verdict_counts import count_verdicts
from recrl.analysis.statistics.verdicts import SOLVED_GAP
from recrl.orchestrator.files.outcomes_file import OUTCOMES_FILE
from recrl.orchestrator.number_texts import DASH

COST_AND_BOUNDS = "Cost of training, one episode of each policy, against its bounds"
COST_AND_LIMITS = "Cost of training, one episode of each policy, against the limits in force"
BOOTSTRAP_SEED = 0
SHOWN_MEASURES = (Measure.STOCHASTIC, Measure.DETERMINISTIC, Measure.DEPLOYMENT)

TIES = (
    f"P(higher return): a tie counts half. Returns tie within {SOLVED_GAP} of each other where the optimum "
    "is known, as for solved; elsewhere only where they differ by rounding. It has no interval where all "
    "tie, or every run of one is better than every run of the other."
)
SAMPLED = "That standard error is over the episodes of a trial; the one after ± is over seeds."
CORRECTED_NOTE = (
    f"{table_formats.CORRECTED}: of a paired t test, corrected by Holm's method for all rows of two or more "
    "seeds, also those with a dash. It is 1 if all pairs tie."
)
LATEX_NOTE = "n: seeds; +-: one standard error over seeds; in parentheses or brackets: 95% intervals."
FEW = f"{table_formats.TOO_FEW}: with fewer than {ENOUGH_RUNS} seeds this interval is too short."
SUMS_NOTE = (
    "Sums over the policies of the training phase, one expected episode each; means over n seeds. A policy "
    "without a finished episode counts with the cost of the one before. Limits in force: the sum of the "
    "limits that the curriculum set, and of the measured cost where the limit was infinite. Net above: the "
    "cost minus these limits, or minus the deployment limit; negative below. Positive parts: only the "
    "policies whose measured mean is above the limit in force; biased upwards where few episodes end per "
    "policy."
)
BOUND_NOTES = {
    "bound": "Bound: if every update solves CPO's problem (CPO only).",
    "discounted bound": "Discounted bound: Proposition 1 of the paper (CPO only).",
    "trivial bound": "Trivial bound: every step at the largest cost.",
}
CLAIMS_NOTE = (
    "Counted are seeds, of the paper's tasks under its deployment limits. A claim about several curricula "
    "holds in a seed if it holds in the trials of all of them."
)
COMPARED_CLAIMS_NOTE = (
    "Comparisons count the seeds that have both trials. Costs of training are those of the training phase. A "
    "difference is the mean over seeds with Student's 95% interval; beside it the fraction of the other "
    "curriculum's mean, where that is above 0 beyond its interval. Feasible pairs: seeds whose two final "
    "policies are feasible. The paper's gains are at the end of the training phase."
)
FAILED_CLAIMS_NOTE = "In a seed with a failed trial a claim does not hold."
FAILED_NOTE = (
    "A failed trial counts as neither feasible nor solved; the means are over the n complete trials."
)
FAILED_PAIRS_NOTE = "failed: trials of the curriculum or of none; their seeds are not among the n pairs."
NO_GAIN = (
    "–: a policy of a pair is infeasible, with one curriculum or the other; more return is then no gain."
)


# Written only if a trial is complete, or if there is a claim to count.
CONDITIONAL_TABLES = (
    OUTCOMES_FILE,
    "claims.csv",
    "verdicts.csv",
    "summary.csv",
    "comparisons.csv",
    "outcomes.tex",
)


@dataclass(frozen=True)
class ShownTable:
    """A table of the report.

    Attributes:
        heading: its title.
        table: finished text.
        note: a sentence below it, or empty.
        kinds: of each row, ``infeasible`` or empty; none for a table without such rows.
    """

    heading: str
    table: pd.DataFrame
    note: str = ""
    kinds: Sequence[str] = ()


@dataclass(frozen=True)
class Tables:
    """Content of the report besides the figures.

    Attributes:
        verdicts: of ``verdict_counts.count_verdicts``; empty before a trial is complete.
        shown: the tables for people.
    """

    verdicts: pd.DataFrame = field(default_factory=pd.DataFrame)
    shown: Sequence[ShownTable] = ()


def write_tables(sweep: Sweep, folder: Path) -> tuple[list[Path], Tables]:
    """Write the tables of a finished or running sweep.

    Args:
        sweep: its frames.
        folder: where the files go.

    Returns:
        The files, and the report's content.
    """
    rows, totals = metrics.outcomes(sweep), metrics.training_totals(sweep)
    bounds = [cumulative_costs(sweep, cost=i).assign(cost=i) for i in range(sweep.num_costs)]
    written = [
        table_formats.write_csv(totals, folder / "training.csv"),
        table_formats.write_csv(pd.concat(bounds), folder / "bounds.csv"),
    ]
    if not len(rows):
        _remove_earlier(folder, written)
        return written, Tables()
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    averaged = metrics.summary(rows, sweep.trials)
    robust = metrics.robust_summary(rows, generator).drop(columns=["seeds", "too_few_seeds"])
    compared = comparisons(rows, generator)
    counted_claims = claims.count_claims(rows, totals, sweep.trials)
    whole = pd.merge(averaged, robust, on=[*GROUP, "measure"], how="left", sort=False)
    whole["too_few_seeds"] = whole["seeds"] < ENOUGH_RUNS
    judged = count_verdicts(rows, compared, curriculum_flags(sweep), sweep.trials, cost_names(sweep))
    suffixes = [cost_suffix(sweep, i) for i in range(sweep.num_costs)]
    outcomes = _outcome_tables(rows, averaged, suffixes)
    shown = [*outcomes, *_comparison_tables(compared, averaged, suffixes)]
    latex = [f"% {it.heading}. {LATEX_NOTE}\n{table_formats.latex(it.table)}\n" for it in shown]
    if len(counted_claims):
        written.append(table_formats.write_csv(counted_claims, folder / "claims.csv"))
        shown.append(_claims(counted_claims))
    shown += [_bounds(costs, suffix) for costs, suffix in zip(bounds, suffixes, strict=True) if len(costs)]
    written += [
        table_formats.write_csv(judged, folder / "verdicts.csv"),
        table_formats.write_csv(rows, folder / OUTCOMES_FILE),
        table_formats.write_csv(whole, folder / "summary.csv"),
        table_formats.write_csv(compared, folder / "comparisons.csv"),
        table_formats.write_text("\n".join(latex), folder / "outcomes.tex"),
    ]
    _remove_earlier(folder, written)
    return written, Tables(judged, shown)


def _remove_earlier(folder: Path, written: Sequence[Path]) -> None:
    """Remove tables of an earlier grid that were not written again, beside an earlier report.

    They can always be computed. Without a report of recrl's a file of such a name may be the user's.
    """
    if not html_page.is_ours(folder / "report.html"):
        return
    for name in {*CONDITIONAL_TABLES} - {path.name for path in written}:
        (folder / name).unlink(missing_ok=True)


def write_outcomes(sweep: Sweep, folder: Path) -> None:
    """Write only ``outcomes.csv``, as ``write_tables`` does, if a trial is complete.

    A file that has these rows already keeps its time, because the report counts as older than outcomes that
    were written after it.

    Args:
        sweep: its frames.
        folder: where the file goes.
    """
    rows, path = metrics.outcomes(sweep), folder / OUTCOMES_FILE
    if not len(rows) or (path.exists() and path.read_bytes() == table_formats.csv_bytes(rows)):
        return
    table_formats.write_csv(rows, path)


def _claims(counted_claims: pd.DataFrame) -> ShownTable:
    """Return the counted claims of the paper."""
    table = claims_table(counted_claims)
    notes = [
        CLAIMS_NOTE,
        COMPARED_CLAIMS_NOTE if counted_claims["difference"].notna().any() else "",
        NO_GAIN if (table == DASH).any(axis=None) else "",
        FAILED_CLAIMS_NOTE if counted_claims["failed"].any() else "",
        table_formats.not_corrected(table),
    ]
    return ShownTable("What the paper says of these tasks", table, " ".join(filter(None, notes)))


def _bounds(costs: pd.DataFrame, suffix: str) -> ShownTable:
    """Return the cumulative cost of training, with the bounds that are known."""
    table = bound_table(costs)
    notes = [
        SUMS_NOTE,
        *(note for title, note in BOUND_NOTES.items() if title in table),
    ]
    heading = COST_AND_BOUNDS if len(notes) > 1 else COST_AND_LIMITS
    which = f" (cost{suffix})" if suffix else ""
    return ShownTable(f"{heading}{which}", table, " ".join(notes))


def _outcome_tables(
    outcomes: pd.DataFrame, averaged: pd.DataFrame, suffixes: Sequence[str]
) -> list[ShownTable]:
    """Return the outcomes, those of the final policy first, each with the tolerance of its costs."""
    tables = []
    for measure in SHOWN_MEASURES:
        rows = averaged[averaged["measure"] == measure.value]
        if len(rows):
            table = table_formats.outcome_table(averaged, measure, suffixes)
            of_measure = outcomes[outcomes["measure"] == measure.value]
            exact = bool(of_measure["exact"].all())
            note = tolerance_sentence(of_measure, exact=exact) + ("" if exact else f" {SAMPLED}")
            note += f" {FAILED_NOTE}" if rows["failed"].any() else ""
            note += f" {counted}" if (counted := table_formats.not_corrected(table)) else ""
            tables.append(ShownTable(_heading(measure), table, note, table_formats.row_kinds(rows)))
    return tables


def _comparison_tables(
    compared: pd.DataFrame, averaged: pd.DataFrame, suffixes: Sequence[str]
) -> list[ShownTable]:
    """Return differences to the agent without a curriculum, those of the final policy first."""
    tables = []
    for measure in (Measure.STOCHASTIC, Measure.DEPLOYMENT) if len(compared) else ():
        rows = table_formats.compared_rows(compared, averaged, measure)
        if not len(rows):
            continue
        table = table_formats.comparison_table(rows, suffixes)
        marked = table["P(higher return)"].str.contains(table_formats.TOO_FEW).any()
        dashed = bool((rows["feasible_pairs"] < rows["pairs"]).any())
        notes = [
            CORRECTED_NOTE if table_formats.CORRECTED in table else "",
            TIES,
            FEW if marked else "",
            NO_GAIN if dashed else "",
            FAILED_PAIRS_NOTE if rows["failed"].any() else "",
            table_formats.not_corrected(table),
        ]
        note = " ".join(filter(None, notes))
        tables.append(
            ShownTable(f"{_heading(measure)}, minus none", table, note, table_formats.row_kinds(rows))
        )
    return tables


def _heading(measure: Measure) -> str:
    text = measure.description.removeprefix("the ")
    return text[0].upper() + text[1:]
