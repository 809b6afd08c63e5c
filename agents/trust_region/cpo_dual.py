"""The step of constrained policy optimisation, solved exactly in a few dimensions.

Achiam et al. 2017 (equation 10) linearise objective and constraints about the present policy and bound the
step by a trust region:

    minimise g.x  subject to  b_i.x + c_i <= 0 for i = 1..k  and  x.H x / 2 <= delta,

with g minus the gradient of the reward surrogate, b_i the gradient of cost surrogate i, H the Hessian of the
mean KL and c_i how far constraint i is violated. **c_i is in the unit of b_i**: if surrogates are in cost per
step, c_i = (mean episode cost i - limit i) / mean episode length. safety-starter-agents divides by it, too;
omnisafe/algorithms/on_policy/second_order/cpo.py (commit 15603dd) and safepo/single_agent/cpo.py of
Safe-Policy-Optimization (commit 8d0fa76) take c_i per episode and b_i per step.

The optimum is x = -(v + sum_i nu_i w_i) / lam with v = H^-1 g, w_i = H^-1 b_i, so only the products
q = g.v, r_i = g.w_i, S_ij = b_i.w_j matter. The paper and safety-starter-agents solve k = 1 by distinguishing
cases. Here the cases are the sets of binding constraints, for any small k. With the set A binding, x is the
shortest step that meets A exactly, plus the rest of the trust region along the projected gradient:

    m = c_A.S_AA^-1 c_A                 squared length of the shortest step that meets A,
    p = q - r_A.S_AA^-1 r_A             squared length of the remaining gradient,
    lam = sqrt(p / (2 delta - m)),  nu_A = S_AA^-1 (lam c_A - r_A).

Each of the at most 2^k candidates is the best point of its face. The problem is convex, so a candidate with
nu >= 0 that also meets the constraints outside A is the solution (Karush, Kuhn and Tucker). For k = 1 that is
nu = 0 or nu = (lam c - r) / s, lam = sqrt((q - r^2 / s) / (2 delta - c^2 / s)), as in the paper.

If no candidate is feasible, no step within the trust region meets all constraints, and the step recovers. It
goes towards the nearest point that meets them all, x = -sum_i nu_i w_i with nu >= 0 and S nu >= c (equality
where nu_i > 0), as far as the trust region allows. Every violated cost falls on the way, and no other
constraint becomes violated. For k = 1 that is the paper's equation 14, -w sqrt(2 delta / s). If only the most
violated cost were decreased each time, a policy could alternate between two costs and stay above both limits.
Only if the constraints contradict one another, the most violated one is decreased alone. This is measured by
the length c_i / sqrt(S_ii) of the step that corrects it, independent of the costs' units.

Notation: k constraints.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from recrl.environments.cmdp import Floats

# A step of length 1 changes a cost surrogate by at most sqrt(S_ii); below this square the effect is
# negligible.
NO_INFLUENCE = 1e-12
# The largest condition number of linearly independent constraints. The products are of float32 gradients,
# each exact to about 1e-7 of its length.
LARGEST_CONDITION = 1e5
# Squared lengths below this fraction of q are rounding errors: with at most one binding constraint, and with
# several, where the condition number multiplies the errors.
ROUNDING, ROUNDING_OF_SEVERAL = 1e-10, 1e-5
# Tolerance of a constraint for rounding, as a fraction of what the trust region can change.
FEASIBILITY_TOLERANCE = 1e-6


class StepCase(IntEnum):
    """Case that the step solved."""

    UNCONSTRAINED = 0  # no constraint binds: the trust-region policy optimisation step
    CONSTRAINED = 1  # at least one constraint binds
    RECOVERY = 2  # the trust region contains no feasible point


@dataclass(frozen=True, eq=False)
class StepProblem:
    """The module's problem, reduced to products.

    Attributes:
        squared_gradient: q = g.H^-1 g, at least 0.
        mixed: r_i = g.H^-1 b_i, [k].
        gram: S_ij = b_i.H^-1 b_j, [k, k], symmetric and positive semidefinite.
        violations: c_i, in the unit of b_i, [k]; negative where the constraint holds.
        radius: delta, the largest mean KL, above 0.
    """

    squared_gradient: float
    mixed: Floats
    gram: Floats
    violations: Floats
    radius: float

    def after(self, solution: DualSolution) -> Floats:
        """Return b_i.x + c_i, the violation of each constraint after a step, to first order, [k]."""
        return (
            self.violations - solution.gradient_weight * self.mixed - self.gram @ solution.constraint_weights
        )

    @property
    def reach(self) -> Floats:
        """The largest fall of each cost surrogate in the trust region, to first order, [k]."""
        reach: Floats = np.sqrt(2.0 * self.radius * np.maximum(np.diag(self.gram), 0.0))
        return reach


@dataclass(frozen=True, eq=False)
class DualSolution:
    """A step x = -(gradient_weight v + sum_i constraint_weights_i w_i).

    Attributes:
        case: the solved case.
        gradient_weight: of v; 1 / lam, or 0 in CPO's recovery.
        constraint_weights: of the w_i, [k]; nu_i / lam.
        multipliers: nu, [k], at least 0; NaN where lam is infinite and in recovery.
        recovered: the violated constraints that recovery decreases; none in the other cases.
    """

    case: StepCase
    gradient_weight: float
    constraint_weights: Floats
    multipliers: Floats
    recovered: tuple[int, ...]


def solve_dual(problem: StepProblem) -> DualSolution:
    """Return the optimal step of the module's problem, or the recovery step.

    A constraint that no step can influence (S_ii about 0) is left out, whether it is met or not.
    """
    usable = tuple(i for i in range(len(problem.violations)) if problem.gram[i, i] > NO_INFLUENCE)
    for size in range(len(usable) + 1):
        for binding in itertools.combinations(usable, size):
            candidate = _best_of_face(problem, binding)
            if candidate is not None and _meets(problem, candidate, set(usable) - set(binding)):
                return candidate
    return _recovery(problem, usable)


def _best_of_face(problem: StepProblem, binding: tuple[int, ...]) -> DualSolution | None:
    """Return the best step that meets the ``binding`` constraints exactly, if there is one with nu >= 0."""
    index = list(binding)
    block = problem.gram[np.ix_(index, index)]
    bound, mixed = problem.violations[index], problem.mixed[index]
    if not _are_independent(block):
        return None  # a smaller set has the same face
    to_meet, along = np.linalg.solve(block, np.stack([bound, mixed], axis=1)).T
    slack = 2.0 * problem.radius - float(bound @ to_meet)
    if slack < 0.0:
        return None
    remaining = problem.squared_gradient - float(mixed @ along)
    negligible = (ROUNDING_OF_SEVERAL if len(binding) > 1 else ROUNDING) * problem.squared_gradient
    has_gradient = remaining > negligible
    gradient_weight = float(np.sqrt(slack / remaining)) if has_gradient else 0.0
    weights, multipliers = np.zeros_like(problem.mixed), np.zeros_like(problem.mixed)
    weights[index] = to_meet - gradient_weight * along
    lengths = np.sqrt(np.diag(block))
    if has_gradient:  # lam is infinite if the face is a single point
        multipliers[index] = to_meet / gradient_weight - along if gradient_weight > 0.0 else np.nan
        pushes = weights[index] * lengths / np.sqrt(2.0 * problem.radius)
        tolerance = FEASIBILITY_TOLERANCE
    else:  # lam is at most sqrt(negligible / slack), about 0
        multipliers[index] = -along
        pushes = multipliers[index] * lengths
        tolerance = np.sqrt(negligible)
    if np.any(pushes < -tolerance):
        return None  # nu < 0: without one of the constraints there is a better step
    case = StepCase.CONSTRAINED if binding else StepCase.UNCONSTRAINED
    return DualSolution(case, gradient_weight, weights, np.maximum(multipliers, 0.0), ())


def _are_independent(block: Floats) -> bool:
    """Whether constraints are linearly independent, up to rounding and whatever their units.

    Args:
        block: S of these constraints, with a positive diagonal.
    """
    lengths = np.sqrt(np.diag(block))
    return not len(block) or bool(np.linalg.cond(block / np.outer(lengths, lengths)) <= LARGEST_CONDITION)


def _meets(problem: StepProblem, solution: DualSolution, constraints: set[int]) -> bool:
    """Whether a step meets some constraints: b_i.x + c_i <= 0, up to rounding."""
    index = sorted(constraints)
    return bool(np.all(problem.after(solution)[index] <= FEASIBILITY_TOLERANCE * problem.reach[index]))


def _recovery(problem: StepProblem, usable: tuple[int, ...]) -> DualSolution:
    """Return the step towards the nearest feasible point, to the edge of the trust region."""
    weights = projection_weights(problem.gram, problem.violations)
    recovered = tuple(i for i in usable if problem.violations[i] > 0.0)
    if weights is None or not weights.any():
        worst = worst_alone(problem.gram, problem.violations)
        weights, recovered = np.zeros_like(problem.violations), (worst,)
        weights[worst] = 1.0
    weights = weights * np.sqrt(2.0 * problem.radius / float(weights @ problem.gram @ weights))
    unknown = np.full_like(problem.violations, np.nan)
    return DualSolution(StepCase.RECOVERY, 0.0, weights, unknown, recovered)


def worst_alone(gram: Floats, excesses: Floats) -> int:
    """Return the constraint that takes the longest step to meet, e_i / sqrt(S_ii).

    Only constraints that a step can influence count; there must be one.

    Args:
        gram: S, [k, k].
        excesses: e, [k].
    """
    squares = np.diag(gram)
    usable = np.flatnonzero(squares > NO_INFLUENCE)
    return int(usable[np.argmax(excesses[usable] / np.sqrt(squares[usable]))])


def projection_weights(gram: Floats, excesses: Floats) -> Floats | None:
    """Return the weights nu of the module's complementarity problem, by enumeration of the binding sets.

    Args:
        gram: S, [k, k], symmetric and positive semidefinite.
        excesses: e, [k].

    Returns:
        [k], or None if the constraints contradict one another.

    >>> projection_weights(np.array([[4.0]]), np.array([2.0]))
    array([0.5])
    """
    usable = [i for i in range(len(excesses)) if gram[i, i] > NO_INFLUENCE]
    lengths = np.sqrt(np.diag(gram)[usable])
    largest = float((excesses[usable] / lengths).max(initial=0.0))
    tolerances = FEASIBILITY_TOLERANCE * largest * lengths
    for size in range(len(usable) + 1):
        for binding in itertools.combinations(usable, size):
            index = list(binding)
            block = gram[np.ix_(index, index)]
            if not _are_independent(block):
                continue  # a smaller set has the same face
            weights = np.zeros_like(excesses)
            weights[index] = np.linalg.solve(block, excesses[index])
            left = (excesses - gram @ weights)[usable]
            if np.all(weights >= 0.0) and np.all(left <= tolerances):
                return weights
    return None
