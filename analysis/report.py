"""All figures and tables of a sweep in one call, from a finished or a running one.

    report.html                 all of it on one self-contained page, with settings and provenance
    report.md                   what is missing, the tables, the list of the rest
    learning-curves_<agent>     the paper's Figures 3 and 4 (PDF and PNG)
    bounds_<agent>              cumulative cost of training beside Proposition 1 (PDF and PNG)
    curricula                   the paper's Figure 5 (PDF and PNG)
    diagnostics_<task>_<agent>  limit, cost, multiplier and KL divergence a method (PDF and PNG)
    policies_<agent>            final policies and their visits on RiverGrid's maps (PDF and PNG)
    return-against-cost         final policies under the frontier J*(d), where it is known (PDF and PNG)
    performance-profiles        share of runs above each return, frozen policies (PDF and PNG)
    outcomes.csv                a row a trial and measure
    summary.csv                 averaged over seeds, with interquartile means
    comparisons.csv             paired differences to the student without a curriculum
    training.csv                what relaxed training cost, a row a trial
    claims.csv                  the paper's claims about RiverGrid's maps, counted, where a grid has these
    bounds.csv                  the same beside Proposition 1, a row a trial and cost
    outcomes.tex                the first table for LaTeX (booktabs)
    outcomes.parquet            outcomes.csv with its types, for programs

Of a sweep that runs, ``sketch`` draws SKETCHED, as PNGs, and all tables and pages: that takes a fraction of
the time of the whole, and trials want the rest.

Equal sweeps give equal bytes: no time is written, and the bootstrap's generator is seeded here.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from recrl.analysis import report_page, report_tables
from recrl.analysis.data.labels import GROUP, ordered
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.data.validity import doubts
from recrl.analysis.figures import learning_curves, styles
from recrl.analysis.figures.cumulative_cost import cumulative_bounds
from recrl.analysis.figures.diagnostics import curriculum_diagnostics
from recrl.analysis.figures.frontier import return_against_cost
from recrl.analysis.figures.policy_map import policy_maps
from recrl.analysis.figures.profiles import performance_profiles
from recrl.analysis.report_page import Section
from recrl.analysis.statistics import claims, metrics
from recrl.analysis.statistics.cumulative_cost import bound_table, cumulative_costs
from recrl.analysis.statistics.curves import MEAN, Averaging, interquartile
from recrl.analysis.statistics.intervals import ENOUGH_RUNS
from recrl.analysis.statistics.metrics import Measure
from recrl.orchestrator.errors import RecrlError, described
from recrl.orchestrator.spec import TrialState

BOOTSTRAP_SEED = 0
RELOAD_SECONDS = 120  # of the page of a sweep that runs
NO_TABLE = "No trial is complete yet: no table."
CAPTIONS = {
    "learning-curves": "Return and cost over training and over deployment",
    "bounds": "Cumulative cost of training beside its bounds",
    "curricula": "Cost limits in force",
    "diagnostics": "Limit, cost, multiplier and KL divergence",
    "policies": "Final policies and their visits",
    "return-against-cost": "Final policies under the best return for each limit, J*(d)",
    "performance-profiles": "Share of runs above each return",
}


SKETCHED = re.compile(r"learning-curves_.*|curricula")
UNFINISHED = "A sketch: the other figures come at the end of the launch, or by recrl-sweep figures"


class NothingToDrawError(RecrlError):
    """The sweep has no policy update on disk yet."""


def draw(sweep: Sweep, folder: Path, *, averaging: Averaging = MEAN) -> list[Path]:
    """Draw every figure and write every table of a sweep, as far as it has come.

    Args:
        sweep: its frames, from whatever source.
        folder: where the files go, for example ``SweepStore.figures_folder``.
        averaging: what lines and bands of the learning curves are.

    Returns:
        The files written, ``report.html`` and ``report.md`` first.

    Raises:
        NothingToDrawError: no trial has committed a policy update yet.
        Exception: what went wrong in the first figure that could not be drawn; all others and the report,
            which names it, are there.
    """
    drawn, mistakes = [], _Mistakes()
    for stem, make in drawings(sweep, averaging=averaging).items():
        with mistakes.kept(stem):
            if (figure := make()) is not None:
                drawn += styles.save(figure, folder, stem)
    written = _with_pages(_noted(sweep, mistakes.notes), folder, drawn)
    mistakes.raise_first()
    return written


def sketch(sweep: Sweep, folder: Path, *, averaging: Averaging = MEAN) -> list[Path]:
    """Draw what is cheap to draw, for a look at a sweep that runs; otherwise like ``draw``.

    Args:
        sweep: its frames.
        folder: where the files go.
        averaging: of the learning curves.
    """
    drawn, mistakes = [], _Mistakes()
    for stem, make in drawings(sweep, averaging=averaging).items():
        with mistakes.kept(stem):
            if SKETCHED.fullmatch(stem) and (figure := make()) is not None:
                drawn.append(styles.save_png(figure, folder / f"{stem}.png"))
    written = _with_pages(_noted(sweep, [*mistakes.notes, UNFINISHED]), folder, drawn)
    mistakes.raise_first()
    return written


class _Mistakes:
    """What went wrong in single figures: the others are drawn all the same, and the report says it."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self._first: Exception | None = None

    @contextmanager
    def kept(self, stem: str) -> Iterator[None]:
        """Keep what is raised while one figure is drawn."""
        try:
            yield
        except OSError:
            raise
        except Exception as error:
            self.notes.append(f"the figure {stem} could not be drawn ({described(error)})")
            self._first = self._first or error

    def raise_first(self) -> None:
        """Raise the first of them, now that all else is done."""
        if self._first is not None:
            raise self._first


def _noted(sweep: Sweep, notes: list[str]) -> Sweep:
    return dataclasses.replace(sweep, notes=(*sweep.notes, *notes))


def _with_pages(sweep: Sweep, folder: Path, drawn: list[Path]) -> list[Path]:
    """Write the tables and the two reports that show the figures drawn; all files, the reports first."""
    written, shown = write_tables(sweep, folder)
    pictures = [path for path in drawn if path.suffix == ".png"]
    text = [f"![{path.stem}]({path.name})" for path in pictures]
    for heading, table in shown:
        text += ["", f"## {heading}", "", report_tables.markdown(table)]
    if not shown:
        text += ["", NO_TABLE]
    state = [
        _count(sweep),
        "",
        *(f"- {report_tables.markdown_text(sentence)}" for sentence in missing(sweep)),
    ]
    title = f"# {report_tables.markdown_text(sweep.name)}"
    reports = [
        report_tables.write_text(_html(sweep, pictures, shown), folder / "report.html"),
        report_tables.write_text("\n".join([title, "", *state, "", *text]), folder / "report.md"),
    ]
    return [*reports, *drawn, *written]


def drawings(sweep: Sweep, *, averaging: Averaging = MEAN) -> dict[str, Callable[[], Figure | None]]:
    """The figures of a sweep by the stems of their files, made when called; None where there is nothing.

    Args:
        sweep: its frames.
        averaging: of the learning curves.

    Raises:
        NothingToDrawError: no trial has committed a policy update yet.
    """
    if not len(sweep.updates):
        raise NothingToDrawError(
            f"{sweep.name}: nothing to draw yet, because none of its {len(sweep.trials)} trials has "
            f"committed a policy update"
        )
    agents = ordered(list(sweep.updates["agent"]), list(sweep.trials["agent"].cat.categories))
    cells = sweep.updates[["task", "agent"]].drop_duplicates().astype(str).to_numpy().tolist()
    made: dict[str, Callable[[], Figure | None]] = {}
    for agent in agents:
        made[f"learning-curves_{_safe(agent)}"] = partial(
            learning_curves.learning_curves, sweep, agent, averaging=averaging
        )
    made["curricula"] = partial(learning_curves.curricula, sweep)
    for task, agent in cells:
        made[f"diagnostics_{_safe(task)}_{_safe(agent)}"] = partial(
            curriculum_diagnostics, sweep, task, agent
        )
    for agent in agents:
        made[f"policies_{_safe(agent)}"] = partial(policy_maps, sweep, agent)
    for agent in agents:
        for i in range(sweep.num_costs):
            which = f"_cost-{i + 1}" if i else ""
            made[f"bounds_{_safe(agent)}{which}"] = partial(cumulative_bounds, sweep, agent, cost=i)
    made["return-against-cost"] = partial(return_against_cost, sweep)
    made["performance-profiles"] = partial(performance_profiles, sweep, Measure.STOCHASTIC)
    return made


def averagings() -> dict[str, Averaging]:
    """What lines and bands can be, by the name that the command line has for it."""
    return {"mean": MEAN, "iqm": interquartile(np.random.default_rng(BOOTSTRAP_SEED))}


def _safe(label: str) -> str:
    """A label as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "-", label)


def missing(sweep: Sweep) -> list[str]:
    """Sentences on what a reader might take for complete but is not; empty for a whole sweep."""
    sentences = [*sweep.notes, *doubts(sweep)]
    for status, what in (
        (TrialState.DAMAGED, "damaged"),
        (TrialState.FAILED, "failed"),
        (TrialState.RUNNING, "still running"),
        (TrialState.WAITING, "waiting to be run"),
    ):
        chosen = sweep.trials[sweep.trials["status"] == status.value]
        if status is TrialState.WAITING and (blank := chosen["env_steps"] == 0).any():
            sentences.append(f"{blank.sum()} trials: not begun yet")
            chosen = chosen[~blank]
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
            f"are too short below {ENOUGH_RUNS} seeds (marked {report_tables.TOO_FEW}); Student's "
            "and Wilson's hold"
        )
    return sentences


def _count(sweep: Sweep) -> str:
    """How many trials stand how: ``20 trials: 1 running, 19 complete.``."""
    counts = sweep.trials["status"].value_counts()
    states = [f"{counts[state.value]} {state.value}" for state in TrialState if counts.get(state.value)]
    return f"{len(sweep.trials)} trials: {', '.join(states)}."


def write_tables(sweep: Sweep, folder: Path) -> tuple[list[Path], list[tuple[str, pd.DataFrame]]]:
    """Write the tables of a sweep, as far as it has come.

    Args:
        sweep: its frames.
        folder: where the files go.

    Returns:
        The files, and the tables for people, as text, with their headings.
    """
    rows = metrics.outcomes(sweep)
    bounds = [cumulative_costs(sweep, cost=i).assign(cost=i) for i in range(sweep.num_costs)]
    written = [
        report_tables.write_csv(metrics.training_totals(sweep), folder / "training.csv"),
        report_tables.write_csv(pd.concat(bounds), folder / "bounds.csv"),
    ]
    if not len(rows):
        return written, []
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    averaged = metrics.summary(rows)
    robust = metrics.robust_summary(rows, generator).drop(columns="seeds")
    compared = metrics.comparisons(rows, generator)
    outcomes = {measure: report_tables.outcome_table(averaged, measure) for measure in Measure}
    latex = [
        f"% Outcome of {measure.description}.\n{report_tables.latex(table)}\n"
        for measure, table in outcomes.items()
        if len(table)
    ]
    shown = [
        (f"Outcome of {measure.description}", table) for measure, table in outcomes.items() if len(table)
    ]
    if len(compared):
        against = report_tables.comparison_table(compared, Measure.DEPLOYMENT)
        shown.append(("Deployment phase against `none`, seed by seed [95% interval]", against))
    weighed = claims.weigh(rows)
    if len(weighed):
        written.append(report_tables.write_csv(weighed, folder / "claims.csv"))
        shown.append(("What the paper says of these maps, in deployment", claims.claims_table(weighed)))
    for i, costs in enumerate(bounds):
        which = "" if sweep.num_costs == 1 else f" (cost {i + 1})"
        if len(costs):
            shown.append((f"Cumulative cost of training beside its bounds{which}", bound_table(costs)))
    whole = pd.merge(averaged, robust, on=[*GROUP, "measure"], sort=False)
    written += [
        report_tables.write_csv(rows, folder / "outcomes.csv"),
        report_tables.write_parquet(rows, folder / "outcomes.parquet"),
        report_tables.write_csv(whole, folder / "summary.csv"),
        report_tables.write_csv(compared, folder / "comparisons.csv"),
        report_tables.write_text("\n".join(latex), folder / "outcomes.tex"),
    ]
    return written, shown


def _html(sweep: Sweep, pictures: list[Path], shown: list[tuple[str, pd.DataFrame]]) -> str:
    """The page: what is missing, figures, tables, settings, provenance."""
    failed = bool(sweep.trials["status"].isin([TrialState.FAILED.value, TrialState.DAMAGED.value]).any())
    sections = []
    if sentences := missing(sweep):
        sections.append(Section("To be known", report_page.items(sentences, failed=failed)))
    sections.append(
        Section("Figures", "\n".join(report_page.figure(path, _caption(path)) for path in pictures))
    )
    sections += [Section(heading.replace("`", ""), report_page.table(table)) for heading, table in shown]
    if not shown:
        sections.append(Section("Tables", report_page.items([NO_TABLE])))
    settings = {
        f"{kind} {choice['label']}": choice
        for trial in sweep.facts
        for kind, choice in trial.spec.to_json().items()
        if kind in ("task", "agent", "method")
    }
    sections.append(
        Section(
            "Settings",
            report_page.verbatim(sweep.grid)
            + report_page.verbatim("\n".join(f"{it}: {json.dumps(settings[it])}" for it in settings)),
        )
    )
    sections.append(Section("Provenance", report_page.verbatim("\n".join(_provenance(sweep)))))
    goes_on = bool((sweep.trials["status"] == TrialState.RUNNING.value).any())
    return report_page.page(
        sweep.name, _count(sweep), sections, reload_seconds=RELOAD_SECONDS if goes_on else None
    )


def _caption(path: Path) -> str:
    kind, _, of = path.stem.partition("_")
    return " ".join([CAPTIONS[kind], *(["for", of.replace("_", ", ")] if of else [])])


def _provenance(sweep: Sweep) -> list[str]:
    """Every different origin of the trials, and how many have it."""
    origins = Counter(trial.provenance for trial in sweep.facts if trial.provenance)
    return [f"{count} trials:\n{text}" for text, count in sorted(origins.items())]
