"""Keep damaged or replaced files instead of deleting them."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path


def move_aside(path: Path, folder: Path, *, copy: bool = False) -> Path | None:
    """Move a file or folder to another folder, under a free name.

    Returns:
        Where it is now; None if it does not exist.
    """
    if not os.path.lexists(path):
        return None
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / f"{next_number(folder):03d}-{path.name.lstrip('.')}"
    if copy and path.is_file():
        shutil.copy2(path, place)
        with place.open("rb") as file:  # a power cut must not take both
            os.fsync(file.fileno())
    else:
        path.rename(place)
    return place


def next_number(folder: Path, prefix: str = "") -> int:
    """Return a number above those of all entries in a folder that begin with a prefix and a number.

    >>> next_number(Path("/nowhere"))
    1
    """
    found = (re.match(rf"{re.escape(prefix)}(\d+)", path.name) for path in folder.glob(f"{prefix}*"))
    return 1 + max((int(match.group(1)) for match in found if match), default=0)
