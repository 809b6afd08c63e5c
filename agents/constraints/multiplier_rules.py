"""Update rules of Lagrange multipliers, each a pure function on a small state.

A constrained learner maximises J_r - sum_i lambda_i (J_i - d_i) over the policy and minimises it over
lambda >= 0. A rule takes the *gaps* J_i - d_i (mean undiscounted episode cost minus limit, positive where
the constraint is violated) and returns the next state. A dimension with an infinite limit is no constraint:
its state does not change, and its multiplier is 0 (of ``projected_ascent`` it is the state, which stays;
``multipliers.Multipliers`` takes it for 0).

A state is a dict of float64 arrays [k], which a checkpoint stores directly; each has the key ``multipliers``.
Notation: k costs.

Which to use: ``projected_ascent`` is an integrator, so the cost oscillates about the limit; the proportional
term of ``proportional_integral`` damps this. Neither winds down below 0 nor, under a positive limit,
accumulates old violations, so both respond immediately to a changed limit. ``softplus_adam`` does both; it is
here because the paper's agents use it. Under a limit of 0 no gap is negative. Then the multiplier of
``projected_ascent`` and the integral of ``proportional_integral`` never fall: all cost that the agent can
avoid is to be avoided.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from recrl.agents.building_blocks.scales import quotient
from recrl.environments.cmdp import Floats

MultiplierState = Mapping[str, Floats]

ADAM_BETAS = (0.9, 0.999)
ADAM_EPSILON = 1e-8
LARGEST_RELATIVE_GAP = 10.0


def start_projected_ascent(num_costs: int, initial: float) -> dict[str, Floats]:
    """Return the initial state: all multipliers at ``initial``, at least 0."""
    return {"multipliers": np.full(num_costs, initial)}


def projected_ascent(
    state: MultiplierState, gaps: Floats, *, step_size: float, maximum: float
) -> dict[str, Floats]:
    """Take a step of projected dual ascent: lambda <- clip(lambda + step_size (J - d), 0, maximum).

    Args:
        state: ``multipliers``.
        gaps: J - d, [k]; -inf where there is no constraint, whose multiplier stays as it is.
        step_size: multiplier units per unit of episode cost, above 0.
        maximum: the largest multiplier, possibly infinite.
    """
    active = np.isfinite(gaps)
    moved = np.clip(state["multipliers"] + step_size * np.where(active, gaps, 0.0), 0.0, maximum)
    return {"multipliers": np.where(active, moved, state["multipliers"])}


def start_softplus_adam(num_costs: int, initial: float) -> dict[str, Floats]:
    """Return the initial state: all multipliers at ``initial``, above 0: theta = log(e^initial - 1)."""
    zeros = np.zeros(num_costs)
    return {
        "multipliers": np.full(num_costs, initial),
        "theta": np.full(num_costs, initial + np.log(-np.expm1(-initial))),
        "first_moment": zeros,
        "second_moment": zeros,
        "steps": zeros,
    }


def softplus_adam(state: MultiplierState, gaps: Floats, *, learning_rate: float) -> dict[str, Floats]:
    """Take an Adam step on the loss -theta (J - d), lambda = softplus(theta) (safety-starter-agents).

    Adam's second moment retains early violations for a thousand updates, and theta falls without bound while
    the constraint holds. So it responds late to a changing limit.

    Args:
        state: ``multipliers``, ``theta``, ``first_moment``, ``second_moment``, ``steps``.
        gaps: J - d, [k]; -inf where there is no constraint.
        learning_rate: Adam's, above 0.
    """
    active = np.isfinite(gaps)
    gradient = np.where(active, -gaps, 0.0)
    steps = state["steps"] + active
    first = np.where(
        active, ADAM_BETAS[0] * state["first_moment"] + (1 - ADAM_BETAS[0]) * gradient, state["first_moment"]
    )
    second = np.where(
        active,
        ADAM_BETAS[1] * state["second_moment"] + (1 - ADAM_BETAS[1]) * gradient**2,
        state["second_moment"],
    )
    count = np.maximum(steps, 1.0)
    direction = (first / (1 - ADAM_BETAS[0] ** count)) / (
        np.sqrt(second / (1 - ADAM_BETAS[1] ** count)) + ADAM_EPSILON
    )
    theta = np.where(active, state["theta"] - learning_rate * direction, state["theta"])
    return {
        "multipliers": np.where(active, np.logaddexp(0.0, theta), 0.0),
        "theta": theta,
        "first_moment": first,
        "second_moment": second,
        "steps": steps,
    }


def start_proportional_integral(num_costs: int, initial: float) -> dict[str, Floats]:
    """Return the initial state: all multipliers and integrals at ``initial``, at least 0."""
    return {
        "multipliers": np.full(num_costs, initial),
        "integral": np.full(num_costs, initial),
    }


def proportional_integral(
    state: MultiplierState,
    gaps: Floats,
    *,
    largest: float,
    proportional: float,
    integral: float,
    maximum: float,
) -> dict[str, Floats]:
    """Take a step of a PI controller of the multiplier, with anti-wind-up (Stooke et al. 2020, algorithm 2).

    I <- clip(I + K_I min(gap, largest), 0, maximum);
    lambda = clip(K_P min(gap, largest) + I, 0, maximum).

    The source also has a derivative term, K_D = 0 here. The integral is clipped to the
    multiplier's range, so that neither a long satisfied nor a long infeasible constraint winds it up. It
    includes the gain K_I, so that changing K_I does not make lambda jump.

    The gap is bounded, too. An episode costs at least 0, so the gap is at least -d, but an untrained policy
    may exceed the limit by any amount. Ten updates with a cost of 50 under a limit of 1 would add more to the
    integral than 400 later ones can subtract. A proportional term without bound would stop all learning of
    rewards until the limit is nearly kept. So a violation counts no more than ``largest``: if J is known
    exactly, the slack of an agent without any cost.

    The bound removes large gaps and no small ones. Relative gaps are divided by a standard error that is
    large where the mean is. So with them the mean cost settles above the limit where the standard error is
    not small beside the limit. With 16 new episodes an update it is 1% for costs of 0 or 100 under a limit of
    25. It is 11% for costs of 0 or 10 under a limit of 1. For rare costs, 0 or 50 under a limit of 1, it is
    2.5 times the limit. Most of that comes from the division: without the bound it is 1%, 9% and 2.4 times.

    Args:
        state: ``multipliers``, ``integral``.
        gaps: J - d in any unit, [k]; -inf where there is no constraint.
        largest: the largest violation that counts, in that unit.
        proportional: K_P, at least 0, multiplier units per unit of the gaps.
        integral: K_I, likewise.
        maximum: the largest multiplier, possibly infinite.
    """
    active = np.isfinite(gaps)
    gap = np.where(active, gaps, 0.0)
    bounded = np.minimum(gap, largest)
    summed = np.clip(state["integral"] + integral * bounded, 0.0, maximum)
    output = np.clip(proportional * bounded + summed, 0.0, maximum)
    return {
        "multipliers": np.where(active, output, 0.0),
        "integral": np.where(active, summed, state["integral"]),
    }


def relative_gaps(gaps: Floats, limits: Floats, standard_errors: Floats) -> Floats:
    """Return gaps relative to limit and standard error: (J - d) / sqrt(d^2 + s^2), [k].

    A gap of 1 is small under a limit of 25 and large under a limit of 1. A gap of one standard error s is not
    significant under any limit. The result has no unit, is at least -1, and is clipped at 10, which matters
    if d and s are 0.

    Args:
        gaps: J - d, [k]; -inf where there is no constraint.
        limits: d, [k], possibly infinite.
        standard_errors: s, of J, [k], at least 0.

    >>> relative_gaps(np.array([10.0, -4.0, 2.0]), np.array([4.0, 4.0, 0.0]), np.array([3.0, 3.0, 0.0]))
    array([ 2. , -0.8, 10. ])
    """
    active = np.isfinite(gaps)
    sizes = np.hypot(np.where(active, limits, 1.0), standard_errors)
    floors = np.maximum(sizes, np.abs(np.where(active, gaps, 0.0)) / LARGEST_RELATIVE_GAP)
    return np.where(active, quotient(np.where(active, gaps, 0.0), floors), -np.inf)


# Initial state by the value of the option ``multiplier_rule``.
STARTS: dict[str, Callable[[int, float], dict[str, Floats]]] = {
    "projected": start_projected_ascent,
    "softplus-adam": start_softplus_adam,
    "proportional-integral": start_proportional_integral,
}
