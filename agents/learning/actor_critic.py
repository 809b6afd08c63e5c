"""Common part of all agents: a policy, 1 + k critics, and the steps of an update.

An agent is an ``ActorCritic`` with a *rule* that improves the policy; PPO-Lagrangian and CPO are rules. An
update collapses the rollout, estimates advantages, lets the rule improve the policy, and fits the critics.

An agent learns on the device that was PyTorch's default when it was made (``with torch.device("cuda")``).
Initial parameters are equal on all devices. Rollouts and actions are NumPy arrays.

Notation: T steps, B environments, N = T B samples, k costs, C = 1 + k signals, U unique observations, M
truncated steps, E finished episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache, partial
from itertools import islice
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recrl.agents.agent import Rollout
from recrl.agents.building_blocks.advantages import generalised_advantages, next_values
from recrl.agents.building_blocks.critics import Critics
from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.policy_families import make_policy
from recrl.agents.building_blocks.scales import RunningScale, quotient
from recrl.agents.constraints.cost_measures import MeanCost, RecentEpisodes, TailCost
from recrl.agents.errors import require_finite
from recrl.agents.experience import Experience
from recrl.agents.learning.estimates import Estimates, row_targets
from recrl.agents.learning.final_policy import NetworkPolicy, PolicyAverage
from recrl.agents.learning.policy_rule import PolicyRule, Stateful, improve_and_measure, indexed, united
from recrl.agents.networks.architecture import INITIALISERS, NetworkArchitecture
from recrl.agents.networks.flat_parameters import Adam
from recrl.agents.observation_features import Encoder
from recrl.agents.shared_options import ActorCriticConfig
from recrl.agents.spaces import observation_size, unbounded_numbers
from recrl.environments.cmdp import CMDPSpec, CurriculumStep, Floats
from recrl.environments.plugins import trusted_attribute


class ActorCritic(NetworkPolicy):
    """An agent; see ``recrl.agents.agent.Agent`` for the contract of its methods.

    Args:
        cmdp: the task's CMDP.
        config: the common settings of agents.
        encoder: of the observations that policy and critics see.
        policy: of the encoded observations and the task's actions.
        average: of the policies after the updates.
        critics: of the reward and the k costs.
        rule: improves the policy.
        generator: of the minibatches.
    """

    learns_rewarded_entropy: ClassVar[bool] = True

    def __init__(
        self,
        cmdp: CMDPSpec,
        config: ActorCriticConfig,
        *,
        encoder: Encoder,
        policy: StochasticPolicy,
        average: PolicyAverage,
        critics: Critics,
        rule: PolicyRule,
        generator: np.random.Generator,
    ) -> None:
        super().__init__(encoder, policy)
        self._cmdp = cmdp
        self._config = config
        self._average = average
        self._critics = critics
        self._critic_optimiser = Adam(critics.parameters, config.critic_learning_rate)
        self._value_scale = RunningScale(1 + cmdp.num_costs)
        self._recent = RecentEpisodes(config.constraint_window, cmdp.num_costs)
        self._rule = rule
        self._generator = generator
        self._constraint = (
            TailCost(config.cvar_level)
            if config.constraint == "cvar"
            else MeanCost(config.constraint_window, cmdp.num_costs)
        )
        self._parts: dict[str, Stateful] = {
            "encoder": self._encoder,
            "average": self._average,
            "critic_optimiser": self._critic_optimiser,
            "value_scale": self._value_scale,
            "recent_episodes": self._recent,
        }
        if isinstance(self._constraint, MeanCost):
            self._parts["constraint"] = self._constraint
        if not isinstance(getattr(rule, "parts", None), Mapping):
            raise TypeError("a rule needs an attribute parts: a dict of what is saved, {} for nothing")
        reserved = {"policy", "critics", "generator", "constraint", *self._parts}
        if taken := sorted(rule.parts.keys() & reserved):
            raise ValueError(f"a rule's parts need other names than the agent's own, got {', '.join(taken)}")
        self._parts |= rule.parts

    def final_policy(self) -> NetworkPolicy:
        """Return the policy with the parameters averaged over the last updates, see ``policy_average``."""
        encoder = self._encoder.with_statistics(self._average.statistics)
        return NetworkPolicy(encoder, self._average.network())

    def update(self, rollout: Rollout, episode_costs: Floats, step: CurriculumStep) -> dict[str, float]:
        """Improve the policy by the rule, then fit the critics to the rollout.

        Raises:
            ValueError: the number of limits or of episode costs does not fit.
            DivergedError: a reward, a loss or a parameter is not finite.
        """
        step.limits.require_one_per_cost(self._cmdp.num_costs, self._cmdp.name)
        with self._on_its_device():
            metrics = self._learn(rollout, episode_costs, step)
        self._network.publish()
        require_finite("policy parameters", self._network.parameters.to_numpy())
        require_finite("critic parameters", self._critics.parameters.to_numpy())
        self._average.add(self._network.parameters.to_numpy(), self._encoder.statistics)
        return metrics

    def _learn(self, rollout: Rollout, episode_costs: Floats, step: CurriculumStep) -> dict[str, float]:
        config, limits = self._config, step.limits.array
        observations = rollout.observations.reshape(-1, rollout.observations.shape[-1])
        actions = rollout.actions.reshape(len(observations), *rollout.actions.shape[2:])
        batch = LearningBatch.deduplicate(
            self._encoder(observations),
            actions,
            compact=config.compaction,
            most_observations=config.minibatch_size,
        )
        episodes = self._recent.add(episode_costs, rollout.finished_lengths())
        measured = self._constraint.measure(rollout, episodes, limits)
        estimates = self._estimate(rollout, measured.step_costs, batch)
        advantages = estimates.advantages
        constraints = measured.against(limits)
        experience = Experience.of(self._network, batch, advantages, constraints)
        if step.entropy_coefficient:
            experience = experience.with_entropy(step.entropy_coefficient)
        metrics = united(
            improve_and_measure(self._rule, self._network, experience, self._generator),
            {
                **indexed("cost_gap", constraints.gaps),
                **indexed("cost_advantage_max", np.abs(advantages[:, 1:]).max(axis=0)),  # eps of Lemma 1
                **estimates.explained_variances(),
                **self._fit_critics(batch, estimates.targets),
            },
        )
        self._encoder.learn(observations)
        return metrics

    def _estimate(self, rollout: Rollout, costs: Floats, batch: LearningBatch) -> Estimates:
        """Estimate advantages and value targets of the reward and the costs, [T, B, k]."""
        config = self._config
        signals = np.concatenate([rollout.rewards[..., None], costs], axis=2)
        require_finite("rewards and costs", signals)
        ended = rollout.terminated | rollout.truncated
        if config.value_scale == "running" and not self._value_scale.is_known:
            self._value_scale.add(_mean_squared_returns(signals, ended, config.discount))
        values = batch.per_sample(self._values(batch.unique_observations)).reshape(signals.shape)
        beyond = np.concatenate([rollout.final_observations, rollout.last_observations])
        beyond_values = self._values(torch.as_tensor(self._encoder(beyond)))
        num_final = len(rollout.final_observations)
        following = next_values(
            values,
            terminated=rollout.terminated,
            truncated=rollout.truncated,
            final_values=beyond_values[:num_final],
            last_values=beyond_values[num_final:],
        )
        decays = np.array(
            [config.reward_trace_decay] + [config.cost_trace_decay] * self._cmdp.num_costs, dtype=np.float64
        )
        estimated = partial(generalised_advantages, signals, values, following, ended=ended)
        advantages = estimated(discount=config.discount, trace_decays=decays)
        returns = values + estimated(discount=config.discount, trace_decays=np.ones_like(decays))
        targets = advantages + values if config.value_target == "lambda-return" else returns
        flat = (-1, signals.shape[2])
        return Estimates(
            advantages.reshape(flat), targets.reshape(flat), values.reshape(flat), returns.reshape(flat)
        )

    def _values(self, rows: Tensor) -> Floats:
        """The values of every row in the task's units, [U, n] -> [U, C]."""
        values = self._critics.values(rows)
        return values * self._value_scale.values if self._config.value_scale == "running" else values

    def _scaled(self, targets: Floats) -> tuple[Floats, Floats]:
        """Include the targets, [N, C], in their running scale; return the scaled targets and the scale, [C].

        The critics' last layers change by the same factor as the scale, so that the values do not change.
        """
        if self._config.value_scale == "none":
            return targets, np.ones(targets.shape[1])
        before = self._value_scale.values
        self._value_scale.add((targets**2).mean(axis=0))
        scale = self._value_scale.values
        self._critics.rescale(np.where(before > 0.0, quotient(before, scale), 1.0))
        return quotient(targets, scale), scale

    def _fit_critics(self, batch: LearningBatch, targets: Floats) -> dict[str, float]:
        """Regress all critics on their targets, [N, C]; they share no parameter, so one loss is enough.

        They take ``critic_steps`` steps, but at least ``critic_passes`` epochs.

        Returns:
            The mean squared errors over the last epoch, measured before the step of each minibatch.
        """
        config = self._config
        targets, scale = self._scaled(targets)
        num_minibatches = batch.num_minibatches(config.minibatch_size)
        steps = max(config.critic_steps, config.critic_passes * num_minibatches)
        regression_on = lru_cache(maxsize=1)(lambda part: row_targets(part, targets))
        losses = []
        for part in islice(batch.minibatches(config.minibatch_size, self._generator), steps):
            means, spread = regression_on(part)
            losses.append(
                self._critics.differentiate(part.unique_observations, part.observation_weights, means)
                + spread
            )
            self._critic_optimiser.step()
        mean = torch.stack(losses[-num_minibatches:]).mean(dim=0).numpy(force=True) * scale**2
        require_finite("value losses", mean)
        return {"value_loss_reward": float(mean[0])} | indexed("value_loss_cost", mean[1:])

    def add_noise(self, noise: float, observations: npt.NDArray[np.float32]) -> dict[str, float]:
        """Make the policy more random once; see ``recrl.agents.building_blocks.noise_scales``."""
        with self._on_its_device():
            metrics = self._network.add_noise(noise, self._encoder(observations), self._config.noise_form)
        self._network.publish()
        require_finite("policy parameters after noise", self._network.parameters.to_numpy())
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Return the parameters, the generator, and the state of every part."""
        return {
            "policy": self._network.parameters.to_numpy(),
            "critics": self._critics.parameters.to_numpy(),
            "generator": self._generator.bit_generator.state,
            **{name: part.state_dict() for name, part in self._parts.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._network.parameters.load(state["policy"])
        self._network.publish()
        self._critics.parameters.load(state["critics"])
        self._generator.bit_generator.state = state["generator"]
        for name, part in self._parts.items():
            part.load_state_dict(state[name])

    def _on_its_device(self) -> AbstractContextManager[Any]:
        """Make tensors on the device of the parameters; on a CPU this does nothing, which saves time."""
        device = self._network.parameters.values.device
        return nullcontext() if device.type == "cpu" else device


def _mean_squared_returns(signals: Floats, ended: npt.NDArray[np.bool_], discount: float) -> Floats:
    """Return the mean squares of the discounted returns within a rollout, [T, B, C] -> [C]."""
    zeros = np.zeros_like(signals)
    trace_decays = np.ones(signals.shape[2])
    returns = generalised_advantages(
        signals, zeros, zeros, ended=ended, discount=discount, trace_decays=trace_decays
    )
    squares: Floats = (returns**2).mean(axis=(0, 1))
    return squares


def _normalised_numbers(cmdp: CMDPSpec, config: ActorCriticConfig) -> npt.NDArray[np.bool_]:
    """Return which numbers of an observation are standardised, [n]."""
    size = observation_size(cmdp.observation_space)
    if config.normalise_observations == "unbounded" and not cmdp.components:
        return unbounded_numbers(cmdp.observation_space)
    return np.full(size, config.normalise_observations == "all")


def fresh_agent(
    cmdp: CMDPSpec,
    config: ActorCriticConfig,
    seed: np.random.SeedSequence,
    make_rule: Callable[[StochasticPolicy], PolicyRule],
) -> ActorCritic:
    """Make an agent; with the same networks and seed, all agents have the same initial policy.

    Args:
        cmdp: the task's CMDP.
        config: the agent's settings.
        seed: of the initial parameters and of the order of minibatches.
        make_rule: the agent's rule for a policy.

    Raises:
        TypeError: the settings are not those of an actor-critic, or the rule has no ``parts``.
    """
    if not isinstance(config, ActorCriticConfig):
        raise TypeError(
            "the options of an agent of fresh_agent must derive from those in recrl.agents.shared_options, "
            f"such as ActorCriticConfig, got {type(config).__name__}"
        )
    encoder = Encoder(
        observation_size(cmdp.observation_space),
        cmdp.components,
        scales=config.proximity_scales if config.encoder == "proximity" else (),
        normalise=_normalised_numbers(cmdp, config),
    )
    architecture = NetworkArchitecture(
        config.hidden_sizes,
        INITIALISERS[config.initialisation],
        config.activation,
        None if config.network is None else trusted_attribute(config.network),
    )

    def first_policy() -> tuple[StochasticPolicy, torch.Generator]:
        """Make the policy before the first update; return the generator for further networks, too."""
        generator = torch.Generator().manual_seed(int(seed.generate_state(1, np.uint64)[0] >> 1))
        made = make_policy(
            encoder.size,
            cmdp.action_space,
            architecture,
            config.last_layer_scale,
            generator,
            min_std=config.min_std,
        )
        return made, generator

    policy, generator = first_policy()
    averaged, _ = first_policy()
    critics = Critics(encoder.size, cmdp.num_costs, architecture, generator)
    order = np.random.SeedSequence(entropy=seed.entropy, spawn_key=(*seed.spawn_key, 0))
    return ActorCritic(
        cmdp,
        config,
        encoder=encoder,
        policy=policy,
        average=PolicyAverage(averaged, config.policy_average),
        critics=critics,
        rule=make_rule(policy),
        generator=np.random.default_rng(order),
    )
