"""Collect experience: T steps of B environments under one policy.

Independent of algorithms and limits. Between two calls it keeps the current observations and the sums of the
running episodes, so episodes go on across rollouts. ``state_dict`` holds both, and a resumed collector
continues exactly. The caller saves the states of environments and generator.

If episodes are longer than a rollout, environments that begin together also end together. Most rollouts would
finish no episode, and each would contain only one part of an episode. With ``staggered`` the first episodes
are cut at evenly spread lengths, each at the end of a rollout. From then on every rollout finishes its share
of the episodes. The agent learns from a cut episode, but it does not count as finished.

Notation: T steps, B environments, k costs, n observation components, E finished episodes, M truncated steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.agents.agent import Policy, Rollout
from recrl.agents.spaces import environment_actions, observation_rows, observation_size
from recrl.environments.vector import CMDPVectorEnv


@dataclass(frozen=True)
class FinishedEpisode:
    """One episode that ended in a rollout.

    Attributes:
        step: t, index in 0..T-1 of the rollout's step that ended it.
        environment: index in 0..B-1 of the environment it ran in.
        length: its number of steps, at least 1, those in earlier rollouts included.
        episode_return: undiscounted sum of rewards.
        costs: undiscounted sums of costs, [k].
    """

    step: int
    environment: int
    length: int
    episode_return: float
    costs: tuple[float, ...]


class Collector:
    """Collector that steps a batch of environments with a policy.

    Args:
        environments: B environments of one task.
        num_steps: T, steps a rollout takes in each environment, at least 1.
        staggered: spread the environments over an episode's steps at the start, if the task's horizon exceeds
            T steps.
    """

    def __init__(self, environments: CMDPVectorEnv, *, num_steps: int, staggered: bool = False) -> None:
        if num_steps < 1:
            raise ValueError(f"num_steps must be at least 1, got {num_steps}")
        self._environments = environments
        self._num_steps = num_steps
        self._observations: npt.NDArray[np.float32] | None = None
        horizon = environments.cmdp.horizon
        self._stages = -(-horizon // num_steps) if staggered and horizon is not None else 1
        self._rollouts = 0
        num_envs, num_costs = environments.num_envs, environments.cmdp.num_costs
        self._lengths = np.zeros(num_envs, dtype=np.int64)
        self._returns = np.zeros(num_envs, dtype=np.float64)
        self._costs = np.zeros((num_envs, num_costs), dtype=np.float64)

    def reset(self, *, seed: int) -> None:
        """Seed the environments and begin B new episodes."""
        observations, _ = self._environments.reset(seed=seed)
        self._observations = observation_rows(self._environments.cmdp.observation_space, observations)
        self._rollouts = 0
        self._forget(slice(None))

    def collect(
        self, policy: Policy, generator: np.random.Generator
    ) -> tuple[Rollout, tuple[FinishedEpisode, ...]]:
        """Take T steps in each environment.

        Args:
            policy: selects the actions.
            generator: the policy's randomness.

        Returns:
            The rollout, and the episodes that finished in it in the order (t, environment).

        Raises:
            RuntimeError: neither ``reset`` nor ``load_state_dict`` was called before.
        """
        self._stagger()
        if self._observations is None:
            raise RuntimeError("a collector must be reset or restored before it collects")
        rollout = self._take_steps(self._observations, policy, generator)
        self._observations = rollout.last_observations
        self._rollouts += 1
        return rollout, self._finished(rollout)

    def _stagger(self) -> None:
        """Cut the first episodes of one group of environments: group j of J before rollout j."""
        stage, num_envs = self._rollouts, self._environments.num_envs
        if not 0 < stage < self._stages:
            return
        groups = np.arange(num_envs) * self._stages // num_envs
        turn = np.flatnonzero(groups == stage)
        if len(turn):
            observations = self._environments.restart(turn)
            self._observations = observation_rows(self._environments.cmdp.observation_space, observations)
            self._forget(turn)

    def _forget(self, index: slice | npt.NDArray[np.intp] | npt.NDArray[np.bool_]) -> None:
        """Reset the sums of some environments' episodes to 0."""
        self._lengths[index] = 0
        self._returns[index] = 0.0
        self._costs[index] = 0.0

    def _take_steps(
        self, current: npt.NDArray[np.float32], policy: Policy, generator: np.random.Generator
    ) -> Rollout:
        """Take T steps in each environment from the current observations, [B, n]."""
        environments, cmdp = self._environments, self._environments.cmdp
        shape = (self._num_steps, environments.num_envs)
        observations = np.empty((*shape, observation_size(cmdp.observation_space)), dtype=np.float32)
        rewards = np.empty(shape, dtype=np.float64)
        costs = np.empty((*shape, cmdp.num_costs), dtype=np.float64)
        terminated = np.empty(shape, dtype=np.bool_)
        truncated = np.empty(shape, dtype=np.bool_)
        actions: npt.NDArray[Any] | None = None
        final_observations: list[npt.NDArray[np.float32]] = []
        for step in range(self._num_steps):
            chosen = policy.act(current, generator)
            if actions is None:
                actions = np.empty((self._num_steps, *chosen.shape), dtype=chosen.dtype)
            observations[step] = current
            actions[step] = chosen
            following, rewards[step], terminated[step], truncated[step], info = environments.step(
                environment_actions(cmdp.action_space, chosen)
            )
            if np.shape(info["cost"]) != costs.shape[1:]:  # NumPy would spread one cost over all
                raise ValueError(
                    f"{cmdp.name}: info['cost'] must have a row for each of {environments.num_envs} "
                    f"environments and a column for each of {cmdp.num_costs} costs, got the shape "
                    f"{np.shape(info['cost'])}"
                )
            costs[step] = info["cost"]
            current = observation_rows(cmdp.observation_space, following)
            truncated[step] &= ~terminated[step]
            if truncated[step].any():
                final = info["final_obs"][truncated[step]]
                final_observations.append(observation_rows(cmdp.observation_space, final))
        assert actions is not None  # T >= 1
        return Rollout(
            observations=observations,
            actions=actions,
            rewards=rewards,
            costs=costs,
            terminated=terminated,
            truncated=truncated,
            final_observations=np.concatenate([observations[0, :0], *final_observations]),
            last_observations=current,
            carried_costs=self._costs.copy(),
            carried_lengths=self._lengths.copy(),
        )

    def _finished(self, rollout: Rollout) -> tuple[FinishedEpisode, ...]:
        """Return the episodes that ended in the rollout, and update the sums of the running ones."""
        ended = rollout.terminated | rollout.truncated
        lengths = np.empty(ended.shape, np.int64)
        returns, costs = np.empty_like(rollout.rewards), np.empty_like(rollout.costs)
        for step, over in enumerate(ended):
            self._lengths += 1
            self._returns += rollout.rewards[step]
            self._costs += rollout.costs[step]
            lengths[step], returns[step], costs[step] = self._lengths, self._returns, self._costs
            self._forget(over)
        columns = (*np.nonzero(ended), lengths[ended], returns[ended], costs[ended])
        return tuple(
            FinishedEpisode(step, environment, length, episode_return, tuple(episode_costs))
            for step, environment, length, episode_return, episode_costs in zip(
                *(column.tolist() for column in columns), strict=True
            )
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the current observations and the sums of the running episodes."""
        if self._observations is None:
            raise RuntimeError("a collector has no state before it is reset")
        return {
            "rollouts": self._rollouts,
            "observations": self._observations.copy(),
            "lengths": self._lengths.copy(),
            "returns": self._returns.copy(),
            "costs": self._costs.copy(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken.

        Raises:
            ValueError: the state has another number of environments or costs.
        """
        if state["costs"].shape != self._costs.shape:
            raise ValueError(
                f"the saved sums of costs have the shape {state['costs'].shape}, "
                f"these environments need {self._costs.shape}"
            )
        self._rollouts = int(state["rollouts"])
        self._observations = np.array(state["observations"], dtype=np.float32)
        self._lengths = np.array(state["lengths"], dtype=np.int64)
        self._returns = np.array(state["returns"], dtype=np.float64)
        self._costs = np.array(state["costs"], dtype=np.float64)


def episode_costs(episodes: tuple[FinishedEpisode, ...], num_costs: int) -> npt.NDArray[np.float64]:
    """Return the costs of finished episodes for ``Agent.update``, [E, k]; E may be 0."""
    return np.array([episode.costs for episode in episodes], dtype=np.float64).reshape(-1, num_costs)
