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
from collections.abc import Mapping
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


def masked_environments(
    name: str, num_envs: int, options: Mapping[str, Any] | None
) -> npt.NDArray[np.intp] | None:
    """Return the environments that the options of a ``reset`` select; None if it is for all of them.

    Args:
        name: the task's name, for the error.
        num_envs: B.
        options: of ``reset``; only ``reset_mask`` is known, bool [B].

    Raises:
        ValueError: there is another option, or the mask is invalid.
    """
    for key in options or {}:
        if key != "reset_mask":
            raise ValueError(f"{name}: reset takes no option {key!r} (its options: reset_mask)")
    if not options:
        return None
    mask = options["reset_mask"]
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (num_envs,):
        raise ValueError(f"{name}: reset_mask must be an array of {num_envs} booleans, got {mask!r}")
    if not mask.any():
        raise ValueError(f"{name}: reset_mask must select at least one environment, got {mask.tolist()}")
    return np.flatnonzero(mask)


def saved_integers(task: str, name: str, values: Any, *, num_envs: int, bound: int) -> npt.NDArray[np.int64]:
    """Return a part of a saved state with one integer per environment, as a new array [B].

    Args:
        task: the task's name, for the error.
        name: the part's name in the state, for the error.
        values: as saved.
        num_envs: B.
        bound: the values must be 0 to ``bound`` - 1.

    Raises:
        ValueError: there is another number of environments, or a value is invalid.
    """
    array = np.asarray(values)
    if array.shape != (num_envs,):
        raise ValueError(f"{task}: the saved state has {array.size} environments, expected {num_envs}")
    if array.dtype.kind not in "iu" or array.min() < 0 or array.max() >= bound:
        raise ValueError(
            f"{task}: {name} in the saved state must be integers from 0 to {bound - 1}, got {array.tolist()}"
        )
    return array.astype(np.int64)
