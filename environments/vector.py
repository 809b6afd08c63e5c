"""Interface between environments and agents: a batch of CMDPs stepped together.

Agents see every task as a ``CMDPVectorEnv``. Its contract:

- ``step(actions)`` returns observations [B, ...], rewards float64 [B], terminated bool [B], truncated
  bool [B] and ``info``, in which
    - ``info["cost"]`` is float64 [B, k], the step's costs in the order of ``cmdp.cost_names``;
    - ``info["final_obs"]`` [B, ...] holds the true last observation in the rows where an episode
      ended (elsewhere its content means nothing); it is present only if one ended.
- An environment whose episode ended is reset in the same step (Gymnasium's ``SAME_STEP``). Row i of
  the returned observations is then the first one of the next episode.
- ``restart(index)`` cuts the episodes of some environments short and begins new ones in them.
- Invalid actions (a wrong shape, a number that is no action, NaN) and a step before the first reset raise a
  ValueError. Continuous actions outside their bounds are clipped to them.
- ``state_dict`` holds everything that the future depends on, generators included. It is a tree of dicts,
  lists, JSON scalars and NumPy arrays. ``load_state_dict`` continues exactly from it.

Notation: B environments, k costs.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv

from recrl.environments.cmdp import CMDPSpec


class CMDPVectorEnv(VectorEnv[Any, Any, Any]):
    """B environments of one task; see the module's docstring for the contract.

    Attributes:
        cmdp: the parts of the CMDP that the task fixes.
    """

    cmdp: CMDPSpec
    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    @abstractmethod
    def restart(self, index: npt.NDArray[np.intp]) -> npt.NDArray[Any]:
        """Begin new episodes in some environments, in any state.

        Args:
            index: which of the B environments, [M], each at most once.

        Returns:
            The new observations of all environments, [B, ...].

        Raises:
            ValueError: ``reset`` was not called before.
        """

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return everything that the future of these environments depends on."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
