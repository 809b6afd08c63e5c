"""Python functions of arrays compiled to machine code.

Numba compiles them at the first call, which takes some seconds, and caches the result beside their file. If
that folder is not writable, it uses the user's cache folder; see Numba's NUMBA_CACHE_DIR. Numba itself
compiles anew only when that file changes. But machine code also contains constants, record layouts and
helpers of other files: ``salted`` makes Numba compare the digest of all of them.

Floating-point operations are done as written (no ``fastmath``), so that results are equal to the last bit in
every process and thread.
"""

from __future__ import annotations

import functools
import hashlib
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba
import numpy as np

FOLDERS = ("safety_gym", "simulation")  # of ``recrl.environments``: who uses this module

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a function for use in compiled functions and in Python."""
    dispatcher: Any = numba.njit(function)
    call: Callable[Parameters, Result] = dispatcher
    return call


def compiled_for_arrays(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a function of arrays for Python."""
    call: Callable[Parameters, Result] = kept(numba.njit, function)
    return call


def kept(compiler: Any, function: Any) -> Any:
    """Compile a function and cache the result in a writable folder."""
    try:
        return compiler(cache=True)(salted(function))
    except RuntimeError:  # there is no writable folder
        return compiler()(function)


def salted(function: Any) -> Any:
    """Return a copy of a function whose stored machine code is used only for the same ``source_digest``.

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
    """A digest of all that compiled functions are made of: the Python files of FOLDERS, and NumPy."""
    digest = hashlib.sha256(np.__version__.encode())
    for name in FOLDERS:
        for path in sorted((folder / name).rglob("*.py")):
            digest.update(
                f"{path.relative_to(folder)} ".encode() + hashlib.sha256(path.read_bytes()).digest()
            )
    return digest.hexdigest()
