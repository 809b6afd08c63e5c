"""All figures and tables of a finished or running sweep in one call.

    report.html                 answer, verdicts, figures and, folded, the rest on one self-contained page
    report.md                   the same as text, with links to the figures
    return-against-cost         final policies, the region above d_d, and the frontier J*(d) (PDF and PNG)
    learning-curves_<agent>     the paper's Figures 3 and 4 (PDF and PNG)
    curricula                   the paper's Figure 5 (PDF and PNG)
    diagnostics_<task>_<agent>  limit, cost, multiplier, explained variance of the critics and KL divergence
                                of each curriculum, one figure per cost (PDF and PNG)
    policies_<agent>            final policies and their visits on RiverGrid's maps (PDF and PNG)
    bounds_<agent>              cumulative cost of training against Proposition 1 (PDF and PNG)
    performance-profiles        fraction of final policies that are feasible and return more (PDF and PNG)
    verdicts.csv                one row per task, agent and curriculum: the report's first table
    outcomes.csv                one row per trial and measure
    summary.csv                 averaged over seeds, with interquartile means
    comparisons.csv             paired differences to the agent without a curriculum
    training.csv                cost of relaxed training, one row per trial
    claims.csv                  the paper's claims about the grid's tasks, counted, if there are any
    bounds.csv                  the cumulative cost against Proposition 1, one row per trial and cost
    outcomes.tex                the first tables for LaTeX (booktabs)

For a running sweep, ``sketch`` draws only SKETCHED, as PNGs, and all tables and pages. This takes a
fraction of the time, and leaves the cores to the trials.

Equal sweeps give equal bytes: the only time is that of the last policy update, and the bootstrap's generator
is seeded here.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from recrl.analysis.data.cost_names import cost_suffix
from recrl.analysis.data.labels import GROUP, ordered
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.data.sweep_warnings import attempts, doubts
from recrl.analysis.figures import learning_curves, styles
from recrl.analysis.figures.cumulative_cost import cumulative_bounds
from recrl.analysis.figures.diagnostics import curriculum_diagnostics
from recrl.analysis.figures.frontier import return_against_cost
from recrl.analysis.figures.policy_map import policy_maps
from recrl.analysis.figures.profiles import performance_profiles
from recrl.analysis.report import html_page, table_formats, verdict_texts
from recrl.analysis.report.html_page import Section
from recrl.analysis.report.table_files import (
    BOOTSTRAP_SEED,
    COST_AND_BOUNDS,
    COST_AND_LIMITS,
    Tables,
    write_tables,
)
from recrl.analysis.statistics.cumulative_cost import is_bounded
from recrl.analysis.statistics.curves import MEAN, CurveAverage, interquartile
from recrl.analysis.statistics.intervals import ENOUGH_RUNS
from recrl.analysis.statistics.metrics import Measure
from recrl.orchestrator.errors import RecrlError, described
from recrl.orchestrator.files.outcomes_file import FAILED, INFEASIBLE
from recrl.orchestrator.spec import TrialStatus

RELOAD_SECONDS = 120  # of the page of a sweep that runs
CAPTIONS = {
    "return-against-cost": "Final policies: return against cost. The shaded region is above the limit; "
    "filled marks are feasible, every cost within the tolerance of its limit, hollow ones are not; a failed "
    "trial has no mark",
    "learning-curves": "Return and cost while training, and magnified in the deployment phase (learning goes "
    "on). Costs in the shaded region are above the limit",
    "curricula": "Cost limits in force",
    "diagnostics": "Limit, cost, multiplier, explained variance of the critics, and KL divergence",
    "policies": "Final policies and their visits",
    "performance-profiles": "Fraction of final policies that are feasible and return more than the value "
    "below; an infeasible one and a failed trial count as the worst",
}


SKETCHED = ("return-against-cost", "learning-curves", "curricula")
UNFINISHED = "A sketch: the other figures come at the end of the launch, or by recrl-sweep figures"


@dataclass(frozen=True)
class Drawing:
    """A figure that can be drawn.

    Attributes:
        kind: the beginning of its file's name, and the key of its caption in CAPTIONS.
        make: draws it; returns None without data.
        about: the labels that the figure is about, which its caption begins with; may be empty.
        shows: the caption of a kind that is not in CAPTIONS, because it depends on the sweep.
    """

    kind: str
    make: Callable[[], Figure | None]
    about: tuple[str, ...] = ()
    shows: str = ""

    @property
    def caption(self) -> str:
        """The caption: the labels as in the grid, and what the figure shows."""
        shows = self.shows or CAPTIONS[self.kind]
        return f"{', '.join(self.about)}: {shows}" if self.about else shows


class NothingToDrawError(RecrlError):
    """The sweep has no policy update on disk yet."""


def draw(sweep: Sweep, folder: Path, *, averaging: CurveAverage = MEAN) -> list[Path]:
    """Draw every figure and write every table of a finished or running sweep.

    Args:
        sweep: its data frames, of any source.
        folder: of the files, for example ``SweepStore.figures_folder``.
        averaging: kind of lines and bands of the learning curves.

    Returns:
        The written files, ``report.html`` and ``report.md`` first.

    Raises:
        NothingToDrawError: no trial has committed a policy update yet.
        Exception: raised by the first figure that failed; all others and the report, which names it, are
            written.
    """
    return _draw(sweep, folder, drawings(sweep, averaging=averaging))


def sketch(sweep: Sweep, folder: Path, *, averaging: CurveAverage = MEAN) -> list[Path]:
    """Draw only the fast figures, for a running sweep; otherwise like ``draw``.

    Args:
        sweep: its frames.
        folder: where the files go.
        averaging: of the learning curves.
    """
    figures = drawings(sweep, averaging=averaging)
    sketched = {stem: drawing for stem, drawing in figures.items() if drawing.kind in SKETCHED}
    return _draw(sweep, folder, sketched, unfinished=True)


def _draw(
    sweep: Sweep, folder: Path, figures: Mapping[str, Drawing], *, unfinished: bool = False
) -> list[Path]:
    """Draw some figures, write all tables and the report; of an unfinished sweep only PNGs, with a note."""
    drawn, mistakes = [], _Mistakes()
    for stem, drawing in figures.items():
        with mistakes.kept(stem):
            if (figure := drawing.make()) is None:
                styles.remove(folder, stem)  # of an earlier grid
                continue
            if unfinished:
                drawn.append(styles.save_png(figure, folder / f"{stem}.png"))
            else:
                drawn += styles.save(figure, folder, stem)
    notes = [*mistakes.notes, UNFINISHED] if unfinished else mistakes.notes
    written = _with_pages(_noted(sweep, notes), folder, drawn, figures)
    mistakes.raise_first()
    return written


class _Mistakes:
    """Collector of errors in single figures: the others are drawn, and the report lists the errors."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self._first: Exception | None = None

    @contextmanager
    def kept(self, stem: str) -> Iterator[None]:
        """Record the error of one figure."""
        try:
            yield
        except OSError:
            raise
        except Exception as error:
            self.notes.append(f"the figure {stem} could not be drawn ({described(error)})")
            self._first = self._first or error

    def raise_first(self) -> None:
        """Raise the first error, after all else is done."""
        if self._first is not None:
            raise self._first


def _noted(sweep: Sweep, notes: list[str]) -> Sweep:
    return dataclasses.replace(sweep, notes=(*sweep.notes, *notes))


def _with_pages(sweep: Sweep, folder: Path, drawn: list[Path], figures: Mapping[str, Drawing]) -> list[Path]:
    """Write the tables and the two reports with the figures; return all files, the reports first."""
    written, tables = write_tables(sweep, folder)
    reports = [
        table_formats.write_text(_html(sweep, drawn, figures, tables), folder / "report.html"),
        table_formats.write_text(_markdown(sweep, drawn, figures, tables), folder / "report.md"),
    ]
    return [*reports, *drawn, *written]


def _full_sizes(drawn: list[Path]) -> dict[Path, str]:
    """Return each PNG with the name of its full-size file: the PDF if there is one."""
    files = set(drawn)
    return {
        path: next(it.name for it in (path.with_suffix(".pdf"), path) if it in files)
        for path in drawn
        if path.suffix == ".png"
    }


def _markdown(sweep: Sweep, drawn: list[Path], figures: Mapping[str, Drawing], tables: Tables) -> str:
    """Return the report as text: answers, verdicts, warnings, figures, tables, provenance."""
    judged = tables.verdicts
    lines = [f"# {table_formats.markdown_text(sweep.name)}", ""]
    if len(judged):
        lines += [*_list(verdict_texts.answers(judged)), ""]
        lines += [table_formats.markdown(_marked(verdict_texts.verdict_table(judged))), ""]
        lines += _list(verdict_texts.task_sentences(sweep, judged))
        lines += _list(verdict_texts.explanation(judged))
    else:
        lines.append(verdict_texts.no_verdict(sweep))
    lines += ["", "## Trials and warnings", "", _count(sweep), "", *_list(missing(sweep))]
    lines += ["", "## Figures", ""]
    for path in _full_sizes(drawn):
        caption = table_formats.markdown_text(figures[path.stem].caption)
        lines += [f"![{path.stem}]({path.name})", "", f"{caption}.", ""]
    for it in tables.shown:
        lines += [f"## {it.heading}", "", table_formats.markdown(it.table), ""]
        lines += [it.note, ""] if it.note else []
    provenance = "\n".join(_provenance(sweep)).splitlines()
    return "\n".join([*lines, "## Provenance", "", *(f"    {line}" for line in provenance)])


def _list(sentences: Sequence[str]) -> list[str]:
    return [f"- {table_formats.markdown_text(sentence)}" for sentence in sentences]


def _marked(table: pd.DataFrame) -> pd.DataFrame:
    """Return the verdict table with violations and failures in bold."""
    bad = (INFEASIBLE, FAILED)
    texts = [f"**{text}**" if any(word in text for word in bad) else text for text in table["verdict"]]
    return table.assign(verdict=texts)


def drawings(sweep: Sweep, *, averaging: CurveAverage = MEAN) -> dict[str, Drawing]:
    """Return the figures of a sweep by file stem; each is drawn when it is called.

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
    made: dict[str, Drawing] = {}

    def add(drawing: Drawing, *labels: str) -> None:
        made[_free_stem("_".join((drawing.kind, *map(_safe, labels))), made)] = drawing

    add(Drawing("return-against-cost", partial(return_against_cost, sweep)))
    without_episodes = _without_episodes(sweep)
    for agent in (it for it in agents if it not in without_episodes):
        curves = partial(learning_curves.learning_curves, sweep, agent, averaging=averaging)
        add(Drawing("learning-curves", curves, (agent,)), agent)
    add(Drawing("curricula", partial(learning_curves.curricula, sweep)))
    about: tuple[str, ...]
    for task, agent in cells:
        for i in range(int(sweep.trials.loc[sweep.trials["task"] == task, "num_costs"].max())):
            suffix = cost_suffix(sweep, i, task)
            diagnosed = partial(curriculum_diagnostics, sweep, task, agent, cost=i)
            about = (task, agent, *_cost_label(suffix))
            add(Drawing("diagnostics", diagnosed, about), task, agent, *_file_label(i))
    for agent in agents:
        add(Drawing("policies", partial(policy_maps, sweep, agent), (agent,)), agent)
    for agent in agents:
        for i in range(sweep.num_costs):
            about = (agent, *_cost_label(cost_suffix(sweep, i)))
            shows = COST_AND_BOUNDS if is_bounded(sweep, agent, cost=i) else COST_AND_LIMITS
            summed = partial(cumulative_bounds, sweep, agent, cost=i)
            add(Drawing("bounds", summed, about, shows), agent, *_file_label(i))
    add(Drawing("performance-profiles", partial(performance_profiles, sweep, Measure.STOCHASTIC)))
    return made


def curve_averages() -> dict[str, CurveAverage]:
    """Return the kinds of lines and bands, by their names on the command line."""
    return {"mean": MEAN, "iqm": interquartile(np.random.default_rng(BOOTSTRAP_SEED))}


def _cost_label(suffix: str) -> tuple[str, ...]:
    """Return the label of one of several costs, from its ``cost_suffix``."""
    return (f"cost{suffix}",) if suffix else ()


def _file_label(i: int) -> tuple[str, ...]:
    """Return what tells the files of several costs apart: the number of the CSV files' columns."""
    return (f"cost-{i}",) if i else ()


def _safe(label: str) -> str:
    """Return a label as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "-", label)


def _free_stem(stem: str, taken: Collection[str]) -> str:
    """Return the stem, with a counter if another figure has it, as two labels may differ only in other signs.

    Upper and lower case count as equal, because some file systems do not tell them apart.

    >>> _free_stem("bounds_-0.1", ["bounds_-0.1", "Bounds_-0.1-2"]), _free_stem("curricula", [])
    ('bounds_-0.1-3', 'curricula')
    """
    known = {it.casefold() for it in taken}
    numbered = (f"{stem}-{count}" for count in itertools.count(2))
    return next(it for it in itertools.chain([stem], numbered) if it.casefold() not in known)


def _without_episodes(sweep: Sweep) -> list[str]:
    """Return the agents that have updates, but no finished episode in any of them."""
    finished = sweep.updates["episode_return"].notna().groupby(sweep.updates["agent"], observed=True).any()
    return [str(agent) for agent in finished.index[~finished]]


def missing(sweep: Sweep) -> list[str]:
    """Return sentences on incomplete results; empty for a complete sweep."""
    sentences = [*sweep.notes, *doubts(sweep)]
    for agent in _without_episodes(sweep):
        sentences.append(f"{agent}: no episode has finished, so there are no learning curves")
    for status, what in (
        (TrialStatus.DAMAGED, "damaged"),
        (TrialStatus.FAILED, "failed"),
        (TrialStatus.RUNNING, "still running"),
        (TrialStatus.WAITING, "waiting to be run"),
    ):
        chosen = sweep.trials[sweep.trials["status"] == status.value]
        if status is TrialStatus.WAITING and (blank := chosen["env_steps"] == 0).any():
            sentences.append(f"{blank.sum()} trials: not begun yet")
            chosen = chosen[~blank]
        for _, row in chosen.iterrows():
            done = row["env_steps"] / row["total_steps"]
            reason = f": {row['error']}" if row["error"] else ""
            title = f"{row['task']} {row['agent']} {row['method']} seed {row['seed']}"
            sentences.append(f"{title}: {what}, {done:.0%} of its steps done{reason}")
    seeds = sweep.trials.groupby(list(GROUP), observed=True)["seed"].nunique()
    few = sorted({int(count) for count in seeds if count < ENOUGH_RUNS})
    if few and few != [1]:  # one seed: the answers say so
        sentences.append(
            f"{' or '.join(map(str, few))} seeds: bootstrap intervals are too short below {ENOUGH_RUNS} "
            f"seeds (marked {table_formats.TOO_FEW}); Student's hold for normal data; Wilson's cover about "
            "95% on average, but as low as 83% when the true fraction is near 0 or 1"
        )
    return sentences


def _count(sweep: Sweep) -> str:
    """Count trials by status: ``20 trials: 1 running, 19 complete.``."""
    counts = sweep.trials["status"].value_counts()
    states = [f"{counts[state.value]} {state.value}" for state in TrialStatus if counts.get(state.value)]
    return f"{len(sweep.trials)} trials: {', '.join(states)}."


def _html(sweep: Sweep, drawn: list[Path], figures: Mapping[str, Drawing], tables: Tables) -> str:
    """Return the page: answers, verdicts, warnings and the first figures; the rest is folded."""
    failed = bool(sweep.trials["status"].isin([TrialStatus.FAILED.value, TrialStatus.DAMAGED.value]).any())
    sentences = [_count(sweep), *missing(sweep)]
    files = _full_sizes(drawn)
    first = {path: file for path, file in files.items() if figures[path.stem].kind in SKETCHED}
    further = {path: file for path, file in files.items() if path not in first}
    settings = html_page.verbatim(sweep.grid) + html_page.verbatim(_settings(sweep))
    sections = [
        Section("Trials and warnings", html_page.items(sentences, kind="failed" if failed else "plain")),
        Section("Figures", _figures(first, figures)),
        *([Section("More figures", _figures(further, figures), folded=True)] if further else []),
        *(
            Section(it.heading, html_page.table(it.table, it.note, it.kinds), folded=True)
            for it in tables.shown
        ),
        Section("Settings", settings, folded=True),
        Section("Provenance", html_page.verbatim("\n".join(_provenance(sweep))), folded=True),
    ]
    goes_on = bool((sweep.trials["status"] == TrialStatus.RUNNING.value).any())
    return html_page.page(
        sweep.name,
        _opening(sweep, tables.verdicts),
        sections,
        made=_made(sweep),
        reload_seconds=RELOAD_SECONDS if goes_on else None,
    )


def _figures(files: Mapping[Path, str], figures: Mapping[str, Drawing]) -> str:
    """Figures with their captions, as HTML."""
    return "\n".join(html_page.figure(path, figures[path.stem].caption, file) for path, file in files.items())


def _made(sweep: Sweep) -> str:
    """Return the versions of recrl that made the trials, and the date of the last policy update."""
    versions = sorted(
        {str(attempt["recrl"]) for it in sweep.facts for attempt in attempts(it) if "recrl" in attempt}
    )
    made = [f"recrl {' and '.join(versions)}"] if versions else []
    if "time" in sweep.updates and len(sweep.updates):  # an export has no times
        last = datetime.fromtimestamp(float(sweep.updates["time"].max()), UTC)
        made.append(f"last policy update on {last:%Y-%m-%d} (UTC)")
    return ", ".join(made)


def _opening(sweep: Sweep, judged: pd.DataFrame) -> str:
    """Return the answers and the verdict table."""
    if not len(judged):
        return html_page.items([verdict_texts.no_verdict(sweep)], kind="answers")
    return "\n".join(
        [
            html_page.items(verdict_texts.answers(judged), kind="answers"),
            html_page.verdict_table(verdict_texts.verdict_table(judged), verdict_texts.verdict_kinds(judged)),
            html_page.items(verdict_texts.task_sentences(sweep, judged), kind="notes"),
            html_page.items(verdict_texts.explanation(judged), kind="notes"),
        ]
    )


def _settings(sweep: Sweep) -> str:
    """Return every task, agent and curriculum with its options, one line each, under the tables' labels."""
    lines = [
        f"{kind} {label}: {json.dumps(trial.spec.to_json()[kind])}"
        for group, trial in zip(sweep.groups, sweep.facts, strict=True)
        for kind, label in zip(GROUP, group, strict=True)
    ]
    return "\n".join(dict.fromkeys(lines))


def _provenance(sweep: Sweep) -> list[str]:
    """Return every distinct provenance of the trials, with the number of trials."""
    origins = Counter(trial.provenance for trial in sweep.facts if trial.provenance)
    return [f"{count} trials:\n{text}" for text, count in sorted(origins.items())]
