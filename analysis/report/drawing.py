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
is seeded with ``BOOTSTRAP_SEED``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import styles
from recrl.analysis.report.figure_list import SKETCHED, Drawing, drawings
from recrl.analysis.report.pages import shown_figures, write_reports
from recrl.analysis.report.table_files import write_tables
from recrl.analysis.statistics.curves import MEAN, CurveAverage
from recrl.orchestrator.errors import described

UNFINISHED = "A sketch: the other figures come at the end of the launch, or by recrl-sweep figures"


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
    return _draw(sweep, folder, drawings(sweep, averaging=averaging), unfinished=True)


def _draw(
    sweep: Sweep, folder: Path, figures: Mapping[str, Drawing], *, unfinished: bool = False
) -> list[Path]:
    """Draw figures, write tables and report; of an unfinished sweep only the fast ones, as PNGs."""
    later = {stem for stem, it in figures.items() if unfinished and it.kind not in SKETCHED}
    earlier = shown_figures(folder)
    drawn, mistakes = [], _Mistakes()
    for stem, drawing in figures.items():
        if stem in later:
            continue
        with mistakes.kept(stem):
            if (figure := drawing.make()) is None:
                styles.remove(folder, stem)  # of an earlier grid
                continue
            if unfinished:
                drawn.append(styles.save_png(figure, folder / f"{stem}.png"))
            else:
                drawn += styles.save(figure, folder, stem)
    for stem in earlier - later - {path.stem for path in drawn}:  # of an earlier grid, or a mistake
        styles.remove(folder, stem)
    notes = [*mistakes.notes, UNFINISHED] if unfinished else mistakes.notes
    noted = dataclasses.replace(sweep, notes=(*sweep.notes, *notes))
    written, tables = write_tables(noted, folder)
    reports = write_reports(noted, folder, drawn, figures, tables)
    mistakes.raise_first()
    return [*reports, *drawn, *written]


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
