"""Detect whether a trial ran other code than is installed now.

A trial's results depend on recrl's tasks, agents, curricula and training loop, not on figures or commands:
only the former are in the digest. For a user's task, agent or curriculum it includes all Python files of the
top-level package, or the single module. Nothing is imported to find them.
"""

from __future__ import annotations

import functools
import importlib.machinery
import importlib.util
from collections.abc import Iterable, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from recrl.agents.registry import AGENTS
from recrl.environments.registry import TASKS
from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.provenance.own_package import digest_of_files, folder_of
from recrl.orchestrator.spec import TrialSpec
from recrl.teachers.registry import TEACHERS

OURS = "recrl"
FOLDERS = ("agents", "environments", "teachers")
MODULES = ("trial/trial.py", "trial/attempt.py", "spec.py")  # of the orchestrator
SUFFIXES = (".py", ".xml", ".txt")  # top-level parts that affect results
KINDS = (
    ("task", "recrl.tasks", TASKS),
    ("agent", "recrl.agents", AGENTS),
    ("method", "recrl.teachers", TEACHERS),
)


def code_of(spec: TrialSpec) -> dict[str, str]:
    """Return digests of a trial's code: recrl's, and one for each top-level package of the user.

    A package that is not installed here is left out.
    """
    found = {OURS: _own_digest()}
    for kind, group, ours in KINDS:
        choice = getattr(spec, kind)
        names = [] if choice.name in ours else [_module_of(choice.name, group)]
        if isinstance(identity := choice.options.get("id"), str) and ":" in identity:
            names.append(identity)  # an id of Gymnasium: ``module:name``
        if isinstance(network := choice.options.get("network"), str):
            names.append(network)
        for name in filter(None, names):
            package = name.partition(":")[0].partition(".")[0]
            if digest := _package_digest(package):
                found[package] = digest
    return found


def other_code(attempts: Iterable[Mapping[str, Any]], spec: TrialSpec) -> bool:
    """Whether an attempt of a trial ran other code than is installed now; False if unknown.

    Args:
        attempts: of ``TrialStore.provenance``.
        spec: the trial.
    """
    now = code_of(spec)
    for attempt in attempts:
        code = attempt.get("code", {})
        if any(name in now and digest != now[name] for name, digest in code.items()):
            return True
    return False


def has_other_code(trial: TrialStore, spec: TrialSpec) -> bool:
    """Apply ``other_code`` to the trial's files; False if these are damaged."""
    try:
        return other_code(trial.provenance(), spec)
    except StorageError:
        return False


def other_code_sentence(complete: int, begun: int) -> str:
    """Describe trials that ran other code; empty for none.

    Args:
        complete: complete ones.
        begun: incomplete ones.
    """
    parts = []
    if complete:
        parts.append(f"{complete} complete trial{'' if complete == 1 else 's'}")
    if begun:
        noun = f"one{'' if begun == 1 else 's'}" if complete else f"trial{'' if begun == 1 else 's'}"
        parts.append(f"{begun} begun {noun}")
    if not parts:
        return ""
    comes = "comes" if complete + begun == 1 else "come"
    them = "it" if complete + begun == 1 else "them"
    return (
        f"{' and '.join(parts)} {comes} from other code than is installed now; launch --rerun-changed runs "
        f"{them} again"
    )


def _module_of(name: str, group: str) -> str:
    """Return the import path of a name that is not recrl's: itself, or that of its entry point."""
    if ":" in name:
        return name
    return next((point.value for point in entry_points(group=group) if point.name == name), "")


@functools.cache
def _own_digest() -> str:
    """Return the digest of the parts of recrl that affect results."""
    files = {
        f"{name}/{path.relative_to(folder_of(name))}": path
        for name in FOLDERS
        for path in folder_of(name).rglob("*")
        if path.suffix in SUFFIXES
    }
    trial = {f"orchestrator/{module}": folder_of("orchestrator") / module for module in MODULES}
    if missing := [str(path) for path in trial.values() if not path.is_file()]:
        raise FileNotFoundError(f"{', '.join(missing)}: results depend on it, and it is missing")
    return digest_of_files({**files, **trial})[:16]


def _package_digest(package: str) -> str:
    """Return the digest of a top-level package or module; empty if it is not found."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return ""
    if spec is None:
        return ""
    folders = [Path(place) for place in spec.submodule_search_locations or ()]
    files = {str(path.relative_to(folder)): path for folder in folders for path in folder.rglob("*.py")}
    if not folders and spec.origin and spec.origin.endswith(tuple(importlib.machinery.SOURCE_SUFFIXES)):
        files = {Path(spec.origin).name: Path(spec.origin)}
    return digest_of_files(files)[:16] if files else ""
