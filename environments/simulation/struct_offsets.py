"""Offsets of fields in MuJoCo's C structures, from the declarations in MuJoCo's Python package.

Compiled code has a pointer to a simulation's ``mjData`` and reads fields at these offsets. Otherwise some
fields, contacts among them, could be read only from a copy of the whole structure. Such a copy takes as long
as a physics step.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

from mujoco.introspect.ast_nodes import ArrayType, PointerType, ValueType
from mujoco.introspect.structs import STRUCTS

_NUMBERS: dict[str, Any] = {
    "char": ctypes.c_char,
    "double": ctypes.c_double,
    "float": ctypes.c_float,
    "int": ctypes.c_int,
    "mjtBool": ctypes.c_bool,
    "mjtByte": ctypes.c_ubyte,
    "mjtNum": ctypes.c_double,
    "mjtSize": ctypes.c_int64,
    "size_t": ctypes.c_size_t,
    "uint64_t": ctypes.c_uint64,
    "uintptr_t": ctypes.c_size_t,
    "unsigned char": ctypes.c_ubyte,
    "unsigned int": ctypes.c_uint,
}


@functools.cache
def structure(name: str) -> Any:
    """Return the ctypes structure of a MuJoCo structure, for example ``mjContact``.

    >>> structure("mjWarningStat").number.offset
    4
    """
    fields = [(field.name, _ctype(field.type)) for field in STRUCTS[name].fields]
    return type(name, (ctypes.Structure,), {"_fields_": fields})


def _ctype(declared: Any) -> Any:
    match declared:
        case PointerType():
            return ctypes.c_void_p
        case ArrayType():
            element = _ctype(declared.inner_type)
            for extent in reversed(declared.extents):
                element *= extent
            return element
        case ValueType() if declared.name in _NUMBERS:
            return _NUMBERS[declared.name]
        case ValueType() if declared.name in STRUCTS:
            return structure(declared.name)
    raise TypeError(f"MuJoCo declares a field of a type that is not known here: {declared}")
