"""The policy that an agent would deploy: the average of its policies after the last updates.

Primal-dual learning circles around the solution: multipliers rise while a limit is violated and fall while it
is kept, and the policy follows them. The last policy is one point of that circle. An average of the last ones
is near its centre (for convex problems: Nedic and Ozdaglar 2009; for networks: Izmailov et al. 2018).

Where observations are standardised by running statistics, these belong to the policy and are averaged, too.
With the statistics of the last update the averaged parameters would see other numbers than they learnt with.
In three trials on HalfCheetah and Ant such policies cost a tenth more than those that they averaged.

Notation: B observations, n observation components, A actions, m action components, P parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.observation_features import Encoder
from recrl.agents.torch_export import PolicyModule
from recrl.environments.cmdp import Floats


class NetworkPolicy:
    """A stochastic policy of raw observations.

    Args:
        encoder: of the observations that the network sees.
        network: the policy of encoded observations.
    """

    def __init__(self, encoder: Encoder, network: StochasticPolicy) -> None:
        self._encoder = encoder
        self._network = network

    def act(self, observations: npt.NDArray[np.float32], generator: np.random.Generator) -> npt.NDArray[Any]:
        """Sample actions for B observations [B, n]: int64 [B] or float32 [B, m]."""
        return self._network.sample(self._encoder(observations), generator)

    def act_greedily(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[Any]:
        """Return the policy's mode for B observations [B, n]: int64 [B] or float32 [B, m]."""
        return self._network.mode(self._encoder(observations))

    def action_probabilities(self, observations: npt.NDArray[np.float32]) -> Floats:
        """Return pi(a | s) at B observations [B, n], float64 [B, A]; Discrete actions only."""
        return self._network.probabilities(self._encoder(observations))

    def to_torch_module(self) -> PolicyModule:
        """Return a copy of the policy, with the encoding of observations, as a module."""
        return PolicyModule(self._encoder, self._network)


class PolicyAverage:
    """Exponential moving average of a policy over updates: of its parameters and its encoder's statistics.

    Args:
        network: holds the average; its parameters before the first update are the first policy's.
        decay: share of the average that each update keeps, in [0, 1); 0 makes the last policy the average.
    """

    def __init__(self, network: StochasticPolicy, decay: float) -> None:
        self._network = network
        self._decay = decay
        self._mean = network.parameters.to_numpy()
        self._statistics: Floats = np.empty((2, 0))
        self._updates = 0

    @property
    def statistics(self) -> Floats:
        """The average of the encoder's statistics, [2, n]; [2, 0] if it has none."""
        return self._statistics

    def add(self, parameters: npt.NDArray[np.float32], statistics: Floats) -> None:
        """Add the policy after an update.

        Args:
            parameters: of its network, [P].
            statistics: of its encoder, [2, n], or [2, 0] if it has none.
        """
        self._updates += 1
        weight = np.float32((1.0 - self._decay) / (1.0 - self._decay**self._updates))
        self._mean = _moved(self._mean, parameters, weight)
        is_first = self._statistics.shape != statistics.shape
        self._statistics = statistics.copy() if is_first else _moved(self._statistics, statistics, weight)

    def network(self) -> StochasticPolicy:
        """Return the averaged policy; the next call changes it in place."""
        self._network.parameters.load(self._mean)
        self._network.publish()
        return self._network

    def state_dict(self) -> dict[str, Any]:
        """Return both averages and the number of updates."""
        return {"mean": self._mean.copy(), "statistics": self._statistics.copy(), "updates": self._updates}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken; older states have no statistics."""
        self._mean = np.array(state["mean"], np.float32)
        self._statistics = np.array(state.get("statistics", np.empty((2, 0))), np.float64)
        self._updates = int(state["updates"])


def _moved(average: npt.NDArray[Any], value: npt.NDArray[Any], weight: np.float32) -> npt.NDArray[Any]:
    """Return average + weight (value - average); exactly the value if the weight is 1."""
    return value.copy() if weight == 1.0 else average + weight * (value - average)
