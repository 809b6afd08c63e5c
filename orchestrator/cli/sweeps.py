"""The sweep of a command."""

from __future__ import annotations

from recrl.orchestrator.cli.requests import SweepRequest
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.find_sweep import find_sweep
from recrl.orchestrator.remote.remote_sweep import sweep_place
from recrl.orchestrator.sweep_place import SweepPlace


def open_place(request: SweepRequest, *, checkpoints: bool = False) -> SweepPlace:
    """Return the place of the sweep; its folder is brought up to date if it is a local copy."""
    store = find_sweep(request.root, request.sweep, request.storage)
    place = sweep_place(store, request.storage)
    place.refresh(checkpoints=checkpoints)
    return place


def open_store(request: SweepRequest, *, checkpoints: bool = False) -> SweepStore:
    """Return the folder of ``open_place``."""
    return open_place(request, checkpoints=checkpoints).store
