"""Names of the executors, for commands and the Python API; imports nothing, so that ``--help`` is fast."""

from __future__ import annotations

from enum import StrEnum


class ExecutorKind(StrEnum):
    """Where the trials of a launch run."""

    RAY = "ray"  # in parallel on all cores or a cluster
    INLINE = "inline"  # one after the other in this process
