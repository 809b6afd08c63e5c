"""A bandit with one continuous action and a closed-form constrained optimum, for Gaussian policies.

Observation: the constant 1, float32 [1].
Action: a in [-1, 1], float32 [1]; what lies outside is clipped to it.
Reward: 1 - (1 - a)^2 a step, best at a = 1.
Cost: ``effort`` = a^2 a step.
Termination: never; truncated after ``horizon`` steps.
Source: ours.

The reward is concave and the cost convex, so by Jensen's inequality no random policy beats a constant action:

    J*(d) = H (1 - (1 - a*)^2),    a* = min(1, sqrt(d / H)).

A Gaussian of mean m and standard deviation s inside the bounds earns s^2 less and costs s^2 more a step.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space
from pydantic import Field

from recrl.environments.cmdp import CMDPSpec, CostLimits, Floats
from recrl.environments.options import Options
from recrl.environments.saved_state import IDENTITY, SavedState, identity
from recrl.environments.vector import CMDPVectorEnv, masked_environments


class ContinuousBanditOptions(Options):
    """Settings of ``continuous-bandit``."""

    horizon: int = Field(default=10, ge=1, le=10_000, description="H, steps in an episode (ours).")


def continuous_bandit_optimum(name: str, options: ContinuousBanditOptions, limits: CostLimits) -> float:
    """J*(d) = H (1 - (1 - a*)^2), a* = min(1, sqrt(d / H)).

    >>> continuous_bandit_optimum("continuous-bandit", ContinuousBanditOptions(), CostLimits((2.5,)))
    7.5
    """
    limits.require_one_per_cost(1, name)
    best = min(1.0, math.sqrt(limits[0] / options.horizon))
    return options.horizon * (1.0 - (1.0 - best) ** 2)


class ContinuousBanditVectorEnv(CMDPVectorEnv):
    """B continuous bandits. They are deterministic: the step counts are their only state."""

    def __init__(self, name: str, num_envs: int, options: ContinuousBanditOptions) -> None:
        if num_envs < 1:
            raise ValueError(f"{name}: num_envs must be at least 1, got {num_envs}")
        self.num_envs = num_envs
        self.single_observation_space = Box(0.0, 1.0, (1,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.cmdp = CMDPSpec(
            name, self.single_observation_space, self.single_action_space, ("effort",), options.horizon
        )
        self._horizon = options.horizon
        self._elapsed: npt.NDArray[np.int64] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start B episodes, or those of a ``reset_mask`` (``recrl.environments.vector``)."""
        chosen = masked_environments(self.cmdp, self.num_envs, options, has_begun=self._elapsed is not None)
        super().reset(seed=seed, options=options)
        if chosen is not None:
            return self.restart(chosen), {}
        self._elapsed = np.zeros(self.num_envs, np.int64)
        return self._observations(), {}

    def step(
        self, actions: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], Floats, npt.NDArray[np.bool_], npt.NDArray[np.bool_], dict[str, Any]]:
        """Take one step in every environment; see ``recrl.environments.vector`` for what is returned."""
        if self._elapsed is None:
            raise ValueError(f"{self.cmdp.name}: call reset before the first step")
        actions = np.asarray(actions, np.float64)
        if actions.shape != (self.num_envs, 1) or not np.isfinite(actions).all():
            raise ValueError(
                f"{self.cmdp.name}: actions must be finite and of shape {(self.num_envs, 1)}, "
                f"got {actions.tolist()}"
            )
        pull: Floats = np.clip(actions, -1.0, 1.0)
        self._elapsed += 1
        truncated = self._elapsed >= self._horizon
        self._elapsed[truncated] = 0
        info: dict[str, Any] = {"cost": pull**2}
        if truncated.any():
            info["final_obs"], info["_final_obs"] = self._observations(), truncated.copy()
        rewards: Floats = 1.0 - (1.0 - pull[:, 0]) ** 2
        return self._observations(), rewards, np.zeros(self.num_envs, np.bool_), truncated, info

    def restart(self, index: npt.NDArray[np.intp]) -> npt.NDArray[np.float32]:
        """Begin new episodes in some environments; see ``recrl.environments.vector``."""
        if self._elapsed is None:
            raise ValueError(f"{self.cmdp.name}: call reset before restart")
        self._elapsed[index] = 0
        return self._observations()

    def state_dict(self) -> dict[str, Any]:
        """The steps taken in each episode."""
        if self._elapsed is None:
            raise ValueError(f"{self.cmdp.name}: there is no state before reset")
        return {IDENTITY: identity(self.cmdp), "elapsed": self._elapsed.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken.

        Raises:
            ValueError: the state is damaged, of another task, or of other options.
        """
        saved = SavedState(f"{self.cmdp.name}: saved state", state)
        saved.check_identity(self.cmdp)
        saved.check_number("elapsed", self.num_envs)
        like = np.zeros(self.num_envs, np.int64)
        self._elapsed = saved.array("elapsed", like, least=0, most=self._horizon - 1)

    def _observations(self) -> npt.NDArray[np.float32]:
        return np.ones((self.num_envs, 1), np.float32)
