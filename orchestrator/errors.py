"""Errors that a user can understand, one class per question; ``cli`` turns them into exit codes."""

from __future__ import annotations

import difflib
import errno
import sysconfig
import traceback
from pathlib import Path
from types import FrameType

INSTALLED = ("stdlib", "platstdlib", "purelib", "platlib")  # kinds of folders, as sysconfig calls them


class RecrlError(Exception):
    """An error that a user can correct; its text is one clear sentence."""


TRUST_HINT = "if you trust it, add --trust"  # the Python API has another one


class GridError(RecrlError):
    """A grid file is wrong; ``problems`` holds one located sentence for each mistake."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class UntrustedGridError(RecrlError):
    """A grid was checked without its import paths, which were not followed; no mistake was found.

    Args:
        source: the grid file's name.
        uncalled: places and texts of the import paths.
    """

    def __init__(self, source: str, uncalled: list[str]) -> None:
        what = "was not called" if len(uncalled) == 1 else "were not called"
        super().__init__(
            f"{source}: {', '.join(uncalled)} {what}, because a file that is only read must run no code; "
            f"{TRUST_HINT}"
        )


class CheckpointError(RecrlError):
    """A checkpoint is truncated, damaged or of another version; an older one may be used."""


class StorageError(RecrlError):
    """A trial's files cannot be written or read; the last commit is intact."""


class DamagedError(StorageError):
    """A file is not what was written: cut, changed, replaced, or of another trial."""


class OtherFormatError(DamagedError):
    """A file has the format of another version of recrl."""


class RowError(RecrlError):
    """A row does not have the columns of its file, or contains an invalid value."""


class LostLeaseError(RecrlError):
    """Another attempt has taken over this trial; this one must not write any more."""


class SweepBusyError(RecrlError):
    """Another process is running this sweep."""


class TeacherUnavailableError(RecrlError):
    """The teacher did not answer; nothing is lost, the trial can be resumed."""


class ClusterError(RecrlError):
    """Ray cannot be started or reached, or lacks the resources of a trial."""


class TrackingError(RecrlError):
    """MLflow cannot be used as requested; training does not depend on it."""


# Invalid paths: a file for a folder, a name that is too long, circular links.
NO_PATH = (
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EEXIST,
    errno.ENAMETOOLONG,
    errno.ELOOP,
    errno.ENOENT,
    errno.EINVAL,
)
# The disk is full, lost or refuses.
NO_ROOM = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.EIO,
    errno.ESTALE,
)

# Exceptions of a user's task, agent or curriculum, which must end only their own trial.
USERS_ERRORS = (Exception, SystemExit)


def described(error: BaseException) -> str:
    """Return an error as one line: ``KeyError: 'window'``; for SystemExit, its exit code."""
    if isinstance(error, SystemExit):
        return f"it ended the process (exit code {error.code})"
    try:
        text = str(error)
    except Exception:  # a user's own class may fail here
        text = "its text cannot be read"
    return " ".join(f"{type(error).__name__}: {text}".split()).removesuffix(":")


def described_with_place(error: BaseException) -> str:
    """Return an error as one line, with the last place in the user's own code, if there is one.

    Own code is neither recrl's nor installed: ``KeyError: 'x' (task.py, line 90, in step)``.
    """
    places = [
        f"{Path(frame.f_code.co_filename).name}, line {line}, in {frame.f_code.co_name}"
        for frame, line in traceback.walk_tb(error.__traceback__)
        if _is_own_code(frame)
    ]
    return f"{described(error)} ({places[-1]})" if places else described(error)


def _is_own_code(frame: FrameType) -> bool:
    """Whether a frame runs a file that is neither recrl's nor installed."""
    file = frame.f_code.co_filename
    if file.startswith("<") or str(frame.f_globals.get("__name__")).partition(".")[0] == "recrl":
        return False
    return not any(Path(file).is_relative_to(sysconfig.get_path(kind)) for kind in INSTALLED)


def first_line(error: BaseException) -> str:
    """Return the first line of an error, or all lines as one if the first only announces the others."""
    first = next(iter(str(error).splitlines()), "")
    return " ".join(str(error).split()) if first.endswith(":") else first


def missing(path: Path) -> str:
    """Describe a missing file: the folder that was searched, and similar names in it."""
    folder = path.absolute().parent
    if not folder.is_dir():
        return f"there is no folder {folder}"
    files = sorted(each for each in folder.iterdir() if each.is_file())
    files.sort(
        key=lambda each: each.suffix == path.suffix
    )  # if two have the same stem, the one with this suffix
    names = {each.stem: each.name for each in files}
    near = difflib.get_close_matches(path.stem, names, n=1)
    hint = f"; did you mean {names[near[0]]!r}?" if near else ""
    return f"there is no such file in {folder}{hint}"
