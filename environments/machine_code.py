"""Python functions compiled to machine code, which step MuJoCo's simulations, on threads where wanted.

Numba compiles them when they are first imported, which takes some seconds, and keeps the result beside their
file (where nobody may write there: in the user's cache folder, see Numba's NUMBA_CACHE_DIR) until that file
changes. A change in another file is not noticed: what is compiled must take from elsewhere nothing but this
module's few functions and ``CALL``, and be told everything else, numbers too. Who changes those changes the
files that use them as well.

Floating-point operations are done as written (no ``fastmath``), so that results are the same to the last bit
wherever and beside whatever a function runs.
"""

from __future__ import annotations

import ctypes
import functools
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, get_type_hints

import mujoco
import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic
from numba.np.numpy_support import carray

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

CALL = np.dtype(
    [
        ("index", np.int64),  # which simulation
        ("first", np.int64),  # the parts of the work to do now: from here
        ("last", np.int64),  # to before here
        ("argument", np.int64),  # an address, which the function is given
    ],
    align=True,
)
"""What a function for ``Simulations.apply`` is called with, besides MuJoCo's model and data."""


@functools.cache
def mujoco_library() -> Any:
    """MuJoCo's shared library, where compiled functions find MuJoCo's, too."""
    folder = Path(mujoco.__file__).parent
    found = [path for pattern in ("libmujoco*", "mujoco.dll") for path in sorted(folder.glob(pattern))]
    if not found:
        raise ImportError(f"MuJoCo's shared library must lie in {folder.name}, found none")
    return ctypes.CDLL(str(found[0]), mode=ctypes.RTLD_GLOBAL)


mujoco_library()
# Pointers are addresses: whole numbers of 64 bits, which are passed alike.
_ADDRESS = types.int64
mj_step: Any = types.ExternalFunction("mj_step", types.void(_ADDRESS, _ADDRESS))
mj_step2: Any = types.ExternalFunction("mj_step2", types.void(_ADDRESS, _ADDRESS))
mj_forward: Any = types.ExternalFunction("mj_forward", types.void(_ADDRESS, _ADDRESS))
mj_getState: Any = types.ExternalFunction(  # noqa: N816  # MuJoCo's name
    "mj_getState", types.void(_ADDRESS, _ADDRESS, _ADDRESS, types.int32)
)

mjb_apply: Any = types.ExternalFunction(
    "mjb_apply",
    types.int32(_ADDRESS, _ADDRESS, types.int32, _ADDRESS, _ADDRESS, types.int32),
)

_yield: Any = types.ExternalFunction("sched_yield", types.int32())
_CAN_YIELD = os.name == "posix"


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function that compiled ones may call, and become part of; Python may, too."""
    dispatcher: Any = numba.njit(function)
    call: Callable[Parameters, Result] = dispatcher
    return call


def compiled_for_batch(function: Callable[[int, int, int, int], None]) -> Any:
    """A function for ``Simulations.apply``: of addresses of model and data, 0, address of a ``CALL``."""
    signature = types.void(_ADDRESS, _ADDRESS, types.int32, _ADDRESS)
    return kept(functools.partial(numba.cfunc, signature), function)


def compiled_for_arrays(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function of arrays for Python."""
    call: Callable[Parameters, Result] = kept(numba.njit, function)
    return call


def compiled_for_python(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function of whole numbers, such as addresses, that Python calls often; it returns a bool or nothing.

    Numba takes no time to look at the arguments, and other Python threads go on meanwhile.
    """
    result = types.void if get_type_hints(function)["return"] is type(None) else types.boolean
    signature = result(*(types.int64,) * function.__code__.co_argcount)
    call: Callable[Parameters, Result] = kept(functools.partial(numba.cfunc, signature), function).ctypes
    return call


def array_at(kind: Any) -> Any:
    """A compiled function (address, size) -> an array of so many numbers or records in memory there."""
    element = numba.from_dtype(np.dtype(kind))

    @intrinsic
    def pointer(_context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        signature: Any = types.CPointer(element)  # type: ignore[no-untyped-call]
        return signature(address), generate

    @numba.njit
    def view(address: int, size: int) -> Any:
        return carray(pointer(address), size)  # type: ignore[call-arg]

    return view


def instruction(function: Callable[..., Any]) -> Any:
    """A function that compiled ones may call; ``function`` says with which instructions."""
    return intrinsic(function)


@instruction
def load(_context: Any, address: Any) -> Any:
    """The whole number at an address, as other threads have left it, and all that they wrote before it."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.load_atomic(_number_at(builder, arguments[0]), "seq_cst", 8)

    return types.int64(address), generate


def _read_and_write(operation: str) -> Any:
    """A function (address, number) -> what was there, which writes there as LLVM's ``operation`` says.

    Other threads see it, and with it all that was written before.
    """

    def exchange(_context: Any, address: Any, value: Any) -> Any:
        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            return builder.atomic_rmw(operation, _number_at(builder, arguments[0]), arguments[1], "seq_cst")

        return types.int64(address, value), generate

    return instruction(exchange)


swap = _read_and_write("xchg")
"""Write a whole number at an address; what was there."""
add = _read_and_write("add")
"""Add to the whole number at an address; what was there."""


@instruction
def replace(_context: Any, address: Any, found: Any, value: Any) -> Any:
    """Write a whole number at an address, as ``swap`` does, if what was found there is still there.

    Returns:
        whether it was.
    """

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        place = _number_at(builder, arguments[0])
        result = builder.cmpxchg(place, arguments[1], arguments[2], "seq_cst", "seq_cst")
        return builder.extract_value(result, 1)

    return types.boolean(address, found, value), generate


@instruction
def pause(_context: Any) -> Any:
    """Let a moment pass, in a loop that waits for another thread; on x86 cheap for the processor's core."""

    def generate(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        if platform.machine() in {"x86_64", "AMD64"}:
            insert: Any = cgutils.get_or_insert_function
            signature = ir.FunctionType(ir.VoidType(), ())
            builder.call(insert(builder.module, signature, "llvm.x86.sse2.pause"), ())
        return context.get_dummy_value()

    return types.void(), generate


@compiled
def step_aside() -> None:
    """Let another thread have this processor if it has none."""
    if _CAN_YIELD:
        _yield()


def _number_at(builder: Any, address: Any) -> Any:
    return builder.inttoptr(address, ir.IntType(64).as_pointer())


def kept(compiler: Any, function: Any) -> Any:
    """Compile, and keep the result where one may write."""
    try:
        return compiler(cache=True)(function)
    except RuntimeError:  # there is no such place
        return compiler()(function)
