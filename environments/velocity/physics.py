"""One compiled step of a robot's physics: MuJoCo's steps, and copies of the observed body data.

After a step, body data are those that MuJoCo computed last: before its last physics step ended. The same
holds in Gymnasium's environments, which read them without computing them anew.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.simulation.machine_code import (
    array_at,
    compiled,
    compiled_for_batch,
    mj_forward,
    mj_rnePostConstraint,
    mj_step,
)
from recrl.environments.simulation.struct_offsets import structure

MAX_FIELDS = 5
"""Maximum number of fields of ``mjData`` that are copied."""

PHYSICS = np.dtype(
    [
        ("frame_skip", np.int64),
        ("forces", np.bool_),  # whether contact forces on bodies are computed
        ("fields", np.int64),  # number of copied fields
        ("offset", np.int64, (MAX_FIELDS,)),  # in mjData
        ("size", np.int64, (MAX_FIELDS,)),  # numbers of one environment
        ("copy", np.int64, (MAX_FIELDS,)),  # address of [B, size]
    ],
    align=True,
)

physics_at = array_at(PHYSICS)
_doubles = array_at(np.float64)
_addresses = array_at(np.int64)


def physics_record(frame_skip: int, copies: dict[str, Floats], *, forces: bool) -> npt.NDArray[Any]:
    """Return the record ``PHYSICS``, an array [1].

    Args:
        frame_skip: physics steps in a step.
        copies: arrays for fields of ``mjData``, by name, contiguous, [B, ...]; the caller keeps them alive.
        forces: whether contact forces on bodies are computed.
    """
    record, data = np.zeros(1, PHYSICS), structure("mjData")
    one = record[0]
    one["frame_skip"], one["forces"], one["fields"] = frame_skip, forces, len(copies)
    for place, (name, copy) in enumerate(copies.items()):
        one["offset"][place], one["copy"][place] = getattr(data, name).offset, copy.ctypes.data
        one["size"][place] = copy[0].size
    return record


@compiled
def copy_fields(physics: Any, data: int, index: int) -> None:
    """Copy the fields that MuJoCo computed last to the arrays of ``physics_record``.

    Args:
        physics: the record ``PHYSICS``.
        data: address of one environment's ``mjData``.
        index: of that environment, the row of each array [B, size].
    """
    for place in range(physics.fields):
        size = physics.size[place]
        source = _doubles(_addresses(data + physics.offset[place], 1)[0], size)
        target = _doubles(physics.copy[place] + 8 * size * index, size)
        for number in range(size):
            target[number] = source[number]


@compiled_for_batch
def advance(model: int, data: int, index: int, argument: int) -> None:
    """Take the physics steps of one step; the controls are in the state."""
    physics = physics_at(argument, 1)[0]
    for _step in range(physics.frame_skip):
        mj_step(model, data)
    if physics.forces:
        mj_rnePostConstraint(model, data)
    copy_fields(physics, data, index)


@compiled_for_batch
def derive(model: int, data: int, index: int, argument: int) -> None:
    """Compute and copy what follows from the state, except contact forces, which stay as they were."""
    mj_forward(model, data)
    copy_fields(physics_at(argument, 1)[0], data, index)
