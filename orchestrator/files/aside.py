"""Keep what is damaged or replaced, instead of deleting it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path


def move_aside(path: Path, folder: Path, *, copy: bool = False) -> None:
    """Keep what is at a path in a folder, under a name that is free there; nothing if there is nothing."""
    if not os.path.lexists(path):
        return
    folder.mkdir(parents=True, exist_ok=True)
    number = 1 + len(list(folder.iterdir()))
    place = folder / f"{number:03d}-{path.name.lstrip('.')}"
    if copy and path.is_file():
        shutil.copy2(path, place)
    else:
        path.rename(place)
