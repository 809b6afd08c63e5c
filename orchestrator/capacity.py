"""How many trials fit on a machine: its cores and GPUs, divided by those of a trial."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath


def trials_at_once(*, cpus_per_trial: float, max_concurrent: int | None, cores: int | None = None) -> int:
    """Return how many trials fit on a number of cores, by default this machine's; at least 1."""
    fitting = max(1, trials_within(cores or usable_cores(), cpus_per_trial))
    return min(fitting, max_concurrent or fitting)


def trials_within(there: float, asked: float) -> int:
    """Return for how many trials an amount of a resource is enough, without errors of rounding.

    >>> trials_within(7.0, 0.07), trials_within(2.0, 0.75)
    (100, 2)
    """
    return int(there / asked + 1e-9)


def trials_on_gpus(gpus: float, gpus_per_trial: float) -> int:
    """Return how many trials fit on the GPUs of one machine, at least 0.

    Args:
        gpus: of the machine, at least 0.
        gpus_per_trial: above 0, and whole above 1. Below 1 several trials share a GPU; none uses two.
    """
    on_each = trials_within(1.0, gpus_per_trial)
    return int(gpus) * on_each if on_each else int(gpus / gpus_per_trial)


def usable_cores(root: Path = Path("/")) -> int:
    """Return the number of cores that this process may use, at least 1.

    A container or a scheduler may allow fewer than the machine has. It does so by the affinity, or by the
    quota of a control group.

    Args:
        root: of the file system.
    """
    return max(1, int(min([len(os.sched_getaffinity(0)), *_quotas(root)])))


def _quotas(root: Path) -> Iterator[float]:
    """Yield the cores of each control group that contains this process and has a quota."""
    mounted = root / "sys/fs/cgroup"
    for version, group in _memberships(root / "proc/self/cgroup"):
        for folder in (group, *group.parents):
            place = str(folder).lstrip("/")  # a container that sees only its own group has it at the top
            with suppress(OSError, ValueError):  # no quota, or the group is not visible here
                if version == 2:  # such as "150000 100000", or "max 100000"
                    quota, period = (mounted / place / "cpu.max").read_text().split()
                else:  # -1 is no quota
                    files = mounted / "cpu" / place
                    quota = (files / "cpu.cfs_quota_us").read_text()
                    period = (files / "cpu.cfs_period_us").read_text()
                if int(quota) > 0 and int(period) > 0:
                    yield int(quota) / int(period)


def _memberships(listed: Path) -> Iterator[tuple[int, PurePosixPath]]:
    """Yield version and path of the control groups of this process that may limit its cores.

    Args:
        listed: lines such as ``0::/jobs/7`` (version 2) or ``5:cpu,cpuacct:/jobs/7`` (version 1).
    """
    with suppress(OSError, ValueError):
        for line in listed.read_text().splitlines():
            _, controllers, group = line.split(":", 2)
            if not controllers:
                yield 2, PurePosixPath(group)
            elif "cpu" in controllers.split(","):
                yield 1, PurePosixPath(group)
