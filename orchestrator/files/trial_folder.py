"""The folder of one trial as its writers share it: the lock, the record, and what is kept aside."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.files.aside import move_aside
from recrl.orchestrator.files.atomic_files import write_sealed
from recrl.orchestrator.files.locks import locked
from recrl.orchestrator.files.trial_reader import RECORD_FORMAT
from recrl.orchestrator.files.trial_record import TrialRecord
from recrl.orchestrator.files.trial_tables import TrialTables


class TrialFolder(TrialTables):
    """What a trial's writers need beside the readers' methods."""

    def write_record(self, record: TrialRecord) -> None:
        """Write ``state.json``; the caller holds ``locked``."""
        value = {"trial_id": self.trial_id, **record.to_json()}
        write_sealed(self.state_path, value, version=RECORD_FORMAT)

    def move_aside(self, path: Path, *, copy: bool = False) -> None:
        """Keep a file of the trial, or what is in its place, in ``aside/``; nothing if it is not there."""
        move_aside(path, self.aside_folder, copy=copy)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Turn what a full or lost disk raises into a StorageError that says how to go on."""
        try:
            yield
        except OSError as error:
            update = self.saved_update
            saved = f"it goes on from update {update}" if update else "it starts anew"
            raise StorageError(
                f"{self.folder.name}: its files cannot be written ({error.strerror or error}); "
                f"{saved} when there is room and the sweep is launched again"
            ) from error

    def locked(self) -> AbstractContextManager[None]:
        """Exclude other writers of this trial on the same file system, for a moment."""
        return locked(self.folder / ".lock")
