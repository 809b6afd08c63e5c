"""The files of a trial: their names and kinds, columns and paths; ``docs/reference/files.md`` describes them.

A file that trials have is declared once, as an attribute of ``TrialFiles``. Its kind decides how a writer
commits it, and whether and how it is uploaded to an object store.
"""

from __future__ import annotations

import re
from enum import Enum
from pathlib import Path
from typing import Any

DEFAULT_ROOT = "runs"  # the folder of all sweeps, in the working directory
EPISODE_COLUMNS = ("index", "phase", "end_step", "length", "episode_return", "noise")
UPDATE_COLUMNS = (
    "update",
    "phase",
    "end_step",
    "episodes",
    "episode_return",
    "noise",
    "time",
    "collect_seconds",
    "update_seconds",
)
EVALUATION_COLUMNS = ("policy", "index", "length", "episode_return")
HARD_LANDING, POLICY_NOISE = "hard landing", "policy noise"  # events that warnings and figures use


def of_update(update: int) -> str:
    """Return the beginning of the names of evaluations and videos of the policy after an update."""
    return f"update-{update:08d}"


class FileKind(Enum):
    """How a file is written."""

    ROWS = "rows appended by each commit, together with a checkpoint"
    LOG = "lines appended at any time"
    WHOLE = "written as a whole"
    RECORD = "the record, which names the committed files"  # a commit in an object store contains it
    LOCAL = "of the machine that runs the trial; not uploaded"


class PathIn:
    """The path of a file or folder, an attribute of what has a ``folder``."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, owner: Any, kind: type[Any]) -> Path:
        folder: Path = owner.folder
        return folder / self.name


class TrialFile(PathIn):
    """The path of a file of a trial.

    Attributes:
        kind: how it is written.
    """

    def __init__(self, name: str, kind: FileKind) -> None:
        super().__init__(name)
        self.kind = kind


class TrialFiles:
    """The files and folders of one trial; ``docs/reference/files.md`` says what each holds.

    Attributes:
        folder: the trial's folder; its name is ``TrialSpec.folder_name``.
    """

    episodes_path = TrialFile("episodes.csv", FileKind.ROWS)
    updates_path = TrialFile("updates.csv", FileKind.ROWS)
    events_path = TrialFile("events.jsonl", FileKind.ROWS)
    log_path = TrialFile("log.txt", FileKind.LOG)
    spec_path = TrialFile("spec.json", FileKind.WHOLE)
    provenance_path = TrialFile("provenance.json", FileKind.WHOLE)
    error_path = TrialFile("error.txt", FileKind.WHOLE)
    evaluation_path = TrialFile("evaluation.csv", FileKind.WHOLE)
    policy_path = TrialFile("policy.csv", FileKind.WHOLE)
    state_path = TrialFile("state.json", FileKind.RECORD)
    reserve_path = TrialFile(".reserve", FileKind.LOCAL)
    lock_path = TrialFile(".lock", FileKind.LOCAL)
    rerun_path = TrialFile("rerun.request", FileKind.LOCAL)
    pulled_path = TrialFile(".pulled.json", FileKind.LOCAL)
    checkpoints_folder = PathIn("checkpoints")
    evaluations_folder = PathIn("evaluations")
    videos_folder = PathIn("videos")
    aside_folder = PathIn("aside")

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def trial_id(self) -> str:
        """The trial's id, from the folder's name."""
        return self.folder.name.rpartition("__")[2]

    @property
    def is_local_copy(self) -> bool:
        """Whether the folder is only a local copy of a trial in an object store."""
        return self.pulled_path.exists()

    @property
    def rerun_folder(self) -> Path | None:
        """Where the next attempt moves the files of earlier ones; None if that was not requested."""
        try:
            name = self.rerun_path.read_bytes().strip()
        except OSError:
            return None
        return self.aside_folder / (name.decode() if re.fullmatch(rb"run-\d{1,9}", name) else "run-unnamed")

    @property
    def rerun_has_begun(self) -> bool:
        """Whether an attempt has begun to move the files of earlier ones, but has not finished."""
        return (place := self.rerun_folder) is not None and place.exists()

    def checkpoints(self) -> list[Path]:
        """The checkpoints on disk, newest first."""
        return sorted(self.checkpoints_folder.glob("checkpoint-*.recrl"), key=_update_of, reverse=True)

    @property
    def saved_update(self) -> int:
        """The update of the newest checkpoint, intact or not; 0 if there is none."""
        return max(map(_update_of, self.checkpoints()), default=0)


def _update_of(checkpoint: Path) -> int:
    """Return the update in the name of a checkpoint; 0 if there is none."""
    number = checkpoint.stem.removeprefix("checkpoint-")
    return int(number) if re.fullmatch(r"[0-9]{1,18}", number) else 0


def files_of(*kinds: FileKind) -> tuple[str, ...]:
    """Return the names of the files of these kinds, in the order of their declaration.

    >>> files_of(FileKind.ROWS)
    ('episodes.csv', 'updates.csv', 'events.jsonl')
    """
    files = (file for file in vars(TrialFiles).values() if isinstance(file, TrialFile))
    return tuple(file.name for file in files if file.kind in kinds)
