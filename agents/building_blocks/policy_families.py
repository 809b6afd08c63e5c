"""The two families of policies: categorical for Discrete actions, diagonal Gaussian for Box.

Notation: U rows, B observations, n observation components, A actions, m action components, P parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Box
from torch import Tensor

from recrl.agents.building_blocks.distributions import Categorical, Gaussian
from recrl.agents.building_blocks.learning_batch import find_repeated
from recrl.agents.building_blocks.noise_scales import matching_log_std, matching_scale, off_greedy_mass
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.networks.architecture import NetworkArchitecture
from recrl.agents.spaces import action_size
from recrl.environments.cmdp import Floats

# Usual initial log standard deviation of a Gaussian policy whose actions are within [-1, 1], also that of
# safety-starter-agents.
INITIAL_LOG_STD = -0.5
# float32: a log_std that was raised to its bound is this close to it.
ROUNDING_OF_LOG_STD = 1e-6
# Noise 1 would make a tempered Gaussian infinitely wide; this bound makes it a thousand times wider.
SMALLEST_TEMPERING = 1e-3


def make_policy(
    num_observations: int,
    action_space: gymnasium.Space[Any],
    architecture: NetworkArchitecture,
    last_scale: float,
    generator: torch.Generator,
    *,
    min_std: float = 0.0,
) -> StochasticPolicy:
    """Make the policy of an action space.

    Args:
        num_observations: n.
        action_space: of one environment.
        architecture: of the network.
        last_scale: factor on the last layer's initial weights; small means nearly uniform or zero-mean.
        generator: the initialisation's randomness.
        min_std: lower bound of a Gaussian's standard deviations, see ``GaussianPolicy``.

    Raises:
        UnsupportedSpaceError: the space is neither Discrete nor a Box of floats.
    """
    size = action_size(action_space)
    if isinstance(action_space, Box):
        return GaussianPolicy(
            num_observations, action_space, architecture, last_scale, generator, min_std=min_std
        )
    return CategoricalPolicy(num_observations, size, architecture, last_scale, generator)


class CategoricalPolicy(StochasticPolicy):
    """A policy of A discrete actions; the network's outputs are their logits."""

    def sample(
        self, observations: npt.NDArray[np.float32], generator: np.random.Generator
    ) -> npt.NDArray[np.int64]:
        """Sample actions for B observations [B, n] by inversion, int64 [B]."""
        outputs = self.outputs(observations)
        cumulative = np.exp(outputs - outputs.max(axis=1, keepdims=True), dtype=np.float64).cumsum(axis=1)
        thresholds = generator.random(len(outputs)) * cumulative[:, -1]
        # A threshold may round up to the whole mass: then the last action is taken.
        actions: npt.NDArray[np.int64] = (cumulative[:, :-1] <= thresholds[:, None]).sum(axis=1)
        return actions

    def mode(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
        """Return the most likely actions at B observations [B, n], int64 [B]."""
        actions: npt.NDArray[np.int64] = self.outputs(observations).argmax(axis=1)
        return actions

    def probabilities(self, observations: npt.NDArray[np.float32]) -> Floats:
        """pi(a | s) at B observations [B, n], float64 [B, A]."""
        outputs = self.outputs(observations).astype(np.float64)
        masses = np.exp(outputs - outputs.max(axis=1, keepdims=True))
        probabilities: Floats = masses / masses.sum(axis=1, keepdims=True)
        return probabilities

    def head(self, outputs: Tensor, spreads: Sequence[Tensor]) -> Categorical:
        """Return the distributions of logits, [U, A]; there are no ``spreads``."""
        return Categorical(torch.log_softmax(outputs, dim=1))

    def add_noise(self, noise: float, observations: npt.NDArray[np.float32], form: str) -> dict[str, float]:
        """See ``StochasticPolicy.add_noise``: the logits become smaller."""
        distinct = find_repeated(observations)
        weights = np.full(len(observations), 1.0 / len(observations))
        if distinct is not None:  # on a tabular task a sixteenth of the rows
            first, row = distinct
            observations, weights = observations[first], np.bincount(row) / len(observations)
        logits = self.outputs(observations).astype(np.float64)
        scale = 1.0 - noise if form == "temperature" else matching_scale(logits, weights, noise)
        self.stack.scale(torch.tensor(scale))
        return {
            "noise_scale": scale,
            "randomness_before": off_greedy_mass(logits, weights),
            "randomness_after": off_greedy_mass(scale * logits, weights),
        }

    def bound_std(self) -> None:
        """Do nothing: there are no standard deviations."""

    def hold_bounded_std(self, gradients: Tensor, ascents: Tensor) -> None:
        """Do nothing: there are no standard deviations."""


class GaussianPolicy(StochasticPolicy):
    """A policy of m independent normal action components; the network's outputs are their means.

    Actions are in half ranges from the middle of the task's (``recrl.agents.spaces.action_range``). The
    log_std does not depend on the state.

    Args:
        num_observations: n.
        action_space: of one environment, with m components.
        architecture: of the network.
        last_scale: factor on the last layer's initial weights; small means zero-mean.
        generator: the initialisation's randomness.
        min_std: lower bound of the standard deviations, in half ranges; of m > 2 components it is times
            sqrt(2 / m).

    Attributes:
        action_space: of one environment.
    """

    def __init__(
        self,
        num_observations: int,
        action_space: Box,
        architecture: NetworkArchitecture,
        last_scale: float,
        generator: torch.Generator,
        *,
        min_std: float = 0.0,
    ) -> None:
        num_components = action_size(action_space)
        super().__init__(
            num_observations, num_components, architecture, last_scale, generator, num_spreads=num_components
        )
        self.action_space = action_space
        self.log_std.fill_(INITIAL_LOG_STD)
        least = min_std * min(1.0, (2.0 / num_components) ** 0.5)
        self._least_log_std = math.log(least) if least else -math.inf
        self.bound_std()
        self.publish()

    @property
    def log_std(self) -> Tensor:
        """The log standard deviations, [m]."""
        return self.parameters.tensors[-1]

    @property
    def _acting_log_std(self) -> npt.NDArray[np.float32]:
        return self._acting_pieces[-1]

    def sample(
        self, observations: npt.NDArray[np.float32], generator: np.random.Generator
    ) -> npt.NDArray[np.float32]:
        """Sample actions for B observations [B, n], float32 [B, m]."""
        outputs = self.outputs(observations)
        spread = np.exp(self._acting_log_std)
        outputs += spread * generator.standard_normal(outputs.shape, dtype=np.float32)
        return outputs

    def mode(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return the most likely actions at B observations [B, n], float32 [B, m]."""
        return self.outputs(observations)

    def probabilities(self, observations: npt.NDArray[np.float32]) -> Floats:
        """Raise an error: continuous actions have densities.

        Raises:
            ValueError: in any case.
        """
        raise ValueError("continuous actions have densities, not probabilities")

    def head(self, outputs: Tensor, spreads: Sequence[Tensor]) -> Gaussian:
        """Return the distributions of means, [U, m]; ``spreads`` has the log_std [m]."""
        (log_std,) = spreads
        return Gaussian(outputs, log_std)

    def add_noise(self, noise: float, observations: npt.NDArray[np.float32], form: str) -> dict[str, float]:
        """See ``StochasticPolicy.add_noise``: the standard deviations become larger."""
        before = self._acting_log_std.astype(np.float64)
        if form == "temperature":
            after = before - np.log(max(1.0 - noise, SMALLEST_TEMPERING))
        else:
            after = matching_log_std(before, noise)
        self.log_std.copy_(torch.as_tensor(after))
        mean_before, mean_after = float(np.exp(before).mean()), float(np.exp(after).mean())
        return {
            "noise_scale": mean_after / mean_before,
            "randomness_before": mean_before,
            "randomness_after": mean_after,
        }

    def bound_std(self) -> None:
        """Raise the standard deviations to their lower bound.

        With two actions or more, the noise then has a mean squared length of at least 2 min_std^2 squared
        half ranges, however many there are.
        """
        self.log_std.clamp_(min=self._least_log_std)

    def hold_bounded_std(self, gradients: Tensor, ascents: Tensor) -> None:
        """See ``StochasticPolicy.hold_bounded_std``."""
        num = self.log_std.numel()
        at_bound = self.log_std <= self._least_log_std + ROUNDING_OF_LOG_STD
        held = at_bound & (ascents[:, -num:] < 0.0).any(dim=0)
        gradients[:, -num:].masked_fill_(held, 0.0)
