"""Python functions compiled to machine code, for stepping MuJoCo simulations.

Numba compiles them at the first import, which takes some seconds, and caches the result beside their file. If
that folder is not writable, it uses the user's cache folder; see Numba's NUMBA_CACHE_DIR. Numba itself
compiles anew only when that file changes. But machine code also contains constants, record layouts and
helpers of other files: ``salted`` makes Numba compare the digest of all of them.

Floating-point operations are done as written (no ``fastmath``), so that results are equal to the last bit in
every process and thread.
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
    """Load MuJoCo's shared library, so that compiled functions find its functions."""
    folder = Path(mujoco.__file__).parent
    found = [path for pattern in ("libmujoco*", "mujoco.dll") for path in sorted(folder.glob(pattern))]
    if not found:
        raise ImportError(f"MuJoCo's shared library must lie in {folder.name}, found none")
    return ctypes.CDLL(str(found[0]), mode=ctypes.RTLD_GLOBAL)


mujoco_library()
# Pointers are addresses: 64-bit integers, which are passed in the same way.
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
    """Compile a function for use in compiled functions and in Python."""
    dispatcher: Any = numba.njit(function)
    call: Callable[Parameters, Result] = dispatcher
    return call


def compiled_for_batch(function: Callable[[int, int, int, int], None]) -> Any:
    """Compile a function for ``Simulations.apply``, of (model, data, index of the simulation, argument).

    ``model`` and ``data`` are addresses, and ``argument`` is that of ``apply``.
    """
    signature = numba_types.void(_ADDRESS, _ADDRESS, numba_types.int32, _ADDRESS)
    return kept(functools.partial(numba.cfunc, signature), function)


def compiled_for_arrays(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a function of arrays for Python."""
    call: Callable[Parameters, Result] = kept(numba.njit, function)
    return call


def compiled_for_python(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a function of integers, such as addresses, for frequent calls from Python.

    It returns a bool or None. Numba does not inspect the arguments, and other Python threads continue
    meanwhile.
    """
    result = numba_types.void if get_type_hints(function)["return"] is type(None) else numba_types.boolean
    signature = result(*(numba_types.int64,) * function.__code__.co_argcount)
    call: Callable[Parameters, Result] = kept(functools.partial(numba.cfunc, signature), function).ctypes
    return call


def array_at(kind: Any) -> Any:
    """Return a compiled function (address, size) -> array of ``size`` numbers or records there."""
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
    """Compile a function and cache the result in a writable folder."""
    try:
        return compiler(cache=True)(salted(function))
    except RuntimeError:  # there is no writable folder
        return compiler()(function)


def salted(function: Any) -> Any:
    """The same function to Numba, but that machine code kept for it is found under ``source_digest`` only.

    Numba compares what a function's free variables hold, so the digest becomes an unused free variable.
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
