"""Many MuJoCo simulations of one model, stepped together, with exact save and restore.

They are one MuJoCo batch (``mjbatch.h``, MuJoCo 4), used through its C interface (``mujoco_library``), on
MuJoCo's own threads.
MuJoCo's Python class ``mujoco.batch.Batch`` cannot put sleeping bodies back to sleep, and sleep is no part of
a state row. Here ``load`` does, so that a simulation with sleeping bodies continues to the last bit.

A batch with several threads cannot be used after a fork: the child process has none of the threads.

Notation: B simulations; n numbers in a state row.
"""

from __future__ import annotations

import ctypes
import os
import weakref
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.saved_state import SavedState
from recrl.environments.simulation.mujoco_library import BatchConfig, BatchFunction, library

Integers = npt.NDArray[np.int32]
Ids = Sequence[int] | npt.NDArray[np.intp] | None

_NUM_WARNINGS = int(mujoco.mjtWarning.mjNWARNING)
BAD_STATES = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]
_EVERYTHING, _NOTHING = int(mujoco.mjtStage.mjSTAGE_ACC), int(mujoco.mjtStage.mjSTAGE_NONE)
ROW = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class PhysicsError(RuntimeError):
    """MuJoCo could not continue a simulation."""


class _Batch:
    """MuJoCo's batch; freed when neither it nor a view of its memory is in use.

    Attributes:
        address: of the ``mjBatch``.
        process: id of the process that made it.
    """

    def __init__(self, model: mujoco.MjModel, number: int, num_threads: int) -> None:
        config = BatchConfig(nthread=num_threads, persistent=True)
        reason = ctypes.create_string_buffer(1000)
        address = library().mjb_makeBatch(model._address, number, ctypes.byref(config), reason, len(reason))
        if not address:
            raise PhysicsError(f"MuJoCo cannot simulate this model in a batch: {reason.value.decode()}")
        self.address = int(address)
        self.process = os.getpid()
        weakref.finalize(self, _delete, self.address, self.process, num_threads)

    def view(self, address: int, dtype: Any, shape: tuple[int, ...]) -> Any:
        """Return the batch's memory at an address as an array, which keeps the batch alive."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        if not size:
            return np.zeros(shape, dtype)
        memory = (ctypes.c_char * size).from_address(address)
        memory.batch = self
        return np.frombuffer(memory, dtype).reshape(shape)


class Simulations:
    """B simulations of one model.

    Args:
        model: the simulated model; it is copied.
        number: B.
        num_threads: threads to step on, the caller's included. Results do not depend on it.

    Attributes:
        model: as given.
        number: B.
        rows: MuJoCo's integration states, a live view, [B, n]. Writing to a row sets that simulation's state
            for its next call.
        stopped: simulations that MuJoCo could not compute since their last reset, [B].
        any_stopped: whether there are any.
    """

    def __init__(self, model: mujoco.MjModel, number: int, *, num_threads: int = 1) -> None:
        if number < 1:
            raise ValueError(f"there must be at least one simulation, got {number}")
        self.model = model
        self.number = number
        self._num_threads = num_threads
        self._library = library()
        self._batch = _Batch(model, number, num_threads)
        self._data = mujoco.MjData(model)
        address = self._batch.address
        size = self._library.mjb_nstate(address)
        view = self._batch.view
        self.rows: Floats = view(self._library.mjb_state(address), np.float64, (number, size))
        self._warnings = view(self._library.mjb_warning(address), np.int32, (number, _NUM_WARNINGS, 2))
        # The bad states are neighbours in mjtWarning, so this is a view.
        self._bad_states = self._warnings[:, min(BAD_STATES) : max(BAD_STATES) + 1, 1]
        self._status = view(self._library.mjb_status(address), np.int32, (number,))
        self.stopped = np.zeros(number, np.bool_)
        self.any_stopped = False

    def state(self, component: mujoco.mjtState, shape: tuple[int, ...]) -> Floats:
        """Return a part of ``rows`` as a live view, [B, *shape]."""
        size, batch = ctypes.c_int(), self._batch.address
        address = self._library.mjb_stateComponent(batch, int(component), ctypes.byref(size))
        start = (address - self._library.mjb_state(batch)) // self.rows.itemsize
        view: Floats = self.rows[:, start : start + size.value].reshape(self.number, *shape)
        return view

    def output(self, field: str, shape: tuple[int, ...]) -> Floats:
        """Return a field of ``mjData`` as MuJoCo computed it last, a live view, [B, *shape].

        MuJoCo copies it after each call. Writing to it has no effect on the simulations.

        Args:
            field: its name, of numbers in double precision and of a size that the model fixes.
            shape: of one simulation's.
        """
        address = self._library.mjb_output(self._batch.address, field.encode(), None, None)
        view: Floats = self._batch.view(address, np.float64, (self.number, *shape))
        return view

    def step(self, count: int, ids: Ids = None, *, derive: bool) -> None:
        """Take physics steps.

        Args:
            count: number of steps.
            ids: the simulations, each once; None for all.
            derive: whether to compute what follows from the last state. Otherwise fields of ``mjData`` are as
                they were before the last step ended.

        Raises:
            ValueError: there is no such simulation, or one is named twice.
            PhysicsError: the simulations use threads, and this process is a fork of their owner.
        """
        self._call(self._library.mjb_step, ids, count, _EVERYTHING if derive else _NOTHING)

    def step_with_inputs(self, inputs: Floats, components: int, ids: Ids) -> None:
        """Take physics steps, each with inputs of its own, and compute what follows; see ``step``.

        Args:
            inputs: for each step, [n, steps, numbers], contiguous.
            components: what they are, bits of ``mjtState``.
            ids: n simulations, in ascending order; None for all.
        """
        steps, address = inputs.shape[1], inputs.ctypes.data
        self._call(self._library.mjb_rollout, ids, steps, address, components, None, 0)
        self._call(self._library.mjb_forward, ids, _EVERYTHING)

    def compute_body_forces(self) -> None:
        """Compute the forces on bodies (``cfrc_ext``), which MuJoCo does not compute in a step."""
        function = ctypes.cast(self._library.mj_rnePostConstraint, ctypes.c_void_p)
        # MuJoCo passes (model, data, index, argument). This function takes the first two. The calling
        # conventions of the processors that MuJoCo supports ignore the others; Humanoid's parity shows it.
        self._call(self._library.mjb_apply, None, function, None, 0)
        self._call(self._library.mjb_forward, None, _NOTHING)  # copies the outputs

    def reset(self, ids: Ids) -> None:
        """Reset some simulations to the model's defaults; then write their rows and call ``forward``."""
        self._check(self._library.mjb_reset, ids, None, _NOTHING)
        self.stopped[self._chosen(ids)] = False
        self.any_stopped = bool(self.stopped.any())

    def forward(self, ids: Ids) -> None:
        """Compute everything that follows from the rows of some simulations."""
        self._check(self._library.mjb_forward, ids, _EVERYTHING)

    def broken(self) -> npt.NDArray[np.bool_]:
        """Whether a simulation has diverged since its last reset, [B].

        After divergence MuJoCo restarts from the model's defaults. If it cannot compute a step, it leaves the
        state unchanged.
        """
        return np.asarray(self._bad_states.any(axis=1) | self.stopped)

    def any_broken(self) -> bool:
        """Whether any simulation has diverged since its last reset; cheaper than ``broken``."""
        return self.any_stopped or bool(self._bad_states.any())

    def data(self, index: int, into: mujoco.MjData | None = None) -> mujoco.MjData:
        """Copy one simulation, for rendering or any function of MuJoCo; into a new object, or ``into``."""
        data = mujoco.MjData(self.model) if into is None else into
        self._library.mjb_getData(self._batch.address, index, data._address)
        return data

    def save(self) -> dict[str, Any]:
        """Return everything that the future of these simulations depends on."""
        asleep = [self.data(index, self._data).tree_asleep.copy() for index in range(self.number)]
        return {
            "rows": self.rows.copy(),
            "asleep": np.array(asleep, np.int32),
            "warnings": self._warnings[:, :, 1].copy(),
            "stopped": self.stopped.copy(),
        }

    def load(self, saved: SavedState) -> None:
        """Continue exactly where ``save`` was called.

        MuJoCo's data of a sleeping body follow from its position. They are computed with all bodies awake;
        then the sleeping ones are put back to sleep.

        Raises:
            ValueError: the state is damaged, or of other simulations.
        """
        rows = saved.array("rows", self.rows)
        warnings = saved.array("warnings", self._warnings[:, :, 1], least=0)
        stopped = saved.array("stopped", self.stopped)
        asleep = self._asleep(saved)
        self.reset(None)
        for index in range(self.number):
            try:
                restored = self._restored(rows[index], asleep[index])
            except mujoco.FatalError as error:
                reason = str(error).splitlines()[0]
                raise saved.error(f"rows.{index}", f"cannot be computed by MuJoCo ({reason})") from error

            def put_back(model: int, data: int, *_: Any, source: int = restored._address) -> None:
                self._library.mj_copyData(data, model, source)

            function = ctypes.cast(BatchFunction(put_back), ctypes.c_void_p)
            self._check(self._library.mjb_apply, [index], function, None, 1)
        self._check(self._library.mjb_forward, None, _NOTHING)  # copies the outputs
        self._warnings[:, :, 1] = warnings
        self.stopped[...] = stopped
        self.any_stopped = bool(self.stopped.any())

    def _asleep(self, saved: SavedState) -> Integers:
        """Return the saved ``tree_asleep`` of each simulation, [B, trees].

        It is negative for trees that are awake. Trees that sleep form cycles: each has the index of the next.
        """
        trees, name = self.model.ntree, "asleep"
        like = np.zeros((self.number, trees), np.int32)
        asleep = saved.array(name, like, least=-1 - mujoco.mjMINAWAKE, most=trees - 1)
        for index, row in enumerate(asleep):
            sleepers = np.flatnonzero(row >= 0)
            if not np.array_equal(np.sort(row[sleepers]), sleepers):
                raise saved.error(
                    f"{name}.{index}", f"must have cycles of sleeping bodies, got {row.tolist()}"
                )
        return asleep

    def _restored(self, row: Floats, asleep: Integers) -> mujoco.MjData:
        data = mujoco.MjData(self.model)
        mujoco.mj_setState(self.model, data, row, ROW)
        mujoco.mj_forward(self.model, data)
        data.tree_asleep[:] = asleep
        self._library.mj_updateSleep(self.model._address, data._address)
        # The forward pass leaves its own initial guess for the next solution; the row has the saved guess.
        data.qacc_warmstart[:] = self._warm_start(row)
        return data

    def _warm_start(self, row: Floats) -> Floats:
        warm_start = np.empty(self.model.nv)
        component = mujoco.mjtState.mjSTATE_WARMSTART.value
        mujoco.mj_extractState(self.model, row, ROW, warm_start, component)
        return warm_start

    def _call(self, function: Any, ids: Ids, *arguments: Any) -> None:
        """Call a function of MuJoCo on simulations, and record which of them it could not compute."""
        chosen = None if ids is None else self._chosen(ids)
        failed = True
        try:
            failed = self._run(function, chosen, *arguments)
        finally:  # a signal may come before the number of failures is known
            if failed:
                self.stopped[self._chosen(ids)] |= self._status[self._chosen(ids)] != 0
                self.any_stopped = bool(self.stopped.any())

    def _check(self, function: Any, ids: Ids, *arguments: Any) -> None:
        """Call a function of MuJoCo on simulations; raise an error if it could not compute one of them."""
        chosen = self._chosen(ids)
        if self._run(function, chosen, *arguments):
            index = int(chosen[self._status[chosen] != 0][0])
            message = self._library.mjb_error(self._batch.address, index).decode()
            raise PhysicsError(f"MuJoCo stopped in simulation {index}: {message}")

    def _run(self, function: Any, chosen: Integers | None, *arguments: Any) -> bool:
        """Call a function of MuJoCo on simulations; return whether it could not compute some."""
        if self._num_threads > 1 and os.getpid() != self._batch.process:
            raise PhysicsError(
                f"simulations with num_threads = {self._num_threads} cannot be used in a forked process: "
                "make them anew here, or with num_threads = 1"
            )
        if chosen is None:
            return bool(function(self._batch.address, None, 0, *arguments))
        if not chosen.size:
            return False
        return bool(function(self._batch.address, chosen.ctypes.data, chosen.size, *arguments))

    def _chosen(self, ids: Ids) -> Integers:
        if ids is None:
            return np.arange(self.number, dtype=np.int32)
        chosen = np.asarray(ids)
        if (
            chosen.dtype.kind in "iu"
            and chosen.size
            and chosen[0] >= 0
            and chosen[-1] < self.number
            and (chosen[1:] > chosen[:-1]).all()
        ):
            return chosen.astype(np.int32)
        ordered = np.unique(chosen)  # required by MuJoCo
        if chosen.size and (
            chosen.dtype.kind not in "iu"
            or ordered[0] < 0
            or ordered[-1] >= self.number
            or len(ordered) < len(chosen)
        ):
            raise ValueError(
                f"simulations must be different whole numbers from 0 to {self.number - 1}, "
                f"got {chosen.tolist()}"
            )
        return ordered.astype(np.int32)


def _delete(address: int, process: int, num_threads: int) -> None:
    """Free a batch, but not in a forked process: MuJoCo would wait for threads that do not exist there."""
    if num_threads == 1 or process == os.getpid():
        library().mjb_deleteBatch(address)
