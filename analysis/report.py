"""All figures and tables of a sweep in one call, from a finished or a running one.

    report.md                   what is missing, the tables, the list of the rest
    learning-curves_<agent>     the paper's Figures 3 and 4 (PDF and PNG)
    curricula                   the paper's Figure 5 (PDF and PNG)
    diagnostics_<task>_<agent>  limit, cost, multiplier and KL divergence a method (PDF and PNG)
    policies_<agent>            final policies and their visits on RiverGrid's maps (PDF and PNG)
    return-against-cost         final policies under the frontier J*(d), where it is known (PDF and PNG)
    outcomes.csv                a row a trial and measure
    summary.csv                 averaged over seeds, with interquartile means
    comparisons.csv             paired differences to the student without a curriculum
    training.csv                what relaxed training cost, a row a trial
    outcomes.tex                the first table for LaTeX (booktabs)

Equal sweeps give equal bytes: no time is written, and the bootstrap's generator is seeded here.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd

from recrl.analysis import figures, frames, metrics, styles, tables
from recrl.analysis.diagnostics import curriculum_diagnostics
from recrl.analysis.frames import GROUP, Sweep, ordered
from recrl.analysis.frontier import return_against_cost
from recrl.analysis.intervals import ENOUGH_RUNS
from recrl.analysis.metrics import Measure
from recrl.analysis.policy_map import policy_maps
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.spec import TrialState
from recrl.orchestrator.store import SweepStore

BOOTSTRAP_SEED = 0


class NothingToDrawError(RecrlError):
    """The sweep has no policy update on disk yet."""


def draw(store: SweepStore, folder: Path) -> list[Path]:
    """Draw every figure and write every table of a sweep, as far as it has come.

    Args:
        store: the sweep; nothing in it is changed.
        folder: where the files go, for example ``store.figures_folder``.

    Returns:
        The files written, ``report.md`` first.

    Raises:
        NothingToDrawError: no trial has committed a policy update yet.
    """
    sweep = frames.load(store)
    if not len(sweep.updates):
        raise NothingToDrawError(
            f"{store.folder}: nothing to draw yet, because none of its {len(sweep.trials)} trials has "
            f"committed a policy update"
        )
    drawn = []
    for agent in sweep.updates["agent"].cat.categories:
        if (sweep.updates["agent"] == agent).any():
            stem = f"learning-curves_{_safe(agent)}"
            drawn += styles.save(figures.learning_curves(sweep, agent), folder, stem)
    drawn += styles.save(figures.curricula(sweep), folder, "curricula")
    for task, agent in sweep.updates[["task", "agent"]].drop_duplicates().astype(str).to_numpy().tolist():
        stem = f"diagnostics_{_safe(task)}_{_safe(agent)}"
        drawn += styles.save(curriculum_diagnostics(sweep, task, agent), folder, stem)
    for agent in ordered(list(sweep.policies["agent"]), list(sweep.trials["agent"].cat.categories)):
        if (maps := policy_maps(sweep, agent)) is not None:
            drawn += styles.save(maps, folder, f"policies_{_safe(agent)}")
    if (against := return_against_cost(sweep)) is not None:
        drawn += styles.save(against, folder, "return-against-cost")
    written, text = _tables(sweep, folder)
    head = [f"# {sweep.name}", "", *_status(sweep), ""]
    images = [f"![{path.stem}]({path.name})" for path in drawn if path.suffix == ".png"]
    report = tables.write_text("\n".join([*head, *images, "", *text]), folder / "report.md")
    return [report, *drawn, *written]


def _safe(label: str) -> str:
    """A label as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "-", label)


def missing(sweep: Sweep) -> list[str]:
    """Sentences on what a reader might take for complete but is not; empty for a whole sweep."""
    sentences = list(sweep.notes)
    for status, what in (
        (TrialState.FAILED, "failed"),
        (TrialState.RUNNING, "still running"),
        (TrialState.WAITING, "waiting to be run"),
    ):
        chosen = sweep.trials[sweep.trials["status"] == status.value]
        for _, row in chosen.iterrows():
            done = row["env_steps"] / row["total_steps"]
            reason = f": {row['error']}" if row["error"] else ""
            title = f"{row['task']} {row['agent']} {row['method']} seed {row['seed']}"
            sentences.append(f"{title}: {what}, {done:.0%} of its steps done{reason}")
    seeds = sweep.trials.groupby(list(GROUP), observed=True)["seed"].nunique()
    few = sorted({int(count) for count in seeds if count < ENOUGH_RUNS})
    if few:
        sentences.append(
            f"{' or '.join(map(str, few))} seed{'s' if few[-1] > 1 else ''}: bootstrap intervals "
            f"are too short below {ENOUGH_RUNS} seeds (marked {tables.TOO_FEW}); Student's and Wilson's hold"
        )
    return sentences


def _status(sweep: Sweep) -> list[str]:
    counts = sweep.trials["status"].value_counts()
    states = [f"{counts[state.value]} {state.value}" for state in TrialState if counts.get(state.value)]
    lines = [f"{len(sweep.trials)} trials: {', '.join(states)}."]
    return [*lines, "", *(f"- {sentence}" for sentence in missing(sweep))]


def _tables(sweep: Sweep, folder: Path) -> tuple[list[Path], list[str]]:
    """Write the tables; returns the files and their Markdown."""
    rows = metrics.outcomes(sweep)
    written = [tables.write_csv(metrics.training_totals(sweep), folder / "training.csv")]
    if not len(rows):
        return written, ["No trial is complete yet: no table."]
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    averaged = metrics.summary(rows)
    robust = metrics.robust_summary(rows, generator).drop(columns="seeds")
    compared = metrics.comparisons(rows, generator)
    text, latex = [], []
    for measure in Measure:
        table = tables.outcome_table(averaged, measure)
        if len(table):
            text += [f"## Outcome of {measure.description}", "", tables.markdown(table), ""]
            latex += [f"% Outcome of {measure.description}.", tables.latex(table), ""]
    if len(compared):
        against = tables.comparison_table(compared, Measure.DEPLOYMENT)
        text += ["## Deployment phase against `none`, seed by seed [95% interval]", ""]
        text += [tables.markdown(against), ""]
    whole = pd.merge(averaged, robust, on=[*GROUP, "measure"], sort=False)
    written += [
        tables.write_csv(rows, folder / "outcomes.csv"),
        tables.write_csv(whole, folder / "summary.csv"),
        tables.write_csv(compared, folder / "comparisons.csv"),
        tables.write_text("\n".join(latex), folder / "outcomes.tex"),
    ]
    return written, text
