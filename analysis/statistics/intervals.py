"""Estimates over few seeds with intervals: pure functions on arrays, one per estimator.

The paper reports means and standard errors of five seeds. The other estimators are those of Agarwal et al.
2021, "Deep RL at the edge of the statistical precipice" (rliable). They are interquartile mean, stratified
percentile bootstrap, probability of improvement and performance profiles. Fractions of seeds get Wilson's
interval.

Coverage with few seeds: the percentile bootstrap resamples only observed values, so its "95%" intervals are
too short for small n. Simulated coverage with normal data (4,000 samples, so +- .004;
tests/benchmarks/interval_statistics.py):

    runs a task                           5      10      20
    mean                               .838    .908    .927
    interquartile mean                 .904    .935    .944
    probability of improvement, 0.5    .912    .947    .953
    the same, 0.8                      .971    .936    .938
    the same, 0.95                     .998    .996    .907
    mean, Student's t                  .951    .951    .953
    paired difference, Student's t     .949    .954    .954
    two groups, Welch's t              .956    .947    .948
    share of 0.5, Wilson               .945    .978    .960
    share of 0.8, Wilson               .944    .964    .958
    share of 0.95, Wilson              .981    .917    .917

A probability of improvement near 0 or 1 often has no interval (``improvement_interval``); these samples are
left out. The same script shows that point estimates equal those of rliable 1.2.0 within 2e-16 on 500 random
tables.

``Interval.is_small`` is true below ``ENOUGH_RUNS``; tables then print a mark. ``mean_interval`` (Student's t)
has its nominal coverage for normal data at any n >= 2; use it at n = 5.

Notation: n runs (seeds), m tasks, r bootstrap replications. Scores are [..., n, m]: runs in rows, tasks in
columns. NaN is not allowed: drop unfinished runs first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri, stdtr, stdtrit  # importing scipy.stats takes a second and a half

from recrl.environments.cmdp import Floats

ENOUGH_RUNS = 10
ENOUGH_FOR_SHARES = 5  # runs: with fewer, Wilson's interval is very wide
REPLICATIONS = 2000
CONFIDENCE = 0.95
ROUNDING = 1e-12  # of the largest value: differences below it are none

Statistic = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Interval:
    """An estimate and the interval around it.

    Attributes:
        estimate: from all runs.
        low: lower end; NaN if n is too small for any interval.
        high: upper end, likewise.
        runs: n.
        is_small: whether n is too small for the nominal coverage.
    """

    estimate: float
    low: float
    high: float
    runs: int
    is_small: bool


@dataclass(frozen=True)
class Difference(Interval):
    """A difference of means, the interval around it, and a test.

    Attributes:
        p_value: of the two-sided t test that the true difference is 0. NaN with fewer than two runs.
            Otherwise it is 1 if all runs tie. If the standard error is 0, the interval is NaN, and p, too,
            unless all runs tie.
    """

    p_value: float


def mean_and_standard_error(values: Floats) -> tuple[float, float]:
    """Return the mean of n values and its standard error s / sqrt(n), s with n - 1 degrees of freedom.

    Args:
        values: [n]; for n = 0 both are NaN. For n = 1 and for infinite values the standard error is.

    >>> mean_and_standard_error(np.array([1.0, 2.0, 3.0, 4.0, 5.0]))
    (3.0, 0.7071067811865476)
    """
    values = np.asarray(values, dtype=np.float64)
    count = len(values)
    mean = float(np.mean(values)) if count else math.nan
    with np.errstate(invalid="ignore"):  # infinite values have no standard error
        error = float(np.std(values, ddof=1) / math.sqrt(count)) if count > 1 else math.nan
    return mean, error


def mean_interval(values: Floats) -> Interval:
    """Return Student's t 95% interval of a mean: mean +- t_{n-1} s / sqrt(n).

    Args:
        values: [n], assumed normal.
    """
    mean, error = mean_and_standard_error(values)
    count = len(values)
    if count < 2:
        return Interval(mean, math.nan, math.nan, count, True)
    reach = _reach(error, count - 1.0)
    return Interval(mean, mean - reach, mean + reach, count, False)


def interquartile_mean(scores: Floats) -> Floats:
    """Return the IQM: the mean of the middle half of all n m scores, without floor(n m / 4) at either end.

    Args:
        scores: [..., n, m].

    Returns:
        [...].
    """
    flat = np.sort(scores.reshape(*scores.shape[:-2], -1), axis=-1)
    cut = flat.shape[-1] // 4
    return np.asarray(np.mean(flat[..., cut : flat.shape[-1] - cut], axis=-1))


def performance_profile(scores: Floats, thresholds: Floats) -> Floats:
    """Return the fraction of runs above each threshold, averaged over tasks: F(tau) = mean 1[x > tau].

    Args:
        scores: [..., n, m].
        thresholds: tau, [t].

    Returns:
        [..., t].
    """
    return np.asarray(np.mean(scores[..., None] > thresholds, axis=(-3, -2)))


def probability_of_improvement(scores: Floats, others: Floats, *, tie: float = 0.0) -> Floats:
    """Return P(X > Y), the mean over tasks and pairs of 1[x > y] + 1[x = y] / 2 (Mann-Whitney's U / n n').

    Args:
        scores: x, [..., n, m].
        others: y, [..., n', m].
        tie: values at most this far apart count as equal, at least 0.

    Returns:
        [...], in [0, 1]; 1/2 means that neither is better.
    """
    difference = scores[..., :, None, :] - others[..., None, :, :]
    higher = np.where(np.abs(difference) <= tie, 0.5, difference > 0.0)
    return np.asarray(np.mean(higher, axis=(-3, -2, -1)))


def stratified_bootstrap(
    scores: Floats,
    statistic: Statistic,
    generator: np.random.Generator,
    *,
    replications: int = REPLICATIONS,
) -> Interval:
    """Return the 95% percentile interval of a statistic; runs are resampled within every task.

    Args:
        scores: [n, m].
        statistic: [..., n, m] -> [...].
        generator: draws the resamples.
        replications: r, number of resamples.
    """
    replicated = statistic(_resampled(scores, generator, replications))
    return _percentile_interval(float(statistic(scores)), replicated, len(scores))


def improvement_interval(
    scores: Floats,
    others: Floats,
    generator: np.random.Generator,
    *,
    tie: float = 0.0,
    replications: int = REPLICATIONS,
) -> Interval:
    """Return the stratified bootstrap 95% interval of P(X > Y); the runs of both are resampled independently.

    Args:
        scores: x, [n, m].
        others: y, [n', m].
        generator: draws the resamples.
        tie: values at most this far apart count as equal, at least 0.
        replications: r, number of resamples.

    Returns:
        The interval. Its ends are NaN where they are equal, which says nothing of the uncertainty. This is so
        where every run of one is better than every run of the other, or all are equal.
    """
    replicated = probability_of_improvement(
        _resampled(scores, generator, replications), _resampled(others, generator, replications), tie=tie
    )
    estimate = float(probability_of_improvement(scores, others, tie=tie))
    found = _percentile_interval(estimate, replicated, min(len(scores), len(others)))
    return replace(found, low=math.nan, high=math.nan) if found.low == found.high else found


def paired_difference(values: Floats, baseline: Floats, *, tie: float = 0.0) -> Difference:
    """Return the mean difference between runs of equal seeds, with Student's t 95% interval and test.

    Equal seeds share the first policy and the stream of the environment. Pairing helps only if this makes
    the runs of one seed vary together.

    Args:
        values: [n], in the order of the seeds.
        baseline: [n], in the same order.
        tie: values at most this far apart count as equal, at least 0. If all pairs are equal, p is 1.
    """
    each = np.subtract(values, baseline)
    mean, error = mean_and_standard_error(each)
    rounding = _rounding(values, baseline)
    return _t_test(mean, error, len(each) - 1.0, runs=len(each), apart=each, tie=tie, rounding=rounding)


def group_difference(values: Floats, baseline: Floats, *, tie: float = 0.0) -> Difference:
    """Return the difference between the means of two independent groups, with Welch's 95% interval and test.

    The groups may differ in size and in variance. Equal to ``scipy.stats.ttest_ind(equal_var=False)``, where
    a group varies.

    Args:
        values: [n].
        baseline: [n'].
        tie: as for ``paired_difference``; p is 1 if every value equals every one of the baseline.
    """
    (mean, error), (base, base_error) = map(mean_and_standard_error, (values, baseline))
    parts = np.array([error, base_error]) ** 2  # s^2 / n and s'^2 / n'
    freedom = np.array([len(values), len(baseline)]) - 1
    squares = float(np.sum(parts**2 / np.maximum(freedom, 1)))
    degrees = float(np.sum(parts)) ** 2 / squares if squares else float(np.sum(freedom))
    return _t_test(
        mean - base,
        math.sqrt(np.sum(parts)),
        degrees,
        runs=min(len(values), len(baseline)),
        apart=np.subtract.outer(values, baseline),
        tie=tie,
        rounding=_rounding(values, baseline),
    )


def holm(p_values: Floats) -> Floats:
    """Return p values corrected for their number by Holm's (1979) method; NaN stays and does not count.

    Args:
        p_values: [n], each in [0, 1] or NaN.

    Returns:
        [n]. If each single p value is valid, the probability of any false positive below 0.05 is at most 5%.

    >>> holm(np.array([0.03, 0.01, math.nan, 0.04])).round(2).tolist()
    [0.06, 0.03, nan, 0.06]
    """
    corrected = np.full(len(p_values), math.nan)
    known = np.flatnonzero(~np.isnan(p_values))
    order = known[np.argsort(p_values[known], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    corrected[order] = np.minimum(np.maximum.accumulate(p_values[order] * factors), 1.0)
    return corrected


def wilson_interval(successes: int, runs: int) -> Interval:
    """Return Wilson's (1927) 95% score interval of a fraction p = successes / n.

    With z the normal quantile: (p + z^2/2n +- z sqrt(p (1 - p)/n + z^2/4n^2)) / (1 + z^2/n). Unlike
    p +- standard error it stays in [0, 1] and does not collapse at 0 or n successes. Equal to
    ``scipy.stats.binomtest``, whose import would take a second and a half.

    Args:
        successes: 0 ... n.
        runs: n, at least 0.
    """
    if runs == 0:
        return Interval(math.nan, math.nan, math.nan, 0, True)
    p, n = successes / runs, runs
    z = float(ndtri(0.5 + CONFIDENCE / 2.0))
    centre = p + z**2 / (2 * n)
    reach = z * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    scale = 1 + z**2 / n
    low, high = (centre - reach) / scale, (centre + reach) / scale
    return Interval(p, max(0.0, min(p, low)), min(1.0, max(p, high)), n, False)  # rounding may exceed p


def share_text(successes: int, runs: int, low: float, high: float) -> str:
    """Format a fraction of runs, with its interval from ENOUGH_FOR_SHARES runs on.

    Args:
        successes: their number.
        runs: total number.
        low: lower end of the interval, in [0, 1].
        high: upper end, likewise.

    >>> share_text(4, 5, 0.376, 0.964), share_text(1, 1, 0.2, 1.0)
    ('4 of 5 (38–96%)', '1 of 1')
    """
    interval = f" ({round(100 * low)}–{round(100 * high)}%)"
    return f"{successes} of {runs}{interval if runs >= ENOUGH_FOR_SHARES else ''}"


def _rounding(values: Floats, baseline: Floats) -> float:
    """Return how far apart two means may be by rounding."""
    return ROUNDING * float(np.max(np.abs([*values, *baseline]), initial=0.0))


def _reach(error: float, degrees: float) -> float:
    """Return half the length of Student's t 95% interval."""
    return float(stdtrit(degrees, 0.5 + CONFIDENCE / 2.0)) * error


def _t_test(
    difference: float,
    error: float,
    degrees: float,
    *,
    runs: int,
    apart: Floats,
    tie: float,
    rounding: float,
) -> Difference:
    """Return Student's t 95% interval and two-sided test of a difference with a standard error.

    Args:
        difference: of two means.
        error: its standard error.
        degrees: of freedom.
        runs: n, the smaller number of the two sides.
        apart: the differences of single runs, of any shape.
        tie: up to which such a difference is none.
        rounding: how far apart equal values may be by rounding.
    """
    if runs < 2:
        return Difference(difference, math.nan, math.nan, runs, True, math.nan)
    has_spread = error > rounding  # equal differences say nothing about how they scatter
    reach = _reach(error, degrees) if has_spread else math.nan
    if (np.abs(apart) <= max(tie, rounding)).all():
        p_value = 1.0
    else:
        p_value = 2.0 * float(stdtr(degrees, -abs(difference) / error)) if has_spread else math.nan
    return Difference(difference, difference - reach, difference + reach, runs, False, p_value)


def _resampled(scores: Floats, generator: np.random.Generator, replications: int) -> Floats:
    """Resample [n, m] -> [r, n, m]: every task's column independently."""
    runs, tasks = scores.shape
    rows = generator.integers(runs, size=(replications, runs, tasks))
    return scores[rows, np.arange(tasks)]


def _percentile_interval(estimate: float, replicated: Floats, runs: int) -> Interval:
    if runs < 2:
        return Interval(estimate, math.nan, math.nan, runs, True)
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = np.quantile(replicated, [tail, 1.0 - tail])
    return Interval(estimate, float(low), float(high), runs, runs < ENOUGH_RUNS)
