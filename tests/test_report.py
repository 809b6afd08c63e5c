"""One call draws a sweep, as far as it has come."""

from collections.abc import Callable
from pathlib import Path

import pytest

from recrl.analysis import report
from recrl.analysis.report import NothingToDrawError
from recrl.orchestrator.store import SweepStore


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
    written = report.draw(store, tmp_path / "first")
    assert [path.name for path in written] == [
        "report.md",
        "learning-curves_my-cpo.pdf",
        "learning-curves_my-cpo.png",
        "curricula.pdf",
        "curricula.png",
        "diagnostics_river-a_my-cpo.pdf",
        "diagnostics_river-a_my-cpo.png",
        "return-against-cost.pdf",
        "return-against-cost.png",
        "training.csv",
        "outcomes.csv",
        "summary.csv",
        "comparisons.csv",
        "outcomes.tex",
    ]
    text = written[0].read_text().splitlines()
    assert text[2] == "4 trials: 1 running, 2 complete, 1 failed."
    assert (
        "- river-a my cpo linear seed 1: failed, 50% of its steps done: ValueError: the river froze" in text
    )
    assert "- river-a my cpo linear seed 0: still running, 50% of its steps done" in text
    again = report.draw(store, tmp_path / "second")
    assert [path.read_bytes() for path in written] == [path.read_bytes() for path in again]


def test_before_any_trial_is_complete_there_are_curves_and_no_table(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path
) -> None:
    store = made_up_sweep(
        seeds=1, tasks=["a"], agents=["cpo"], methods=["none"], unfinished=["a cpo none seed 0"]
    )
    names = [path.name for path in report.draw(store, tmp_path)]
    assert "curricula.png" in names
    assert "outcomes.csv" not in names
    assert "No trial is complete yet: no table." in (tmp_path / "report.md").read_text()


def test_nothing_to_draw_is_one_clear_sentence(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "empty")
    with pytest.raises(NothingToDrawError) as caught:
        report.draw(store, tmp_path / "figures")
    assert str(caught.value) == (
        f"{store.folder}: nothing to draw yet, because none of its 0 trials has committed a policy update"
    )
    assert not (tmp_path / "figures").exists()
