"""The paths in a trial's folder; ``sweep_store`` describes the files."""

from __future__ import annotations

from pathlib import Path

PROVENANCE = "provenance.json"


class TrialPaths:
    """The paths in the folder of one trial.

    Attributes:
        folder: the trial's folder; its name is ``TrialSpec.folder_name``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def spec_path(self) -> Path:
        """The TrialSpec as JSON."""
        return self.folder / "spec.json"

    @property
    def state_path(self) -> Path:
        """The TrialRecord as JSON."""
        return self.folder / "state.json"

    @property
    def episodes_path(self) -> Path:
        """One row per episode."""
        return self.folder / "episodes.csv"

    @property
    def updates_path(self) -> Path:
        """One row per policy update."""
        return self.folder / "updates.csv"

    @property
    def events_path(self) -> Path:
        """One line per event."""
        return self.folder / "events.jsonl"

    @property
    def evaluation_path(self) -> Path:
        """One row per episode of the final evaluations."""
        return self.folder / "evaluation.csv"

    @property
    def policy_path(self) -> Path:
        """The final policy's table, if the task is finite."""
        return self.folder / "policy.csv"

    @property
    def evaluations_folder(self) -> Path:
        """Results of ``recrl-sweep evaluate``."""
        return self.folder / "evaluations"

    @property
    def videos_folder(self) -> Path:
        """Filmed episodes."""
        return self.folder / "videos"

    @property
    def checkpoints_folder(self) -> Path:
        """The newest checkpoints."""
        return self.folder / "checkpoints"

    @property
    def provenance_path(self) -> Path:
        """Versions, commit and machine."""
        return self.folder / PROVENANCE

    @property
    def log_path(self) -> Path:
        """The trial's log."""
        return self.folder / "log.txt"

    @property
    def error_path(self) -> Path:
        """The traceback of a failed trial."""
        return self.folder / "error.txt"

    @property
    def reserve_path(self) -> Path:
        """Disk space that is released to record the end of a trial on a full disk."""
        return self.folder / ".reserve"

    @property
    def aside_folder(self) -> Path:
        """Damaged or replaced files, moved there when an attempt began."""
        return self.folder / "aside"

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
