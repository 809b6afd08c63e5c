"""A trial's commit as one object: its record, the new rows, and its checkpoint.

    <64 hex digits> <10 digits>        SHA-256 and length of the header
    header                            JSON: the TrialRecord, and the pieces that each file is made of
    spaces, then bytes                the pieces of this commit

A store writes objects atomically, so a commit is complete or absent. Rows that earlier commits of the attempt
sent are referred to as pieces of their objects, not sent again.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

from recrl.orchestrator.files.trial_files import FileKind, files_of
from recrl.orchestrator.files.trial_record import TrialRecord

FORMAT = 2
PREFIX_BYTES = 76
FIRST_READ_BYTES = 8192  # most headers are shorter
SMALLEST_HEADER = 2048

APPENDED = files_of(FileKind.ROWS, FileKind.LOG)
WHOLE = files_of(FileKind.WHOLE)
CHECKPOINT = re.compile(r"checkpoints/checkpoint-\d{8,18}\.recrl")
COMMIT = re.compile(r"commit-\d{8}")


class OtherVersionError(ValueError):
    """A commit of another version of recrl."""


@dataclass(frozen=True)
class Piece:
    """Consecutive bytes of a file, in a commit's object.

    Attributes:
        commit: name of the object, in the same folder.
        offset: of its first byte in the object.
        start: of its first byte in the file.
        length: bytes, at least 1.
        sha256: of these bytes, in hex.
    """

    commit: str
    offset: int
    start: int
    length: int
    sha256: str

    @property
    def end(self) -> int:
        """End of the piece in the file."""
        return self.start + self.length


@dataclass(frozen=True)
class Commit:
    """A set of files that belong together.

    Attributes:
        record: of the trial.
        files: the contiguous pieces of each file, by its path in the trial's folder.
    """

    record: TrialRecord
    files: Mapping[str, tuple[Piece, ...]]

    @property
    def objects(self) -> frozenset[str]:
        """Names of the objects with its pieces."""
        return frozenset(piece.commit for pieces in self.files.values() for piece in pieces)

    def to_json(self) -> dict[str, Any]:
        """Return the commit as JSON values; ``from_json`` is the inverse."""
        files = {name: [asdict(piece) for piece in pieces] for name, pieces in self.files.items()}
        return {"format": FORMAT, "record": self.record.to_json(), "files": files}

    @classmethod
    def from_json(cls, value: Any) -> Self:
        """Return the commit of ``to_json``.

        Raises:
            OtherVersionError: it is a commit of another version.
            ValueError: it is no commit.
        """
        try:
            if value["format"] != FORMAT:
                raise OtherVersionError(
                    f"the commit has format {value['format']!r}, of another version of recrl, "
                    f"and this one reads format {FORMAT}"
                )
            files = {name: tuple(Piece(**it) for it in pieces) for name, pieces in value["files"].items()}
            commit = cls(TrialRecord.from_json(value["record"]), files)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"no commit: {error}") from error
        for name, pieces in files.items():
            if name not in (*APPENDED, *WHOLE) and not CHECKPOINT.fullmatch(name):
                raise ValueError(f"a commit names a file that trials do not have: {name!r}")
            if [piece.start for piece in pieces] != [0, *(piece.end for piece in pieces)][:-1]:
                raise ValueError(f"a commit's pieces of {name} leave a gap")
            if not all(COMMIT.fullmatch(piece.commit) for piece in pieces):
                raise ValueError(f"a commit's pieces of {name} are in objects that are no commits")
        return commit


def pack(
    name: str,
    record: TrialRecord,
    kept: Mapping[str, tuple[Piece, ...]],
    new: Mapping[str, tuple[int, bytes]],
) -> tuple[Commit, bytes]:
    """Make a commit and its object.

    Args:
        name: of the object.
        record: of the trial.
        kept: the pieces of each file that earlier objects hold; every file has an entry.
        new: for files with new bytes, their offset in the file, and the bytes.
    """
    pieces = {
        file: Piece(name, 0, start, len(data), hashlib.sha256(data).hexdigest())
        for file, (start, data) in new.items()
    }
    room = SMALLEST_HEADER
    while True:
        offset, files = room, dict(kept)
        for file, piece in pieces.items():
            files[file] = (*kept[file], replace(piece, offset=offset))
            offset += piece.length
        commit = Commit(record, files)
        header = _header(commit)
        if len(header) <= room:
            return commit, header.ljust(room) + b"".join(data for _, data in new.values())
        room *= 2


def unpack(read: Callable[[int, int], bytes]) -> Commit:
    """Read the header of a commit's object.

    Args:
        read: returns the object's bytes from one position to another, fewer if it is shorter.

    Raises:
        OtherVersionError: it is of another version.
        ValueError: it is not intact.
    """
    data = read(0, FIRST_READ_BYTES)
    try:
        digest, length = data[:PREFIX_BYTES].decode("ascii").split()
        end = PREFIX_BYTES + int(length)
    except (UnicodeDecodeError, ValueError) as error:
        raise ValueError("its beginning is not that of a commit") from error
    if end > len(data) == FIRST_READ_BYTES:
        data += read(FIRST_READ_BYTES, end)
    header = data[PREFIX_BYTES:end]
    if hashlib.sha256(header).hexdigest() != digest:
        raise ValueError("its header is not intact")
    return Commit.from_json(json.loads(header))


def _header(commit: Commit) -> bytes:
    text = json.dumps(commit.to_json(), allow_nan=False).encode()
    return f"{hashlib.sha256(text).hexdigest()} {len(text):010d}\n".encode() + text
