"""Choose the storage of a sweep. fsspec is imported only if an object store is used."""

from __future__ import annotations

from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.places import LocalSweep, SweepPlace


def sweep_place(store: SweepStore, given: str | None = None) -> SweepPlace:
    """Return a sweep's place: the given address, the address stored in its folder, or the folder.

    Args:
        store: the sweep's folder on this machine.
        given: the address of an object store, or None.

    Raises:
        RecrlError: the address is invalid, needs a package that is not installed, or cannot be read.
    """
    if given or store.storage_path.exists():
        from recrl.orchestrator.remote.remote_sweep import remembered_uri  # noqa: PLC0415

        return place_at(store, given or remembered_uri(store) or "")
    return LocalSweep(store)


def place_at(store: SweepStore, uri: str) -> SweepPlace:
    """Return the place at an address; the folder itself if the address is empty."""
    if not uri:
        return LocalSweep(store)
    from recrl.orchestrator.remote.remote_sweep import RemoteSweep  # noqa: PLC0415

    return RemoteSweep(uri, store)
