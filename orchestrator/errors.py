"""The questions a user may have, each an exception; only ``cli`` turns them into text and exit codes."""

from __future__ import annotations

import difflib
from pathlib import Path


class RecrlError(Exception):
    """Anything that a user can understand and mend; its text is one clear sentence."""


class GridError(RecrlError):
    """A grid file is wrong; ``problems`` holds one located sentence for every mistake in it."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class UncalledError(RecrlError):
    """A grid has no mistake that could be found without code that it names, which was not run.

    Attributes:
        source: the grid file's name.
        uncalled: where the import paths are, and what they are.
    """

    def __init__(self, source: str, uncalled: list[str]) -> None:
        what = "was not called" if len(uncalled) == 1 else "were not called"
        super().__init__(
            f"{source}: {', '.join(uncalled)} {what}, because a file that is only read must run no code; "
            "if you trust it, add --trust"
        )
        self.source = source
        self.uncalled = uncalled


class CheckpointError(RecrlError):
    """A checkpoint is truncated, damaged or of another version; an older one may serve."""


class StorageError(RecrlError):
    """A trial's files cannot be written, or read where they are kept; its last commit stands."""


class DamagedError(StorageError):
    """A file is not what was written: cut, changed, replaced, or of another trial."""


class OtherFormatError(DamagedError):
    """A file has the format of another version of recrl."""


class RowError(RecrlError):
    """A row does not have the columns of its file, or holds what is no cell."""


class LostLeaseError(RecrlError):
    """Another attempt has taken this trial over; this one must write nothing more."""


class SweepBusyError(RecrlError):
    """Another process is running this sweep."""


class TeacherUnavailableError(RecrlError):
    """The teacher did not answer; nothing is lost, the trial can be resumed."""


class ClusterError(RecrlError):
    """Ray cannot be started or reached, or lacks what a trial asks for."""


class TrackingError(RecrlError):
    """MLflow cannot be used in the way that was asked for; training does not depend on it."""


# What a user's own task, agent or teacher may raise, and what must not end more than its own work.
USERS_ERRORS = (Exception, SystemExit)


def described(error: BaseException) -> str:
    """An error as one line: ``KeyError: 'window'``; of one that ends the process, its exit code."""
    if isinstance(error, SystemExit):
        return f"it ended the process (exit code {error.code})"
    return " ".join(f"{type(error).__name__}: {error}".split())


def missing(path: Path) -> str:
    """What is said of a file that is not there: where it was looked for, and what there may be meant."""
    folder = path.absolute().parent
    if not folder.is_dir():
        return f"there is no folder {folder}"
    files = sorted(each for each in folder.iterdir() if each.is_file())
    files.sort(key=lambda each: each.suffix == path.suffix)  # of two with one stem, that of the same kind
    names = {each.stem: each.name for each in files}
    near = difflib.get_close_matches(path.stem, names, n=1)
    hint = f"; did you mean {names[near[0]]!r}?" if near else ""
    return f"there is no such file in {folder}{hint}"
