"""The sweep of a command."""

from __future__ import annotations

from recrl.orchestrator.cli.requests import SweepRequest
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.find_sweep import find_sweep
from recrl.orchestrator.remote.remote_sweep import sweep_place


def open_store(request: SweepRequest, *, checkpoints: bool = False) -> SweepStore:
    """Return the folder of the sweep, brought up to date if it is a local copy."""
    store = find_sweep(request.root, request.sweep, request.storage)
    sweep_place(store, request.storage).refresh(checkpoints=checkpoints)
    return store
