"""Interface between environments and agents: a batch of CMDPs stepped together.

Agents see every task as a ``CMDPVectorEnv``. Its contract:

- ``step(actions)`` returns observations [B, ...], rewards float64 [B], terminated bool [B], truncated
  bool [B] and ``info``, in which
    - ``info["cost"]`` is float64 [B, k], the step's costs in the order of ``cmdp.cost_names``;
    - ``info["final_obs"]`` [B, ...] holds the true last observation in the rows where an episode
      ended (elsewhere its content means nothing); it is present only if one ended;
    - ``info["_final_obs"]``, bool [B], marks these rows, and is present with it.
- An environment whose episode ended is reset in the same step (Gymnasium's ``SAME_STEP``). Row i of
  the returned observations is then the first one of the next episode.
- All other entries of ``info`` belong to the step, not to the reset, and have every row. So Gymnasium's
  ``final_info`` would be ``info`` itself; it and the masks of the other entries are left out.
- ``restart(index)`` cuts the episodes of some environments short and begins new ones in them. So does
  Gymnasium's ``reset(options={"reset_mask": mask})``, with a mask bool [B].
- Invalid actions (a wrong shape, a number that is no action, NaN) and a step before the first reset raise a
  ValueError. Continuous actions outside their bounds are clipped to them.
- ``state_dict`` holds everything that the future depends on, generators included. It is a tree of dicts,
  lists, JSON scalars and NumPy arrays. ``load_state_dict`` continues exactly from it, or raises a ValueError.

Notation: B environments, k costs.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv

from recrl.environments.cmdp import CMDPSpec


def masked_environments(
    cmdp: CMDPSpec, num_envs: int, options: Mapping[str, Any] | None, *, has_begun: bool
) -> npt.NDArray[np.intp] | None:
    """Return the environments to reset, [M], by the options of ``reset``; None if they name none.

    Args:
        cmdp: of the task, for errors.
        num_envs: B.
        options: of ``reset``. As in Gymnasium, ``reset_mask`` is bool [B], with at least one True.
        has_begun: whether ``reset`` was called before.

    Raises:
        TypeError: the mask is no array of booleans.
        ValueError: it has a wrong shape or chooses no environment, there are other options, or the first
            reset has a mask.
    """
    name = cmdp.name
    if not options:
        return None
    if others := sorted(map(str, options.keys() - {"reset_mask"})):
        raise ValueError(f"{name}: the only option of reset is 'reset_mask', got {', '.join(others)}")
    mask = options["reset_mask"]
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        kind = mask.dtype if isinstance(mask, np.ndarray) else type(mask).__name__
        raise TypeError(f"{name}: reset_mask must be an array of booleans, got {kind}")
    if mask.shape != (num_envs,) or not mask.any():
        raise ValueError(
            f"{name}: reset_mask must have shape ({num_envs},) and at least one True, got {mask.tolist()}"
        )
    if not has_begun:
        raise ValueError(f"{name}: call reset without a reset_mask first")
    return np.flatnonzero(mask)


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
