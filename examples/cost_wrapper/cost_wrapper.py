"""Existing environments as tasks: wrappers that put a cost into ``info["cost"]``."""

import gymnasium
import numpy as np


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


class FarOrTilted(gymnasium.Wrapper):
    """CartPole with two costs: of a step far from the middle, and the angle of the pole in radians."""

    cost_names = ("far", "tilted")

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        position, _, angle, _ = observation
        costs = np.array([abs(position) > 0.5, abs(angle)], np.float64)
        return observation, reward, terminated, truncated, {**info, "cost": costs}


def pole_of_two_costs(render_mode=None):
    """Return one environment with two costs."""
    return FarOrTilted(gymnasium.make("CartPole-v1", render_mode=render_mode))


class SeparateCost(gymnasium.Wrapper):
    """An environment whose step returns the cost as its third value of six."""

    def step(self, action):
        observation, reward, cost, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, "cost": cost}
