"""A finished sweep in one file: what comes back, and what it leaves out."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from recrl.analysis import compact, frames, report
from recrl.analysis.frames import Sweep, drawn_columns
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.store import SweepStore


@pytest.fixture(scope="module")
def restored(finished: Sweep, tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    return compact.load(compact.save(finished, tmp_path_factory.mktemp("compact") / "sweep.zip"))


@pytest.mark.parametrize("name", ["trials", "phases", "evaluations", "events", "policies"])
def test_outcomes_are_exact(restored: Sweep, finished: Sweep, name: str) -> None:
    pd.testing.assert_frame_equal(getattr(restored, name), getattr(finished, name), check_exact=True)


def test_updates_are_rounded_and_only_what_is_drawn(restored: Sweep, finished: Sweep) -> None:
    expected = finished.updates[drawn_columns(map(str, finished.updates))]
    assert list(restored.updates[expected.columns]) == list(expected)
    pd.testing.assert_frame_equal(restored.updates[expected.columns], expected, rtol=1e-5)
    assert (
        restored.updates["episode_return"].map(lambda value: len(f"{abs(value):.12g}".strip("0."))).max() <= 8
    )


def test_settings_and_provenance_come_back(restored: Sweep, finished: Sweep) -> None:
    assert restored.facts == finished.facts
    assert (restored.name, restored.grid, restored.notes) == (finished.name, finished.grid, finished.notes)


def test_saving_again_gives_equal_bytes(restored: Sweep, finished: Sweep, tmp_path: Path) -> None:
    first, second = compact.save(finished, tmp_path / "1.zip"), compact.save(restored, tmp_path / "2.zip")
    assert first.read_bytes() == second.read_bytes()


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image).astype(int)


def test_all_figures_and_tables_are_drawn_from_it(
    made_up_sweep: Callable[..., SweepStore], tmp_path: Path
) -> None:
    store = made_up_sweep(
        seeds=2, tasks=["a"], agents=["cpo"], methods=["none", "step"], failed=["a cpo step seed 1"]
    )
    sweep = frames.load(store)
    small = compact.load(compact.save(sweep, tmp_path / "sweep.zip"))
    drawn = report.draw(sweep, tmp_path / "files")
    again = report.draw(small, tmp_path / "compact")
    assert [path.name for path in drawn] == [path.name for path in again]
    rounded = ("bounds.csv", "report.html", "report.md")  # sums over rounded updates, and pages with them
    for one, other in zip(drawn, again, strict=True):
        if one.suffix == ".png":  # a rounded curve is at the same place, but for its soft edges
            assert np.abs(pixels(one) - pixels(other)).max() <= 4, one.name
        elif one.suffix != ".pdf" and one.name not in rounded:
            assert one.read_bytes() == other.read_bytes(), one.name


def test_what_is_no_compact_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "none.zip"
    with pytest.raises(RecrlError, match=r"none\.zip: cannot be read as a sweep's compact file"):
        compact.load(path)
    path.write_text("nothing")
    with pytest.raises(RecrlError, match="File is not a zip file"):
        compact.load(path)


def test_significant_digits() -> None:
    values = np.array([123456.7, 1.2345678e-9, -0.1, np.inf])
    assert compact._significant(values).tolist() == [123457.0, 1.23457e-9, -0.1, np.inf]
