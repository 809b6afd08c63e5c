"""The paths in a trial's folder; ``sweep_store`` describes the files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

PROVENANCE = "provenance.json"


class Below:
    """The path of a file or folder, an attribute of what has a ``folder``."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, owner: Any, kind: type[Any]) -> Path:
        folder: Path = owner.folder
        return folder / self._name


class TrialPaths:
    """The paths in the folder of one trial; ``sweep_store`` says what each holds.

    Attributes:
        folder: the trial's folder; its name is ``TrialSpec.folder_name``.
    """

    spec_path = Below("spec.json")
    state_path = Below("state.json")
    episodes_path = Below("episodes.csv")
    updates_path = Below("updates.csv")
    events_path = Below("events.jsonl")
    evaluation_path = Below("evaluation.csv")
    policy_path = Below("policy.csv")
    evaluations_folder = Below("evaluations")
    videos_folder = Below("videos")
    checkpoints_folder = Below("checkpoints")
    provenance_path = Below(PROVENANCE)
    log_path = Below("log.txt")
    error_path = Below("error.txt")
    reserve_path = Below(".reserve")
    aside_folder = Below("aside")

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def trial_id(self) -> str:
        """The trial's id, from the folder's name."""
        return self.folder.name.rpartition("__")[2]

    @property
    def is_local_copy(self) -> bool:
        """Whether the folder is only a local copy of a trial in an object store."""
        return (self.folder / ".pulled.json").exists()

    def checkpoints(self) -> list[Path]:
        """The checkpoints on disk, newest first."""
        return sorted(self.checkpoints_folder.glob("checkpoint-*.recrl"), reverse=True)

    @property
    def saved_update(self) -> int:
        """The update of the newest checkpoint, intact or not; 0 if there is none."""
        names = [path.stem.removeprefix("checkpoint-") for path in self.checkpoints()[:1]]
        return int(names[0]) if names and names[0].isdecimal() else 0
