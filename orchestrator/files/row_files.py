"""Append-only files of rows: committed length and digest, and the rows of the next commit.

Each commit extends the digest by its new bytes only, so that its time does not grow with the file. A writer
that resumes a file reads it once and checks its digest.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recrl.orchestrator.errors import DamagedError, RowError, StorageError

PIECE_BYTES = 2**20
NO_FILE = (FileNotFoundError, IsADirectoryError, NotADirectoryError)
EMPTY_DIGEST = hashlib.sha256().hexdigest()


@dataclass(frozen=True)
class Extent:
    """Committed part of a file.

    Attributes:
        length: bytes.
        sha256: of these bytes, in hex.
    """

    length: int = 0
    sha256: str = EMPTY_DIGEST

    @classmethod
    def of(cls, data: bytes) -> Extent:
        """Return the extent of a whole small file."""
        return cls(len(data), hashlib.sha256(data).hexdigest())


@dataclass
class RowFile:
    """Writer of one append-only file.

    Attributes:
        path: of the file.
        length: bytes committed.
        columns: the names in its first line, once there is one; empty for files without one.
    """

    path: Path
    length: int = 0
    columns: tuple[str, ...] = ()
    _hash: Any = field(default_factory=hashlib.sha256, repr=False)
    _rows: list[str] = field(default_factory=list, repr=False)

    @property
    def extent(self) -> Extent:
        """Return the committed extent."""
        return Extent(self.length, self._hash.hexdigest())

    @property
    def has_header(self) -> bool:
        """Whether the columns are fixed."""
        return bool(self.columns)

    def resume_after(self, extent: Extent) -> bool:
        """Resume the file after its first bytes, if their digest is right.

        Args:
            extent: the part to keep; the caller truncates the rest.

        Returns:
            Whether the file begins with these bytes; if not, nothing is changed.
        """
        found = digest_of(self.path, extent.length)
        if found is None or found.hexdigest() != extent.sha256:
            return False
        self._hash, self.length = found, extent.length
        self._rows.clear()
        self.columns = _first_line(self.path, extent.length) if self.path.suffix == ".csv" else ()
        return True

    def add_text(self, text: str) -> None:
        """Add a finished line to the next commit."""
        self._rows.append(text)

    def add_row(self, row: Mapping[str, Any], *, of: str) -> None:
        """Add a row to the next commit; the first row fixes the columns, later rows are matched by name.

        Args:
            row: a value for each column, in any order.
            of: source of the rows, for errors.

        Raises:
            RowError: the row has a missing or additional column, or an invalid value.
        """
        if not self.columns:
            self.columns = tuple(row)
            self._rows.append(csv_line(self.columns))
        elif row.keys() != set(self.columns):
            hint = "; if code has changed since the first, use launch --rerun-changed" if self.length else ""
            raise RowError(
                f"{of}: {_difference(row.keys(), self.columns)} in a row of {self.path.name}; every "
                f"update must give the same metrics as the first{hint}"
            )
        self._rows.append(csv_line([row[name] for name in self.columns]))

    def write(self) -> tuple[int, Any]:
        """Write the rows of the next commit after the committed bytes, and sync.

        The rows count as committed after ``mark_committed``.

        Raises:
            DamagedError: the file has fewer bytes than are committed.
            OSError: the disk is full or gone.
        """
        data = "".join(self._rows).encode()
        with self.path.open("r+b" if self.path.exists() else "w+b") as file:
            found = os.fstat(file.fileno()).st_size
            if found < self.length:
                raise DamagedError(
                    f"{self.path.name} {shortage(found, self.length)}; it was cut while the trial ran"
                )
            file.truncate(self.length)
            file.seek(self.length)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        extended = self._hash.copy()
        extended.update(data)
        return self.length + len(data), extended

    def mark_committed(self, written: tuple[int, Any]) -> None:
        """Mark the result of ``write`` as committed."""
        self.length, self._hash = written
        self._rows.clear()


def digest_of(path: Path, length: int) -> Any | None:
    """Return the running SHA-256 of a file's first bytes; None if it has fewer, or is no file.

    Raises:
        StorageError: the file cannot be read at present, so whether it is intact is not known.
    """
    digest, left = hashlib.sha256(), length
    if length == 0:
        return digest
    try:
        with path.open("rb") as file:
            while left > 0:
                piece = file.read(min(left, PIECE_BYTES))
                if not piece:
                    return None
                digest.update(piece)
                left -= len(piece)
    except NO_FILE:
        return None
    except OSError as error:
        raise StorageError(f"{path.name} cannot be read ({error.strerror})") from error
    return digest


def shortage(found: int, committed: int) -> str:
    """Describe a file that is too short."""
    return f"has {found:,} of its {committed:,} committed bytes"


def rows_text(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Return a CSV file of at least one row, all with the same keys in any order."""
    names = tuple(rows[0])
    for row in rows:
        if row.keys() != set(names):
            raise RowError(f"{_difference(row.keys(), names)} in one of the rows")
    return "".join([csv_line(names), *(csv_line([row[name] for name in names]) for row in rows)]).encode()


def csv_line(values: Iterable[Any]) -> str:
    """Format a CSV line of numbers and plain words; floats as the shortest exact text.

    Raises:
        RowError: a value's text has a comma, a quotation mark or a line break in it.
    """
    cells = list(map(str, values))
    line = ",".join(cells)
    if line.count(",") != len(cells) - 1 or '"' in line or "\n" in line or "\r" in line:
        wrong = next(cell for cell in cells if any(sign in cell for sign in ',"\n\r'))
        raise RowError(f"a cell must be a number or a plain word, got {wrong[:80]!r}")
    return line + "\n"


def _difference(found: Collection[str], expected: Collection[str]) -> str:
    """Describe a difference of columns: ``kl is missing; entropy is new``."""
    missing = [name for name in expected if name not in found]
    new = [name for name in found if name not in expected]
    parts = [f"{', '.join(missing)} missing" if missing else "", f"{', '.join(new)} new" if new else ""]
    return "; ".join(filter(None, parts))


def _first_line(path: Path, length: int) -> tuple[str, ...]:
    """Return the names in a CSV file's first line; none if nothing is committed."""
    if length == 0:
        return ()
    with path.open("rb") as file:
        return tuple(file.readline().decode().rstrip("\n").split(","))
