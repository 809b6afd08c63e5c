"""Multiplier rules against hand-computed steps and against PyTorch."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from scipy.stats import binom

from recrl.agents.constraints.multiplier_rules import (
    STARTS,
    projected_ascent,
    proportional_integral,
    relative_gaps,
    softplus_adam,
    start_projected_ascent,
    start_proportional_integral,
    start_softplus_adam,
)

UNLIMITED = -math.inf
NO_LIMIT_AND_2 = np.array([math.inf, 2.0])


def test_projected_ascent_climbs_with_the_gap_and_stops_at_zero_and_at_the_maximum() -> None:
    state = start_projected_ascent(3, 1.0)
    state = projected_ascent(state, np.array([2.0, -30.0, 50.0]), step_size=0.1, maximum=5.0)
    assert state["multipliers"].tolist() == pytest.approx([1.2, 0.0, 5.0])


def test_projected_ascent_does_not_wind_down_while_a_constraint_is_slack() -> None:
    state = start_projected_ascent(1, 0.0)
    for _ in range(100):
        state = projected_ascent(state, np.array([-10.0]), step_size=0.1, maximum=10.0)
    assert projected_ascent(state, np.array([1.0]), step_size=0.1, maximum=10.0)["multipliers"] == [0.1]


def test_softplus_adam_begins_where_it_is_told() -> None:
    state = start_softplus_adam(1, 1.0)
    assert np.logaddexp(0.0, state["theta"]) == pytest.approx([1.0])


def test_softplus_adam_equals_pytorch() -> None:
    gaps = np.random.default_rng(0).normal(3.0, 5.0, size=(50, 2))
    state = start_softplus_adam(2, 1.0)
    theta = torch.tensor(state["theta"], requires_grad=True)
    optimiser = torch.optim.Adam([theta], lr=0.05)
    for gap in gaps:
        state = softplus_adam(state, gap, learning_rate=0.05)
        optimiser.zero_grad()
        (-(theta * torch.from_numpy(gap)).sum()).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    expected = torch.nn.functional.softplus(theta).detach().numpy()
    np.testing.assert_allclose(state["multipliers"], expected, rtol=1e-10)


def test_proportional_integral_adds_its_two_terms() -> None:
    gains: dict[str, Any] = {"proportional": 0.1, "integral": 0.01, "maximum": 100.0}
    gains["largest"] = 20.0
    state = proportional_integral(start_proportional_integral(1, 0.0), np.array([10.0]), **gains)
    assert state["multipliers"] == pytest.approx([1.1])  # 0.1 * 10 + 0.01 * 10
    state = proportional_integral(state, np.array([12.0]), **gains)
    assert state["multipliers"] == pytest.approx([1.2 + 0.22])


def test_proportional_integral_does_not_wind_up() -> None:
    gains: dict[str, Any] = {"proportional": 0.0, "integral": 0.1, "maximum": 2.0}
    state, gains["largest"] = start_proportional_integral(2, 0.0), 10.0
    for _ in range(1000):
        state = proportional_integral(state, np.array([10.0, -10.0]), **gains)
    assert state["integral"].tolist() == [2.0, 0.0]
    state = proportional_integral(state, np.array([-10.0, 10.0]), **gains)
    assert state["multipliers"].tolist() == [1.0, 1.0]


def test_what_a_violation_winds_up_satisfaction_can_wind_down_in_as_many_updates() -> None:
    gains: dict[str, Any] = {"proportional": 0.0, "integral": 0.1, "maximum": 100.0}
    state, gains["largest"] = start_proportional_integral(2, 1.0), np.array([5.0, 2.0])
    state = proportional_integral(state, np.array([60.0, 1.0]), **gains)
    assert state["integral"].tolist() == pytest.approx([1.5, 1.1])
    state = proportional_integral(state, np.array([-5.0, -2.0]), **gains)
    assert state["integral"].tolist() == pytest.approx([1.0, 0.9])


def test_a_large_violation_counts_no_more_than_the_largest_in_both_terms() -> None:
    gains: dict[str, Any] = {"proportional": 0.5, "integral": 0.1, "maximum": 100.0}
    state = proportional_integral(
        start_proportional_integral(2, 0.0), np.array([60.0, 3.0]), largest=5.0, **gains
    )
    assert state["multipliers"].tolist() == pytest.approx([0.5 * 5.0 + 0.1 * 5.0, 0.5 * 3.0 + 0.1 * 3.0])


def test_a_gap_counts_by_its_limit_and_by_how_well_it_is_known() -> None:
    gaps = relative_gaps(
        np.array([50.0, 50.0, 2.0, -25.0, -math.inf, 3.0, 0.0]),
        np.array([25.0, 25.0, 0.0, 25.0, math.inf, 0.0, 0.0]),
        np.array([0.0, 60.0, 4.0, 0.0, 1.0, 0.0, 0.0]),
    )
    assert gaps.tolist() == pytest.approx([2.0, 50.0 / 65.0, 0.5, -1.0, -math.inf, 10.0, 0.0])


def test_a_relative_gap_has_no_unit() -> None:
    values = np.array([30.0, -10.0]), np.array([25.0, 25.0]), np.array([7.0, 0.0])
    larger = (1024.0 * each for each in values)
    assert relative_gaps(*larger).tolist() == relative_gaps(*values).tolist()


@pytest.mark.parametrize(
    ("cost", "limit", "clipped", "unclipped", "true_error"),
    [(100.0, 25.0, 1.01, 1.01, 1.00), (10.0, 1.0, 1.11, 1.09, 1.03), (50.0, 1.0, 2.54, 2.36, 1.19)],
)
def test_the_mean_cost_settles_where_the_documentation_says(
    cost: float, limit: float, clipped: float, unclipped: float, true_error: float
) -> None:
    """The mean cost at which an integral keeps its value on average; 16 episodes cost 0 or the same."""
    costly = np.arange(17)
    share = costly / 16.0
    own_errors = cost * np.sqrt(share * (1.0 - share) / 15.0)

    def settled(largest: float, *, uses_true_error: bool) -> float:
        def drift(probability: float) -> float:
            error = cost * math.sqrt(probability * (1.0 - probability) / 16.0)
            errors = np.full(17, error) if uses_true_error else own_errors
            gaps = relative_gaps(share * cost - limit, np.full(17, limit), errors)
            return float(binom.pmf(costly, 16, probability) @ np.minimum(gaps, largest))

        return brentq(drift, 1e-6, 0.999) * cost / limit

    found = [settled(1.0, uses_true_error=False), settled(math.inf, uses_true_error=False)]
    found.append(settled(1.0, uses_true_error=True))
    assert found == pytest.approx([clipped, unclipped, true_error], abs=0.005)


@pytest.mark.parametrize("rule", STARTS)
def test_without_a_limit_a_rule_keeps_its_state(rule: str) -> None:
    steps = {
        "projected": lambda state, gaps: projected_ascent(state, gaps, step_size=0.1, maximum=10.0),
        "softplus-adam": lambda state, gaps: softplus_adam(state, gaps, learning_rate=0.1),
        "proportional-integral": lambda state, gaps: proportional_integral(
            state,
            gaps,
            largest=2.0,
            proportional=0.1,
            integral=0.1,
            maximum=10.0,
        ),
    }
    start = STARTS[rule](2, 1.0)
    state = steps[rule](start, np.array([UNLIMITED, 2.0]))
    assert state["multipliers"][0] == (1.0 if rule == "projected" else 0.0)  # its only state
    assert state["multipliers"][1] > 1.0
    for key in set(state) - {"multipliers"}:
        assert state[key][0] == start[key][0]
