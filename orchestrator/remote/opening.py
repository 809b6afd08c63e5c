"""Choose the storage of a sweep. fsspec is imported only if an object store is used."""

from __future__ import annotations

from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.places import SweepPlace


def sweep_place(store: SweepStore, given: str | None = None) -> SweepPlace:
    """Return a sweep's place: the given address, the address stored in its folder, or the folder.

    Args:
        store: the sweep's folder on this machine.
        given: the address of an object store, or None.

    Raises:
        RecrlError: the address is invalid, needs a package that is not installed, or cannot be read.
    """
    if not given and not store.storage_path.exists():
        return SweepPlace(store)
    from recrl.orchestrator.remote.remote_sweep import RemoteSweep, remembered_uri  # noqa: PLC0415

    uri = given or remembered_uri(store)
    return RemoteSweep(uri, store) if uri else SweepPlace(store)
