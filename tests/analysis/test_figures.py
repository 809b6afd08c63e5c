"""The paper's figures show what the frames hold."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from PIL import Image

from recrl.agents.trust_region.cpo_dual import StepCase
from recrl.analysis.data import sweep_data
from recrl.analysis.data.labels import METHOD_ORDER
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures import learning_curves, styles
from recrl.analysis.figures.diagnostics import RECOVERY_CASE, curriculum_diagnostics
from recrl.analysis.figures.frontier import concave_frontier, return_against_cost
from recrl.analysis.figures.styles import IN_FORCE_COLOUR, LIMIT_COLOUR, OPTIMUM_COLOUR, STYLES
from recrl.analysis.report.figure_list import drawings
from recrl.orchestrator.files.sweep_store import SweepStore


def lines_of(axes: Axes, colour: str) -> list[Line2D]:
    return [line for line in axes.get_lines() if line.get_color() == colour]


def legend_texts(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


@pytest.fixture
def panel(finished: Sweep) -> Sweep:
    """One task and one agent, for what is only drawn to be saved."""
    updates = finished.updates
    one = (updates["task"] == "river-a") & (updates["agent"] == "cpo")
    return dataclasses.replace(finished, updates=updates[one])


def test_a_row_a_task_and_four_columns(finished: Sweep) -> None:
    figure = learning_curves.learning_curves(finished, "cpo")
    assert len(figure.axes) == 2 * 4
    assert [axes.get_title() for axes in figure.axes[:4]] == [
        "return",
        "return in deployment",
        "episode cost",
        "cost in deployment",
    ]
    assert figure.axes[0].get_ylabel() == "river-a\n3 seeds, 16k steps"


def test_curves_limit_boundary_and_optimum_are_where_the_frames_say(finished: Sweep) -> None:
    returns, _, costs, deployed = learning_curves.learning_curves(finished, "cpo").axes[:4]
    for method in ("none", "linear", "dynamic"):
        assert len(lines_of(returns, STYLES[method].colour)) == 1
    boundary = lines_of(returns, "black")[0]
    assert list(np.asarray(boundary.get_xdata())) == [15_200, 15_200]
    assert lines_of(costs, LIMIT_COLOUR)[0].get_ydata() == [5.0, 5.0]
    assert lines_of(returns, OPTIMUM_COLOUR)[0].get_ydata() == [14.0, 14.0]
    assert deployed.get_xlim() == (15_200, 16_000)


def test_the_limit_can_be_read_where_costs_start_high(finished: Sweep) -> None:
    costs = learning_curves.learning_curves(finished, "cpo").axes[2]
    assert costs.get_yscale() == "symlog"
    assert 5.0 in costs.get_yticks()
    assert -5.0 < costs.get_ylim()[0] < 0.0


def test_low_costs_stay_on_a_linear_axis(finished: Sweep) -> None:
    updates = finished.updates.assign(cost_0=finished.updates["cost_0"].clip(upper=20.0))
    costs = learning_curves.learning_curves(dataclasses.replace(finished, updates=updates), "cpo").axes[2]
    assert costs.get_yscale() == "linear"


def test_two_costs_have_six_columns(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(seeds=1, num_costs=2, tasks=["a"], agents=["cpo"], methods=["none", "step"])
    figure = learning_curves.learning_curves(sweep_data.load(store), "cpo")
    assert [axes.get_title() for axes in figure.axes][4:] == ["episode cost 1", "cost 1 in deployment"]
    assert len(learning_curves.curricula(sweep_data.load(store)).axes) == 2


def test_curricula_show_every_run_and_the_mean(finished: Sweep) -> None:
    figure = learning_curves.curricula(finished)
    assert len(figure.axes) == 4
    dynamic = lines_of(figure.axes[0], STYLES["dynamic"].colour)
    assert len(dynamic) == 3 + 1 + 1  # runs, the agent's own mean cost, the mean limit
    assert max(line.get_linewidth() for line in dynamic) > 3 * min(line.get_linewidth() for line in dynamic)


def test_an_agents_task_that_has_not_run_has_an_empty_panel_of_limits(finished: Sweep) -> None:
    missing = (finished.updates["task"] == "river-a") & (finished.updates["agent"] == "cpo")
    rest = dataclasses.replace(finished, updates=finished.updates[~missing])
    titles = [axes.get_title(loc="left") for axes in learning_curves.curricula(rest).axes]
    assert [title for title in titles if "nothing run yet" in title] == ["cpo\nriver-a: nothing run yet"]


def test_infinite_limits_are_marked(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=["none", "unconstrained"])
    panel = learning_curves.curricula(sweep_data.load(store)).axes[0]
    assert [text.get_text().strip() for text in panel.texts] == ["∞"]


def test_infinite_limits_of_two_curricula_do_not_hide_each_other(finished: Sweep) -> None:
    updates = finished.updates
    infinite = updates["method"].isin(["linear", "dynamic"]) & (updates["end_step"] <= 8000)
    sweep = dataclasses.replace(
        finished, updates=updates.assign(limit_0=updates["limit_0"].mask(infinite, np.inf))
    )
    panel = learning_curves.curricula(sweep).axes[0]
    marks = {
        str(line.get_color()): list(np.asarray(line.get_ydata()))
        for line in panel.get_lines()
        if line.get_transform() == panel.get_xaxis_transform()
        and len(np.asarray(line.get_xdata())) == 2
        and line.get_color() != "black"
    }
    assert marks[STYLES["linear"].colour] == [1.0, 1.0]
    assert 0.9 < marks[STYLES["dynamic"].colour][0] < 1.0
    assert len({it.get_position() for it in panel.texts}) == 2


def test_the_measurement_of_the_training_limit_is_not_marked(finished: Sweep) -> None:
    updates = finished.updates
    trials = finished.trials.assign(start_limit_0=60.0)
    for measured, shown in ((1600, 0), (0, 2)):  # 10% of a trial, or a limit that is infinite later
        of_linear = (updates["method"] == "linear") & (updates["end_step"] <= 1600) & (measured > 0)
        of_linear |= (updates["method"] == "linear") & (updates["end_step"] == 4000) & (measured == 0)
        infinite = updates.assign(limit_0=updates["limit_0"].mask(of_linear, np.inf))
        figure = learning_curves.curricula(dataclasses.replace(finished, trials=trials, updates=infinite))
        assert sum(len(axes.texts) for axes in figure.axes[:2]) == shown


def test_a_cell_of_one_seed_does_not_change_what_the_bands_are_called(finished: Sweep) -> None:
    updates = finished.updates
    one = (updates["task"] == "river-a") & (updates["method"] == "none") & (updates["seed"] > 0)
    figure = learning_curves.learning_curves(dataclasses.replace(finished, updates=updates[~one]), "cpo")
    assert figure.legends[0].get_title().get_text() == (
        "cpo: mean ± standard error over seeds; a line without a band is one seed"
    )


def test_the_shaded_region_is_called_above_the_limit(finished: Sweep) -> None:
    figures = [return_against_cost(finished), learning_curves.learning_curves(finished, "cpo")]
    figures += [learning_curves.curricula(finished), curriculum_diagnostics(finished, "river-a", "cpo")]
    for figure in figures:
        assert figure is not None
        assert "above $d_d$" in legend_texts(figure)  # a policy there may be feasible within the tolerance


def test_diagnostics_of_each_of_several_costs(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(seeds=1, num_costs=2, tasks=["a"], agents=["cpo"], methods=["none"], updates=20)
    sweep = sweep_data.load(store)
    sweep = dataclasses.replace(
        sweep, updates=sweep.updates.assign(cost_1=3.0, explained_variance_cost_1=0.5)
    )
    figures = {stem: it for stem, it in drawings(sweep).items() if it.kind == "diagnostics"}
    assert list(figures) == ["diagnostics_a_cpo", "diagnostics_a_cpo_cost-1"]
    assert [it.about for it in figures.values()] == [("a", "cpo", "cost 0"), ("a", "cpo", "cost 1")]
    figure = figures["diagnostics_a_cpo_cost-1"].make()
    assert figure is not None
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels[0] == "cost 1"
    assert "explained\nvariance, cost 1" in labels
    assert set(np.asarray(lines_of(figure.axes[0], STYLES["none"].colour)[0].get_ydata())) == {3.0}


def test_diagnostics_draw_the_explained_variance_of_their_own_cost_critic(finished: Sweep) -> None:
    critics = {"reward": 0.9, "cost_0": 0.5, "cost_1": 0.1}
    updates = finished.updates.assign(**{f"explained_variance_{name}": it for name, it in critics.items()})
    figure = curriculum_diagnostics(dataclasses.replace(finished, updates=updates), "river-a", "cpo")
    drawn = {
        axes.get_ylabel(): set(np.asarray(lines_of(axes, STYLES["none"].colour)[0].get_ydata()).round(6))
        for axes in figure.axes[::3]
    }
    assert drawn["explained\nvariance, reward"] == {0.9}
    assert drawn["explained\nvariance, cost"] == {0.5}


def test_a_running_sweep_says_how_many_seeds_have_arrived(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(
        seeds=2, tasks=["a"], agents=["cpo"], methods=["none"], unfinished=["a cpo none seed 1"]
    )
    figure = learning_curves.learning_curves(sweep_data.load(store), "cpo")
    assert figure.axes[0].get_ylabel() == "a\n1–2 seeds, 16k steps"


def test_one_seed_before_deployment_can_be_drawn(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(
        seeds=1, tasks=["a"], agents=["cpo"], methods=["none"], unfinished=["a cpo none seed 0"]
    )
    sweep = sweep_data.load(store)
    assert "not yet" in [
        text.get_text() for text in learning_curves.learning_curves(sweep, "cpo").axes[1].texts
    ]
    assert len(learning_curves.curricula(sweep).axes) == 1


def test_the_frontier_is_sampled_where_it_bends() -> None:
    asked: list[float] = []

    def optimum(limit: float) -> float:  # RiverGrid 1a: -20 + 5.9 d up to 5, then flat
        asked.append(limit)
        return min(-20.0 + 5.9 * limit, 9.5)

    points = concave_frontier(optimum, 12.0, tolerance=0.05)
    exact = [min(-20.0 + 5.9 * limit, 9.5) for limit in np.linspace(0.0, 12.0, 200)]
    assert np.interp(np.linspace(0.0, 12.0, 200), *points.T) == pytest.approx(exact, abs=0.1 * 5.9)
    assert len(asked) < 25


def test_final_policies_lie_under_the_frontier_left_of_the_shaded_region(finished: Sweep) -> None:
    figure = return_against_cost(finished)
    assert figure is not None
    assert [axes.get_title() for axes in figure.axes[:2]] == ["ppo-lag", "cpo"]
    assert figure.axes[0].get_ylabel() == "river-a\nreturn"
    panel = figure.axes[0]
    frontier = np.asarray(lines_of(panel, OPTIMUM_COLOUR)[0].get_xydata())
    assert [5.0, 14.0] in frontier.tolist()
    assert "best return $J^*(d)$, where known" in legend_texts(figure)
    feasible = [len(np.asarray(marks.get_facecolor())) for marks in panel.collections]
    assert feasible[:2] == [3, 3]  # filled
    runs = [np.asarray(marks.get_offsets()).tolist() for marks in panel.collections]
    assert runs[0] == [[4.8, 8.0], [0.5, -15.0], [0.5, -15.0]]  # none
    assert runs[1] == [[4.8, 8.0]] * 3
    shaded = [patch for patch in panel.patches if isinstance(patch, Rectangle)]
    assert [patch.get_x() for patch in shaded] == [5.0]


def test_a_cost_beyond_the_axis_is_on_the_right_edge_and_the_legend_says_so(finished: Sweep) -> None:
    near = return_against_cost(finished)
    far = return_against_cost(
        dataclasses.replace(finished, evaluations=finished.evaluations.assign(cost_0=51.0))
    )
    assert near is not None and far is not None
    titles = ["\n".join(it.get_title().get_text() for it in figure.legends) for figure in (near, far)]
    assert ["marks on the right edge: the cost is beyond the axis" in title for title in titles] == [
        False,
        True,
    ]
    assert np.asarray(far.axes[0].collections[0].get_offsets())[0].tolist()[0] == 50.0  # ten times the limit


def test_a_panel_without_a_complete_trial_says_so(finished: Sweep) -> None:
    missing = (finished.trials["task"] == "river-a") & (finished.trials["agent"] == "cpo")
    failed = finished.trials["status"].where(~missing, "failed")
    figure = return_against_cost(dataclasses.replace(finished, trials=finished.trials.assign(status=failed)))
    assert figure is not None
    texts = [[text.get_text() for text in axes.texts] for axes in figure.axes]
    assert texts == [[], ["no complete trial"], [], []]


def test_a_legend_is_read_row_by_row_in_even_rows(made_up_sweep: Callable[..., SweepStore]) -> None:
    methods = ["none", "linear", "cosine", "exponential", "dynamic"]
    store = made_up_sweep(seeds=1, tasks=["a"], agents=["cpo"], methods=methods)
    above = learning_curves.curricula(sweep_data.load(store)).legends[0]
    columns = [["none", "exponential"], ["linear", "dynamic"], ["cosine"]]
    assert [text.get_text() for text in above.get_texts()] == [name for column in columns for name in column]


def test_without_a_known_optimum_there_are_policies_and_limits_but_no_frontier(finished: Sweep) -> None:
    trials = finished.trials.assign(optimal_return=np.nan)
    figure = return_against_cost(dataclasses.replace(finished, trials=trials))
    assert figure is not None
    assert len(np.asarray(lines_of(figure.axes[0], OPTIMUM_COLOUR)[0].get_xydata())) == 0
    assert lines_of(figure.axes[0], LIMIT_COLOUR)[0].get_xdata() == [5.0, 5.0]
    assert "limit $d_d$" in legend_texts(figure)
    assert not any("best return" in text for text in legend_texts(figure))


def test_the_frontier_begins_at_the_least_limit_that_a_policy_keeps() -> None:
    def optimum(limit: float) -> float:
        return min(2.0 * math.sqrt(limit - 2.0), 3.0) if limit >= 2.0 else -math.inf

    points = concave_frontier(optimum, 10.0, tolerance=0.003)
    assert np.isfinite(points).all()
    assert points[0, 0] == pytest.approx(2.0, abs=0.01)
    middles = (points[1:, 0] + points[:-1, 0]) / 2.0
    below = [optimum(middle) - np.interp(middle, *points.T) for middle in middles]
    assert max(below) < 0.1


def test_thirteen_curricula_look_different() -> None:
    look = styles.method_styles([f"mine-{index}" for index in range(13)])
    assert len(set(look.values())) == 13
    assert len({(style.dashes, style.colour) for style in look.values()}) == 13


def test_each_cost_has_its_own_row(made_up_sweep: Callable[..., SweepStore]) -> None:
    store = made_up_sweep(seeds=1, num_costs=2, tasks=["a"], agents=["cpo"], methods=["linear"])
    figure = return_against_cost(sweep_data.load(store))
    assert figure is not None
    assert [axes.get_xlabel() for axes in figure.axes] == ["episode cost 0", "episode cost 1"]


def test_costs_equal_to_the_limit_do_not_fill_a_panel_with_rounding_errors(panel: Sweep) -> None:
    updates = panel.updates.assign(cost_0=5.001, episode_return=14.001)
    drawn = learning_curves.learning_curves(dataclasses.replace(panel, updates=updates), "cpo")
    _, returns, costs, magnified = drawn.axes[:4]
    assert magnified.get_ylim()[0] <= 4.0
    assert magnified.get_ylim()[1] >= 6.0
    assert np.diff(returns.get_ylim()) >= 0.8
    assert all(any(isinstance(it, Rectangle) for it in axes.patches) for axes in (costs, magnified))


def test_diagnostics_show_limit_cost_multiplier_and_noise(finished: Sweep) -> None:
    figure = curriculum_diagnostics(finished, "river-a", "cpo")
    assert len(figure.axes) == 3 * 3
    assert [axes.get_title() for axes in figure.axes[:3]] == ["none", "linear", "dynamic"]
    assert [axes.get_ylabel() for axes in figure.axes[::3]] == [
        "cost\nlog above $d_d$",
        "multiplier",
        "KL divergence",
    ]
    dynamic = figure.axes[2]
    assert len(lines_of(dynamic, IN_FORCE_COLOUR)) == 3
    (limit,) = lines_of(dynamic, LIMIT_COLOUR)
    assert (
        limit.get_linestyle()
        == lines_of(learning_curves.learning_curves(finished, "cpo").axes[2], LIMIT_COLOUR)[0].get_linestyle()
        == "--"
    )
    ticks = [line for line in dynamic.get_lines() if line.get_transform() == dynamic.get_xaxis_transform()]
    (marks,) = (line for line in ticks if line.get_color() != "black")
    assert list(np.asarray(marks.get_xdata())) == [4_000.0, 8_000.0, 12_000.0]
    assert marks.get_marker() == "|"


def test_diagnostics_mark_recovery_steps(finished: Sweep) -> None:
    case = np.where(finished.updates["end_step"] == 800, 2.0, 1.0)
    sweep = dataclasses.replace(finished, updates=finished.updates.assign(case=case))
    panel = curriculum_diagnostics(sweep, "river-a", "cpo").axes[6]
    marks = [line for line in panel.get_lines() if list(np.asarray(line.get_xdata())) == [800.0]]
    assert [line.get_marker() for line in marks] == ["x"]  # noise has another mark


def test_diagnostics_draw_the_target_of_the_kl_divergence(finished: Sweep) -> None:
    facts = [
        dataclasses.replace(
            it,
            spec=dataclasses.replace(
                it.spec, agent=dataclasses.replace(it.spec.agent, options={"target_kl": 0.02})
            ),
        )
        for it in finished.facts
    ]
    panel = curriculum_diagnostics(dataclasses.replace(finished, facts=tuple(facts)), "river-a", "cpo").axes[
        6
    ]
    assert [0.02, 0.02] in [list(np.asarray(line.get_ydata())) for line in panel.get_lines()]


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
    first = styles.save(learning_curves.curricula(panel), tmp_path / "first", "curricula")
    second = styles.save(learning_curves.curricula(panel), tmp_path / "second", "curricula")
    assert [path.suffix for path in first] == [".pdf", ".png"]
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_figures_have_print_size(panel: Sweep, tmp_path: Path) -> None:
    path = styles.save_png(learning_curves.learning_curves(panel, "cpo"), tmp_path / "curves.png")
    with Image.open(path) as image:
        assert image.width == 7.0 * 200
        assert image.info["dpi"] == pytest.approx((200, 200), abs=0.1)


def test_the_users_matplotlib_is_left_alone_and_leaves_ours_alone(panel: Sweep, tmp_path: Path) -> None:
    before = dict(mpl.rcParams)
    usual = styles.save_png(learning_curves.curricula(panel), tmp_path / "usual.png").read_bytes()
    assert dict(mpl.rcParams) == before
    with mpl.rc_context({"axes.facecolor": "red", "font.size": 30.0}):
        other = styles.save_png(learning_curves.curricula(panel), tmp_path / "other.png")
    assert other.read_bytes() == usual


def test_the_figure_marks_the_case_of_the_trust_region_agents() -> None:
    assert RECOVERY_CASE == StepCase.RECOVERY
