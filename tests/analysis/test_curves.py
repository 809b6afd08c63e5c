"""Learning curves over seeds."""

import math

import numpy as np
import pandas as pd
import pytest

from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.statistics import curves
from recrl.analysis.statistics.intervals import interquartile_mean, stratified_bootstrap
from tests.analysis.rows import only


def curve_rows(rows: list[tuple[int, int, int, float]]) -> pd.DataFrame:
    """Updates from (seed, end_step, episodes, episode_return)."""
    return pd.DataFrame(rows, columns=["seed", "end_step", "episodes", "episode_return"])


def test_no_bin_mixes_the_phases() -> None:
    edges = curves.step_grid(95, 100, updates=20, bins=100)
    assert edges.tolist() == pytest.approx([*range(0, 100, 5), 100])
    assert 95_000 in curves.step_grid(95_000, 100_000, updates=316, bins=100)
    assert curves.step_grid(100, 100, updates=4, bins=100).tolist() == [0, 25, 50, 75, 100]


def test_a_bin_weights_updates_with_their_episodes() -> None:
    rows = curve_rows([(0, 5, 1, 10.0), (0, 10, 3, 2.0), (0, 20, 0, math.nan)])
    runs = curves.binned_runs(rows, "episode_return", np.array([0.0, 10.0, 20.0]))
    assert runs[0, 0] == 4.0  # (10 + 3 x 2) / 4
    assert math.isnan(runs[0, 1])


def test_limits_weigh_every_update_once() -> None:
    rows = curve_rows([(0, 5, 1, 0.0), (0, 10, 9, 0.0)]).assign(limit_0=[30.0, 10.0])
    assert curves.binned_runs(rows, "limit_0", np.array([0.0, 10.0]))[0, 0] == 20.0


def test_a_curve_is_the_mean_and_standard_error_over_seeds() -> None:
    rows = curve_rows([(0, 10, 1, 1.0), (1, 10, 7, 2.0), (2, 10, 1, 6.0), (0, 20, 1, 5.0)])
    curve = curves.mean_curve(rows, "episode_return", np.array([0.0, 10.0, 20.0]))
    assert curve.steps.tolist() == [5.0, 15.0]
    assert curve.centre.tolist() == [3.0, 5.0]
    assert curve.high[0] - curve.centre[0] == pytest.approx(math.sqrt(7.0 / 3.0))
    assert math.isnan(curve.low[1])


def test_curves_on_one_bin_equal_the_phase_means(finished: Sweep) -> None:
    one = finished.updates[(finished.updates["task"] == "river-a") & (finished.updates["agent"] == "cpo")]
    linear = one[one["method"] == "linear"]
    runs = curves.binned_runs(linear, "episode_return", np.array([0.0, 15_200.0, 16_000.0]))
    for seed in range(3):
        key = {"task": "river-a", "agent": "cpo", "method": "linear", "seed": seed}
        row = only(finished.phases, **key, phase="deployment")
        assert runs[seed, 1] == pytest.approx(row["episode_return"], abs=1e-3)


def test_an_interquartile_curve_is_robust_and_has_a_band() -> None:
    rows = curve_rows(
        [(seed, 10, 1, value) for seed, value in enumerate([-90.0, 1.0, 2.0, 6.0, 90.0])] + [(0, 20, 1, 5.0)]
    )
    edges = np.array([0.0, 10.0, 20.0, 30.0])
    curve = curves.interquartile_curve(rows, "episode_return", edges, np.random.default_rng(0))
    assert curve.centre.tolist()[:2] == [3.0, 5.0]
    assert curve.low[0] < 3.0 < curve.high[0]
    assert np.isnan([curve.low[1], curve.high[1], curve.centre[2]]).all()


def test_a_band_is_the_bootstrap_interval_of_each_bin() -> None:
    scores = np.random.default_rng(1).normal(size=12)
    rows = curve_rows([(seed, 10, 1, value) for seed, value in enumerate(scores.tolist())])
    curve = curves.interquartile_curve(
        rows, "episode_return", np.array([0.0, 10.0]), np.random.default_rng(0)
    )
    interval = stratified_bootstrap(scores[:, None], interquartile_mean, np.random.default_rng(2))
    assert (curve.low[0], curve.high[0]) == pytest.approx((interval.low, interval.high), abs=0.1)


def test_too_few_seeds_for_a_band_are_named() -> None:
    averaging = curves.interquartile(np.random.default_rng(0))
    assert averaging.describe([10]) == "interquartile mean and its 95% bootstrap band over seeds"
    assert averaging.describe([12, 5]).endswith("; 5 seeds are too few for it: the band is too narrow")
    assert curves.MEAN.describe([2]) == "mean ± standard error over seeds"


def test_a_line_of_one_seed_does_not_hide_what_the_bands_of_the_others_are() -> None:
    assert curves.MEAN.describe([1, 1]) == "one seed, no interval"
    assert (
        curves.MEAN.describe([3, 1]) == "mean ± standard error over seeds; a line without a band is one seed"
    )
    averaging = curves.interquartile(np.random.default_rng(0))
    assert averaging.describe([12, 1]).endswith("over seeds; a line without a band is one seed")
