"""A task of one's own: any Gymnasium environment that reports ``info["cost"]``, under a name."""

import gymnasium
import numpy as np


class Corridor(gymnasium.Env):
    """Walk to the end; running gets there in half the time and costs 1 a step.

    Options of the task are the keywords here: ``options: {length: 12}`` in a grid.
    """

    def __init__(self, length: int = 8) -> None:
        self.length = length
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(2)  # walk, run
        self.spec = gymnasium.envs.registration.EnvSpec("Corridor-v0", max_episode_steps=length)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return self._observation(), {}

    def step(self, action):
        self.place += 1 + int(action)
        arrived = self.place >= self.length
        return self._observation(), 10.0 * arrived - 1.0, arrived, False, {"cost": float(action)}

    def _observation(self):
        return np.array([min(1.0, self.place / self.length)], np.float32)
