"""Frozen-policy evaluation: what a policy earns and costs when it no longer learns.

Episodes are counted per environment, not in the order in which they end: taking the first that end would
favour short ones, and on RiverGrid short means good.

Letters: B environments, n observation components.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.agents.agent import Agent
from recrl.agents.collect import Collector, FinishedEpisode
from recrl.environments.vector import CMDPVectorEnv

CHUNK_STEPS = 100
MAX_STEPS = 10_000_000


class FrozenPolicy(StrEnum):
    """How a frozen policy chooses: as it was trained, or by its mode."""

    STOCHASTIC = "stochastic"
    DETERMINISTIC = "deterministic"


@dataclass(frozen=True)
class _Actor:
    """The part of an agent that a collector uses."""

    agent: Agent
    policy: FrozenPolicy

    def act(self, observations: npt.NDArray[np.float32], generator: np.random.Generator) -> npt.NDArray[Any]:
        if self.policy is FrozenPolicy.DETERMINISTIC:
            return self.agent.act_greedily(observations)
        return self.agent.act(observations, generator)


def evaluate(
    agent: Agent,
    environments: CMDPVectorEnv,
    policy: FrozenPolicy,
    *,
    num_episodes: int,
    seed: np.random.SeedSequence,
) -> tuple[FinishedEpisode, ...]:
    """Run a frozen policy for a number of whole episodes.

    Args:
        agent: whose policy acts; it is not changed.
        environments: B fresh environments; they are reset here.
        policy: stochastic or deterministic.
        num_episodes: at least 0; each environment runs its equal share, the first ones one more.
        seed: of the environments and of the policy's randomness.

    Returns:
        ``num_episodes`` episodes, environment by environment.

    Raises:
        RuntimeError: the episodes do not end.
    """
    environment_seed, policy_seed = np.random.SeedSequence(
        entropy=seed.entropy, spawn_key=seed.spawn_key
    ).spawn(2)
    generator = np.random.default_rng(policy_seed)
    collector = Collector(environments, num_steps=CHUNK_STEPS)
    collector.reset(seed=int(environment_seed.generate_state(1)[0]))
    whole, rest = divmod(num_episodes, environments.num_envs)
    shares = [whole + (index < rest) for index in range(environments.num_envs)]
    done: list[list[FinishedEpisode]] = [[] for _ in shares]
    steps = 0
    while any(len(episodes) < share for episodes, share in zip(done, shares, strict=True)):
        if steps >= MAX_STEPS:
            raise RuntimeError(f"evaluation: no episode ended within {MAX_STEPS} steps")
        _, finished = collector.collect(_Actor(agent, policy), generator)
        steps += CHUNK_STEPS
        for episode in finished:
            if len(done[episode.environment]) < shares[episode.environment]:
                done[episode.environment].append(episode)
    return tuple(episode for episodes in done for episode in episodes)
