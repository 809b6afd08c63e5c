"""Constraint-rectified policy optimisation (Xu, Liang and Lan 2021): no multiplier, no penalty, one rule.

Where every constraint holds up to a tolerance eta, the policy takes a trust-region step up the reward's
surrogate; otherwise one down the surrogate of a violated cost (algorithm 1), here the most violated in
standard deviations of its advantages, whatever the costs' units. Nothing is remembered from one update to the
next, so a limit that moves is answered at once.

If no episode finished, nothing is known about the constraints and the policy stays. Letters: N samples, k
costs.
"""

from __future__ import annotations

import numpy as np

from recrl.agents.actor_critic import ActorCritic, Stateful, fresh_student, indexed
from recrl.agents.advantages import SMALLEST_STD
from recrl.agents.config import CRPOConfig
from recrl.agents.experience import Experience
from recrl.agents.policies import StochasticPolicy
from recrl.agents.trpo import step_up
from recrl.environments.cmdp import CMDPSpec, Floats


def most_violated(gaps: Floats, spreads: Floats, tolerance: float) -> int | None:
    """The cost to mend, or None if all gaps are within the tolerance.

    Args:
        gaps: mean episode cost minus limit, [k]; -inf where there is no constraint.
        spreads: standard deviations of the costs' advantages, [k], above 0.
        tolerance: eta, in episode cost, at least 0.

    >>> most_violated(np.array([3.0, 2.0, -9.0]), np.array([2.0, 1.0, 1.0]), 0.5)
    1
    """
    violated = gaps > tolerance
    if not violated.any():
        return None
    return int(np.argmax(np.where(violated, gaps / spreads, -np.inf)))


class ConstraintRectifiedPolicyOptimisation:
    """The rule of ``crpo``; a ``recrl.agents.actor_critic.PolicyRule``."""

    def __init__(self, config: CRPOConfig) -> None:
        self._config = config
        self.parts: dict[str, Stateful] = {}

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Take one step up the reward or down a violated cost, unless nothing is known of the constraints."""
        constraints, advantages = experience.constraints, experience.advantages
        if not constraints.known:
            stayed = {"policy_steps": 0.0, "line_search_steps": float("nan"), "step_norm": 0.0}
            return {**stayed, **indexed("multiplier", np.full_like(constraints.limits, np.nan))}
        spreads = np.maximum(advantages.std(axis=0), SMALLEST_STD)
        standardised = (advantages - advantages.mean(axis=0)) / spreads
        mended = most_violated(constraints.gaps, spreads[1:], self._config.tolerance)
        objective = standardised[:, 0] if mended is None else -standardised[:, 1 + mended]
        multipliers = np.zeros_like(constraints.limits)
        if mended is not None:
            multipliers[mended] = np.inf  # as if this constraint were all that counts
        metrics = step_up(policy, experience, objective, self._config, generator)
        return {**metrics, **indexed("multiplier", multipliers)}


def make_crpo(cmdp: CMDPSpec, config: CRPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """A fresh CRPO student."""
    return fresh_student(cmdp, config, seed, lambda _: ConstraintRectifiedPolicyOptimisation(config))
