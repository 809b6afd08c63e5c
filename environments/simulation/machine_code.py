"""Python functions compiled to machine code, which step MuJoCo's simulations.

Numba compiles them when they are first imported, which takes some seconds, and keeps the result beside their
file (where nobody may write there: in the user's cache folder, see Numba's NUMBA_CACHE_DIR). Numba itself
compiles anew only when that file changes. But what a function takes from another one (a constant, a record
layout, a helper) becomes part of its machine code: ``salted`` has Numba compare the digest of all of them.

Floating-point operations are done as written (no ``fastmath``), so that results are the same to the last bit
wherever and beside whatever a function runs.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, get_type_hints

import mujoco
import numba
import numpy as np
from numba.core import types as numba_types
from numba.extending import intrinsic
from numba.np.numpy_support import carray

FOLDERS = ("safety_gym", "simulation", "velocity")  # of ``recrl.environments``: who uses this module

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


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
_ADDRESS = numba_types.int64
mj_step: Any = numba_types.ExternalFunction("mj_step", numba_types.void(_ADDRESS, _ADDRESS))
mj_step2: Any = numba_types.ExternalFunction("mj_step2", numba_types.void(_ADDRESS, _ADDRESS))
mj_forward: Any = numba_types.ExternalFunction("mj_forward", numba_types.void(_ADDRESS, _ADDRESS))
mj_rnePostConstraint: Any = numba_types.ExternalFunction(  # noqa: N816  # MuJoCo's name
    "mj_rnePostConstraint", numba_types.void(_ADDRESS, _ADDRESS)
)
mj_getState: Any = numba_types.ExternalFunction(  # noqa: N816  # MuJoCo's name
    "mj_getState", numba_types.void(_ADDRESS, _ADDRESS, _ADDRESS, numba_types.int32)
)


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function that compiled ones may call, and become part of; Python may, too."""
    dispatcher: Any = numba.njit(function)
    call: Callable[Parameters, Result] = dispatcher
    return call


def compiled_for_batch(function: Callable[[int, int, int, int], None]) -> Any:
    """A function for ``Simulations.apply``, of (model, data, index of the simulation, argument).

    ``model`` and ``data`` are addresses, and ``argument`` is what ``apply`` was given.
    """
    signature = numba_types.void(_ADDRESS, _ADDRESS, numba_types.int32, _ADDRESS)
    return kept(functools.partial(numba.cfunc, signature), function)


def compiled_for_arrays(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function of arrays for Python."""
    call: Callable[Parameters, Result] = kept(numba.njit, function)
    return call


def compiled_for_python(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function of whole numbers, such as addresses, that Python calls often; it returns a bool or nothing.

    Numba takes no time to look at the arguments, and other Python threads go on meanwhile.
    """
    result = numba_types.void if get_type_hints(function)["return"] is type(None) else numba_types.boolean
    signature = result(*(numba_types.int64,) * function.__code__.co_argcount)
    call: Callable[Parameters, Result] = kept(functools.partial(numba.cfunc, signature), function).ctypes
    return call


def array_at(kind: Any) -> Any:
    """A compiled function (address, size) -> an array of so many numbers or records in memory there."""
    element = numba.from_dtype(np.dtype(kind))

    @intrinsic
    def pointer(_context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        signature: Any = numba_types.CPointer(element)  # type: ignore[no-untyped-call]
        return signature(address), generate

    @numba.njit
    def view(address: int, size: int) -> Any:
        return carray(pointer(address), size)  # type: ignore[call-arg]

    return view


def kept(compiler: Any, function: Any) -> Any:
    """Compile, and keep the result where one may write."""
    try:
        return compiler(cache=True)(salted(function))
    except RuntimeError:  # there is no such place
        return compiler()(function)


def salted(function: Any) -> Any:
    """The same function to Numba, but that machine code kept for it is found under ``source_digest`` only.

    Numba compares what a function's free variables hold, so the digest becomes one that nobody reads.
    """
    code = function.__code__
    found = types.FunctionType(
        code.replace(co_freevars=(*code.co_freevars, "_salt")),
        function.__globals__,
        function.__name__,
        function.__defaults__,
        (*(function.__closure__ or ()), types.CellType(source_digest())),
    )
    found.__kwdefaults__, found.__qualname__ = function.__kwdefaults__, function.__qualname__
    found.__annotations__, found.__doc__ = function.__annotations__, function.__doc__
    return found


@functools.cache
def source_digest(folder: Path = Path(__file__).parents[1]) -> str:
    """A digest of all that compiled functions are made of: the Python files of FOLDERS, MuJoCo and NumPy."""
    digest = hashlib.sha256(f"{mujoco.__version__} {np.__version__}".encode())
    for name in FOLDERS:
        for path in sorted((folder / name).rglob("*.py")):
            digest.update(
                f"{path.relative_to(folder)} ".encode() + hashlib.sha256(path.read_bytes()).digest()
            )
    return digest.hexdigest()
