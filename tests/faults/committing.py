"""Files put into a trial's folder as if its writer had committed them."""

from dataclasses import replace

from recrl.orchestrator.files.row_files import Extent
from recrl.orchestrator.files.trial_store import TrialStore


def commit_file(trial: TrialStore, name: str, text: str) -> None:
    """Write a file of a trial, with its length and digest in the record."""
    (trial.folder / name).write_text(text)
    record, extent = trial.stored_record(), Extent.of(text.encode())
    trial.write_record(
        replace(
            record,
            committed={**record.committed, name: extent.length},
            digests={**record.digests, name: extent.sha256},
        )
    )
