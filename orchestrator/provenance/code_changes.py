"""Detect whether a trial ran other code, or with other versions of libraries, than is installed now.

A trial's results depend on recrl's tasks, agents, curricula and training loop, not on figures or commands:
only the former are in the digest. Docstrings and lines that only have a comment are not.
A user's task, agent or curriculum has a digest of its top-level package (all Python files) or single module.
Each module of the user's project that it imports, directly or through others, has one too. Nothing is
imported to find them: import statements are read from the files. So modules in the working directory are
found also where a command may not import them.

The project is the nearest folder above the module that holds a project file or a repository, else the
module's own folder. Installed packages, the standard library and imports by a computed name are left out.

Of ``LIBRARIES`` the versions are compared. Others are named, but they are no reason to run a trial again:
most new versions change nothing, or only the rounding.
"""

from __future__ import annotations

import ast
import functools
import importlib.machinery
import importlib.util
import sys
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from importlib.machinery import ModuleSpec
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from recrl.agents.registry import AGENTS
from recrl.environments.plugins import modules_folder
from recrl.environments.registry import TASKS
from recrl.orchestrator.counting import counted
from recrl.orchestrator.errors import StorageError
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.provenance.own_package import digest_of_code, folder_of
from recrl.orchestrator.provenance.versions import package_versions
from recrl.orchestrator.spec import TrialSpec
from recrl.teachers.registry import TEACHERS

OURS = "recrl"
FOLDERS = ("agents", "environments", "teachers")  # top-level parts that affect results
MODULES = (  # of the orchestrator
    "trial/trial.py",
    "trial/attempt.py",
    "trial/device.py",
    "trial/one_thread.py",
    "spec.py",
)
SUFFIXES = (".py", ".xml", ".txt")
MOST_FILES = 1000  # of the user's project, for one plug-in
PROJECT_FILES = ("pyproject.toml", "setup.py", "setup.cfg", ".git")  # in the folder of a project
INSTALLED = ("site-packages", "dist-packages")
LIBRARIES = ("gymnasium", "minigrid", "mujoco", "numba", "numpy", "scipy", "torch")  # that affect results
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
        found = {OURS: _own_digest()}
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

    A process imports a package once. If its files have changed since, ``CHANGED`` is in place of a digest, so
    that the trial counts as one of other code.
    """
    return InstalledCode(_digests_of_imported).of(spec)


@dataclass(frozen=True)
class CodeComparison:
    """The code that a trial ran, compared with the code that is installed now.

    Attributes:
        differs: whether an attempt ran other code; False if unknown.
        missing: the top-level packages and modules that it ran and that are not found now. So it is unknown
            whether their code differs. Empty if other code differs.
        versions: of libraries in an attempt, where they are others now, such as "torch 2.12.0, now 2.13.0".
    """

    differs: bool = False
    missing: frozenset[str] = frozenset()
    versions: frozenset[str] = frozenset()


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
    if any(name in now and digest != now[name] for name, digest in ran):
        return CodeComparison(differs=True, versions=versions)
    return CodeComparison(missing=frozenset(name for name, _ in ran if name not in now), versions=versions)


def library_versions(attempt: Mapping[str, Any]) -> dict[str, str]:
    """Return the versions of ``LIBRARIES`` in an attempt, without the build (as in ``2.13.0+cpu``)."""
    packages = attempt.get("packages")
    return _without_builds(packages) if isinstance(packages, Mapping) else {}


def compare_files(
    trial: TrialStore, spec: TrialSpec, installed: InstalledCode | None = None
) -> CodeComparison:
    """Apply ``compare`` to the trial's files; nothing differs or is missing if these are damaged."""
    try:
        return compare(trial.provenance(), spec, installed)
    except StorageError:
        return CodeComparison()


def other_code_sentence(complete: int, begun: int) -> str:
    """Describe trials that ran other code; empty for none.

    Args:
        complete: complete ones.
        begun: incomplete ones.
    """
    parts = []
    if complete:
        parts.append(counted(complete, "complete trial"))
    if begun:
        parts.append(counted(begun, "begun one" if complete else "begun trial"))
    if not parts:
        return ""
    comes = "comes" if complete + begun == 1 else "come"
    them = "it" if complete + begun == 1 else "them"
    return (
        f"{' and '.join(parts)} {comes} from other code than is installed now; launch --rerun-changed runs "
        f"{them} again"
    )


def missing_modules_sentence(missing: Iterable[Collection[str]]) -> str:
    """Describe trials whose code could not be compared; empty for none.

    Args:
        missing: ``CodeComparison.missing`` of each trial.
    """
    lacking = [names for names in missing if names]
    if not lacking:
        return ""
    first, *others = sorted(set().union(*lacking))
    subject = f"{first} and {counted(len(others), 'other')} were" if others else f"{first} was"
    return (
        f"the code of {counted(len(lacking), 'trial')} was not checked for changes, because the module "
        f"{subject} not found; start the command in the folder that holds {'them' if others else 'it'}"
    )


def other_versions_sentence(versions: Iterable[Collection[str]]) -> str:
    """Describe trials that ran with other versions of libraries; empty for none.

    Args:
        versions: ``CodeComparison.versions`` of each trial.
    """
    others = [changes for changes in versions if changes]
    if not others:
        return ""
    listed = "; ".join(sorted(set().union(*others)))
    return (
        f"{counted(len(others), 'trial')} ran with other versions of libraries than are installed now "
        f"({listed}); the same settings may give other results"
    )


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
    digests, place = _digests_of(package), (package, _folder(_files_of(package)))
    imported = _imported_of(digests.keys() | {package})
    before, first = _ran.get(place, (imported, digests))
    are_reloaded = bool(before) and all(imported.get(name) is not spec for name, spec in before.items())
    if digests == first or are_reloaded:
        _ran[place] = (imported, digests)
        return digests
    return {name: digest if digest == first.get(name) else CHANGED for name, digest in digests.items()}


def _imported_of(packages: Collection[str]) -> dict[str, ModuleSpec | None]:
    """Return the modules of some packages that this process has imported, with how it found each."""
    return {
        name: getattr(module, "__spec__", None)
        for name, module in list(sys.modules.items())
        if name.partition(".")[0] in packages
    }


def _digests_of(package: str) -> dict[str, str]:
    """Return the digest of a top-level package or module, and of those of its project that it imports."""
    return {name: digest_of_code(files)[:16] for name, files in _with_imports(package).items()}


def _with_imports(package: str) -> dict[str, dict[str, Path]]:
    """Return the files of a top-level package or module, and of those of its project that it imports.

    Returns:
        The files by their names within the package, by package; empty if the package is not found. Imported
        packages are followed in the order of their names, up to about ``MOST_FILES`` files.
    """
    files = _files_of(package)
    if not files:
        return {}
    found, room = {package: files}, MOST_FILES - len(files)
    project = _project_of(package, files)
    waiting = sorted(_imported_by(files)) if project else []
    while waiting and room > 0:
        name = waiting.pop(0)
        if name in found or name == OURS or name in sys.stdlib_module_names:
            continue
        files = _files_of(name, project)
        if not files:
            continue
        found[name] = dict(sorted(files.items())[:room])
        room -= len(found[name])
        waiting += sorted(_imported_by(found[name]) - set(waiting))
    return found


def _files_of(package: str, project: Path | None = None) -> dict[str, Path]:
    """Return the Python files of a top-level package or module; empty if it is not found in the project.

    Args:
        package: its name.
        project: the folder of a project; None to look everywhere.
    """
    try:
        spec = importlib.util.find_spec(package) or _spec_in_modules_folder(package)
    except (ImportError, ValueError):
        return {}
    if spec is None:
        return {}
    folders = [Path(place) for place in spec.submodule_search_locations or ()]
    places = folders or [Path(spec.origin or "")]
    if project is not None and not all(_is_in_project(place, project) for place in places):
        return {}  # before the files of a large package are listed
    files = {str(path.relative_to(folder)): path for folder in folders for path in folder.rglob("*.py")}
    if not folders and spec.origin and spec.origin.endswith(tuple(importlib.machinery.SOURCE_SUFFIXES)):
        files = {Path(spec.origin).name: Path(spec.origin)}
    return files


def _spec_in_modules_folder(package: str) -> ModuleSpec | None:
    """Find a package or module in the folder that ``import_module`` searches last; import nothing."""
    folder = modules_folder()
    return None if folder is None else importlib.machinery.PathFinder.find_spec(package, [folder])


def _project_of(package: str, files: Mapping[str, Path]) -> Path | None:
    """Return the folder of the project that holds a top-level package; None if the package is installed."""
    folder = _folder(files)
    assert folder is not None
    if set(files) != {f"{package}.py"}:  # a package: its own folder is below
        folder = folder.parent
    if set(INSTALLED) & set(folder.parts):
        return None
    marked = (it for it in (folder, *folder.parents) if any((it / name).exists() for name in PROJECT_FILES))
    return next(marked, folder)


def _folder(files: Mapping[str, Path]) -> Path | None:
    """Return the folder that files by their names within it are in; None without files."""
    return next((path.resolve().parents[len(Path(name).parts) - 1] for name, path in files.items()), None)


def _is_in_project(path: Path, project: Path) -> bool:
    resolved = path.resolve()
    return project in resolved.parents and not set(INSTALLED) & set(resolved.parts)


def _imported_by(files: Mapping[str, Path]) -> set[str]:
    """Return the top-level names that the first ``MOST_FILES`` files import."""
    names: set[str] = set()
    for _, path in sorted(files.items())[:MOST_FILES]:
        try:
            names |= _imported_names(path.read_bytes())
        except OSError:  # an editor's file that came and went
            continue
    return names


@functools.lru_cache(maxsize=2 * MOST_FILES)
def _imported_names(source: bytes) -> frozenset[str]:
    """Return the top-level names in the import statements of a module, relative imports excluded.

    >>> sorted(_imported_names(b"import a.b, c; from d import e; from . import f"))
    ['a', 'c', 'd']
    """
    try:
        nodes = list(ast.walk(ast.parse(source)))
    except (SyntaxError, ValueError, RecursionError):
        return frozenset()
    absolute = [it.module for it in nodes if isinstance(it, ast.ImportFrom) and not it.level and it.module]
    plain = [alias.name for it in nodes if isinstance(it, ast.Import) for alias in it.names]
    return frozenset(name.partition(".")[0] for name in (*absolute, *plain))
