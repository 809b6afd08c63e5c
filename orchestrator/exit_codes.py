"""What ``recrl-sweep`` ends with; a script or a continuous integration may rely on it."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Each code and when it is given."""

    OK = 0  # done, or nothing to do
    TRIALS_FAILED = 1  # the sweep went through, but some trials failed, are damaged or could not be finished
    WRONG_INPUT = 2  # the grid or the arguments are wrong; nothing was started
    BUSY = 3  # another process is running this sweep
    CANNOT_RUN = 4  # Ray, MLflow or the storage could not be started or reached
    TRIALS_LEFT = 5  # plan --check: a launch would have something to do
    STOPPED = 130  # Ctrl-C or SIGTERM; the same command goes on
