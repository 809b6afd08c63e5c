"""Performance profiles show the share of runs above each return."""

import dataclasses

import numpy as np
import pytest

from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.figures.profiles import feasible_scores, performance_profiles
from recrl.analysis.figures.styles import STYLES
from recrl.analysis.statistics.metrics import Measure, outcomes


def test_a_profile_falls_by_a_run_at_the_return_of_each_run(finished: Sweep) -> None:
    figure = performance_profiles(finished, Measure.STOCHASTIC)
    assert figure is not None
    panel = figure.axes[0]
    assert panel.get_title(loc="left") == "river-a, ppo-lag"
    (line,) = (line for line in panel.get_lines() if line.get_color() == STYLES["none"].colour)
    rows = outcomes(finished).query(
        "task == 'river-a' and agent == 'ppo-lag' and method == 'none' and measure == 'stochastic'"
    )
    thresholds, shares = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
    returns = rows["episode_return"].to_numpy()
    assert shares == pytest.approx([(returns > threshold).mean() for threshold in thresholds])
    assert (shares[0], shares[-1]) == (1.0, 0.0)
    assert set(returns) < set(thresholds)
    assert line.get_drawstyle() == "steps-post"  # vertical at a return, and level up to the next one


def test_infeasible_runs_count_as_the_worst(finished: Sweep) -> None:
    rows = outcomes(finished).query("measure == 'stochastic'").head(3).assign(feasible=[True, False, True])
    scores = feasible_scores(rows)[:, 0]
    assert scores[1] == -np.inf
    assert scores[[0, 2]].tolist() == rows["episode_return"].iloc[[0, 2]].tolist()
    high = finished.evaluations.assign(cost_0=100.0)
    figure = performance_profiles(dataclasses.replace(finished, evaluations=high), Measure.STOCHASTIC)
    assert figure is not None
    methods = [line for line in figure.axes[0].get_lines() if len(np.asarray(line.get_xdata())) > 2]
    assert all(np.asarray(line.get_ydata()).max() == 0.0 for line in methods)


def test_failed_trials_count_as_the_worst(finished: Sweep) -> None:
    broken = (finished.trials["method"] == "none") & (finished.trials["seed"] > 0)
    broken |= finished.trials["method"] == "dynamic"
    trials = finished.trials.assign(status=finished.trials["status"].mask(broken, "failed"))
    figure = performance_profiles(dataclasses.replace(finished, trials=trials), Measure.STOCHASTIC)
    assert figure is not None
    highest = {
        method: max(
            np.asarray(line.get_ydata()).max()
            for line in figure.axes[0].get_lines()
            if line.get_color() == STYLES[method].colour
        )
        for method in ("none", "linear", "dynamic")
    }
    assert highest == pytest.approx({"none": 1 / 3, "linear": 1.0, "dynamic": 0.0})
    (legend,) = figure.legends
    assert {text.get_text() for text in legend.get_texts()} == {"none", "linear", "dynamic"}


def test_without_a_complete_trial_there_is_no_profile(finished: Sweep) -> None:
    trials = finished.trials.assign(status="running")
    assert performance_profiles(dataclasses.replace(finished, trials=trials), Measure.STOCHASTIC) is None


def test_an_agent_that_always_failed_is_drawn_at_0(finished: Sweep) -> None:
    lost = finished.trials["agent"] == "cpo"
    trials = finished.trials.assign(status=finished.trials["status"].astype(str).mask(lost, "failed"))
    figure = performance_profiles(dataclasses.replace(finished, trials=trials), Measure.STOCHASTIC)
    assert figure is not None
    titles = {axes.get_title(loc="left"): axes for axes in figure.axes}
    assert any(title.endswith(", cpo") for title in titles)
    for title, axes in titles.items():
        lines = [line for line in axes.get_lines() if len(np.atleast_1d(line.get_xdata())) > 2]
        highest = max(float(np.max(line.get_ydata())) for line in lines)
        assert (highest == 0.0) == title.endswith(", cpo")
