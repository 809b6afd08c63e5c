"""Reading of untrusted zip archives, with a bound on the unpacked size."""

from __future__ import annotations

import lzma
import zipfile
import zlib
from collections.abc import Sequence
from functools import partial

PIECE_BYTES = 4096  # bytes per read
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA)

# Exceptions of reading a damaged or hostile archive. RuntimeError is raised for encryption, methods that
# Python does not know, and deep nesting of the content.
UNREADABLE = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    OSError,
    RuntimeError,
    ValueError,
    IndexError,
    KeyError,
)


def unpacked(archive: zipfile.ZipFile, names: Sequence[str], *, max_bytes: int) -> list[bytes]:
    """Read the members of these names, if their total size is within a bound.

    An archive declares the sizes of its members, possibly wrongly. So they are read in small pieces, of which
    zipfile keeps no more than was declared. A piece may unpack to a thousand times its packed length for
    deflate, and several thousand for LZMA. With bzip2 it may be tens of thousands, so bzip2 is refused.

    Args:
        archive: open for reading.
        names: of the members; each must exist.
        max_bytes: bound on their unpacked size, at least 0.

    Raises:
        ValueError: they are larger, or packed by another method than METHODS. Other damage raises one of
            UNREADABLE.
    """
    members = [archive.getinfo(name) for name in names]
    if any(member.compress_type not in METHODS for member in members):
        raise ValueError("its members must be deflated or packed by LZMA")
    size = sum(member.file_size for member in members)
    if size > max_bytes:
        raise ValueError(f"it unpacks to {size} bytes, at most {max_bytes} are taken")
    return [_member(archive, name) for name in names]


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    with archive.open(name) as file:
        return b"".join(iter(partial(file.read, PIECE_BYTES), b""))
