"""PPO on the Lagrangian (Ray et al. 2019, section 5).

Multipliers first answer the gaps; then the policy climbs the penalised surrogate in at most ``policy_steps``
full-batch steps, and stops when it has moved too far. If no episode finished, nothing is known about the
constraints: the multipliers stay.

The objective is (L_r - sum_i p_i L_i) / (1 + sum_i p_i), p the multipliers. ``separate`` clips the reward's
surrogate only (the paper's students); ``combined`` clips the surrogate of the penalised advantage
A_r - sum_i p_i A_i, so that the policy gains nothing from leaving the clip range for a cost's sake either.

Letters: N samples, D decisions, k costs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recrl.agents.actor_critic import ActorCritic, Constraints, indexed, initial_networks
from recrl.agents.batch import LearningBatch
from recrl.agents.config import PPOLagConfig
from recrl.agents.distributions import mean_divergence
from recrl.agents.errors import require_finite
from recrl.agents.lagrange import (
    STARTS,
    MultiplierState,
    pid,
    projected_ascent,
    restarted,
    softplus_adam,
)
from recrl.agents.networks import Adam
from recrl.agents.policies import StochasticPolicy
from recrl.agents.surrogates import SignedAdvantages, clipped_surrogate, surrogate
from recrl.environments.cmdp import CMDPSpec, Floats

SMALLEST_STD = 1e-8


def scaled_advantages(advantages: Floats, form: str) -> tuple[Floats, Floats]:
    """Reward advantages standardised, [N]; cost advantages centred and in the unit ``form`` says, [N, k].

    Beside standardised rewards, raw costs make the multiplier's meaning drift: on RiverGrid a step's cost
    advantage is tens of times a reward's, and grows further as the reward's spread falls. ``reward-scaled``
    divides both by the same number, so that the multiplier is the CMDP's own.

    Args:
        advantages: raw, [N, 1 + k].
        form: ``reward-scaled`` or ``centred``.
    """
    centred = advantages - advantages.mean(axis=0)
    std = max(float(centred[:, 0].std()), SMALLEST_STD)
    return centred[:, 0] / std, centred[:, 1:] / (std if form == "reward-scaled" else 1.0)


class PPOLagrangian:
    """The rule of ``ppo-lag``; a ``recrl.agents.actor_critic.PolicyRule``."""

    def __init__(self, config: PPOLagConfig, policy: StochasticPolicy, num_costs: int) -> None:
        self._config = config
        self._optimiser = Adam(policy.parameters, config.policy_learning_rate)
        self._start = STARTS[config.multiplier_rule](num_costs, config.multiplier_initial)
        self._state: MultiplierState = self._start
        self._step_multipliers = multiplier_step(config)
        self._last_limits = np.full(num_costs, np.nan)

    def improve(
        self,
        policy: StochasticPolicy,
        batch: LearningBatch,
        advantages: Floats,
        constraints: Constraints,
    ) -> dict[str, float]:
        """Move the multipliers, then the policy."""
        self._move_multipliers(constraints)
        multipliers = np.where(np.isfinite(constraints.limits), self._state["multipliers"], 0.0)
        objective = self._objective(batch, advantages, multipliers)
        old = policy.distribution(batch.rows)
        old_log_probs = old.log_prob(batch.actions, batch.decision_rows)
        stop = self._config.stop_kl_factor * self._config.target_kl
        steps, divergence = 0, 0.0
        for steps in range(self._config.policy_steps + 1):
            now = policy.evaluate(batch.rows)
            with torch.no_grad():
                divergence = float(mean_divergence(old, now.distribution, batch.row_weights))
            if steps == self._config.policy_steps or divergence > stop:
                break
            ratios = torch.exp(now.distribution.log_prob(batch.actions, batch.decision_rows) - old_log_probs)
            gain = objective(ratios)
            if self._config.entropy_bonus > 0.0:
                entropy = torch.dot(batch.row_weights, now.distribution.entropy())
                gain = gain + self._config.entropy_bonus * entropy
            now.gradient(-gain)
            self._optimiser.step()
        require_finite("the KL of the policy's steps", divergence)
        centred = batch.per_decision(advantages - advantages.mean(axis=0))
        new_log_probs = policy.distribution(batch.rows).log_prob(batch.actions, batch.decision_rows)
        gains = surrogate(torch.exp(new_log_probs - old_log_probs), centred).numpy()
        return {
            "policy_steps": float(steps),
            "surrogate_reward": float(gains[0]),
            **indexed("surrogate_cost", gains[1:]),
            **indexed("multiplier", multipliers),
        }

    def _move_multipliers(self, constraints: Constraints) -> None:
        """Answer the gaps; unknown gaps change nothing."""
        if self._config.multiplier_reset:
            changed = (constraints.limits != self._last_limits) & ~np.isnan(self._last_limits)
            self._state = restarted(self._state, self._start, changed)
        self._last_limits = constraints.limits.copy()
        if constraints.known:
            self._state = self._step_multipliers(self._state, constraints.gaps)

    def _objective(
        self, batch: LearningBatch, advantages: Floats, multipliers: Floats
    ) -> Callable[[Tensor], Tensor]:
        """What the policy climbs, as a function of the decisions' probability ratios, [D]."""
        config = self._config
        rewards, costs = scaled_advantages(advantages, config.cost_advantages)
        weight = 1.0 / (1.0 + float(multipliers.sum()))
        if config.penalty == "combined":
            penalised = SignedAdvantages.split(batch, weight * (rewards - costs @ multipliers))
            return lambda ratios: clipped_surrogate(ratios, penalised, config.clip)
        signed = SignedAdvantages.split(batch, weight * rewards)
        penalty = batch.per_decision(weight * (costs @ multipliers))
        return lambda ratios: clipped_surrogate(ratios, signed, config.clip) - surrogate(ratios, penalty)

    def state_dict(self) -> dict[str, Any]:
        """The policy's optimiser, the multipliers, and the limits last seen."""
        return {
            "optimiser": self._optimiser.state_dict(),
            "multipliers": {key: values.copy() for key, values in self._state.items()},
            "last_limits": self._last_limits.copy(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._optimiser.load_state_dict(state["optimiser"])
        self._state = {key: np.array(values, np.float64) for key, values in state["multipliers"].items()}
        self._last_limits = np.array(state["last_limits"], np.float64)


def multiplier_step(config: PPOLagConfig) -> Callable[[MultiplierState, Floats], MultiplierState]:
    """The multiplier rule that the options name, as a function of state and gaps."""
    step, maximum = config.multiplier_step, config.multiplier_maximum
    rules: dict[str, Callable[[MultiplierState, Floats], MultiplierState]] = {
        "projected": partial(projected_ascent, step_size=step, maximum=maximum),
        "softplus-adam": partial(softplus_adam, learning_rate=step),
        "pid": partial(
            pid,
            proportional=config.multiplier_proportional,
            integral=step,
            derivative=config.multiplier_derivative,
            maximum=maximum,
        ),
    }
    return rules[config.multiplier_rule]


def make_ppo_lag(cmdp: CMDPSpec, config: PPOLagConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """A fresh PPO-Lagrangian student."""
    policy, critics = initial_networks(cmdp, config, seed)
    return ActorCritic(cmdp, config, policy, critics, PPOLagrangian(config, policy, cmdp.num_costs))
