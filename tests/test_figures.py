"""The paper's figures show what the frames hold."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from PIL import Image

from recrl.analysis import figures, frames, styles
from recrl.analysis.frames import METHOD_ORDER, Sweep
from recrl.analysis.styles import LIMIT_COLOUR, OPTIMUM_COLOUR, STYLES
from recrl.orchestrator.store import SweepStore


def lines_of(axes: Axes, colour: str) -> list[Line2D]:
    return [line for line in axes.get_lines() if line.get_color() == colour]


@pytest.fixture
def panel(finished: Sweep) -> Sweep:
    """One task and one agent, for what is only drawn to be saved."""
    updates = finished.updates
    one = (updates["task"] == "river-a") & (updates["agent"] == "cpo")
    return dataclasses.replace(finished, updates=updates[one])


def test_a_row_a_task_and_four_columns(finished: Sweep) -> None:
    figure = figures.learning_curves(finished, "cpo")
    assert len(figure.axes) == 2 * 4
    assert [axes.get_title() for axes in figure.axes[:4]] == [
        "return",
        "return in deployment",
        "episode cost",
        "cost in deployment",
    ]
    assert figure.axes[0].get_ylabel() == "river-a\n3 seeds, 16k steps"


def test_curves_limit_boundary_and_optimum_are_where_the_frames_say(finished: Sweep) -> None:
    returns, _, costs, deployed = figures.learning_curves(finished, "cpo").axes[:4]
    for method in ("none", "linear", "dynamic"):
        assert len(lines_of(returns, STYLES[method].colour)) == 1
    boundary = lines_of(returns, "black")[0]
    assert list(np.asarray(boundary.get_xdata())) == [15_200, 15_200]
    assert lines_of(costs, LIMIT_COLOUR)[0].get_ydata() == [5.0, 5.0]
    assert lines_of(returns, OPTIMUM_COLOUR)[0].get_ydata() == [14.0, 14.0]
    assert deployed.get_xlim() == (15_200, 16_000)


def test_the_limit_can_be_read_where_costs_start_high(finished: Sweep) -> None:
    costs = figures.learning_curves(finished, "cpo").axes[2]
    assert costs.get_yscale() == "symlog"
    assert 5.0 in costs.get_yticks()
    assert costs.get_ylim()[0] == 0.0


def test_low_costs_stay_on_a_linear_axis(finished: Sweep) -> None:
    updates = finished.updates.assign(cost_0=finished.updates["cost_0"].clip(upper=20.0))
    costs = figures.learning_curves(dataclasses.replace(finished, updates=updates), "cpo").axes[2]
    assert costs.get_yscale() == "linear"


def test_two_costs_have_six_columns(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(seeds=1, num_costs=2, tasks=["a"], agents=["cpo"], methods=["none", "step"])
    figure = figures.learning_curves(frames.load(store), "cpo")
    assert [axes.get_title() for axes in figure.axes][4:] == ["episode cost 2", "cost 2 in deployment"]
    assert len(figures.curricula(frames.load(store)).axes) == 2


def test_curricula_show_every_run_and_the_mean(finished: Sweep) -> None:
    figure = figures.curricula(finished)
    assert len(figure.axes) == 4
    dynamic = lines_of(figure.axes[0], STYLES["dynamic"].colour)
    assert len(dynamic) == 3 + 1
    assert max(line.get_linewidth() for line in dynamic) > 3 * min(line.get_linewidth() for line in dynamic)


def test_infinite_limits_are_marked(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["none", "unconstrained"])
    panel = figures.curricula(frames.load(store)).axes[0]
    assert [text.get_text().strip() for text in panel.texts] == ["∞"]


def test_a_running_sweep_says_how_many_seeds_have_arrived(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(
        seeds=2, tasks=["a"], agents=["cpo"], methods=["none"], unfinished=["a cpo none seed 1"]
    )
    figure = figures.learning_curves(frames.load(store), "cpo")
    assert figure.axes[0].get_ylabel() == "a\n1–2 seeds, 16k steps"


def test_one_seed_before_deployment_can_be_drawn(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(
        seeds=1, tasks=["a"], agents=["cpo"], methods=["none"], unfinished=["a cpo none seed 0"]
    )
    sweep = frames.load(store)
    assert "not yet" in [text.get_text() for text in figures.learning_curves(sweep, "cpo").axes[1].texts]
    assert len(figures.curricula(sweep).axes) == 1


def test_known_methods_look_the_same_in_every_sweep() -> None:
    few = styles.method_styles(["dynamic", "mine"])
    many = styles.method_styles([*METHOD_ORDER, "mine", "another"])
    assert few["dynamic"] == many["dynamic"]
    assert list(many) == [*METHOD_ORDER, "another", "mine"]


def test_methods_differ_without_colour() -> None:
    looks = [*STYLES.values(), *styles.SPARE_STYLES]
    assert len({(look.dashes, look.marker) for look in looks}) == len(looks)
    assert len({look.colour for look in looks}) == len(looks)


def test_drawing_again_gives_equal_bytes(panel: Sweep, tmp_path: Path) -> None:
    first = styles.save(figures.curricula(panel), tmp_path / "first", "curricula")
    second = styles.save(figures.curricula(panel), tmp_path / "second", "curricula")
    assert [path.suffix for path in first] == [".pdf", ".png"]
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_figures_have_print_size(panel: Sweep, tmp_path: Path) -> None:
    paths = styles.save(figures.learning_curves(panel, "cpo"), tmp_path, "curves")
    with Image.open(paths[1]) as image:
        assert image.width == 7.0 * 200
        assert image.info["dpi"] == pytest.approx((200, 200), abs=0.1)


def test_the_users_matplotlib_is_left_alone_and_leaves_ours_alone(panel: Sweep, tmp_path: Path) -> None:
    before = dict(mpl.rcParams)
    usual = styles.save(figures.curricula(panel), tmp_path, "usual")[1].read_bytes()
    assert dict(mpl.rcParams) == before
    with mpl.rc_context({"axes.facecolor": "red", "font.size": 30.0}):
        assert styles.save(figures.curricula(panel), tmp_path, "other")[1].read_bytes() == usual
