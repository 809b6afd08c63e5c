"""A digest of all that a compiled function depends on: constants, record layouts, helper functions.

Numba caches machine code and checks only the file of the compiled function. But the values of a function's
global names become part of the machine code, and some are imported: constants, record layouts, other
functions. ``salted`` makes their digest part of what Numba compares.
"""

from __future__ import annotations

import dis
import enum
import hashlib
import inspect
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.types import ExternalFunction, Type

SALT = "_salt"
_NUMBERS = (bool, int, float, complex, str, bytes, type(None), np.generic)


def salted(function: Any) -> Any:
    """Return a function that Numba compiles alike, but caches by its digest.

    Numba compares the values of a function's free variables, so the digest becomes an unused one.
    """
    code = function.__code__
    found = types.FunctionType(
        code.replace(co_freevars=(*code.co_freevars, SALT)),
        function.__globals__,
        function.__name__,
        function.__defaults__,
        (*(function.__closure__ or ()), types.CellType(digest(function))),
    )
    found.__kwdefaults__, found.__qualname__ = function.__kwdefaults__, function.__qualname__
    found.__annotations__, found.__doc__ = function.__annotations__, function.__doc__
    return found


def digest(function: Any) -> str:
    """Return 64 hex digits that change with the function and with anything that it depends on.

    Raises:
        TypeError: it depends on an object without a stable value.
    """
    found = hashlib.sha256()
    for part in _function(function, set()):
        found.update(part.encode() + b"\n")
    return found.hexdigest()


def _function(function: Any, seen: set[int]) -> Iterator[str]:
    """Describe a function; each function once."""
    if id(function) in seen:
        return
    seen.add(id(function))
    yield f"function {function.__name__}"
    yield from _code(function.__code__)
    for default in (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()):
        yield from _value(default, function, seen)
    for cell in function.__closure__ or ():
        yield from _value(cell.cell_contents, function, seen)
    for name in _global_names(function.__code__):
        if name in function.__globals__:  # otherwise a Python built-in, such as range
            yield name
            yield from _value(function.__globals__[name], function, seen)


def _code(code: types.CodeType) -> Iterator[str]:
    yield f"{code.co_code.hex()} {code.co_names} {code.co_varnames} {code.co_freevars}"
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _code(constant)
        elif isinstance(constant, frozenset):
            yield repr(sorted(map(repr, constant)))
        else:
            yield repr(constant)


def _global_names(code: types.CodeType) -> Iterator[str]:
    """Return the global names that a function or a nested one reads."""
    for instruction in dis.get_instructions(code):
        if instruction.opname in {"LOAD_GLOBAL", "LOAD_NAME"}:
            yield instruction.argval
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _global_names(constant)


def _value(value: Any, taken_by: Any, seen: set[int]) -> Iterator[str]:
    """Describe a value that a function depends on."""
    inner = inspect.unwrap(value) if callable(value) else value  # the Python function of a compiled one
    match inner:
        case types.FunctionType() if inner.__module__.split(".")[0] in {"numba", "numpy"}:
            # Numba has its own version of it and compares versions itself.
            yield f"{inner.__module__}.{inner.__qualname__}"
        case types.FunctionType():
            yield from _function(inner, seen)
        case tuple() | list():
            yield f"{type(inner).__name__} of {len(inner)}"
            for one in inner:
                yield from _value(one, taken_by, seen)
        case enum.Enum():
            yield f"{inner!r} {inner.value!r}"
        case ExternalFunction():
            yield f"{inner.symbol} {inner.sig}"
        case Type() | np.dtype():
            yield f"{inner!r}"
        case np.ndarray():
            yield f"{inner.dtype!r} {inner.shape} {inner.tobytes().hex()}"
        case types.ModuleType():
            yield inner.__name__
            yield _file_digest(inner)
        case type() | types.BuiltinFunctionType() | np.ufunc():
            yield f"{inner!r}"
        case _ if isinstance(inner, _NUMBERS):
            yield f"{type(inner).__name__} {inner!r}"
        case _:
            raise TypeError(
                f"{taken_by.__module__}.{taken_by.__qualname__}: compiled code may take numbers, tuples, "
                f"arrays, records' types, modules and functions from outside, got {type(inner).__name__}"
            )


def _file_digest(module: types.ModuleType) -> str:
    """Whether a value belongs to a Python module whose attributes the function may use."""
    path = Path(getattr(module, "__file__", None) or "")
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.suffix == ".py" else ""
