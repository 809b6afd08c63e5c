"""What all students here have in common: a policy, 1 + k critics, and the walk of an update.

A student is an ``ActorCritic`` with a *rule* that improves the policy; PPO-Lagrangian and CPO are rules. An
update collapses the rollout, estimates advantages, lets the rule improve the policy, and fits the critics.

Letters: T steps, B environments, N = T B samples, k costs, C = 1 + k signals, U distinct rows, M truncated
steps, E finished episodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch

from recrl.agents.advantages import generalised_advantages, next_values
from recrl.agents.agent import Rollout
from recrl.agents.batch import LearningBatch, to_tensor
from recrl.agents.config import StudentConfig
from recrl.agents.distributions import mean_divergence
from recrl.agents.errors import require_finite
from recrl.agents.networks import INITIALISERS, Adam, Critics, NetworkForm
from recrl.agents.policies import StochasticPolicy
from recrl.agents.spaces import observation_size
from recrl.environments.cmdp import CMDPSpec, Floats


@dataclass(frozen=True, eq=False)
class Constraints:
    """What is known about the constraints after a rollout.

    Attributes:
        limits: d, [k], possibly infinite.
        gaps: mean undiscounted cost of the finished episodes minus limit, [k]; -inf where the limit is
            infinite, NaN where no episode finished.
        episode_length: mean steps of an episode, above 0: environment steps over finished episodes; NaN if
            none finished.
    """

    limits: Floats
    gaps: Floats
    episode_length: float

    @classmethod
    def measure(
        cls, rollout: Rollout, episode_costs: Floats, limits: Floats, horizon: int | None
    ) -> Constraints:
        """Compare the finished episodes, costs [E, k], with the limits, [k]."""
        count = len(episode_costs)
        if count == 0:
            return cls(limits, np.full_like(limits, np.nan), float("nan"))
        length = rollout.rewards.size / count
        # A rollout that ends few of the episodes it carries on would make them look longer than they can be.
        return cls(limits, episode_costs.mean(axis=0) - limits, min(length, horizon or length))

    @property
    def known(self) -> bool:
        """Whether any episode finished."""
        return not bool(np.isnan(self.episode_length))


class PolicyRule(Protocol):
    """How a student's policy gets better: what tells the algorithms apart."""

    def improve(
        self,
        policy: StochasticPolicy,
        batch: LearningBatch,
        advantages: Floats,
        constraints: Constraints,
    ) -> dict[str, float]:
        """Change the policy once.

        Args:
            policy: the one that collected the samples; changed in place.
            batch: the collapsed samples.
            advantages: raw estimates for the reward, then each cost, [N, 1 + k].
            constraints: limits and gaps.

        Returns:
            Metrics, the same keys every time: ``policy_steps``, ``surrogate_reward``, ``surrogate_cost_i``,
            ``multiplier_i``, and the rule's own.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """What the rule has learnt and adapted."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        ...


def indexed(name: str, values: npt.NDArray[np.floating]) -> dict[str, float]:
    """One metric a cost, [k]: ``name_0``, ``name_1``, ...; infinite values are NaN, as metrics must be."""
    return {
        f"{name}_{i}": float(value) if np.isfinite(value) else float("nan") for i, value in enumerate(values)
    }


class ActorCritic:
    """A student; see ``recrl.agents.agent.Agent`` for what its methods promise.

    Args:
        cmdp: what the task fixes.
        config: the settings that students share.
        policy: of the task's spaces.
        critics: of the reward and the k costs.
        rule: improves the policy.
    """

    def __init__(
        self,
        cmdp: CMDPSpec,
        config: StudentConfig,
        policy: StochasticPolicy,
        critics: Critics,
        rule: PolicyRule,
    ) -> None:
        self._cmdp = cmdp
        self._config = config
        self._policy = policy
        self._critics = critics
        self._critic_optimiser = Adam(critics.parameters, config.critic_learning_rate)
        self._rule = rule

    def act(self, observations: npt.NDArray[np.float32], generator: np.random.Generator) -> npt.NDArray[Any]:
        """Sample actions for B observations [B, n]: int64 [B] or float32 [B, m]."""
        return self._policy.sample(observations, generator)

    def act_greedily(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[Any]:
        """The policy's mode for B observations [B, n]: int64 [B] or float32 [B, m]."""
        return self._policy.mode(observations)

    def action_probabilities(self, observations: npt.NDArray[np.float32]) -> Floats:
        """pi(a | s) at B observations [B, n], float64 [B, A]; for Discrete actions only."""
        return self._policy.probabilities(observations)

    def update(self, rollout: Rollout, episode_costs: Floats, limits: Floats) -> dict[str, float]:
        """Improve the policy by the rule, then fit the critics to the rollout.

        Raises:
            DivergedError: a reward, a loss or a parameter is not finite.
        """
        observations = rollout.observations.reshape(-1, rollout.observations.shape[-1])
        actions = rollout.actions.reshape(len(observations), *rollout.actions.shape[2:])
        batch = LearningBatch.gather(observations, actions, compact=self._config.compaction)
        advantages, targets = self._estimate(rollout, batch)
        constraints = Constraints.measure(rollout, episode_costs, limits, self._cmdp.horizon)
        old = self._policy.distribution(batch.rows)
        metrics = self._rule.improve(self._policy, batch, advantages, constraints)
        new = self._policy.distribution(batch.rows)
        metrics["kl"] = float(mean_divergence(old, new, batch.row_weights))
        metrics["entropy"] = float(torch.dot(batch.row_weights, new.entropy()))
        metrics |= indexed("cost_gap", constraints.gaps)
        metrics |= indexed("cost_advantage_max", np.abs(advantages[:, 1:]).max(axis=0))  # eps of Lemma 1
        metrics |= self._fit_critics(batch, targets)
        require_finite("policy parameters", self._policy.parameters.values.numpy())
        require_finite("critic parameters", self._critics.parameters.values.numpy())
        return metrics

    def _estimate(self, rollout: Rollout, batch: LearningBatch) -> tuple[Floats, Floats]:
        """Advantages and value targets of all signals, both [N, C]."""
        config = self._config
        signals = np.concatenate([rollout.rewards[..., None], rollout.costs], axis=2)
        require_finite("rewards and costs", signals)
        values = batch.per_sample(self._critics.values(batch.rows)).reshape(signals.shape)
        beyond = np.concatenate([rollout.final_observations, rollout.last_observations])
        beyond_values = self._critics.values(torch.from_numpy(beyond))
        num_final = len(rollout.final_observations)
        following = next_values(
            values,
            terminated=rollout.terminated,
            truncated=rollout.truncated,
            final_values=beyond_values[:num_final],
            last_values=beyond_values[num_final:],
        )
        ended = rollout.terminated | rollout.truncated
        decays = np.array(
            [config.reward_trace_decay] + [config.cost_trace_decay] * self._cmdp.num_costs, dtype=np.float64
        )
        advantages = generalised_advantages(
            signals, values, following, ended=ended, discount=config.discount, trace_decays=decays
        )
        if config.value_target == "lambda-return":
            targets = advantages + values
        else:
            ones = np.ones_like(decays)
            targets = values + generalised_advantages(
                signals, values, following, ended=ended, discount=config.discount, trace_decays=ones
            )
        num_signals = signals.shape[2]
        return advantages.reshape(-1, num_signals), targets.reshape(-1, num_signals)

    def _fit_critics(self, batch: LearningBatch, targets: Floats) -> dict[str, float]:
        """Regress all critics on their targets, [N, C]; they share no parameter, so one loss serves all.

        The mean squared error over samples is that about the mean target of each row, weighted by the
        row's share of the samples, plus the targets' spread about those means, which no critic can lower.
        """
        sums = batch.per_row(targets)
        shares = batch.row_weights.numpy().astype(np.float64)[:, None]
        means = to_tensor((sums / shares).T.copy())
        spread = np.mean(targets**2, axis=0) - np.sum(sums**2 / shares, axis=0)
        errors = torch.zeros(len(means))
        for _ in range(self._config.critic_steps):
            errors = self._critics.differentiate(batch.rows, batch.row_weights, means)
            self._critic_optimiser.step()
        losses = errors.numpy() + np.maximum(spread, 0.0)
        require_finite("value losses", losses)
        return {"value_loss_reward": float(losses[0])} | indexed("value_loss_cost", losses[1:])

    def add_noise(self, noise: float, observations: npt.NDArray[np.float32]) -> dict[str, float]:
        """Make the policy more random once; see ``recrl.agents.noise``."""
        metrics = self._policy.add_noise(noise, observations, self._config.noise_form)
        require_finite("policy parameters after noise", self._policy.parameters.values.numpy())
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Parameters, optimisers and the rule's state."""
        return {
            "policy": self._policy.parameters.to_numpy(),
            "critics": self._critics.parameters.to_numpy(),
            "critic_optimiser": self._critic_optimiser.state_dict(),
            "rule": self._rule.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._policy.parameters.load(state["policy"])
        self._critics.parameters.load(state["critics"])
        self._critic_optimiser.load_state_dict(state["critic_optimiser"])
        self._rule.load_state_dict(state["rule"])


def initial_networks(
    cmdp: CMDPSpec, config: StudentConfig, seed: np.random.SeedSequence
) -> tuple[StochasticPolicy, Critics]:
    """A fresh policy and its critics; the same seed gives every student the same policy."""
    generator = torch.Generator().manual_seed(int(seed.generate_state(1, np.uint64)[0] >> 1))
    num_observations = observation_size(cmdp.observation_space)
    form = NetworkForm(config.hidden_sizes, INITIALISERS[config.initialisation])
    policy = StochasticPolicy(num_observations, cmdp.action_space, form, config.last_layer_scale, generator)
    critics = Critics(num_observations, cmdp.num_costs, form, generator)
    return policy, critics
