"""The constrained optimum J*(d) of a finite CMDP, and the exact return and costs of any policy.

``solve_by_lagrangian`` solves

    J*(d) = max_pi J(pi)    such that    C_i(pi) <= d_i for all i,

over all policies, time-dependent and random ones included, undiscounted over a finite horizon. RiverGrid's
200 steps take about 0.1 s. A test compares it with an independent solution over occupation measures (Altman
1999, chapter 3).

J* is an upper bound on an agent's return, because an agent's policy does not see the time.

Notation: H horizon, S states, A actions, k costs, t a time step, x an occupation measure, lambda the
multipliers [k].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import linprog

from recrl.environments.cmdp import CostLimits, Floats
from recrl.environments.finite.finite_cmdp import FiniteCMDP, InfeasibleLimitsError

Actions = npt.NDArray[np.integer[Any]]
TOLERANCE = 1e-9  # relative; on returns and costs
ROUNDING = 1e-3  # absolute; of the sum of a policy's probabilities, for tables from files
MAX_POLICIES = 10_000


@dataclass(frozen=True, eq=False)
class PolicyValue:
    """Expected return, costs and visits of a policy over an episode.

    Attributes:
        episode_return: expected undiscounted return.
        costs: expected undiscounted episode costs, [k].
        visits: expected number of visits of each (state, action) pair, [S, A]; sums to the expected length.
    """

    episode_return: float
    costs: Floats
    visits: Floats


@dataclass(frozen=True, eq=False)
class ConstrainedOptimum:
    """A solution of a constrained problem.

    Attributes:
        episode_return: J*(d).
        costs: expected undiscounted episode costs of ``policy``, [k].
        multipliers: lambda_i = dJ*/dd_i >= 0, the gain in return per unit of each limit, [k]; 0 for infinite
            limits.
        model: the CMDP.
        mixture: probabilities of deterministic policies, one of which is drawn for a whole episode, with
            their actions [H, S].
    """

    episode_return: float
    costs: Floats
    multipliers: Floats
    model: FiniteCMDP
    mixture: tuple[tuple[float, Actions], ...]

    @cached_property
    def policy(self) -> Floats:
        """An optimal policy, pi_t(a | s), [H, S, A]; its tables take much memory for a large CMDP."""
        one_hot = np.eye(self.model.num_actions)
        occupation = np.sum(
            [weight * _occupation(self.model, one_hot[actions]) for weight, actions in self.mixture], axis=0
        )
        return _conditional(occupation)


def evaluate_policy(model: FiniteCMDP, policy: Floats) -> PolicyValue:
    """Compute the exact value of a policy by propagating the state distribution forward.

    mu_0 = start, x_t(s, a) = mu_t(s) pi_t(a | s), mu_{t+1}(s') = sum_{s, a} x_t(s, a) T(s' | s, a).

    Args:
        model: the CMDP.
        policy: pi(a | s), [S, A] (stationary) or [H, S, A].

    Raises:
        ValueError: the policy has another shape, or its rows are no probabilities.
    """
    table = (model.num_states, model.num_actions)
    if policy.shape not in {table, (model.horizon, *table)}:
        raise ValueError(
            f"the policy must have shape {table} or {(model.horizon, *table)}, got {policy.shape}"
        )
    if not ((policy >= -TOLERANCE).all() and (np.abs(policy.sum(axis=-1) - 1.0) <= ROUNDING).all()):
        raise ValueError("each row of the policy must be probabilities, at least 0 and with a sum of 1")
    visits = _occupation(model, np.broadcast_to(policy, (model.horizon, *table))).sum(axis=0)
    return PolicyValue(
        episode_return=float(np.sum(visits * model.rewards)),
        costs=np.einsum("sa,sak->k", visits, model.costs),
        visits=visits,
    )


def solve_by_lagrangian(model: FiniteCMDP, limits: CostLimits) -> ConstrainedOptimum:
    """Solve for J*(d) by the dual, min_{lambda >= 0} max_pi J(pi) - lambda . (C(pi) - d).

    For a fixed lambda, backward induction finds an optimal deterministic policy. A small linear program mixes
    the policies found so far within the limits. Its dual variables are the next lambda (cutting planes of the
    dual, Dantzig-Wolfe). The iteration ends when no policy improves on the mixture under its own multipliers:
    then the two bounds meet. A first phase minimises the total excess over the limits in the same way, to
    find out whether they are feasible.

    Raises:
        InfeasibleLimitsError: no policy keeps the limits.
        ValueError: there is another number of limits than of costs.
    """
    constrained = np.array(limits.finite)
    bounds = _checked_limits(model, limits)[constrained]
    found = [_backward_induction(model, reward_weight=1.0, multipliers=np.zeros(model.num_costs))]
    for reward_weight in (0.0, 1.0):
        for _ in range(MAX_POLICIES):
            weights, multipliers, bound = _mixture(found, bounds, constrained, reward_weight)
            candidate = _backward_induction(model, reward_weight=reward_weight, multipliers=multipliers)
            value = reward_weight * candidate.episode_return - multipliers @ candidate.costs
            if value <= bound + TOLERANCE * (1.0 + abs(bound)):
                break
            found.append(candidate)
        else:
            raise RuntimeError(f"no optimum after {MAX_POLICIES} policies")
        costs = weights @ np.array([policy.costs for policy in found[: len(weights)]])
        excess = np.maximum(costs[constrained] - bounds, 0.0)
        if reward_weight == 0.0 and (excess > 1e-6 * (1.0 + bounds)).any():
            raise InfeasibleLimitsError(
                f"no policy keeps the limits {limits.to_json()}, the smallest total excess is "
                f"{excess.sum():.6g}"
            )
        bounds = np.maximum(bounds, costs[constrained])  # rounding must not make the next phase infeasible
    used = [(weight, policy) for weight, policy in zip(weights, found, strict=False) if weight > 0.0]
    return ConstrainedOptimum(
        episode_return=float(sum(weight * policy.episode_return for weight, policy in used)),
        costs=np.asarray(costs, np.float64),
        multipliers=multipliers,
        model=model,
        mixture=tuple((float(weight), policy.actions) for weight, policy in used),
    )


@dataclass(frozen=True, eq=False)
class _DeterministicPolicy:
    """One vertex of the set of attainable (return, costs); ``actions`` is [H, S]."""

    actions: Actions
    episode_return: float
    costs: Floats


def _backward_induction(
    model: FiniteCMDP, *, reward_weight: float, multipliers: Floats
) -> _DeterministicPolicy:
    """Return a policy that maximises reward_weight J - multipliers . C, with its own J and C.

    V_H = 0,  Q_t(s, a) = [R, C](s, a) + sum_s' T(s' | s, a) V_{t+1}(s'),
    V_t(s) = Q_t(s, argmax_a [reward_weight, -multipliers] . Q_t(s, a)).
    """
    weights = np.concatenate([[reward_weight], -multipliers])
    immediate = np.concatenate([model.rewards[:, :, None], model.costs], axis=2)
    going_on = ~model.terminal[:, None]
    values = np.zeros((model.num_states, 1 + model.num_costs))
    # The smallest type, because all policies that are found stay in memory.
    actions = np.zeros((model.horizon, model.num_states), np.min_scalar_type(model.num_actions - 1))
    state = np.arange(model.num_states)
    for step in reversed(range(model.horizon)):
        future = np.einsum("sam,samc->sac", model.probabilities, (values * going_on)[model.successors])
        action_values = immediate + future
        best = np.argmax(action_values @ weights, axis=1)
        actions[step] = best
        values = action_values[state, best]
    totals = model.start @ values
    return _DeterministicPolicy(actions, float(totals[0]), totals[1:])


def _mixture(
    found: list[_DeterministicPolicy],
    bounds: Floats,
    constrained: npt.NDArray[np.bool_],
    reward_weight: float,
) -> tuple[Floats, Floats, float]:
    """Return the best mixture of the policies found: its weights, the multipliers [k] and its value.

    With reward_weight 1 it maximises the return within the limits. With 0 it minimises the total excess over
    them.
    """
    costs = np.array([policy.costs for policy in found])[:, constrained]
    returns = np.array([policy.episode_return for policy in found])
    # With reward_weight 0, excess over the limits is allowed and minimised.
    slacks = 0 if reward_weight else len(bounds)
    solution = linprog(
        np.concatenate([-reward_weight * returns, np.ones(slacks)]),
        A_ub=np.hstack([costs.T, -np.eye(len(bounds), slacks)]),
        b_ub=bounds,
        A_eq=np.concatenate([np.ones(len(found)), np.zeros(slacks)])[None],
        b_eq=np.ones(1),
        method="highs",
    )
    if solution.status != 0:  # the first phase finds a mixture that keeps the limits
        raise RuntimeError(f"the linear program was not solved: {solution.message}")
    multipliers = np.zeros(len(constrained))
    multipliers[constrained] = np.maximum(-np.asarray(solution.ineqlin.marginals), 0.0)
    weights: Floats = np.asarray(solution.x)[: len(found)]
    return weights, multipliers, -float(solution.eqlin.marginals[0])


def _occupation(model: FiniteCMDP, policy: Floats) -> Floats:
    """Return x_t(s, a), the probability of state s and action a in step t of a policy; both are [H, S, A]."""
    occupation = np.zeros((model.horizon, model.num_states, model.num_actions))
    distribution: Floats = model.start
    successors = model.successors.reshape(-1)
    for step in range(model.horizon):
        occupation[step] = distribution[:, None] * policy[step]
        flow = (occupation[step][:, :, None] * model.probabilities).reshape(-1)
        distribution = np.bincount(successors, weights=flow, minlength=model.num_states).astype(np.float64)
        distribution[model.terminal] = 0.0
    return occupation


def _conditional(occupation: Floats) -> Floats:
    """Return the policy of an occupation x, both [H, S, A]; it is uniform in states that are never visited.

    pi_t(a | s) = x_t(s, a) / sum_a x_t(s, a).
    """
    mass = occupation.sum(axis=2, keepdims=True)
    policy: Floats = np.full_like(occupation, 1.0 / occupation.shape[2])
    np.divide(occupation, mass, out=policy, where=mass > 1e-12)
    return policy


def _checked_limits(model: FiniteCMDP, limits: CostLimits) -> Floats:
    if len(limits) != model.num_costs:
        raise ValueError(f"the CMDP has {model.num_costs} costs, got {len(limits)} limits")
    return limits.array
