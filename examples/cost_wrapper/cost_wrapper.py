"""Existing environments as tasks: wrappers that put a cost into ``info["cost"]``."""

import gymnasium


class FarFromMiddle(gymnasium.Wrapper):
    """CartPole with a cost of 1 for each step in which the cart is far from the middle."""

    cost_names = ("far",)

    def __init__(self, env, distance):
        super().__init__(env)
        self.distance = distance

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        cost = float(abs(observation[0]) > self.distance)
        return observation, reward, terminated, truncated, {**info, "cost": cost}


def pole(distance=0.5, render_mode=None):
    """Return one environment. Its keywords are the options of the task in the grid file."""
    return FarFromMiddle(gymnasium.make("CartPole-v1", render_mode=render_mode), distance)


class SeparateCost(gymnasium.Wrapper):
    """An environment whose step returns the cost as its third value of six."""

    def step(self, action):
        observation, reward, cost, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, "cost": cost}
