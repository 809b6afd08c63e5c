"""Checkpoint format: a tree of plain values and arrays in one file; reading it runs no code.

A tree is made of dicts with string keys, lists, strings, numbers, booleans, None and NumPy arrays. The file
is a magic line, the SHA-256 of the rest, and a safetensors payload. Its metadata has the tree as JSON, with
each array replaced by its key. A file cut short or changed in a single bit is refused.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from recrl.orchestrator.errors import CheckpointError, DamagedError
from recrl.orchestrator.files.atomic_files import read_whole

MAGIC = b"recrl checkpoint 2\n"
_ANY_MAGIC = b"recrl checkpoint "
_ARRAY = "__array__"


def encode(tree: dict[str, Any]) -> bytes:
    """Encode a tree as the bytes of a checkpoint.

    Raises:
        TypeError: a leaf is neither a JSON value nor an array.
    """
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    skeleton = json.dumps(_without_arrays(tree, arrays, "$"))
    payload = safetensors.numpy.save(arrays, metadata={"tree": skeleton})
    return MAGIC + hashlib.sha256(payload).digest() + payload


def decode(data: bytes, *, source: str) -> dict[str, Any]:
    """Decode the tree of ``encode``.

    Args:
        data: a whole checkpoint.
        source: its name for errors.

    Raises:
        CheckpointError: the bytes are not an intact checkpoint of this version.
    """
    if data.startswith(_ANY_MAGIC) and not data.startswith(MAGIC):
        number = data[len(_ANY_MAGIC) :].split(b"\n", 1)[0][:8].decode(errors="replace")
        raise CheckpointError(
            f"{source}: the checkpoint has format {number}, of another version of recrl, and this one reads "
            f"format {MAGIC[len(_ANY_MAGIC) :].decode().strip()}"
        )
    if not data.startswith(MAGIC):
        raise CheckpointError(f"{source}: not a checkpoint of this version of recrl")
    digest, payload = data[len(MAGIC) : len(MAGIC) + 32], data[len(MAGIC) + 32 :]
    if hashlib.sha256(payload).digest() != digest:
        raise CheckpointError(f"{source}: the checkpoint is truncated or damaged (its checksum differs)")
    try:
        arrays = safetensors.numpy.load(payload)
        header_length = int.from_bytes(payload[:8], "little")
        metadata = json.loads(payload[8 : 8 + header_length])["__metadata__"]
        tree = _with_arrays(json.loads(metadata["tree"]), arrays)
    except (safetensors.SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(f"{source}: the checkpoint cannot be read: {error}") from error
    if not isinstance(tree, dict):
        raise CheckpointError(f"{source}: the checkpoint holds no tree")
    return tree


def load(path: Path) -> dict[str, Any]:
    """Read the tree in a checkpoint file.

    Raises:
        CheckpointError: the file is missing, truncated, damaged or of another version.
        StorageError: it cannot be read at present, so whether it is intact is not known.
    """
    try:
        data = read_whole(path)
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror}") from error
    except DamagedError as error:
        raise CheckpointError(f"{path}: cannot be read: {error}") from error
    return decode(data, source=str(path))


def _without_arrays(value: Any, arrays: dict[str, np.ndarray[Any, Any]], path: str) -> Any:
    """Return the tree with each array moved to ``arrays`` and replaced by its key there.

    The key is the number of arrays before it. A path would not do: a key of a dict may contain a dot.
    """
    if isinstance(value, np.ndarray):
        key = str(len(arrays))
        arrays[key] = np.array(value, order="C")
        return {_ARRAY: key}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str) or key == _ARRAY:
                raise TypeError(f"checkpoint: {path}: keys must be strings other than {_ARRAY}, got {key!r}")
        return {key: _without_arrays(item, arrays, f"{path}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_arrays(item, arrays, f"{path}.{index}") for index, item in enumerate(value)]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"checkpoint: {path}: cannot store a {type(value).__name__}")


def _with_arrays(value: Any, arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    """Inverse of ``_without_arrays``."""
    if isinstance(value, dict):
        if _ARRAY in value:
            return arrays[value[_ARRAY]]
        return {key: _with_arrays(item, arrays) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_arrays(item, arrays) for item in value]
    return value
