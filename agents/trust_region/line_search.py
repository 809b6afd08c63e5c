"""A backtracking line search along a step of a policy's P parameters."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.networks.flat_parameters import FlatParameters
from recrl.agents.shared_options import TrustRegionConfig


def backtrack(
    parameters: FlatParameters,
    step: Tensor,
    is_acceptable: Callable[[], bool],
    *,
    ratio: float,
    tries: int,
    project: Callable[[], None] = lambda: None,
) -> int | None:
    """Move along ``step`` and shorten it until the new policy is acceptable.

    Args:
        parameters: changed in place; restored if no try is acceptable.
        step: the full step, [P].
        is_acceptable: checks the policy at its present parameters.
        ratio: factor in (0, 1) on the step from one try to the next.
        tries: largest number of tries, at least 1.
        project: moves the parameters to the nearest allowed ones before each check.

    Returns:
        j, the number of times the step was shortened (it is then ``ratio ** j`` times the full one), or
        None if no try was acceptable.
    """
    start = parameters.values.clone()
    for shortened in range(tries):
        torch.add(start, step, alpha=ratio**shortened, out=parameters.values)
        project()
        if is_acceptable():
            return shortened
    parameters.values.copy_(start)
    return None


def line_search(
    policy: StochasticPolicy, step: Tensor, is_acceptable: Callable[[], bool], config: TrustRegionConfig
) -> dict[str, float]:
    """``backtrack`` with an agent's settings; standard deviations below their bound are raised to it.

    Returns:
        Metrics: ``policy_steps``, 1 or 0; ``line_search_steps``, how often the step was shortened; and
        ``step_norm``, the length of the step taken.
    """
    shortened = backtrack(
        policy.parameters,
        step,
        is_acceptable,
        ratio=config.backtrack_ratio,
        tries=config.backtrack_tries,
        project=policy.bound_std,
    )
    taken = 0.0 if shortened is None else config.backtrack_ratio**shortened
    return {
        "policy_steps": float(shortened is not None),
        "line_search_steps": float(config.backtrack_tries if shortened is None else shortened),
        "step_norm": taken * float(step.norm()),
    }
