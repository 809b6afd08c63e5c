"""Generalised advantages against hand-computed numbers and the laws they obey."""

import numpy as np
import pytest

from recrl.agents.building_blocks.advantages import generalised_advantages, next_values
from recrl.environments.cmdp import Floats


def column(*values: float) -> Floats:
    """T numbers as [T, 1, 1]."""
    return np.array(values, dtype=np.float64).reshape(-1, 1, 1)


def advantages(
    *, terminated: list[bool], truncated: list[bool], final_values: list[float], trace_decay: float = 0.5
) -> list[float]:
    """Of rewards 1, 2, 3 with values 0.5, 1, 1.5, the value 2 beyond, and gamma = 0.5."""
    values = column(0.5, 1.0, 1.5)
    ends, time_outs = np.array(terminated)[:, None], np.array(truncated)[:, None]
    following = next_values(
        values,
        terminated=ends,
        truncated=time_outs,
        final_values=np.array(final_values).reshape(-1, 1),
        last_values=np.array([[2.0]]),
    )
    found = generalised_advantages(
        column(1.0, 2.0, 3.0),
        values,
        following,
        ended=ends | time_outs,
        discount=0.5,
        trace_decays=np.array([trace_decay]),
    )
    return [float(value) for value in found.ravel()]


NEVER = [False, False, False]
SECOND = [False, True, False]


def test_the_end_of_the_rollout_is_bootstrapped() -> None:
    # delta = 1 + .5 - .5, 2 + .75 - 1, 3 + 1 - 1.5 = 1, 1.75, 2.5; gamma lambda = .25
    assert advantages(terminated=NEVER, truncated=NEVER, final_values=[]) == [1.59375, 2.375, 2.5]


def test_a_termination_is_not_bootstrapped_and_cuts_the_trace() -> None:
    # delta_1 = 2 - 1 = 1
    assert advantages(terminated=SECOND, truncated=NEVER, final_values=[]) == [1.25, 1.0, 2.5]


def test_a_time_out_is_bootstrapped_with_the_true_last_observation_and_cuts_the_trace() -> None:
    # delta_1 = 2 + .5 * 4 - 1 = 3
    assert advantages(terminated=NEVER, truncated=SECOND, final_values=[4.0]) == [1.75, 3.0, 2.5]


def test_without_traces_it_is_the_temporal_difference() -> None:
    found = advantages(terminated=NEVER, truncated=NEVER, final_values=[], trace_decay=0.0)
    assert found == [1.0, 1.75, 2.5]


def test_with_full_traces_it_is_the_discounted_return_minus_the_value() -> None:
    generator = np.random.default_rng(0)
    shape = (12, 3, 2)
    signals, values = generator.normal(size=shape), generator.normal(size=shape)
    terminated = generator.random(shape[:2]) < 0.2
    truncated = (generator.random(shape[:2]) < 0.2) & ~terminated
    final = generator.normal(size=(int(truncated.sum()), 2))
    last = generator.normal(size=(3, 2))
    following = next_values(
        values, terminated=terminated, truncated=truncated, final_values=final, last_values=last
    )
    found = generalised_advantages(
        signals, values, following, ended=terminated | truncated, discount=0.9, trace_decays=np.ones(2)
    )
    finals = iter(final)
    by_place = {place: next(finals) for place in zip(*np.nonzero(truncated), strict=True)}
    for environment in range(3):
        beyond = last[environment]
        for step in reversed(range(12)):
            if terminated[step, environment]:
                beyond = np.zeros(2)
            elif truncated[step, environment]:
                beyond = by_place[step, environment]
            beyond = signals[step, environment] + 0.9 * beyond
            np.testing.assert_allclose(
                found[step, environment], beyond - values[step, environment], atol=1e-12
            )


def test_a_true_value_function_leaves_no_advantage() -> None:
    # One reward a step for ever is worth 1 / (1 - gamma).
    values = np.full((5, 2, 1), 1.0 / (1.0 - 0.8))
    never = np.zeros((5, 2), dtype=np.bool_)
    following = next_values(
        values, terminated=never, truncated=never, final_values=np.empty((0, 1)), last_values=values[0]
    )
    found = generalised_advantages(
        np.ones((5, 2, 1)), values, following, ended=never, discount=0.8, trace_decays=np.array([0.7])
    )
    assert found == pytest.approx(0.0, abs=1e-12)


def test_each_signal_has_its_own_trace_decay() -> None:
    never = np.zeros((2, 1), dtype=np.bool_)
    zeros = np.zeros((2, 1, 2))
    signals = np.array([[[0.0, 0.0]], [[1.0, 1.0]]])
    found = generalised_advantages(
        signals, zeros, zeros, ended=never, discount=1.0, trace_decays=np.array([0.25, 0.75])
    )
    assert found[0, 0].tolist() == [0.25, 0.75]
