"""Conjugate gradients: the product of an inverse metric and a gradient.

Notation: P parameters, H the metric (``recrl.agents.trust_region.fisher_metric.FisherMetric``).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

# For a system scaled to a right-hand side of length 1.
CONVERGED_SQUARED_RESIDUAL = 1e-10
# A right-hand side shorter than this is a rounding error.
VANISHED = 1e-15


def conjugate_gradient(metric: Callable[[Tensor], Tensor], target: Tensor, *, iterations: int) -> Tensor:
    """Solve H x = b approximately (Nocedal and Wright 2006, algorithm 5.2, from x = 0).

    Args:
        metric: v -> H v, with H symmetric and positive definite. In a direction without curvature the
            iteration ends.
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
        curvature = float(torch.dot(direction, product))
        if curvature <= 0.0:  # a policy that its parameters do not change, without damping
            break
        step = squared / curvature
        solution.add_(direction, alpha=step)
        residual.sub_(product, alpha=step)
        previous, squared = squared, float(torch.dot(residual, residual))
        direction.mul_(squared / previous).add_(residual)
    return solution.mul_(length)
