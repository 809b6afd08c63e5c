"""MuJoCo's shared library: the functions of ``mjbatch.h`` that Python has no name for.

A type that is declared here and differs from the library's could damage memory without a word, and
``mj_updateSleep`` is in no header of MuJoCo. So ``pyproject.toml`` bounds MuJoCo's version, and ``library``
refuses others. ``tests/environments/test_mujoco_library.py`` compares the types with MuJoCo's headers, and
describes how to allow a new version.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import Any

import mujoco

TESTED = (4, 0)  # version of MuJoCo that these types were checked with
RANGE = "mujoco>=4.0,<4.1"
WITHOUT_HEADER = ("mj_updateSleep",)  # exported by the library, but in no header


class BatchConfig(ctypes.Structure):
    """``mjBatchConfig``."""

    _fields_ = (("nthread", ctypes.c_int), ("persistent", ctypes.c_bool))


BatchFunction = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)
_POINTER, _INTEGER = ctypes.c_void_p, ctypes.c_int
_TO_INTEGER = ctypes.POINTER(ctypes.c_int)
# Result and arguments by function; a void pointer for any pointer that Python does not follow.
SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "mjb_makeBatch": (
        _POINTER,
        (_POINTER, _INTEGER, ctypes.POINTER(BatchConfig), ctypes.c_char_p, _INTEGER),
    ),
    "mjb_deleteBatch": (None, (_POINTER,)),
    "mjb_nstate": (_INTEGER, (_POINTER,)),
    "mjb_state": (_POINTER, (_POINTER,)),
    "mjb_stateComponent": (_POINTER, (_POINTER, _INTEGER, _TO_INTEGER)),
    "mjb_warning": (_POINTER, (_POINTER,)),
    "mjb_status": (_POINTER, (_POINTER,)),
    "mjb_output": (_POINTER, (_POINTER, ctypes.c_char_p, _TO_INTEGER, _TO_INTEGER)),
    "mjb_step": (_INTEGER, (_POINTER, _POINTER, _INTEGER, _INTEGER, _INTEGER)),
    "mjb_rollout": (
        _INTEGER,
        (_POINTER, _POINTER, _INTEGER, _INTEGER, _POINTER, _INTEGER, _POINTER, _INTEGER),
    ),
    "mjb_forward": (_INTEGER, (_POINTER, _POINTER, _INTEGER, _INTEGER)),
    "mjb_reset": (_INTEGER, (_POINTER, _POINTER, _INTEGER, _POINTER, _INTEGER)),
    "mjb_error": (ctypes.c_char_p, (_POINTER, _INTEGER)),
    "mjb_getData": (None, (_POINTER, _INTEGER, _POINTER)),
    "mjb_apply": (_INTEGER, (_POINTER, _POINTER, _INTEGER, _POINTER, _POINTER, _INTEGER)),
    "mjb_nthread": (_INTEGER, (_POINTER,)),
    "mjb_persistent": (_INTEGER, (_POINTER,)),
    "mj_updateSleep": (None, (_POINTER, _POINTER)),
    "mj_copyData": (_POINTER, (_POINTER, _POINTER, _POINTER)),
}


@functools.cache
def library() -> Any:
    """Load MuJoCo's shared library, and declare the types of the functions that are used here.

    Raises:
        ImportError: the installed MuJoCo has another version than the tested one, or lacks the library.
    """
    if tuple(map(int, mujoco.__version__.split(".")[:2])) != TESTED:
        raise ImportError(
            f"MuJoCo {mujoco.__version__} may have other types in C than recrl uses; install a version that "
            f"it was tested with: pip install '{RANGE}'"
        )
    folder = Path(mujoco.__file__).parent
    found = [path for pattern in ("libmujoco*", "mujoco.dll") for path in sorted(folder.glob(pattern))]
    if not found:
        raise ImportError(f"MuJoCo's shared library must lie in {folder.name}, found none")
    loaded = ctypes.CDLL(str(found[0]))
    for name, (result, arguments) in SIGNATURES.items():
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
    return loaded
