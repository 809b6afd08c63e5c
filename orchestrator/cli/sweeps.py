"""The sweep of a command."""

from __future__ import annotations

import shlex
from pathlib import Path

from recrl.orchestrator.cli.output import short
from recrl.orchestrator.cli.requests import SweepRequest
from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_files import DEFAULT_ROOT
from recrl.orchestrator.find_sweep import find_sweep
from recrl.orchestrator.redaction import redacted
from recrl.orchestrator.remote.remote_sweep import sweep_place
from recrl.orchestrator.spec import TrialSpec
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


def listed_trials(store: SweepStore) -> list[TrialSpec]:
    """Return the trials of the last launch; empty before it, or if the file that lists them is damaged."""
    try:
        return store.specs()
    except StorageError:
        return []


def command_line(command: str, store: SweepStore, tracking_uri: str | None = None) -> str:
    """Return a command about a sweep, for a hint: it can be pasted into the same terminal.

    Args:
        command: for example ``sync``.
        store: the sweep.
        tracking_uri: as given by the user; None for the default.
    """
    words = ["recrl-sweep", command, store.name]
    root = store.folder.parent
    if root.resolve() != Path(DEFAULT_ROOT).resolve():
        words += ["--root", str(short(root))]
    if tracking_uri:
        words += ["--tracking-uri", redacted(tracking_uri)]
    return shlex.join(words)
