"""Zip archives that somebody else may have made: unpacked only as far as there is room for them."""

from __future__ import annotations

import lzma
import zipfile
import zlib
from collections.abc import Sequence
from functools import partial

PIECE_BYTES = 4096  # asked for at once
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA)

# What reading a damaged or hostile archive raises; RuntimeError stands for encryption, methods that Python
# does not know, and deep nesting of what is in it.
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
    """The members of these names, if they are small enough all together.

    An archive says how large its members are before anything is unpacked. It may lie: so they are asked for
    in small pieces, of which zipfile keeps no more than was said. What a piece unpacks to meanwhile is a
    thousandfold of its packed length for deflate, some thousandfold for LZMA; bzip2, for which it may be
    tens of thousands, is refused.

    Args:
        archive: open for reading.
        names: of the members, each of which must be there.
        max_bytes: that they may unpack to, at least 0.

    Raises:
        ValueError: they are larger, or packed by another method than METHODS. What else is wrong with them
            raises one of UNREADABLE.
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
