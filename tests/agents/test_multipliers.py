"""Multipliers whose violations are divided by a moving average of the error."""

import copy
import math

import numpy as np
import pytest
from scipy.signal import lfilter

from recrl.agents.constraints.multiplier_rules import relative_gaps
from recrl.agents.constraints.multipliers import Multipliers
from recrl.agents.experience import Constraints
from recrl.agents.shared_options import LagrangianConfig


def measured(gap: float, error: float, limit: float = 3.0) -> Constraints:
    return Constraints(np.array([limit]), np.array([gap]), np.array([error]), 10.0)


def ascent(decay: float) -> Multipliers:
    options = {"multiplier_rule": "projected", "multiplier_step": 1.0, "multiplier_error_decay": decay}
    return Multipliers(LagrangianConfig.model_validate(options), 1)


def test_a_violation_is_divided_by_the_limit_and_the_mean_square_of_the_errors() -> None:
    multipliers = ascent(0.5)
    assert multipliers.move(measured(4.0, error=3.0)) == pytest.approx([4.0 / math.sqrt(9.0 + 9.0)])
    mean = (1.0 * 9.0 + 2.0 * 25.0) / 3.0  # the newest has twice the weight of the one before
    expected = 4.0 / math.sqrt(9.0 + 9.0) + 4.0 / math.sqrt(9.0 + mean)
    assert multipliers.move(measured(4.0, error=5.0)) == pytest.approx([expected])


def test_without_a_decay_it_is_the_error_of_the_update() -> None:
    multipliers = ascent(0.0)
    multipliers.move(measured(-4.0, error=100.0))
    assert multipliers.move(measured(4.0, error=4.0)) == [4.0 / 5.0]


def test_the_average_goes_on_from_a_checkpoint_and_begins_anew_from_an_earlier_version() -> None:
    first, second, third = ascent(0.5), ascent(0.5), ascent(0.5)
    first.move(measured(4.0, error=3.0))
    state = copy.deepcopy(first.state_dict())
    second.load_state_dict(state)
    del state["errors"]
    third.load_state_dict(state)
    expected = first.move(measured(4.0, error=5.0))
    assert second.move(measured(4.0, error=5.0)) == expected
    assert third.move(measured(4.0, error=5.0)) == pytest.approx(
        [4.0 / math.sqrt(9.0 + 9.0) + 4.0 / math.sqrt(9.0 + 25.0)]
    )


@pytest.mark.parametrize(
    ("cost", "limit", "settled"), [(100.0, 25.0, 1.00), (10.0, 1.0, 1.04), (50.0, 1.0, 1.30)]
)
def test_the_mean_cost_settles_where_the_documentation_says(
    cost: float, limit: float, settled: float
) -> None:
    """The mean cost at which an integral keeps its value on average; 16 episodes cost 0 or the same."""

    def drift(probability: float) -> float:
        shares = np.random.default_rng(0).binomial(16, probability, 100_000) / 16.0
        squares = cost**2 * shares * (1.0 - shares) / 15.0
        errors = np.sqrt(lfilter([0.1], [1.0, -0.9], squares))[1000:]
        gaps = relative_gaps(shares[1000:] * cost - limit, np.full(len(errors), limit), errors)
        return float(np.minimum(gaps, 1.0).mean())

    assert drift((settled - 0.02) * limit / cost) < 0.0 < drift((settled + 0.02) * limit / cost)
