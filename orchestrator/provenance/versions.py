"""Provenance of a result: commits, versions and the machine, without secrets.

Environment variables, the user's name and paths are not recorded, because folders of results are shared. The
resolved settings are in the trial's ``spec.json``.
"""

from __future__ import annotations

import functools
import os
import platform
import re
import subprocess
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

DISTRIBUTION = "recrl"
LIBRARIES = ("gymnasium", "minigrid", "mujoco", "numba", "numpy", "scipy", "torch")  # that affect results
_GIT_SECONDS = 10.0


def recrl_version() -> str:
    """Return the installed version of recrl."""
    return version(DISTRIBUTION)


def collect(folder: Path | None = None) -> dict[str, Any]:
    """Return the data for reproducing a result, as JSON values.

    Args:
        folder: the user's project, whose commit is recorded; the working directory by default.

    Returns:
        ``recrl`` and ``packages``: versions; ``project`` and ``source``: commit and dirty flag of the user's
        repository and of the one recrl itself runs from, or None outside a repository; ``python``,
        ``system``, ``machine``, ``cpu`` and ``cpu_count``.
    """
    return {
        "recrl": recrl_version(),
        "project": _git_state_of_project(folder),
        "source": git_state(Path(__file__).resolve().parent),
        "python": platform.python_version(),
        "system": platform.platform(),
        "machine": platform.machine(),
        "cpu": _cpu_model(),
        "cpu_count": os.cpu_count(),
        "packages": package_versions(_dependencies()),
    }


def _git_state_of_project(folder: Path | None) -> dict[str, Any] | None:
    try:
        return git_state((folder or Path.cwd()).resolve())
    except FileNotFoundError:  # the working directory was deleted
        return None


@functools.lru_cache(maxsize=16)
def git_state(folder: Path) -> dict[str, Any] | None:
    """Return the commit of ``folder``, and whether tracked files differ from it.

    Cached per process, so that it is the same for all trials of a worker.

    Returns:
        ``{"commit": 40 hex digits, "dirty": bool}``, or None if there is no repository with a commit, or
        no git.
    """
    if "site-packages" in folder.parts:  # an installed copy inside another repository is not part of it
        return None
    commit = _git(folder, "rev-parse", "--verify", "HEAD")
    if commit is None:
        return None
    changes = _git(folder, "status", "--porcelain", "--untracked-files=no")
    return {"commit": commit, "dirty": bool(changes)}


def package_versions(names: Iterable[str]) -> dict[str, str]:
    """Return the installed version of each distribution; missing ones are left out."""
    versions = {}
    for name in names:
        try:
            versions[name] = _version(name)
        except PackageNotFoundError:
            continue
    return versions


@functools.cache
def _version(name: str) -> str:
    """Return the version of a distribution when the process first asked, because reading it is slow."""
    return version(name)


def _dependencies() -> list[str]:
    """Return the requirements of recrl itself, without extras."""
    needed = [line for line in requires(DISTRIBUTION) or [] if "extra ==" not in line]
    return sorted(re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0] for line in needed)


def _git(folder: Path, *arguments: str) -> str | None:
    """Return git's output, or None if it fails, is missing or hangs."""
    try:
        done = subprocess.run(
            ["git", "--no-optional-locks", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            errors="replace",  # names of files
            timeout=_GIT_SECONDS,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _cpu_model() -> str:
    """Return the processor's name from the system, or empty."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    except OSError:
        pass  # no such file outside Linux
    return platform.processor()
