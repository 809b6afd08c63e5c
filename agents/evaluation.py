"""Evaluation and filming of a policy without learning.

Episodes are counted per environment, not in the order in which they end. The first ones to end would be
biased to short episodes, which on RiverGrid are good ones.

Nothing learns here: networks and statistics of observations change only in
``recrl.agents.learning.actor_critic.ActorCritic.update``.

Notation: B environments, k costs, n observation components.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from recrl.agents.agent import FinalPolicy
from recrl.agents.collection import Collector, FinishedEpisode
from recrl.agents.spaces import environment_actions
from recrl.environments.cmdp import Floats
from recrl.environments.registry import NotDrawnError
from recrl.environments.vector import CMDPVectorEnv

CHUNK_STEPS = 100
MAX_STEPS = 100_000
MAX_FILMED_STEPS = 10_000


class StoppedError(Exception):
    """An evaluation was stopped before its end."""


class PolicyKind(StrEnum):
    """How a final policy acts: stochastically as in training, or by its mode."""

    STOCHASTIC = "stochastic"
    DETERMINISTIC = "deterministic"


@dataclass(frozen=True)
class EvaluatedPolicy:
    """What a collector uses of a final policy."""

    actor: FinalPolicy
    kind: PolicyKind

    def act(self, observations: npt.NDArray[np.float32], generator: np.random.Generator) -> npt.NDArray[Any]:
        """Choose actions; a deterministic policy leaves the generator as it is."""
        if self.kind is PolicyKind.DETERMINISTIC:
            return self.actor.act_greedily(observations)
        return self.actor.act(observations, generator)


def evaluate(
    actor: FinalPolicy,
    environments: CMDPVectorEnv,
    kind: PolicyKind,
    *,
    num_episodes: int,
    seed: np.random.SeedSequence,
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[FinishedEpisode, ...]:
    """Run a policy without learning for a number of whole episodes.

    Args:
        actor: chooses the actions.
        environments: B fresh environments; they are reset here.
        kind: stochastic or deterministic.
        num_episodes: at least 0; divided equally among the environments, the first ones run one more.
        seed: of the environments and of the policy's randomness.
        should_stop: called every ``CHUNK_STEPS`` steps; once true, ``StoppedError`` is raised.

    Returns:
        ``num_episodes`` episodes, environment by environment.

    Raises:
        RuntimeError: environments with a share left finish none in ``MAX_STEPS`` steps, nor in twice the
            task's horizon.
        StoppedError: see ``should_stop``.
    """
    environment_seed, policy_seed = _spawned(seed)
    generator = np.random.default_rng(policy_seed)
    collector = Collector(environments, num_steps=CHUNK_STEPS)
    collector.reset(seed=int(environment_seed.generate_state(1)[0]))
    whole, rest = divmod(num_episodes, environments.num_envs)
    shares = [whole + (index < rest) for index in range(environments.num_envs)]
    done: list[list[FinishedEpisode]] = [[] for _ in shares]
    steps, most_steps = 0, max(MAX_STEPS, 2 * (environments.cmdp.horizon or 0))
    while any(len(episodes) < share for episodes, share in zip(done, shares, strict=True)):
        if should_stop():
            raise StoppedError
        if steps >= most_steps:
            short = next(i for i, share in enumerate(shares) if len(done[i]) < share)
            raise RuntimeError(
                f"evaluation: no episode ended in {most_steps:,} steps of environment {short}; the task must "
                "return terminated or truncated at some time (gymnasium.wrappers.TimeLimit does)"
            )
        _, finished = collector.collect(EvaluatedPolicy(actor, kind), generator)
        steps += CHUNK_STEPS
        for episode in finished:
            if len(done[episode.environment]) < shares[episode.environment]:
                done[episode.environment].append(episode)
                steps = 0
    return tuple(episode for episodes in done for episode in episodes)


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame of a filmed episode.

    Attributes:
        frame: RGB, uint8 [height, width, 3].
        step: steps taken, from 0.
        episode_return: undiscounted sum of the rewards so far.
        costs: undiscounted sums of the costs so far, [k]; all 0 before the first step.
    """

    frame: npt.NDArray[np.uint8]
    step: int
    episode_return: float
    costs: Floats


def film(
    actor: FinalPolicy,
    environment: gymnasium.Env[Any, Any],
    kind: PolicyKind,
    *,
    num_costs: int,
    seed: np.random.SeedSequence,
    every: int = 1,
) -> Iterator[Shot]:
    """Film one episode of a policy without learning, from before the first step.

    Args:
        actor: chooses the actions.
        environment: a rendering environment with ``info["cost"]``, for example of ``registry.make_drawn``.
        kind: stochastic or deterministic.
        num_costs: k.
        seed: of the environment and of the policy's randomness.
        every: steps from one frame to the next, at least 1; rendering may take longer than all else.

    Yields:
        Shots, the last step included; none after ``MAX_FILMED_STEPS`` steps, even if the episode goes on.

    Raises:
        NotDrawnError: the environment does not render an RGB frame.
    """
    environment_seed, policy_seed = _spawned(seed)
    generator = np.random.default_rng(policy_seed)
    chooser = EvaluatedPolicy(actor, kind)
    # Some simulators take signed seeds only.
    observation, _ = environment.reset(seed=int(environment_seed.generate_state(1)[0] >> 1))
    episode_return, costs = 0.0, np.zeros(num_costs)
    yield Shot(_frame(environment), 0, episode_return, costs)
    for step in range(1, MAX_FILMED_STEPS + 1):
        flat = gymnasium.spaces.flatten(environment.observation_space, observation)
        chosen = chooser.act(np.asarray(flat, np.float32)[None], generator)
        action = environment_actions(environment.action_space, chosen)[0]
        observation, reward, terminated, truncated, info = environment.step(action)
        episode_return += float(reward)
        costs = costs + np.asarray(info["cost"], np.float64).reshape(-1)
        if step % every == 0 or terminated or truncated:
            yield Shot(_frame(environment), step, episode_return, costs)
        if terminated or truncated:
            return


def _frame(environment: gymnasium.Env[Any, Any]) -> npt.NDArray[np.uint8]:
    wanted = "an RGB image, a uint8 array of shape (H, W, 3)"
    try:
        drawn: Any = environment.render()
    except NotImplementedError as error:
        if type(environment.unwrapped).render is not gymnasium.Env.render:  # the user's own error
            raise
        raise NotDrawnError(f"it has no render(), which must return {wanted}") from error
    if not (isinstance(drawn, np.ndarray) and drawn.dtype == np.uint8 and drawn.shape[2:] == (3,)):
        kind = f"{drawn.dtype} {drawn.shape}" if isinstance(drawn, np.ndarray) else type(drawn).__name__
        raise NotDrawnError(f"render() must return {wanted}, got {kind}")
    frame: npt.NDArray[np.uint8] = drawn
    return frame


def _spawned(seed: np.random.SeedSequence) -> list[np.random.SeedSequence]:
    """Return the seeds of the environments and of the policy; equal in every call."""
    return np.random.SeedSequence(entropy=seed.entropy, spawn_key=seed.spawn_key).spawn(2)
