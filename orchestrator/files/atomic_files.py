"""Small files that are read whole: written atomically, and sealed by a digest.

A sealed file is a JSON object with the number of its format and the SHA-256 of the rest. A file that was
truncated, emptied, changed in a byte or replaced by a folder is refused with one sentence.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from recrl.orchestrator.errors import DamagedError, OtherFormatError, StorageError

FORMAT_KEY = "format"
SEAL_KEY = "sha256"
_TEMPORARY = re.compile(r"\..+\.\d+\.[0-9a-f]{8}")  # names of ``write_atomically``


def write_atomically(path: Path, data: bytes) -> None:
    """Write a whole file atomically: readers see the old or the new content, also after a crash."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}")
    try:
        with beside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def remove_temporary_files(folder: Path) -> None:
    """Remove what processes that were killed in ``write_atomically`` left; the caller is the only writer."""
    for path in folder.glob(".*.*"):
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write strict JSON atomically."""
    write_atomically(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def write_sealed(path: Path, value: Mapping[str, Any], *, version: int) -> None:
    """Write a sealed JSON file atomically.

    Args:
        path: of the file.
        value: its content, without the keys ``format`` and ``sha256``.
        version: of the format.
    """
    write_json(path, sealed(value, version=version))


def sealed(value: Mapping[str, Any], *, version: int) -> dict[str, Any]:
    """Return the value with its format and its seal."""
    return {FORMAT_KEY: version, SEAL_KEY: _seal(value, version), **value}


def read_sealed(path: Path, *, version: int) -> dict[str, Any]:
    """Read a file of ``write_sealed``, without format and seal.

    Raises:
        FileNotFoundError: the file does not exist.
        OtherFormatError: it has another format.
        DamagedError: it is not what was written.
        StorageError: it cannot be read.
    """
    return unsealed(read_whole(path), path.name, version=version)


def unsealed(data: bytes, name: str, *, version: int) -> dict[str, Any]:
    """Return the value in some bytes that ``sealed`` was given.

    Raises:
        OtherFormatError: they have another format; the sentence begins with ``name``.
        DamagedError: they are not what was written; likewise.
    """
    value = parsed_object(data, name)
    found, seal = value.pop(FORMAT_KEY, None), value.pop(SEAL_KEY, None)
    if found != version and (seal is None or seal == _seal(value, found)):
        raise OtherFormatError(
            f"{name} has format {found!r}, of another version of recrl, and this one reads format {version}"
        )
    if seal != _seal(value, version):
        raise DamagedError(f"{name} is not what was written: its checksum differs")
    return value


def read_whole(path: Path) -> bytes:
    """Read the bytes of a small file.

    Raises:
        FileNotFoundError: the file does not exist.
        DamagedError: there is a folder in its place.
        StorageError: it cannot be read.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise
    except IsADirectoryError as error:
        raise DamagedError(f"{path.name} is a folder, it must be a file") from error
    except NotADirectoryError as error:
        raise DamagedError(f"{path.parent.name} is a file, it must be a folder") from error
    except OSError as error:
        raise StorageError(f"{path.name} cannot be read ({error.strerror})") from error


def parsed_object(data: bytes, name: str) -> dict[str, Any]:
    """Parse a JSON object.

    Raises:
        DamagedError: there is none; the sentence begins with ``name``.
    """
    if not data.strip(b"\0 \r\n\t"):
        raise DamagedError(f"{name} is empty")
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DamagedError(f"{name} is not JSON") from error
    if not isinstance(value, dict):
        raise DamagedError(f"{name} must hold a JSON object, it holds a {type(value).__name__}")
    return value


def _seal(value: Mapping[str, Any], version: object) -> str:
    text = json.dumps({**value, FORMAT_KEY: version}, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
