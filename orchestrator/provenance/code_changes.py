"""Detect whether a trial ran other code, or with other versions of libraries, than is installed now.

A trial's results depend on recrl's tasks, agents, curricula and training loop, not on figures or commands:
only the former are in the digest. Docstrings and lines that only have a comment are not.
A user's task, agent or curriculum has a digest of its top-level package (all Python files) or single module.
Each module of the user's project that it imports, directly or through others, has one too
(``project_files``).

Of ``LIBRARIES`` the versions are compared. Others are named, but they are no reason to run a trial again:
most new versions change nothing, or only the rounding.
"""

from __future__ import annotations

import functools
import sys
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from importlib.machinery import ModuleSpec
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from recrl.agents.registry import AGENTS
from recrl.environments.plugins import is_edited
from recrl.environments.registry import TASKS
from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.provenance.own_package import digest_of_code, folder_of
from recrl.orchestrator.provenance.project_files import files_of, files_with_imports, folder_of_files
from recrl.orchestrator.provenance.versions import DISTRIBUTION, LIBRARIES, package_versions
from recrl.orchestrator.spec import TrialSpec
from recrl.teachers.registry import TEACHERS

FOLDERS = ("agents", "environments", "teachers")  # top-level parts that affect results
MODULES = (  # of the orchestrator
    "trial/trial.py",
    "trial/attempt.py",
    "trial/device.py",
    "trial/torch_settings.py",
    "spec.py",
)
SUFFIXES = (".py", ".xml", ".txt")
KINDS = (
    ("task", "recrl.tasks", TASKS),
    ("agent", "recrl.agents", AGENTS),
    ("method", "recrl.teachers", TEACHERS),
)


CHANGED = "changed since it was imported"  # in place of a digest; equal to none
# By package and folder: how this process found the modules that it had imported, and the digests.
_ran: dict[tuple[str, Path | None], tuple[dict[str, ModuleSpec | None], dict[str, str]]] = {}


class InstalledCode:
    """The code that is installed now; each package is read once, for many trials.

    Args:
        digests_of: returns the digest of a top-level package or module, and of those of its project that it
            imports; None for those of the files as they are.

    Attributes:
        libraries: versions of ``LIBRARIES``.
    """

    def __init__(self, digests_of: Callable[[str], dict[str, str]] | None = None) -> None:
        self._module_of = functools.cache(_module_of)
        self._digests_of = functools.cache(digests_of or _digests_of)
        self.libraries = _without_builds(package_versions(LIBRARIES))

    def of(self, spec: TrialSpec) -> dict[str, str]:
        """Return digests of a trial's code: recrl's, and those of the user's top-level packages or modules.

        These are the named ones, and those of the same project that they import. A package that is not
        installed here is left out.
        """
        found = {DISTRIBUTION: _own_digest()}
        for kind, group, ours in KINDS:
            choice = getattr(spec, kind)
            names = [] if choice.name in ours else [self._module_of(choice.name, group)]
            if isinstance(identity := choice.options.get("id"), str) and ":" in identity:
                names.append(identity)  # an id of Gymnasium: ``module:name``
            if isinstance(network := choice.options.get("network"), str):
                names.append(network)
            for name in filter(None, names):
                found |= self._digests_of(name.partition(":")[0].partition(".")[0])
        return found


def code_of(spec: TrialSpec) -> dict[str, str]:
    """Return ``InstalledCode.of`` a trial that this process runs now.

    A process imports a package once. If its files have changed since, that is a warning. Then ``CHANGED`` is
    in place of a digest, so that the trial counts as one of other code.
    """
    found = InstalledCode(_digests_of_imported).of(spec)
    if changed := [name for name, digest in found.items() if digest == CHANGED]:
        warnings.warn(
            f"the code of {', '.join(changed)} has changed since this process imported it; the code of "
            "before runs until you start a new Python process or reload the modules",
            stacklevel=2,
        )
    return found


@dataclass(frozen=True)
class CodeComparison:
    """The code that a trial ran, compared with the code that is installed now.

    Attributes:
        changed: the packages and modules of which an attempt ran other code; empty if that is unknown.
        missing: the top-level packages and modules that it ran and that are not found now. So it is unknown
            whether their code differs. Empty if other code differs.
        versions: of libraries in an attempt, where they are others now, such as "torch 2.12.0, now 2.13.0".
        unreadable: why the file that names the code could not be read, so that nothing was compared; empty
            if it was read.
    """

    changed: frozenset[str] = frozenset()
    missing: frozenset[str] = frozenset()
    versions: frozenset[str] = frozenset()
    unreadable: str = ""

    @property
    def differs(self) -> bool:
        """Whether an attempt ran other code; False if unknown."""
        return bool(self.changed)


def compare(
    attempts: Iterable[Mapping[str, Any]], spec: TrialSpec, installed: InstalledCode | None = None
) -> CodeComparison:
    """Compare the code that a trial ran with the code that is installed now.

    Args:
        attempts: of ``TrialStore.provenance``.
        spec: the trial.
        installed: shared by the trials of one pass; None to read the code for this one.
    """
    attempts = list(attempts)
    ran = [(name, digest) for attempt in attempts for name, digest in attempt.get("code", {}).items()]
    installed = installed or InstalledCode()
    now = installed.of(spec)
    versions = _other_versions(attempts, installed.libraries)
    if changed := frozenset(name for name, digest in ran if name in now and digest != now[name]):
        return CodeComparison(changed, versions=versions)
    return CodeComparison(missing=frozenset(name for name, _ in ran if name not in now), versions=versions)


def library_versions(attempt: Mapping[str, Any]) -> dict[str, str]:
    """Return the versions of ``LIBRARIES`` in an attempt, without the build (as in ``2.13.0+cpu``)."""
    packages = attempt.get("packages")
    return _without_builds(packages) if isinstance(packages, Mapping) else {}


def compare_files(
    trial: TrialStore, spec: TrialSpec, installed: InstalledCode | None = None
) -> CodeComparison:
    """Apply ``compare`` to the trial's files; ``unreadable`` says why that is not possible."""
    try:
        return compare(trial.provenance(), spec, installed)
    except StorageError as error:
        return CodeComparison(unreadable=str(error))


def _without_builds(packages: Mapping[str, Any]) -> dict[str, str]:
    return {name: str(packages[name]).partition("+")[0] for name in LIBRARIES if name in packages}


def _other_versions(attempts: Iterable[Mapping[str, Any]], now: Mapping[str, str]) -> frozenset[str]:
    """Return each library's version in an attempt that is not the installed one, with the latter."""
    return frozenset(
        f"{name} {ran}, now {now[name]}"
        for attempt in attempts
        for name, ran in library_versions(attempt).items()
        if ran != now.get(name, ran)
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
    return digest_of_code({**files, **trial})[:16]


def _digests_of_imported(package: str) -> dict[str, str]:
    """Return ``_digests_of`` a package, or ``CHANGED`` where files have changed since this process read them.

    Python imports a module once. So after a change the process runs the code of before, unless all modules
    that it had imported were reloaded.
    """
    digests, place = _digests_of(package), (package, folder_of_files(files_of(package)))
    imported = _imported_of(digests.keys() | {package})
    if place not in _ran:
        _ran[place] = (imported, _without_edited(digests, imported))
    before, first = _ran[place]
    are_reloaded = bool(before) and all(imported.get(name) is not spec for name, spec in before.items())
    if digests == first or are_reloaded:
        _ran[place] = (imported, digests)
        return digests
    return {name: digest if digest == first.get(name) else CHANGED for name, digest in digests.items()}


def _without_edited(digests: Mapping[str, str], imported: Mapping[str, ModuleSpec | None]) -> dict[str, str]:
    """Return digests with ``CHANGED`` where a file was edited between its import and the first look at it."""
    edited = {name.partition(".")[0] for name, spec in imported.items() if spec and is_edited(spec)}
    return {name: CHANGED if name in edited else digest for name, digest in digests.items()}


def _imported_of(packages: Collection[str]) -> dict[str, ModuleSpec | None]:
    """Return the modules of some packages that this process has imported, with how it found each."""
    return {
        name: getattr(module, "__spec__", None)
        for name, module in list(sys.modules.items())
        if name.partition(".")[0] in packages
    }


def _digests_of(package: str) -> dict[str, str]:
    """Return the digest of a top-level package or module, and of those of its project that it imports."""
    return {name: digest_of_code(files)[:16] for name, files in files_with_imports(package).items()}
