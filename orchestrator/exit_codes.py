"""Exit codes of ``recrl-sweep``, for scripts and continuous integration."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes and their meanings."""

    OK = 0  # done, or nothing to do
    TRIALS_FAILED = 1  # some trials failed, are damaged, could not be finished, or (evaluate) were left out
    WRONG_INPUT = 2  # the grid or the arguments are wrong; nothing was started
    BUSY = 3  # another process is running this sweep
    CANNOT_RUN = 4  # Ray, MLflow or the storage could not be started or reached
    TRIALS_LEFT = 5  # plan --check: trials are left to run, or come from other code
    STOPPED = 130  # Ctrl-C or SIGTERM; the same command continues
