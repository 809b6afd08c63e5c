"""Many MuJoCo simulations of one model, stepped together, that can be saved and restored exactly.

This is MuJoCo's own batch (``mjbatch.h``, MuJoCo 4) through its C interface. MuJoCo's Python class
``mujoco.batch.Batch`` lacks one thing: which bodies sleep is not part of a state row, and the class offers no
way to put it back. Here ``load`` does, so that a simulation with sleeping bodies continues to the last bit.

Letters: B simulations; n numbers in a state row.
"""

from __future__ import annotations

import ctypes
import functools
import weakref
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.machine_code import mujoco_library

Integers = npt.NDArray[np.int32]
Ids = Sequence[int] | npt.NDArray[np.intp] | None

_BatchFunction = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)
_NUM_WARNINGS = int(mujoco.mjtWarning.mjNWARNING)
BAD_STATES = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]
_EVERYTHING, _NOTHING = int(mujoco.mjtStage.mjSTAGE_ACC), int(mujoco.mjtStage.mjSTAGE_NONE)
ROW = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class _Config(ctypes.Structure):
    """``mjBatchConfig``."""

    _fields_ = (("nthread", ctypes.c_int), ("persistent", ctypes.c_bool))


@functools.cache
def _library() -> Any:
    """MuJoCo's shared library, with the types of the functions that are used here."""
    library = mujoco_library()
    pointer, integer = ctypes.c_void_p, ctypes.c_int
    signatures: dict[str, tuple[Any, tuple[Any, ...]]] = {
        "mjb_makeBatch": (
            pointer,
            (pointer, integer, ctypes.POINTER(_Config), ctypes.c_char_p, integer),
        ),
        "mjb_deleteBatch": (None, (pointer,)),
        "mjb_nstate": (integer, (pointer,)),
        "mjb_state": (pointer, (pointer,)),
        "mjb_stateComponent": (pointer, (pointer, integer, ctypes.POINTER(integer))),
        "mjb_warning": (pointer, (pointer,)),
        "mjb_step": (integer, (pointer, pointer, integer, integer, integer)),
        "mjb_forward": (integer, (pointer, pointer, integer, integer)),
        "mjb_reset": (integer, (pointer, pointer, integer, pointer, integer)),
        "mjb_status": (pointer, (pointer,)),
        "mjb_error": (ctypes.c_char_p, (pointer, integer)),
        "mjb_getData": (None, (pointer, integer, pointer)),
        "mjb_apply": (integer, (pointer, pointer, integer, pointer, pointer, integer)),
        "mj_updateSleep": (None, (pointer, pointer)),
        "mj_copyData": (pointer, (pointer, pointer, pointer)),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


class PhysicsError(RuntimeError):
    """MuJoCo refused to go on."""


class Simulations:
    """B simulations of one model.

    Args:
        model: what is simulated; it is copied.
        number: B.
        num_threads: threads to step on, the caller's included. Results do not depend on it.

    Attributes:
        model: as given.
        number: B.
        rows: MuJoCo's integration states, a live view, [B, n]; writing to a row sets that simulation's
            state for its next call.
        stopped: simulations that MuJoCo could not compute since their last reset, [B].
        any_stopped: whether there are any.
    """

    def __init__(self, model: mujoco.MjModel, number: int, *, num_threads: int = 1) -> None:
        self.model = model
        self.number = number
        self._library = _library()
        config = _Config(nthread=num_threads, persistent=True)
        reason = ctypes.create_string_buffer(1000)
        self._batch = self._library.mjb_makeBatch(
            model._address, number, ctypes.byref(config), reason, len(reason)
        )
        if not self._batch:
            raise PhysicsError(f"MuJoCo cannot simulate this model in a batch: {reason.value.decode()}")
        self._delete = weakref.finalize(self, self._library.mjb_deleteBatch, self._batch)
        self._data = mujoco.MjData(model)
        self._everyone: Integers = np.arange(number, dtype=np.int32)
        self._everyone_address = self._everyone.ctypes.data
        self.rows: Floats = self._view(
            self._library.mjb_state(self._batch),
            np.float64,
            (number, self._library.mjb_nstate(self._batch)),
        )
        counters = self._view(self._library.mjb_warning(self._batch), np.int32, (number, _NUM_WARNINGS, 2))
        self._warnings: Integers = counters[:, :, 1]
        self.stopped = np.zeros(number, np.bool_)
        self.any_stopped = False

    def state(self, component: mujoco.mjtState, shape: tuple[int, ...]) -> Floats:
        """A part of ``rows`` as a live view, [B, *shape]."""
        size = ctypes.c_int()
        address = self._library.mjb_stateComponent(self._batch, int(component), ctypes.byref(size))
        start = (address - self._library.mjb_state(self._batch)) // self.rows.itemsize
        view: Floats = self.rows[:, start : start + size.value].reshape(self.number, *shape)
        return view

    def apply(self, function: Any, argument: int, ids: Ids = None) -> None:
        """Run a compiled function on simulations, on all threads; it may step them.

        Args:
            function: from ``machine_code.compiled_for_batch``.
            argument: an address, which the function is given.
            ids: which simulations, ascending; None for all.
        """
        address, count = self._everyone_address, self.number
        if ids is not None:
            chosen = self._chosen(ids)
            address, count = chosen.ctypes.data, len(chosen)
        self._note(self._library.mjb_apply(self._batch, address, count, function.address, argument, 1))

    def step(self, substeps: int, ids: Ids = None) -> None:
        """Advance simulations, then compute everything, accelerations included, at the new state.

        Args:
            substeps: physics steps.
            ids: which simulations; None for all.
        """
        chosen = self._chosen(ids)
        self._note(
            self._library.mjb_step(self._batch, chosen.ctypes.data, len(chosen), substeps, _EVERYTHING)
        )

    def reset(self, ids: Ids) -> None:
        """Reset some simulations to the model's defaults; then write their rows and call ``forward``."""
        chosen = self._chosen(ids)
        self.stopped[chosen] = False
        self.any_stopped = bool(self.stopped.any())
        self._check(self._library.mjb_reset(self._batch, chosen.ctypes.data, len(chosen), None, _NOTHING))

    def forward(self, ids: Ids) -> None:
        """Compute everything that follows from the rows of some simulations."""
        chosen = self._chosen(ids)
        self._check(self._library.mjb_forward(self._batch, chosen.ctypes.data, len(chosen), _EVERYTHING))

    def broken(self) -> npt.NDArray[np.bool_]:
        """Whether a simulation has diverged since its last reset, [B].

        MuJoCo then warns and silently starts again from the model's defaults, or, where it cannot compute a
        step at all, leaves the simulation where it was.
        """
        return np.asarray(self._warnings[:, BAD_STATES].any(axis=1) | self.stopped)

    def data(self, index: int, into: mujoco.MjData | None = None) -> mujoco.MjData:
        """A copy of one simulation, for drawing or for any function of MuJoCo; a new one, or ``into``."""
        data = mujoco.MjData(self.model) if into is None else into
        self._library.mjb_getData(self._batch, index, data._address)
        return data

    def save(self) -> dict[str, Any]:
        """Everything that the future of these simulations depends on."""
        asleep = np.empty((self.number, self.model.ntree), np.int32)
        for index in range(self.number):
            self._library.mjb_getData(self._batch, index, self._data._address)
            asleep[index] = self._data.tree_asleep
        return {
            "rows": self.rows.copy(),
            "asleep": asleep,
            "warnings": self._warnings.copy(),
            "stopped": self.stopped.copy(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``save`` was called.

        What MuJoCo remembers of a sleeping body follows from its position: it is computed with everything
        awake, and then those that slept are put back to sleep.
        """
        rows = np.asarray(state["rows"], np.float64)
        if rows.shape != self.rows.shape:
            raise ValueError(f"saved physics must have shape {self.rows.shape}, got {rows.shape}")
        self.reset(range(self.number))
        sources = [self._restored(rows[index], state["asleep"][index]) for index in range(self.number)]
        copy_data = self._library.mj_copyData

        def put_back(model: int, data: int, index: int, _: Any) -> None:
            copy_data(data, model, sources[index]._address)

        function = _BatchFunction(put_back)
        address = ctypes.cast(function, ctypes.c_void_p)
        self._check(self._library.mjb_apply(self._batch, None, 0, address, None, 1))
        self._warnings[...], self.stopped[...] = state["warnings"], state["stopped"]
        self.any_stopped = bool(self.stopped.any())

    def _restored(self, row: Floats, asleep: Integers) -> mujoco.MjData:
        data = mujoco.MjData(self.model)
        mujoco.mj_setState(self.model, data, row, ROW)
        mujoco.mj_forward(self.model, data)
        data.tree_asleep[:] = asleep
        self._library.mj_updateSleep(self.model._address, data._address)
        # The forward pass leaves its own guess for the next solution; the row has the one that was saved.
        data.qacc_warmstart[:] = self._warm_start(row)
        return data

    def _warm_start(self, row: Floats) -> Floats:
        warm_start = np.empty(self.model.nv)
        component = mujoco.mjtState.mjSTATE_WARMSTART.value
        mujoco.mj_extractState(self.model, row, ROW, warm_start, component)
        return warm_start

    def _view(self, address: int, dtype: Any, shape: tuple[int, ...]) -> Any:
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        buffer = (ctypes.c_char * size).from_address(address)
        buffer._owner = self  # keeps the memory alive while a view is
        return np.frombuffer(buffer, dtype).reshape(shape)

    def _status(self) -> Integers:
        status: Integers = self._view(self._library.mjb_status(self._batch), np.int32, (self.number,))
        return status

    def _chosen(self, ids: Ids) -> Integers:
        return self._everyone if ids is None else np.ascontiguousarray(ids, np.int32)

    def _note(self, failed: int) -> None:
        if failed:
            self.stopped |= self._status() != 0
            self.any_stopped = True

    def _check(self, failed: int) -> None:
        if not failed:
            return
        index = int(np.flatnonzero(self._status())[0])
        message = self._library.mjb_error(self._batch, index).decode()
        raise PhysicsError(f"MuJoCo stopped in simulation {index}: {message}")
