"""Tools of trust-region methods: conjugate gradient and a backtracking line search on a policy.

Notation: P parameters, H the metric (``recrl.agents.learning.policies.FisherMetric``).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from recrl.agents.networks.flat_parameters import FlatParameters
from recrl.agents.shared_options import TrustRegionConfig

# For a system scaled to a right-hand side of length 1.
CONVERGED_SQUARED_RESIDUAL = 1e-10
# A right-hand side shorter than this is a rounding error.
VANISHED = 1e-15


def conjugate_gradient(metric: Callable[[Tensor], Tensor], target: Tensor, *, iterations: int) -> Tensor:
    """Solve H x = b approximately (Nocedal and Wright 2006, algorithm 5.2, from x = 0).

    Args:
        metric: v -> H v, with H symmetric and positive definite.
        target: b, [P].
        iterations: upper bound; fewer if the residual becomes small relative to b.

    Returns:
        x, [P].
    """
    length = float(torch.linalg.vector_norm(target))
    solution = torch.zeros_like(target)
    if length < VANISHED:
        return solution
    residual = target / length  # squares of a saturated policy's gradients underflow in float32
    direction = residual.clone()
    squared = float(torch.dot(residual, residual))
    for _ in range(iterations):
        if squared <= CONVERGED_SQUARED_RESIDUAL:
            break
        product = metric(direction)
        step = squared / float(torch.dot(direction, product))
        solution.add_(direction, alpha=step)
        residual.sub_(product, alpha=step)
        previous, squared = squared, float(torch.dot(residual, residual))
        direction.mul_(squared / previous).add_(residual)
    return solution.mul_(length)


def backtrack(
    parameters: FlatParameters,
    step: Tensor,
    is_acceptable: Callable[[], bool],
    *,
    ratio: float,
    tries: int,
) -> int | None:
    """Move along ``step`` and shorten it until the new policy is acceptable.

    Args:
        parameters: changed in place; restored if no try is acceptable.
        step: the full step, [P].
        is_acceptable: checks the policy at its present parameters.
        ratio: factor in (0, 1) on the step from one try to the next.
        tries: largest number of tries, at least 1.

    Returns:
        j, the number of times the step was shortened (it is then ``ratio ** j`` times the full one), or
        None if no try was acceptable.
    """
    start = parameters.values.clone()
    for shortened in range(tries):
        torch.add(start, step, alpha=ratio**shortened, out=parameters.values)
        if is_acceptable():
            return shortened
    parameters.values.copy_(start)
    return None


def line_search(
    parameters: FlatParameters, step: Tensor, is_acceptable: Callable[[], bool], config: TrustRegionConfig
) -> dict[str, float]:
    """``backtrack`` with an agent's settings.

    Returns:
        Metrics: ``policy_steps``, 1 or 0; ``line_search_steps``, how often the step was shortened; and
        ``step_norm``, the length of the step taken.
    """
    shortened = backtrack(
        parameters, step, is_acceptable, ratio=config.backtrack_ratio, tries=config.backtrack_tries
    )
    taken = 0.0 if shortened is None else config.backtrack_ratio**shortened
    return {
        "policy_steps": float(shortened is not None),
        "line_search_steps": float(config.backtrack_tries if shortened is None else shortened),
        "step_norm": taken * float(step.norm()),
    }
