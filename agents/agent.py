"""Interface between a trial and its agent.

An agent is any CRL algorithm. **The output of a curriculum is an argument of ``update``, never agent state**.
The cost limits are a vector [k], may be infinite, and change between updates. Arguments and results are NumPy
arrays, not tensors.

Notation: T steps, B environments, k costs, E episodes finished in the rollout, M of its steps truncated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import CurriculumStep, Floats


@dataclass(frozen=True)
class Rollout:
    """T steps of B environments, collected under one policy.

    Attributes:
        observations: float32 [T, B, n].
        actions: int64 [T, B] (categorical) or float32 [T, B, m] (Gaussian, before clipping).
        rewards: float64 [T, B].
        costs: float64 [T, B, k].
        terminated: the step ended an episode for good (value afterwards is 0), bool [T, B].
        truncated: the step ended an episode by a time-out (value afterwards is bootstrapped), bool
            [T, B]; never true where ``terminated`` is.
        final_observations: the true last observations of the truncated steps, in row-major order of
            ``truncated``, float32 [M, n].
        last_observations: the observations after the rollout, float32 [B, n]; they bootstrap the unfinished
            episodes.
        carried_costs: undiscounted costs so far of the episodes that were under way when the rollout began,
            float64 [B, k].
        carried_lengths: steps so far of those episodes, int64 [B].
    """

    observations: npt.NDArray[np.float32]
    actions: npt.NDArray[Any]
    rewards: Floats
    costs: Floats
    terminated: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]
    final_observations: npt.NDArray[np.float32]
    last_observations: npt.NDArray[np.float32]
    carried_costs: Floats
    carried_lengths: npt.NDArray[np.int64]

    def ages(self) -> npt.NDArray[np.int64]:
        """Number of earlier steps of the episode of each step, [T, B]."""
        ages = np.empty(self.rewards.shape, np.int64)
        so_far = self.carried_lengths.copy()
        for step, over in enumerate(self.terminated | self.truncated):
            ages[step] = so_far
            so_far += 1
            so_far[over] = 0
        return ages

    def finished_lengths(self) -> npt.NDArray[np.int64]:
        """Lengths of the E episodes that ended in the rollout, earlier steps included, [E], by (t, b)."""
        return self.ages()[self.terminated | self.truncated] + 1


class Policy(Protocol):
    """A policy that can collect experience: the only part of an agent that a collector needs."""

    def act(self, observations: npt.NDArray[np.float32], generator: np.random.Generator) -> npt.NDArray[Any]:
        """Sample actions for B observations [B, n]: int64 [B], or float32 [B, m].

        Continuous ones are in half ranges from the middle of the task's range.
        """
        ...


@runtime_checkable
class DiscretePolicy(Protocol):
    """A policy with action probabilities, for a finite number of actions; optional for agents."""

    def action_probabilities(self, observations: npt.NDArray[np.float32]) -> Floats:
        """pi(a | s) at B observations [B, n], float64 [B, A]; for Discrete actions only."""
        ...


class FinalPolicy(Policy, Protocol):
    """A policy that is evaluated: stochastic as it was trained, or by its mode."""

    def act_greedily(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[Any]:
        """Return the policy's mode for B observations [B, n], as ``act`` does."""
        ...


@runtime_checkable
class Averaging(Protocol):
    """An agent whose final policy differs from its behaviour policy; optional for agents."""

    def final_policy(self) -> FinalPolicy:
        """Return the policy that would be deployed now.

        It may share memory with the agent: use it before the agent learns again.
        """
        ...


class Agent(FinalPolicy, Protocol):
    """A constrained learner: CPO, PPO-Lagrangian, or a user's own."""

    def update(self, rollout: Rollout, episode_costs: Floats, step: CurriculumStep) -> dict[str, float]:
        """Learn from one rollout under the limits of a curriculum's step.

        Args:
            rollout: T x B steps collected with the current policy.
            episode_costs: undiscounted costs of the episodes that finished in it, [E, k]. With E = 0 they
                are estimated from the steps so far.
            step: the curriculum's output for this update. Its limits may be infinite. Its policy noise has
                already been added (``add_noise``). Agents for which
                ``learns_rewarded_entropy`` is true use its entropy coefficient.

        Returns:
            Metrics, finite or NaN; the keys are the same in every update.

        Raises:
            ValueError: the number of limits or of episode costs does not fit.
        """
        ...

    def add_noise(self, noise: float, observations: npt.NDArray[np.float32]) -> dict[str, float]:
        """Make the policy more exploratory once (Algorithm 2, line 9).

        Args:
            noise: eps_pi in (0, 1].
            observations: states at which the policy's randomness is measured, [N, n].

        Returns:
            Metrics of the change; the keys are always the same.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return all learnt and adaptive state: a tree of dicts, lists, JSON scalars and NumPy arrays."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        ...


def learns_rewarded_entropy(agent: Agent) -> bool:
    """Return whether ``update`` uses ``CurriculumStep.entropy_coefficient``.

    An agent says so by an attribute of this name that is true; without it, it does not.
    """
    return bool(getattr(agent, "learns_rewarded_entropy", False))


def final_policy(agent: Agent) -> FinalPolicy:
    """Return the policy that would be deployed now: the agent's own, where it does not average."""
    return agent.final_policy() if isinstance(agent, Averaging) else agent
