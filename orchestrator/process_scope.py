"""Whether a process that is known by its recorded id has ended.

A process id has a meaning only on one machine, until its next boot, and in one PID namespace. Two containers
may share a host name and number their processes independently, so the host name is not enough.
"""

from __future__ import annotations

import os
from pathlib import Path


def process_scope() -> str:
    """Return the scope of this process's ids: machine, boot and PID namespace; empty if unknown."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def is_own_scope(scope: str) -> bool:
    """Return whether this process sees the processes of a scope; False for an empty one."""
    return bool(scope) and scope == process_scope()


def has_ended(pid: int, scope: str) -> bool:
    """Return whether a process has ended; False if that cannot be seen from here.

    Args:
        pid: its id.
        scope: of ``process_scope`` where it ran, or empty.
    """
    if not is_own_scope(scope):
        return False
    try:
        os.kill(pid, 0)  # signal 0 only checks
    except ProcessLookupError:
        return True
    except PermissionError:
        pass  # a process of another user, so it exists
    return False
