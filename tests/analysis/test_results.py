"""What is committed under results/rivergrid can be drawn again from its compact file, pixel by pixel."""

from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

from recrl.analysis.data import export
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import styles
from recrl.analysis.report import figure_list, table_files
from recrl.analysis.statistics.cumulative_cost import cumulative_costs

RESULTS = Path(__file__).parents[2] / "results" / "rivergrid"
PINNED = "matplotlib==" + mpl.__version__
pytestmark = pytest.mark.skipif(
    PINNED not in (RESULTS.parent.parent / "constraints.txt").read_text().split(),
    reason="another matplotlib than the pinned one draws other pixels",
)


@pytest.fixture(scope="module")
def rivergrid() -> Sweep:
    return export.load(RESULTS / "rivergrid.zip")


@pytest.mark.parametrize(
    "stem", ["learning-curves_cpo", "curricula", "policies_ppo-lag", "return-against-cost"]
)
def test_figures_are_redrawn_pixel_by_pixel(rivergrid: Sweep, tmp_path: Path, stem: str) -> None:
    figure = figure_list.drawings(rivergrid)[stem].make()
    assert figure is not None
    redrawn = styles.save_png(figure, tmp_path / "figure.png")
    with Image.open(redrawn) as one, Image.open(RESULTS / "figures" / f"{stem}.png") as other:
        assert np.array_equal(np.asarray(one), np.asarray(other))


def test_every_committed_figure_has_its_drawing(rivergrid: Sweep) -> None:
    committed = {path.stem for path in (RESULTS / "figures").glob("*.png")}
    assert committed == set(figure_list.drawings(rivergrid))


def test_tables_are_rewritten_byte_by_byte(rivergrid: Sweep, tmp_path: Path) -> None:
    written, _ = table_files.write_tables(rivergrid, tmp_path)
    names = {path.name for path in written}
    assert names == {path.name for path in (RESULTS / "figures").iterdir() if path.suffix in (".csv", ".tex")}
    for name in names:
        assert (tmp_path / name).read_bytes() == (RESULTS / "figures" / name).read_bytes(), name


def test_measured_cost_lies_under_the_bounds_on_river_grid(rivergrid: Sweep) -> None:
    rows = cumulative_costs(rivergrid)
    assert len(rows) == 100
    assert (rows["cost_sum"] < rows["ceiling_sum"]).all()
    cpo = rows[rows["agent"] == "cpo"]
    assert (cpo["cost_sum"] < cpo["bound"]).all()


def test_proposition_1_is_tighter_with_the_runs_own_advantages_and_still_above_the_cost(
    rivergrid: Sweep,
) -> None:
    own = cumulative_costs(rivergrid).query("agent == 'cpo'")
    unaware = replace(rivergrid, updates=rivergrid.updates.drop(columns="cost_advantage_max_0"))
    crude = cumulative_costs(unaware).query("agent == 'cpo'")
    assert len(own) == len(crude) == 50
    # the discounted cost, which the bound is on, is at most the measured one
    assert (own["cost_sum"] < own["discounted_bound"]).all()
    assert (own["discounted_bound"] < crude["discounted_bound"]).all()
    assert own["cost_sum"].tolist() == crude["cost_sum"].tolist()
