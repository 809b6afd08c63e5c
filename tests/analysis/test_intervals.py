"""Estimators over few seeds: literals by hand, laws, other implementations' numbers, and coverage."""

import math
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from recrl.analysis.statistics.intervals import (
    Difference,
    Interval,
    Statistic,
    group_difference,
    holm,
    improvement_interval,
    interquartile_mean,
    mean_and_standard_error,
    mean_interval,
    paired_difference,
    performance_profile,
    probability_of_improvement,
    stratified_bootstrap,
    wilson_interval,
)
from recrl.environments.cmdp import Floats
from tests.benchmarks.interval_statistics import mean_of_tasks

# Two tables of scores, [5, 3] and [7, 3], and what rliable 1.2.0 says of them (arch 7.2.0).
SCORES = np.array(
    [
        [0.001, 0.299, -0.274],
        [-0.891, -0.455, -0.992],
        [0.060, 1.340, -0.492],
        [-0.620, 0.490, 0.357],
        [0.105, -0.930, -0.029],
    ]
)
OTHERS = np.array(
    [
        [0.995, -1.044, -0.158],
        [-1.601, -0.990, -1.542],
        [0.065, -0.967, 0.571],
        [0.457, 0.113, -2.217],
        [-0.239, 0.251, 0.413],
        [-1.230, -0.178, -0.679],
        [-0.509, 1.361, -0.508],
    ]
)
RLIABLE_IQM = (-0.15611111111111114, -0.34536363636363626)
RLIABLE_IMPROVEMENT = 0.580952380952381
RLIABLE_IQM_INTERVAL = (-0.51366667, 0.13411389)  # 50,000 replications
RLIABLE_IMPROVEMENT_INTERVAL = (0.39047619, 0.77142857)  # 5,000
RLIABLE_PROFILE = [1.0, 7 / 15, 1 / 15]  # at -1, 0 and 1


def generator() -> np.random.Generator:
    return np.random.default_rng(0)


def test_mean_and_standard_error_by_hand() -> None:
    mean, error = mean_and_standard_error(np.array([1.0, 2.0, 3.0, 4.0, 5.0]))
    assert mean == 3.0
    assert error == pytest.approx(math.sqrt(2.5 / 5.0))


def test_one_value_has_no_standard_error_and_none_has_no_mean() -> None:
    mean, error = mean_and_standard_error(np.array([4.0]))
    assert mean == 4.0
    assert math.isnan(error)
    assert all(math.isnan(value) for value in mean_and_standard_error(np.array([])))


def test_student_interval_by_the_printed_table() -> None:
    # t_{4, 0.975} = 2.776 in every table of Student's t
    interval = mean_interval(np.array([1.0, 2.0, 3.0, 4.0, 5.0]))
    assert interval.high - 3.0 == pytest.approx(2.776 * math.sqrt(0.5), abs=1e-3)
    assert 3.0 - interval.low == pytest.approx(interval.high - 3.0)


def test_interquartile_mean_by_hand() -> None:
    assert interquartile_mean(np.arange(1.0, 9.0).reshape(4, 2)) == 4.5  # 3, 4, 5, 6
    assert interquartile_mean(np.array([[-90.0], [1.0], [2.0], [6.0], [90.0]])) == 3.0  # 5 // 4 = 1 off


def test_estimators_equal_those_of_rliable() -> None:
    assert (interquartile_mean(SCORES), interquartile_mean(OTHERS)) == pytest.approx(RLIABLE_IQM, abs=1e-15)
    assert probability_of_improvement(SCORES, OTHERS) == pytest.approx(RLIABLE_IMPROVEMENT, abs=1e-15)
    assert performance_profile(SCORES, np.array([-1.0, 0.0, 1.0])) == pytest.approx(RLIABLE_PROFILE)


def test_bootstrap_intervals_agree_with_those_of_rliable() -> None:
    ours = stratified_bootstrap(SCORES, interquartile_mean, generator(), replications=20_000)
    assert (ours.low, ours.high) == pytest.approx(RLIABLE_IQM_INTERVAL, abs=0.01)
    ours = improvement_interval(SCORES, OTHERS, generator(), replications=5_000)
    assert (ours.low, ours.high) == pytest.approx(RLIABLE_IMPROVEMENT_INTERVAL, abs=0.011)  # steps of 1/105


@given(st.integers(1, 9), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_interquartile_mean_is_scipys_trimmed_mean(runs: int, tasks: int, seed: int) -> None:
    scores = np.random.default_rng(seed).normal(size=(runs, tasks))
    assert interquartile_mean(scores) == pytest.approx(stats.trim_mean(scores, 0.25, axis=None))


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_probability_of_improvement_is_mann_whitneys_u(runs: int, others: int, seed: int) -> None:
    numbers = np.random.default_rng(seed)
    x, y = numbers.integers(0, 5, (runs, 1)).astype(float), numbers.integers(0, 5, (others, 1)).astype(float)
    u = stats.mannwhitneyu(x[:, 0], y[:, 0], alternative="greater", method="asymptotic").statistic
    assert probability_of_improvement(x, y) == pytest.approx(u / (runs * others))


def test_probability_of_improvement_by_hand() -> None:
    # 1 > 0, 1 < 2, 2 > 0, 2 = 2: (1 + 0 + 1 + 1/2) / 4
    assert probability_of_improvement(np.array([[1.0], [2.0]]), np.array([[0.0], [2.0]])) == 0.625


def test_returns_within_the_tolerance_are_ties() -> None:
    # 9.5 = 9.5 - 1e-9, 9.5 > 9: (1/2 + 1) / 2; without a tolerance the first counts as a gain
    scores, others = np.array([[9.5]]), np.array([[9.5 - 1e-9], [9.0]])
    assert probability_of_improvement(scores, others, tie=0.2) == 0.75
    assert probability_of_improvement(others, scores, tie=0.2) == 0.25
    assert probability_of_improvement(scores, others) == 1.0
    interval = improvement_interval(scores, others[:1], generator(), tie=0.2)
    assert interval.estimate == 0.5


def test_improvement_over_oneself_is_a_half() -> None:
    assert probability_of_improvement(SCORES, SCORES) == 0.5


def test_bootstrap_resamples_within_tasks() -> None:
    scores = np.tile(np.array([[1.0, 100.0]]), (12, 1))  # tasks differ, runs do not
    assert stratified_bootstrap(scores, mean_of_tasks, generator()) == Interval(50.5, 50.5, 50.5, 12, False)


def test_bootstrap_says_when_runs_are_too_few() -> None:
    assert stratified_bootstrap(SCORES, interquartile_mean, generator()).is_small
    alone = stratified_bootstrap(SCORES[:1], interquartile_mean, generator())
    assert alone.is_small
    assert math.isnan(alone.low)


def test_a_bootstrap_that_knows_no_other_order_gives_no_interval() -> None:
    apart = improvement_interval(np.array([[3.0], [4.0]]), np.array([[1.0], [2.0]]), generator())
    assert apart.estimate == 1.0
    assert np.isnan([apart.low, apart.high]).all()  # a width of 0 would say that it is certain


def test_equal_generators_give_equal_intervals() -> None:
    first = improvement_interval(SCORES, OTHERS, generator())
    assert first == improvement_interval(SCORES, OTHERS, generator())
    assert first.low <= first.estimate <= first.high


def test_bootstrap_mean_agrees_with_its_exact_distribution() -> None:
    """Of four zeros and four ones the resampled sum is binomial: P(S <= 0) = 0.004, P(S <= 1) = 0.035."""
    scores = np.repeat([0.0, 1.0], 4)[:, None]
    found = stratified_bootstrap(scores, mean_of_tasks, generator())
    assert (found.low, found.high) == (1.0 / 8.0, 7.0 / 8.0)


def test_pairing_removes_what_seeds_share() -> None:
    shared = np.array([-20.0, 0.0, 9.0, 30.0])
    difference = paired_difference(shared + np.array([0.0, 2.0, 0.0, 2.0]), shared)
    reach = 3.182446 * (2.0 / math.sqrt(3.0)) / 2.0  # t_{3, 0.975} s / sqrt(4)
    found = (difference.estimate, difference.low, difference.high)
    assert found == pytest.approx((1.0, 1.0 - reach, 1.0 + reach), abs=1e-5)


def test_paired_test_by_the_printed_table() -> None:
    # differences 1 ... 5: t = 3 / sqrt(0.5), and t_{4, 0.995} = 4.604 has p = 0.01 in every table
    base = np.array([2.0, 0.0, 7.0, 1.0, 5.0])
    difference = paired_difference(base + np.arange(1.0, 6.0), base)
    assert difference.p_value == pytest.approx(stats.ttest_1samp(np.arange(1.0, 6.0), 0.0).pvalue)
    assert 0.01 < difference.p_value < 0.05
    scale = 4.604 * math.sqrt(0.5) / 3.0  # moves the mean to t = 4.604
    shifted = paired_difference(np.arange(1.0, 6.0) + 3.0 * (scale - 1.0), np.zeros(5))
    assert shifted.p_value == pytest.approx(0.01, abs=1e-5)


@given(st.integers(2, 9), st.integers(2, 9), st.floats(0.1, 9.0), st.integers(0, 2**32 - 1))
def test_two_groups_are_compared_as_by_scipy(first: int, second: int, scale: float, seed: int) -> None:
    numbers = np.random.default_rng(seed)
    values, base = numbers.normal(1.0, scale, first), numbers.normal(size=second)
    ours, theirs = group_difference(values, base), stats.ttest_ind(values, base, equal_var=False)
    low, high = theirs.confidence_interval(0.95)
    assert ours.estimate == pytest.approx(values.mean() - base.mean())
    assert (ours.low, ours.high, ours.p_value) == pytest.approx((low, high, theirs.pvalue))
    assert ours.runs == min(first, second)


@pytest.mark.parametrize("compare", [paired_difference, group_difference])
def test_differences_without_spread_or_with_one_run(
    compare: Callable[[Floats, Floats], Difference],
) -> None:
    same = compare(np.full(3, 2.0), np.full(3, 2.0))
    assert (same.estimate, same.p_value) == (0.0, 1.0)
    assert all(math.isnan(value) for value in (same.low, same.high))
    rounded = compare(np.full(7, 0.1), np.full(7, 0.3 - 0.2))  # differ in the last digit
    assert rounded.p_value == 1.0
    other = compare(np.full(3, 2.0), np.full(3, 1.0))
    assert other.estimate == 1.0
    assert all(math.isnan(value) for value in (other.low, other.high, other.p_value))
    one = compare(np.array([2.0]), np.array([1.0]))
    assert (one.estimate, one.is_small) == (1.0, True)
    assert all(math.isnan(value) for value in (one.low, one.high, one.p_value))


def test_holms_correction_by_hand_and_by_its_law() -> None:
    # sorted 0.01, 0.02, 0.03 by 3, 2, 1: 0.03, 0.04, 0.03, and none below the one before it
    assert holm(np.array([0.03, 0.01, 0.02])) == pytest.approx([0.04, 0.03, 0.04])
    assert holm(np.array([0.9, 0.8])) == pytest.approx([1.0, 1.0])
    assert not len(holm(np.array([])))
    assert holm(np.array([math.nan, 0.02])) == pytest.approx([math.nan, 0.02], nan_ok=True)
    # closed testing: a hypothesis is as likely as the likeliest of all intersections that it is in
    numbers = generator().uniform(size=6) ** 3
    for count in range(1, 7):
        p_values = numbers[:count]
        subsets = [set(it) for size in range(1, count + 1) for it in combinations(range(count), size)]
        expected = [
            max(min(1.0, len(them) * p_values[list(them)].min()) for them in subsets if i in them)
            for i in range(count)
        ]
        assert holm(p_values) == pytest.approx(expected)
    # with ten true hypotheses at 5% a false claim is made in 5% of all tables, 40% without a correction
    p_values = generator().uniform(size=(4000, 10))
    false = np.mean([bool((holm(row) < 0.05).any()) for row in p_values])
    assert false == pytest.approx(1.0 - 0.995**10, abs=0.01)


@given(st.integers(1, 40), st.data())
def test_ends_of_wilsons_interval_are_one_quantile_away(runs: int, data: st.DataObject) -> None:
    # its definition: at each end p0, |p - p0| = z sqrt(p0 (1 - p0) / n)
    successes = data.draw(st.integers(0, runs))
    interval = wilson_interval(successes, runs)
    z = stats.norm.ppf(0.975)
    for end in (interval.low, interval.high):
        away = abs(successes / runs - end)
        assert away == pytest.approx(z * math.sqrt(max(0.0, end * (1 - end)) / runs), abs=1e-7)
    assert 0.0 <= interval.low <= interval.estimate <= interval.high <= 1.0


@pytest.mark.parametrize("runs", [1, 2, 5, 20, 160])
def test_wilsons_interval_is_that_of_scipy(runs: int) -> None:
    for successes in range(runs + 1):
        interval = wilson_interval(successes, runs)
        expected = stats.binomtest(successes, runs).proportion_ci(method="wilson")
        assert (interval.low, interval.high) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_five_of_five_seeds_are_not_certainty() -> None:
    interval = wilson_interval(5, 5)
    assert interval.estimate == interval.high == 1.0
    assert interval.low == pytest.approx(1.0 / (1.0 + 1.959964**2 / 5.0), abs=1e-6)  # 0.57


def test_wilsons_interval_covers_about_95_percent_on_average_and_less_near_0_and_1() -> None:
    shares = np.linspace(0.0, 1.0, 10_001)[1:-1]
    for runs in (5, 10, 20):
        intervals = [wilson_interval(count, runs) for count in range(runs + 1)]
        low, high = np.array([(it.low, it.high) for it in intervals]).T
        covered = (low <= shares[:, None]) & (shares[:, None] <= high)
        coverage = (stats.binom.pmf(np.arange(runs + 1), runs, shares[:, None]) * covered).sum(axis=1)
        assert coverage.mean() == pytest.approx(0.95, abs=0.01)
        assert coverage.min() == pytest.approx(0.835, abs=0.005)
        assert not 0.05 < shares[coverage.argmin()] < 0.95


def test_no_runs_have_no_share() -> None:
    assert math.isnan(wilson_interval(0, 0).estimate)


@pytest.mark.parametrize(
    ("runs", "statistic", "expected"),
    [(5, mean_of_tasks, 0.83), (20, mean_of_tasks, 0.93), (5, interquartile_mean, 0.895)],
)
def test_bootstrap_covers_as_often_as_the_docstring_says(
    runs: int, statistic: Statistic, expected: float
) -> None:
    numbers, repeats = generator(), 1200
    covered = 0
    for _ in range(repeats):
        interval = stratified_bootstrap(numbers.normal(size=(runs, 1)), statistic, numbers, replications=400)
        covered += interval.low <= 0.0 <= interval.high
    assert covered / repeats == pytest.approx(expected, abs=0.03)  # three standard errors


def test_the_page_shows_every_simulated_share() -> None:
    root = Path(__file__).parents[2]
    simulated = (root / "results" / "statistics" / "intervals.txt").read_text().splitlines()
    rows = [line.rsplit(maxsplit=3) for line in simulated if line.startswith("share of")]
    page = (root / "docs" / "explanation" / "statistics.md").read_text()
    assert len(rows) == 3
    for name, *shares in rows:
        assert f"| {name} | {' | '.join(share.removeprefix('0') for share in shares)} |" in page


def test_student_covers_what_it_promises_at_five_runs() -> None:
    numbers = generator()
    covered = 0
    for _ in range(1200):
        interval = mean_interval(numbers.normal(size=5))
        covered += interval.low <= 0.0 <= interval.high
    assert covered / 1200 == pytest.approx(0.95, abs=0.02)
