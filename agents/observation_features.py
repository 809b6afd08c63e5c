"""Inputs of an agent's networks, computed from observations: proximity features and normalisation.

Proximity. A lidar number v belongs to one direction: the closest object of a kind is at the distance (1 - v)
r, r the lidar's range; v = 0 if nothing is in range. Safety Gym's range is 3 m and its hazards have a radius
of 0.2 m, so only the last 7% of v, in any of 16 directions, affect the cost. A perceptron that is fitted to
raw values does not predict future cost. So for each lidar number and each length scale l the networks also
receive

    exp(-(1 - v) r / l)    for v > 0,    0 for v = 0.

The task declares which numbers are a lidar, and its range (``CMDPSpec.components``). Without this, or with
``encoder: none``, there are no such features.

Normalisation. Numbers of unknown scale (``normalise_observations``) are standardised by their mean and
standard deviation over all observations of training so far, and clipped. The statistics are updated after
each policy update, so that acting and learning on a rollout use the same ones. Evaluation does not change
them.

Notation: N observations, n numbers in each, L lidar numbers, S length scales.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box

from recrl.environments.cmdp import Floats, ObservationComponent

Rows = npt.NDArray[np.float32]

CLIP = 10.0
"""Standard deviations beyond which a normalised number is clipped."""
SMALLEST_VARIANCE = 1e-8
"""Added to variances, so that a constant number becomes 0."""


class RunningMoments:
    """Mean and variance of each of n numbers over all observations seen (Chan, Golub and LeVeque 1983).

    Args:
        size: n.
    """

    def __init__(self, size: int) -> None:
        self._count = 0
        self._mean: Floats = np.zeros(size)
        self._scatter: Floats = np.zeros(size)

    def add(self, observations: Rows) -> None:
        """Include N more observations, [N, n]."""
        count, mean = len(observations), observations.mean(axis=0, dtype=np.float64)
        scatter = ((observations - mean) ** 2).sum(axis=0)
        total, offset = self._count + count, mean - self._mean
        self._mean = self._mean + offset * (count / total)
        self._scatter = self._scatter + scatter + offset**2 * (self._count * count / total)
        self._count = total

    def standardised(self, observations: Rows) -> Rows:
        """Return (observations [N, n] - mean) / standard deviation, clipped to +-10."""
        mean, spread = self.mean_and_spread
        if not len(mean):
            return observations
        clipped = np.clip((observations - mean) / spread, -CLIP, CLIP)
        return clipped.astype(np.float32)

    @classmethod
    def of(cls, mean: Floats, variance: Floats) -> RunningMoments:
        """Return moments with a given mean and variance of each number, [n]."""
        moments = cls(len(mean))
        moments._count, moments._mean, moments._scatter = 1, mean, variance
        return moments

    @property
    def mean_and_variance(self) -> Floats:
        """The mean and the variance of each number, [2, n]; [2, 0] before the first observation."""
        return np.stack([self._mean, self._scatter / self._count]) if self._count else np.empty((2, 0))

    @property
    def mean_and_spread(self) -> tuple[Floats, Floats]:
        """The mean and the standard deviation of each number, [n]; [0] before the first observation."""
        mean, variance = self.mean_and_variance
        return mean, np.sqrt(variance + SMALLEST_VARIANCE)

    def state_dict(self) -> dict[str, Any]:
        """Return the count, the means and the sums of squared deviations."""
        return {"count": self._count, "mean": self._mean.copy(), "scatter": self._scatter.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._count = int(state["count"])
        self._mean = np.array(state["mean"], np.float64)
        self._scatter = np.array(state["scatter"], np.float64)


class Encoder:
    """Encoder of observations for the networks; see the module's docstring.

    Args:
        num_observations: n.
        components: the declared slices of an observation; empty if the task declares none.
        scales: length scales l of the proximity features in metres, each above 0; none for no features.
        normalise: which numbers are standardised by running statistics, [n].

    Attributes:
        size: number of inputs of the networks, n + S L.
    """

    def __init__(
        self,
        num_observations: int,
        components: Sequence[ObservationComponent],
        *,
        scales: Sequence[float],
        normalise: npt.NDArray[np.bool_],
    ) -> None:
        self._lidar, ranges = lidar_numbers(components)
        self._rates = [(ranges / scale).astype(np.float32) for scale in scales] if len(ranges) else []
        self._normalise = normalise
        self._moments = RunningMoments(num_observations) if normalise.any() else None
        self._is_identity = not self._rates and self._moments is None
        self.size = num_observations + len(self._rates) * len(ranges)

    def __call__(self, observations: Rows) -> Rows:
        """Encode observations, [N, n] -> [N, ``size``]."""
        if self._is_identity:
            return observations
        kept = observations
        if self._moments is not None:
            kept = np.where(self._normalise, self._moments.standardised(observations), observations)
        if not self._rates:
            return kept
        values = observations[:, self._lidar]
        seen, beyond = values > 0.0, values - np.float32(1.0)
        return np.concatenate([kept, *(np.exp(beyond * rate) * seen for rate in self._rates)], axis=1)

    def constants(self) -> dict[str, npt.NDArray[Any]]:
        """Return what an encoding is computed from at present.

        Returns:
            lidar, the indices of the lidar numbers, [L]; rates, the ranges over the length scales, [S, L];
            normalise, which numbers are standardised, [n]. If any is: mean and spread of all numbers, [n];
            else [0].
        """
        mean, spread = self._moments.mean_and_spread if self._moments else (np.empty(0), np.empty(0))
        rates = np.array(self._rates, np.float32).reshape(len(self._rates), len(self._lidar))
        return {
            "lidar": self._lidar,
            "rates": rates,
            "normalise": self._normalise,
            "mean": mean,
            "spread": spread,
        }

    @property
    def statistics(self) -> Floats:
        """The running mean and variance of each number, [2, n]; [2, 0] if there are none yet."""
        return np.empty((2, 0)) if self._moments is None else self._moments.mean_and_variance

    def with_statistics(self, statistics: Floats) -> Encoder:
        """Return an encoder with other statistics, [2, n]; itself if they are [2, 0]."""
        if not statistics.size:
            return self
        changed = copy.copy(self)
        changed._moments = RunningMoments.of(*statistics)
        return changed

    def learn(self, observations: Rows) -> None:
        """Include the observations of a rollout, [N, n], in the running statistics, if there are any."""
        if self._moments is not None:
            self._moments.add(observations)

    def state_dict(self) -> dict[str, Any]:
        """Return the running statistics; empty without normalisation."""
        return {} if self._moments is None else self._moments.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        if self._moments is not None:
            self._moments.load_state_dict(state)


def lidar_numbers(components: Sequence[ObservationComponent]) -> tuple[npt.NDArray[np.intp], Floats]:
    """Return the indices of all lidar numbers in an observation, [L], and their ranges in metres, [L].

    >>> parts = (ObservationComponent("speed", 2), ObservationComponent("walls", 2, lidar_range=3.0))
    >>> [values.tolist() for values in lidar_numbers(parts)]
    [[2, 3], [3.0, 3.0]]
    """
    ranges = np.concatenate(
        [np.empty(0), *(np.full(part.size, part.lidar_range or 0.0) for part in components)]
    )
    places = np.flatnonzero(ranges)
    return places, ranges[places]


class ProximityObservation(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Gymnasium wrapper with the proximity features, for agents of other libraries.

    Args:
        environment: its observations are vectors, and its ``observation_components`` declare the lidars, as
            in ``recrl.environments.safety_gym.safety_gym_environments``.
        components: the slices of an observation, for an environment that does not declare them.
        scales: length scales in metres.

    Raises:
        ValueError: no lidar is declared, the components are not those of an observation, or a scale is not
            above 0.
    """

    def __init__(
        self,
        environment: gymnasium.Env[Any, Any],
        components: Sequence[ObservationComponent] | None = None,
        scales: Sequence[float] = (0.15, 0.4),
    ) -> None:
        super().__init__(environment)
        if components is None and environment.has_wrapper_attr("observation_components"):
            components = environment.get_wrapper_attr("observation_components")
        space = environment.observation_space
        if not isinstance(space, Box) or len(space.shape) != 1 or not len(lidar_numbers(components or ())[0]):
            raise ValueError(
                f"proximity features need observations that are vectors with a declared lidar, got {space}; "
                "give components"
            )
        if (declared := sum(part.size for part in components or ())) != space.shape[0]:
            raise ValueError(
                f"components: must have the {space.shape[0]} numbers of an observation, got {declared}"
            )
        if not all(0.0 < scale < np.inf for scale in scales):
            raise ValueError(f"scales: must be finite and above 0, got {list(scales)}")
        self._encoder = Encoder(
            space.shape[0], components or (), scales=scales, normalise=np.zeros(space.shape[0], np.bool_)
        )
        added = self._encoder.size - space.shape[0]
        low, high = space.low.astype(np.float32), space.high.astype(np.float32)
        self.observation_space = Box(
            np.concatenate([low, np.zeros(added, np.float32)]),
            np.concatenate([high, np.ones(added, np.float32)]),
        )
        # Without a lidar, so that agents of this package do not add the features again.
        plain = (ObservationComponent(part.name, part.size) for part in components or ())
        self.observation_components = (*plain, ObservationComponent("proximity", added))

    def observation(self, observation: Any) -> Rows:
        """Add the proximity features, [n] -> [n + S L]."""
        encoded: Rows = self._encoder(np.asarray(observation, np.float32)[None]).reshape(-1)
        return encoded
