"""The critics of an agent: the value functions of the reward and of every cost.

Notation: U rows, n inputs, k costs.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recrl.agents.networks.architecture import NetworkArchitecture
from recrl.agents.networks.network_stack import make_stack
from recrl.agents.networks.tanh_stack import blocks


class Critics:
    """The 1 + k value functions of a CMDP: of the reward, then of each cost.

    Args:
        num_observations: n.
        num_costs: k.
        architecture: of each network.
        generator: the initialisation's randomness.
    """

    def __init__(
        self,
        num_observations: int,
        num_costs: int,
        architecture: NetworkArchitecture,
        generator: torch.Generator,
    ) -> None:
        self.parameters, self._stack = make_stack(
            architecture,
            1 + num_costs,
            num_observations,
            1,
            last_scale=1.0,
            generator=generator,
            role="critic",
        )

    def values(self, rows: Tensor) -> npt.NDArray[np.float64]:
        """Return the values of every row, [U, n] -> float64 [U, 1 + k]."""
        return self._stack.outputs(rows)[..., 0].numpy(force=True).T.astype(np.float64)

    def rescale(self, factors: npt.NDArray[np.float64]) -> None:
        """Multiply each critic's values by a factor, [1 + k] (van Hasselt et al. 2016, section 2.2)."""
        self._stack.scale(torch.as_tensor(factors, dtype=torch.get_default_dtype()))

    def differentiate(self, rows: Tensor, observation_weights: Tensor, targets: Tensor) -> Tensor:
        """Return the squared errors of each critic; write the gradient of their sum to the block.

        L_c = sum_u w_u (V_c(u) - y_cu)^2. The critics share no parameter, so the gradient of the sum consists
        of their separate gradients.

        Args:
            rows: [U, n].
            observation_weights: w, [U].
            targets: y, [1 + k, U].

        Returns:
            L, [1 + k].
        """
        losses = torch.zeros(len(targets))
        for block in blocks(len(rows)):
            activations = self._stack.activations(rows[block])
            errors = activations[-1][..., 0] - targets[:, block]
            weighted = errors * observation_weights[block]
            self._stack.pull_back(activations, (2.0 * weighted)[..., None], add=block.start > 0)
            losses += (weighted * errors).sum(dim=1)
        return losses
