"""Many MuJoCo simulations of one model, stepped together, that can be saved and restored exactly.

Each is a batch of MuJoCo's (``mjbatch.h``, MuJoCo 4) with one simulation, through its C interface; threads
share the batches out (``recrl.environments.thread_pool``). MuJoCo's Python class ``mujoco.batch.Batch`` lacks
one thing besides: which bodies sleep is not part of a state row, and the class offers no way to put it back.
Here ``load`` does, so that a simulation with sleeping bodies continues to the last bit.

Letters: B simulations; n numbers in a state row.
"""

from __future__ import annotations

import copy
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
from recrl.environments.thread_pool import SIMULATION, ThreadPool, in_cache_lines

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
        "mjb_setModels": (None, (pointer, pointer)),
        "mjb_nstate": (integer, (pointer,)),
        "mjb_state": (pointer, (pointer,)),
        "mjb_stateComponent": (pointer, (pointer, integer, ctypes.POINTER(integer))),
        "mjb_warning": (pointer, (pointer,)),
        "mjb_step": (integer, (pointer, pointer, integer, integer, integer)),
        "mjb_forward": (integer, (pointer, pointer, integer, integer)),
        "mjb_reset": (integer, (pointer, pointer, integer, pointer, integer)),
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
        if number < 1:
            raise ValueError(f"there must be at least one simulation, got {number}")
        self.model = model
        self.number = number
        self._library = _library()
        self._own_model = copy.copy(model)
        self._models = ctypes.c_void_p(self._own_model._address)
        self._batches: list[int] = []
        self._delete = weakref.finalize(
            self, _delete, self._library, self._batches, (self._own_model, self._models)
        )
        for _ in range(number):
            self._batches.append(self._make_batch())
        self._data = mujoco.MjData(model)
        self._everyone: Integers = in_cache_lines(number, np.int32)
        self._everyone[:] = np.arange(number)
        size = self._library.mjb_nstate(self._batches[0])
        addresses = [self._library.mjb_state(batch) for batch in self._batches]
        self._states = [_view(address, np.float64, (size,)) for address in addresses]
        self._warnings = [
            _view(self._library.mjb_warning(batch), np.int32, (_NUM_WARNINGS, 2)) for batch in self._batches
        ]
        self.rows: Floats = np.array(self._states)
        records = in_cache_lines(number, SIMULATION)
        records["batch"], records["state"] = self._batches, addresses
        records["row"] = [row.ctypes.data for row in self.rows]
        self._records = records
        self._threads = ThreadPool(records, size, num_threads)
        self.stopped = np.zeros(number, np.bool_)
        self.any_stopped = False

    def state(self, component: mujoco.mjtState, shape: tuple[int, ...]) -> Floats:
        """A part of ``rows`` as a live view, [B, *shape]."""
        size, batch = ctypes.c_int(), self._batches[0]
        address = self._library.mjb_stateComponent(batch, int(component), ctypes.byref(size))
        start = (address - self._library.mjb_state(batch)) // self.rows.itemsize
        view: Floats = self.rows[:, start : start + size.value].reshape(self.number, *shape)
        return view

    def apply(self, function: Any, argument: int, ids: Ids = None, *, parts: int = 1) -> None:
        """Run a compiled function on simulations; it may step them.

        Args:
            function: from ``machine_code.compiled_for_batch``.
            argument: an address, which the function is given.
            ids: which simulations, each once; None for all.
            parts: of which the function's work consists; it is done on all threads if there are several. The
                function may be called several times, each time for parts ``first`` to before ``last`` of its
                ``CALL``.

        Raises:
            ValueError: there is no such simulation, or one is named twice; or there are no parts.
        """
        chosen = self._chosen(ids)
        if parts < 1:
            raise ValueError(f"work must have at least one part, got {parts}")
        try:
            self._threads.run(function.address, argument, chosen, parts)
        finally:  # after a signal, too: the job is done then
            if self._threads.failures[0]:
                self.any_stopped = True
                self.stopped[chosen] |= self._records["failed"][chosen] != 0
                self._threads.failures[0] = 0

    def step(self, substeps: int, ids: Ids = None) -> None:
        """Advance simulations, then compute everything, accelerations included, at the new state.

        Args:
            substeps: physics steps.
            ids: which simulations; None for all.
        """
        for index in self._chosen(ids):
            self._states[index][:] = self.rows[index]
            if self._library.mjb_step(self._batches[index], None, 1, substeps, _EVERYTHING):
                self.stopped[index] = self.any_stopped = True
            self.rows[index] = self._states[index]

    def reset(self, ids: Ids) -> None:
        """Reset some simulations to the model's defaults; then write their rows and call ``forward``."""
        chosen = self._chosen(ids)
        self.stopped[chosen] = False
        self.any_stopped = bool(self.stopped.any())
        for index in chosen:
            self._check(index, self._library.mjb_reset(self._batches[index], None, 1, None, _NOTHING))
            self.rows[index] = self._states[index]

    def forward(self, ids: Ids) -> None:
        """Compute everything that follows from the rows of some simulations."""
        for index in self._chosen(ids):
            self._states[index][:] = self.rows[index]
            self._check(index, self._library.mjb_forward(self._batches[index], None, 1, _EVERYTHING))
            self.rows[index] = self._states[index]

    def broken(self) -> npt.NDArray[np.bool_]:
        """Whether a simulation has diverged since its last reset, [B].

        MuJoCo then warns and silently starts again from the model's defaults, or, where it cannot compute a
        step at all, leaves the simulation where it was.
        """
        return np.asarray([warnings[BAD_STATES, 1].any() for warnings in self._warnings] | self.stopped)

    def data(self, index: int, into: mujoco.MjData | None = None) -> mujoco.MjData:
        """A copy of one simulation, for drawing or for any function of MuJoCo; a new one, or ``into``."""
        data = mujoco.MjData(self.model) if into is None else into
        self._library.mjb_getData(self._batches[index], 0, data._address)
        return data

    def save(self) -> dict[str, Any]:
        """Everything that the future of these simulations depends on."""
        asleep = np.empty((self.number, self.model.ntree), np.int32)
        for index in range(self.number):
            self._library.mjb_getData(self._batches[index], 0, self._data._address)
            asleep[index] = self._data.tree_asleep
        return {
            "rows": self.rows.copy(),
            "asleep": asleep,
            "warnings": np.array([warnings[:, 1] for warnings in self._warnings]),
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
        for index, batch in enumerate(self._batches):
            restored = self._restored(rows[index], state["asleep"][index])

            def put_back(model: int, data: int, *_: Any, source: int = restored._address) -> None:
                self._library.mj_copyData(data, model, source)

            function = ctypes.cast(_BatchFunction(put_back), ctypes.c_void_p)
            self._check(index, self._library.mjb_apply(batch, None, 0, function, None, 1))
            self.rows[index] = self._states[index]
            self._warnings[index][:, 1] = state["warnings"][index]
        self.stopped[...] = state["stopped"]
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

    def _make_batch(self) -> int:
        config = _Config(nthread=1, persistent=True)
        reason = ctypes.create_string_buffer(1000)
        batch = self._library.mjb_makeBatch(self._models, 1, ctypes.byref(config), reason, len(reason))
        if not batch:
            raise PhysicsError(f"MuJoCo cannot simulate this model in a batch: {reason.value.decode()}")
        # Each batch has a copy of the model; one that all look at fits into a core's cache better.
        self._library.mjb_setModels(batch, ctypes.byref(self._models))
        return int(batch)

    def _chosen(self, ids: Ids) -> Integers:
        if ids is None:
            return self._everyone
        chosen = np.asarray(ids)
        if chosen.size and (
            chosen.dtype.kind not in "iu"
            or chosen.min() < 0
            or chosen.max() >= self.number
            or len(np.unique(chosen)) < len(chosen)
        ):
            raise ValueError(
                f"simulations must be different whole numbers from 0 to {self.number - 1}, "
                f"got {chosen.tolist()}"
            )
        return np.ascontiguousarray(chosen, np.int32)

    def _check(self, index: int, failed: int) -> None:
        if failed:
            message = self._library.mjb_error(self._batches[index], 0).decode()
            raise PhysicsError(f"MuJoCo stopped in simulation {index}: {message}")


def _view(address: int, dtype: Any, shape: tuple[int, ...]) -> Any:
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    return np.frombuffer((ctypes.c_char * size).from_address(address), dtype).reshape(shape)


def _delete(library: Any, batches: list[int], _needed: object) -> None:
    for batch in batches:
        library.mjb_deleteBatch(batch)
