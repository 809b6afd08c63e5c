"""Keep damaged or replaced files instead of deleting them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path


def move_aside(path: Path, folder: Path, *, copy: bool = False) -> None:
    """Move a file or folder to another folder, under a free name; do nothing if it does not exist."""
    if not os.path.lexists(path):
        return
    folder.mkdir(parents=True, exist_ok=True)
    number = 1 + len(list(folder.iterdir()))
    place = folder / f"{number:03d}-{path.name.lstrip('.')}"
    if copy and path.is_file():
        shutil.copy2(path, place)
    else:
        path.rename(place)
