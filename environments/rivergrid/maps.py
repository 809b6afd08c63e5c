"""Maps of RiverGrid as text: 1a, 1b and a parser; ``instances`` generates random ones.

A map is a rectangle of characters, enclosed by walls:

    ``#`` wall, ``.`` dry ground, ``~`` river, ``%`` mud, ``G`` goal (at least one),
    ``>`` ``v`` ``<`` ``^`` the start and its heading (exactly one, on dry ground).

A cell is (x, y), the column and the row, both from 0 at the top left. Error messages count lines and columns
from 1, like an editor.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

Cell = tuple[int, int]

WALL, DRY, RIVER, MUD, GOAL = "#", ".", "~", "%", "G"
GROUND = DRY + RIVER + MUD  # tiles that can be entered
STARTS = ">v<^"  # in the order of MiniGrid's headings: 0 east, 1 south, 2 west, 3 north
TILES = WALL + GROUND + GOAL + STARTS
STEPS: tuple[Cell, ...] = ((1, 0), (0, 1), (-1, 0), (0, -1))  # step forward by heading; y grows downwards


# Ours, after the paper's figure 1. The river is crossed at a cost of 5 (1a), or also bypassed at a cost of 0
# (1b).
MAPS = {
    "1a": """
        #########
        #.~~~~~.#
        #.~~~~~.#
        #.~~~~~.#
        #>~~~~~G#
        #.~~~~~.#
        #.~~~~~.#
        #.~~~~~.#
        #########
        """,
    "1b": """
        #########
        #.~~~~~.#
        #.~~~~~.#
        #.~~~~~.#
        #.~~~~~.#
        #.~~~~~.#
        #>~~~~~G#
        #.......#
        #########
        """,
}


class MapError(ValueError):
    """A map that cannot be used; the message says where and why."""


@dataclass(frozen=True)
class RiverMap:
    """A valid map.

    Attributes:
        rows: the characters, top row first; all of one length.
    """

    rows: tuple[str, ...]

    def __str__(self) -> str:
        return "\n".join(self.rows)

    @property
    def width(self) -> int:
        """Columns, walls included."""
        return len(self.rows[0])

    @property
    def height(self) -> int:
        """Rows, walls included."""
        return len(self.rows)

    @property
    def start(self) -> Cell:
        """The start, (x, y)."""
        return self.cells(STARTS)[0]

    @property
    def heading(self) -> int:
        """The heading at the start: 0 east, 1 south, 2 west, 3 north."""
        return STARTS.index(self.tile(self.start))

    def tile(self, cell: Cell) -> str:
        """Return the character at (x, y)."""
        return self.rows[cell[1]][cell[0]]

    def cells(self, tiles: str) -> tuple[Cell, ...]:
        """Return all cells whose character is in ``tiles``, row by row."""
        return tuple((x, y) for y, row in enumerate(self.rows) for x, tile in enumerate(row) if tile in tiles)

    def reaches_goal(self) -> bool:
        """Whether some path leads from the start to a goal."""
        reached, frontier = {self.start}, [self.start]
        while frontier:
            x, y = frontier.pop()
            following = {(x + right, y + down) for right, down in STEPS} - reached
            entered = [cell for cell in following if self.tile(cell) != WALL]
            reached.update(entered)
            frontier += entered
        return any(cell in reached for cell in self.cells(GOAL))


def parse_map(text: str, *, source: str = "map") -> RiverMap:
    """Parse a map; a common indentation and empty lines around it are ignored.

    Args:
        text: the map, one line a row.
        source: its name in errors, for example a file's name.

    Raises:
        MapError: it is not a map; the message names the first offending line and column.
    """
    lines = textwrap.dedent(text).split("\n")
    first = next((index for index, line in enumerate(lines) if line.strip()), len(lines))
    rows = tuple(line.rstrip() for line in "\n".join(lines[first:]).rstrip().split("\n"))
    _check_drawing(rows, source, first + 1)
    river_map = RiverMap(rows)
    if not river_map.reaches_goal():
        raise MapError(f"{source}: no goal can be reached from the start, open a way through the walls")
    return river_map


def read_map(path: Path) -> RiverMap:
    """Read a map from a text file.

    Raises:
        MapError: the file cannot be read or is not a map.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise MapError(f"{path}: cannot be read as a map ({error})") from error
    return parse_map(text, source=str(path))


def _check_drawing(rows: tuple[str, ...], source: str, first_line: int) -> None:
    width, height = len(rows[0]), len(rows)
    if width < 3 or height < 3:
        raise MapError(f"{source}: must be at least 3 columns by 3 rows, got {width} by {height}")
    starts = []
    for y, row in enumerate(rows):
        line = f"{source}: line {y + first_line}"
        if len(row) != width:
            raise MapError(f"{line}: must have {width} columns like the first row, got {len(row)}")
        for x, tile in enumerate(row):
            where = f"{line}, column {x + 1}"
            if tile not in TILES:
                raise MapError(f"{where}: unknown tile {tile!r}, allowed are {' '.join(TILES)}")
            if (x in (0, width - 1) or y in (0, height - 1)) and tile != WALL:
                raise MapError(f"{where}: the border must be wall {WALL!r}, got {tile!r}")
            if tile in STARTS:
                starts.append(where)
                if len(starts) > 1:
                    raise MapError(f"{where}: there must be one start, the first is at {starts[0]}")
    if not starts:
        raise MapError(f"{source}: needs a start, one of {' '.join(STARTS)}")
    if not any(GOAL in row for row in rows):
        raise MapError(f"{source}: needs a goal {GOAL!r}")


def enclosed(rows: Iterable[str]) -> RiverMap:
    """Return the map of the inner tiles with a border of wall around them, without any check."""
    inner = [WALL + row + WALL for row in rows]
    border = WALL * len(inner[0])
    return RiverMap((border, *inner, border))
