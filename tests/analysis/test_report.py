"""One call draws a sweep, as far as it has come."""

import dataclasses
import os
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from recrl.analysis.data import sweep_data
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import learning_curves
from recrl.analysis.report import drawing, figure_list, html_page, table_files
from recrl.analysis.report.figure_list import NothingToDrawError
from recrl.analysis.report.verdict_answers import no_verdict
from recrl.orchestrator.files.sweep_store import SweepStore
from tests.conftest import MadeUpSweep
from tests.faults.committing import commit_file


def test_a_partial_sweep_is_drawn_twice_alike_and_says_what_is_missing(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path
) -> None:
    store = made_up_sweep(
        seeds=2,
        tasks=["river-a"],
        agents=["my cpo"],
        methods=["none", "linear"],
        unfinished=["river-a my cpo linear seed 0"],
        failed=["river-a my cpo linear seed 1"],
    )
    written = drawing.draw(sweep_data.load(store), tmp_path / "first")
    assert [path.name for path in written] == [
        "report.html",
        "report.md",
        "return-against-cost.pdf",
        "return-against-cost.png",
        "learning-curves_my-cpo.pdf",
        "learning-curves_my-cpo.png",
        "curricula.pdf",
        "curricula.png",
        "diagnostics_river-a_my-cpo.pdf",
        "diagnostics_river-a_my-cpo.png",
        "bounds_my-cpo.pdf",
        "bounds_my-cpo.png",
        "performance-profiles.pdf",
        "performance-profiles.png",
        "training.csv",
        "bounds.csv",
        "verdicts.csv",
        "outcomes.csv",
        "summary.csv",
        "comparisons.csv",
        "outcomes.tex",
    ]
    text = written[1].read_text().splitlines()
    assert text[2] == (
        "- river-a: none of 4 trials (1 agent x 2 curricula x 2 seeds) solves it so far; 1 failed; the sweep "
        "is incomplete: 1 trial has no result yet."
    )
    assert any("| linear | **failed 1 of 2; no result yet 1 of 2** | " in line for line in text)
    assert text[6].startswith("| river-a | my cpo | none | feasible | ")
    assert "4 trials: 1 running, 2 complete, 1 failed." in text
    assert text.index("## Trials and warnings") < text.index("## Figures") < text.index("## Provenance")
    assert (
        "- river-a my cpo linear seed 1: failed, 50% of its steps done: ValueError: the river froze" in text
    )
    assert "- river-a my cpo linear seed 0: running or interrupted, 50% of its steps done" in text
    assert (
        "- 2 seeds: bootstrap intervals are too short below 10 seeds (marked †); Student's hold for normal "
        "data; Wilson's cover about 95% on average, but as low as 83% when the true fraction is near 0 or 1"
    ) in text
    again = drawing.draw(sweep_data.load(store), tmp_path / "second")
    assert [path.read_bytes() for path in written] == [path.read_bytes() for path in again]


@pytest.mark.usefixtures("unrendered")
def test_before_any_trial_is_complete_there_are_curves_and_no_table(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path
) -> None:
    store = made_up_sweep(
        seeds=1, tasks=["a"], agents=["cpo"], methods=["none"], unfinished=["a cpo none seed 0"]
    )
    sweep = sweep_data.load(store)
    names = [path.name for path in drawing.sketch(sweep, tmp_path)]
    assert "curricula.png" in names
    assert "outcomes.csv" not in names
    assert "No trial is complete yet: no verdict." in (tmp_path / "report.md").read_text()
    for stem in ("bounds_cpo", "return-against-cost", "performance-profiles"):
        assert figure_list.drawings(sweep)[stem].make() is None


@pytest.mark.usefixtures("unrendered")
def test_a_sketch_has_what_changes_while_a_sweep_runs_and_all_tables(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path
) -> None:
    store = made_up_sweep(
        seeds=1, tasks=["a"], agents=["cpo"], methods=["none", "step"], unfinished=["a cpo step seed 0"]
    )
    sweep = sweep_data.load(store)
    sketched = drawing.sketch(sweep, tmp_path / "sketch")
    pictures = {path.name for path in sketched if path.suffix == ".png"}
    assert pictures == {"return-against-cost.png", "learning-curves_cpo.png", "curricula.png"}
    assert not any(path.suffix == ".pdf" for path in sketched)
    tables = {path.name for path in sketched if path.suffix in (".csv", ".tex")}
    assert tables == {path.name for path in table_files.write_tables(sweep, tmp_path / "tables")[0]}
    text = sketched[1].read_text()
    assert f"- {drawing.UNFINISHED}" in text.splitlines()
    assert text.count("another seed may give another verdict") == 1  # the answers say so, the warnings do not


@pytest.mark.usefixtures("unrendered")
def test_labels_that_differ_only_in_other_signs_have_figures_of_their_own(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path
) -> None:
    store = made_up_sweep(
        seeds=1, tasks=["a_1", "a 1"], agents=["β=0.1", "λ=0.1"], methods=["none"], updates=10
    )
    figures = figure_list.drawings(sweep_data.load(store))
    captions = {stem: it.caption.split(":")[0] for stem, it in figures.items() if it.kind == "diagnostics"}
    assert captions == {
        "diagnostics_a-1_-0.1": "a 1, β=0.1",
        "diagnostics_a-1_-0.1-2": "a 1, λ=0.1",
        "diagnostics_a-1_-0.1-3": "a_1, β=0.1",
        "diagnostics_a-1_-0.1-4": "a_1, λ=0.1",
    }
    names = [path.name for path in drawing.sketch(sweep_data.load(store), tmp_path)]
    assert {"learning-curves_-0.1.png", "learning-curves_-0.1-2.png"} <= set(names)
    text = (tmp_path / "report.md").read_text()
    assert "\nβ=0.1: Return and cost while training" in text
    assert "\nλ=0.1: Return and cost while training" in text


def test_tables_of_outcomes_say_their_tolerance(finished: Sweep, tmp_path: Path) -> None:
    notes = {it.heading: it.note for it in table_files.write_tables(finished, tmp_path)[1].shown}
    tolerance = "no mean cost exceeds its limit by more than 1% or, where it is sampled, one standard error"
    assert tolerance in notes["Deployment phase (learning goes on)"]
    assert "over the episodes of a trial" in notes["Deployment phase (learning goes on)"]


def test_outcomes_alone_are_those_of_the_tables(finished: Sweep, tmp_path: Path) -> None:
    table_files.write_outcomes(finished, tmp_path / "alone")
    (alone,) = (tmp_path / "alone").iterdir()
    os.utime(alone, (1.0, 1.0))
    table_files.write_outcomes(finished, tmp_path / "alone")
    assert alone.stat().st_mtime == 1.0  # equal rows are not newer than the report
    table_files.write_tables(finished, tmp_path)
    assert alone.read_bytes() == (tmp_path / "outcomes.csv").read_bytes()


def test_trials_without_an_evaluation_are_not_said_to_be_incomplete(finished: Sweep, tmp_path: Path) -> None:
    unevaluated = dataclasses.replace(finished, evaluations=finished.evaluations.iloc[:0])
    _, tables = table_files.write_tables(unevaluated, tmp_path)
    assert not len(tables.verdicts)
    assert no_verdict(unevaluated) == ("No final policy was evaluated: set run.evaluation_episodes.")
    for status, sentence in (
        ("failed", "No verdict: all 36 trials failed."),
        ("running", "No trial is complete yet: no verdict."),
    ):
        trials = finished.trials.assign(status=status)
        assert no_verdict(dataclasses.replace(finished, trials=trials)) == sentence


@pytest.mark.usefixtures("unrendered")
def test_a_report_of_failed_trials_alone_says_so(finished: Sweep, tmp_path: Path) -> None:
    failed = dataclasses.replace(finished, trials=finished.trials.assign(status="failed"))
    drawing.draw(failed, tmp_path)
    for name in ("report.md", "report.html"):
        assert "No verdict: all 36 trials failed." in (tmp_path / name).read_text()


@pytest.mark.usefixtures("unrendered")
def test_no_table_or_figure_of_an_earlier_grid_stays_beside_a_new_report(
    finished: Sweep, tmp_path: Path
) -> None:
    stale = ("outcomes.csv", "summary.csv", "verdicts.csv", "comparisons.csv", "claims.csv", "outcomes.tex")
    for name in (*stale, "return-against-cost.png", "mine.csv"):
        (tmp_path / name).write_text("old")
    running = dataclasses.replace(finished, trials=finished.trials.assign(status="running"))
    for report in ("mine.html", "report.html"):  # no report of recrl's is here: they may be somebody's own
        (tmp_path / report).write_text("<html>somebody's own</html>")
        table_files.write_tables(running, tmp_path)
        assert all((tmp_path / name).read_text() == "old" for name in stale)
    (tmp_path / "report.html").write_text(html_page.page("an earlier one", "", []))
    drawing.sketch(running, tmp_path)
    assert [name for name in stale if (tmp_path / name).exists()] == []
    assert not (tmp_path / "return-against-cost.png").exists()
    assert (tmp_path / "mine.csv").read_text() == "old"


@pytest.mark.usefixtures("unrendered")
def test_figures_that_an_earlier_report_shows_are_drawn_again_or_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def sweep(*agents: str) -> Sweep:
        made_up = MadeUpSweep(seeds=1, tasks=("a",), agents=agents, methods=("none",), updates=10)
        return sweep_data.load(made_up.write(tmp_path, "-".join(agents)))

    def figures() -> set[str]:
        return {path.stem for path in tmp_path.glob("*.png")} & {path.stem for path in tmp_path.glob("*.pdf")}

    two, one = sweep("cpo", "ppo-lag"), sweep("cpo")
    drawing.draw(two, tmp_path)
    before = figures()
    for suffix in ("png", "pdf"):
        (tmp_path / f"learning-curves_mine.{suffix}").write_text("the user's")
        (tmp_path / f"photo.{suffix}").write_text("the user's")
    report = tmp_path / "report.md"
    report.write_text(f"{report.read_text()}\n![photo](photo.png)\n")
    own = {"learning-curves_mine", "photo"}
    drawing.sketch(one, tmp_path)
    gone = {stem for stem in before if "ppo-lag" in stem}
    assert gone
    assert figures() == (before | own) - gone

    def mistaken(*_: object, **__: object) -> None:
        raise KeyError("river")

    drawing.draw(one, tmp_path)
    monkeypatch.setattr(learning_curves, "curricula", mistaken)
    with pytest.raises(KeyError, match="river"):
        drawing.draw(one, tmp_path)
    assert figures() == (before | own) - gone - {"curricula"}


def test_nothing_to_draw_is_one_clear_sentence(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "empty")
    with pytest.raises(NothingToDrawError) as caught:
        drawing.draw(sweep_data.load(store), tmp_path / "figures")
    assert str(caught.value) == (
        "empty: nothing to draw yet, because no trial has committed a policy update (0 trials)"
    )
    assert not (tmp_path / "figures").exists()


class Strict(HTMLParser):
    """Reads a page; every tag that is opened must be closed, in order.

    Attributes:
        outside: what the page would fetch or leads to.
        text: what it shows.
    """

    EMPTY = ("meta", "link", "img", "input")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.outside: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.EMPTY:
            self.open.append(tag)
        addresses = (value or "" for name, value in attrs if name in ("src", "href"))
        self.outside += [address for address in addresses if not address.startswith("data:")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_holds_everything_and_fetches_nothing(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path
) -> None:
    store = made_up_sweep(
        seeds=1,
        tasks=["<b>bold & wide"],
        agents=["cpo"],
        methods=["none", "linear"],
        failed=["<b>bold & wide cpo linear seed 0"],
    )
    trial = store.trials()[0]
    commit_file(trial, "provenance.json", '{"torch": "9.9"}')
    store.write_specs([trial.spec], b"name: made-up  # <script>alert(1)</script>\n")
    drawing.sketch(sweep_data.load(store), tmp_path / "figures")  # the page is made as by draw
    reader = Strict()
    reader.feed((tmp_path / "figures" / "report.html").read_text())
    assert reader.open == []
    assert reader.outside == ["learning-curves_cpo.png", "curricula.png"]
    assert set(reader.outside) <= {path.name for path in (tmp_path / "figures").iterdir()}
    for sentence in ("<b>bold & wide", "<script>alert(1)</script>", '{"torch": "9.9"}', "Provenance"):
        assert sentence in reader.text


@pytest.mark.usefixtures("laid_out")
def test_a_sweep_in_which_no_episode_has_finished_can_be_drawn(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path
) -> None:
    sweep = sweep_data.load(made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["none", "step"]))
    updates = sweep.updates.assign(episode_return=np.nan, cost_0=np.nan)
    files = drawing.draw(dataclasses.replace(sweep, updates=updates), tmp_path)
    assert not [path for path in files if path.stem.startswith("learning-curves")]
    assert (tmp_path / "diagnostics_a_cpo.png").exists()
    assert "no episode has finished, so there are no learning curves" in (tmp_path / "report.md").read_text()
