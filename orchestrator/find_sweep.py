"""Find a sweep by its name, folder or grid file, here or in an object store."""

from __future__ import annotations

import os
from pathlib import Path

from recrl.environments.plugins import nearest
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.grid.checking import read_name
from recrl.orchestrator.remote.remote_sweep import sweeps_at

EXPORT_SUFFIX = ".zip"


def find_sweep(root: Path, sweep: str | None, storage: str | None = None) -> SweepStore:
    """Return the folder of a sweep, which is not brought up to date.

    Args:
        root: the folder of all sweeps.
        sweep: its name, its folder or its grid file; None for the only sweep there.
        storage: the address of an object store to search; None to search ``root``.

    Raises:
        RecrlError: there is no such sweep, or more than one.
    """
    place: str | Path = storage or root
    names = sweeps_at(storage) if storage else sorted(path.name for path in root.glob("*") if is_sweep(path))
    if sweep is None:
        if len(names) == 1:
            return SweepStore(root, names[0])
        if names:
            raise RecrlError(f"{place}: holds {len(names)} sweeps; give one: {', '.join(names)}")
        raise RecrlError(f"{place}: holds no sweep; launch one first{_elsewhere(storage)}")
    if sweep.endswith((".yaml", ".yml")):
        sweep = read_name(Path(sweep))
    if sweep.endswith(EXPORT_SUFFIX) and sweep not in names:
        raise RecrlError(
            f"{sweep}: an export has tables but no policies, logs or trials; give the sweep's name or folder"
        )
    if sweep not in names:
        folder = Path(os.path.abspath(sweep))  # without "..", which is no sweep's name
        if not storage and (is_sweep(folder) or (folder / "trials").is_dir()):
            return SweepStore(folder.parent, folder.name)
        hint = nearest(Path(sweep).name, names)
        listed = f" (there: {', '.join(names)})" if names else f"; launch it first{_elsewhere(storage)}"
        raise RecrlError(f"{place}: holds no sweep {sweep!r}{hint}{listed}")
    return SweepStore(root, sweep)


def _elsewhere(storage: str | None) -> str:
    return "" if storage else ", or give the folder of your sweeps with --root"


def is_sweep(folder: Path) -> bool:
    """Whether a sweep was launched into this folder; not if the folder may not be read."""
    try:
        return (folder / "sweep.json").exists() or (folder / "trials.jsonl").exists()
    except OSError:
        return False
