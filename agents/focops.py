"""First-order constrained optimisation in policy space (Zhang, Vuong and Ross 2020, algorithm 1).

The best policy near pi_old is known in closed form, pi* ~ pi_old exp((A_r - sum_i nu_i A_i) / lam); the
network is drawn towards it. Up to constants, climbing

    mean over samples of 1[KL(s) <= delta] (ratio (A_r - sum_i nu_i A_i) / lam - KL(s)),
    KL(s) = KL(pi(. | s) || pi_old(. | s)),

does that. lam, the temperature, is an option, in standard deviations of the reward advantages, and the
multipliers nu move by a rule of ``recrl.agents.lagrange``; the paper's is projected ascent up to 2. Here, as
in ``ppo-lag``, the penalised advantage is divided by 1 + sum_i nu_i, so that a large multiplier does not make
the policy jump; lam keeps its meaning where no constraint binds.

Letters: N samples, U rows, D decisions, k costs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recrl.agents.actor_critic import ActorCritic, Constraints, indexed, initial_networks
from recrl.agents.advantages import penalised_advantages, scaled_advantages
from recrl.agents.ascent import Objective, ascend
from recrl.agents.batch import LearningBatch
from recrl.agents.config import FOCOPSConfig
from recrl.agents.distributions import Distribution
from recrl.agents.multipliers import Multipliers
from recrl.agents.networks import Adam
from recrl.agents.policies import StochasticPolicy
from recrl.environments.cmdp import CMDPSpec, Floats


def projection_objective(
    batch: LearningBatch, old: Distribution, advantages: Floats, *, temperature: float, radius: float
) -> Objective:
    """What draws the policy towards pi*: the module's formula.

    Args:
        batch: the collapsed samples.
        old: pi_old at the batch's rows.
        advantages: of the Lagrangian, [N].
        temperature: lam, above 0.
        radius: delta, nats; rows that have moved further pull no more.
    """
    pull = batch.per_decision(advantages / temperature)

    def objective(now: Distribution, ratios: Tensor) -> Tensor:
        assert type(now) is type(old)
        divergence = now.divergence(old)  # type: ignore[arg-type]
        near = (divergence.detach() <= radius).to(divergence.dtype)
        near_decisions = near if batch.decision_rows is None else near[batch.decision_rows]
        return torch.dot(ratios * near_decisions, pull) - torch.dot(batch.row_weights * near, divergence)

    return objective


class FirstOrderConstrainedOptimisation:
    """The rule of ``focops``; a ``recrl.agents.actor_critic.PolicyRule``."""

    def __init__(self, config: FOCOPSConfig, policy: StochasticPolicy, num_costs: int) -> None:
        self._config = config
        self._optimiser = Adam(policy.parameters, config.policy_learning_rate)
        self._multipliers = Multipliers(config, num_costs)

    def improve(
        self,
        policy: StochasticPolicy,
        batch: LearningBatch,
        advantages: Floats,
        constraints: Constraints,
    ) -> dict[str, float]:
        """Move the multipliers, then the policy."""
        multipliers = self._multipliers.answer(constraints)
        rewards, costs = scaled_advantages(advantages, "reward-scaled")
        objective = projection_objective(
            batch,
            policy.distribution(batch.rows),
            penalised_advantages(rewards, costs, multipliers),
            temperature=self._config.temperature,
            radius=self._config.target_kl,
        )
        metrics = ascend(policy, self._optimiser, batch, advantages, objective=objective, config=self._config)
        return {**metrics, **indexed("multiplier", multipliers)}

    def state_dict(self) -> dict[str, Any]:
        """The policy's optimiser, the multipliers, and the limits last seen."""
        return {"optimiser": self._optimiser.state_dict(), **self._multipliers.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._optimiser.load_state_dict(state["optimiser"])
        self._multipliers.load_state_dict(state)


def make_focops(cmdp: CMDPSpec, config: FOCOPSConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """A fresh FOCOPS student."""
    policy, critics = initial_networks(cmdp, config, seed)
    rule = FirstOrderConstrainedOptimisation(config, policy, cmdp.num_costs)
    return ActorCritic(cmdp, config, policy, critics, rule)
