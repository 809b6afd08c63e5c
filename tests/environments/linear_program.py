"""The constrained optimum of a finite CMDP by linear programming: independent of the package's solver."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array

from recrl.environments.cmdp import CostLimits, Floats
from recrl.environments.finite.finite_cmdp import FiniteCMDP, InfeasibleLimitsError, Integers


class ProgramSolution(NamedTuple):
    """The attributes of ``ConstrainedOptimum`` with their meaning there."""

    episode_return: float
    costs: Floats
    multipliers: Floats
    policy: Floats


def solve_by_linear_program(model: FiniteCMDP, limits: CostLimits) -> ProgramSolution:
    """Solve for J*(d) by linear programming over occupation measures x_t(s, a) >= 0 (HiGHS).

    maximise    sum_{t, s, a} x_t(s, a) R(s, a)
    subject to  sum_a x_0(s, a) = start(s),
                sum_a x_t(s', a) = sum_{s, a} x_{t-1}(s, a) T(s' | s, a)    for every s' that is not terminal,
                sum_{t, s, a} x_t(s, a) C_i(s, a) <= d_i,

    and pi_t(a | s) is proportional to x_t(s, a). Only states that are reachable at time t have variables.

    Raises:
        InfeasibleLimitsError: no policy keeps the limits.
    """
    constrained = np.array(limits.finite)
    bounds = limits.array[constrained]
    times, states, flow, inflow = _flow_constraints(model)
    at_most = model.costs[states].reshape(-1, model.num_costs)[:, constrained].T
    objective: Floats = -model.rewards[states].reshape(-1)
    solution = linprog(objective, at_most, bounds, flow, inflow, method="highs")
    if solution.status == 2:
        raise InfeasibleLimitsError(f"no policy keeps the limits {limits.to_json()}")
    assert solution.status == 0, solution.message
    occupation = np.zeros((model.horizon, model.num_states, model.num_actions))
    occupation[times, states] = np.maximum(np.asarray(solution.x), 0.0).reshape(-1, model.num_actions)
    multipliers = np.zeros(model.num_costs)
    multipliers[constrained] = np.maximum(-np.asarray(solution.ineqlin.marginals), 0.0)
    visits = occupation.sum(axis=2, keepdims=True)
    policy = np.full_like(occupation, 1.0 / model.num_actions)  # where a state is never visited
    np.divide(occupation, visits, out=policy, where=visits > 1e-12)
    return ProgramSolution(
        episode_return=float(np.sum(occupation * model.rewards)),
        costs=np.einsum("tsa,sak->k", occupation, model.costs),
        multipliers=multipliers,
        policy=policy,
    )


def _flow_constraints(model: FiniteCMDP) -> tuple[Integers, Integers, Any, Floats]:
    """Return the times and states of the variables (each with A actions), and their flow equations."""
    reachable = np.zeros((model.horizon, model.num_states), np.bool_)
    reachable[0] = model.start > 0.0
    for step in range(1, model.horizon):
        previous = reachable[step - 1]
        possible = model.successors[previous][model.probabilities[previous] > 0.0]
        reachable[step, possible] = True
        reachable[step, model.terminal] = False
    times, states = np.nonzero(reachable)
    row_of = np.full((model.horizon + 1, model.num_states), -1)
    row_of[times, states] = np.arange(len(times))
    columns = np.arange(len(times) * model.num_actions)
    own_rows = np.repeat(np.arange(len(times)), model.num_actions)
    num_successors = model.successors.shape[2]
    next_rows = row_of[times[:, None, None] + 1, model.successors[states]].reshape(-1)
    flowing = model.probabilities[states].reshape(-1)
    counted = (next_rows >= 0) & (flowing > 0.0)
    flow = coo_array(
        (
            np.concatenate([np.ones(len(columns)), -flowing[counted]]),
            (
                np.concatenate([own_rows, next_rows[counted]]),
                np.concatenate([columns, np.repeat(columns, num_successors)[counted]]),
            ),
        ),
        shape=(len(times), len(columns)),
    )
    return times, states, flow, np.where(times == 0, model.start[states], 0.0)
