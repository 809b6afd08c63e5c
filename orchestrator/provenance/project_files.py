"""Find the files of a user's package, and of the modules of the same project that it imports.

Nothing is imported: import statements are read from the files. So modules in the working directory are found
also where a command may not import them.

The project is the nearest folder above the module that holds a project file or a repository, else the
module's own folder. Installed packages, the standard library and imports by a computed name are left out.
"""

from __future__ import annotations

import ast
import functools
import importlib.machinery
import importlib.util
import sys
from collections.abc import Mapping
from importlib.machinery import ModuleSpec
from pathlib import Path

from recrl.environments.plugins import modules_folder
from recrl.orchestrator.provenance.versions import DISTRIBUTION

MOST_FILES = 1000  # of the user's project, for one plug-in
PROJECT_FILES = ("pyproject.toml", "setup.py", "setup.cfg", ".git")  # in the folder of a project
INSTALLED = ("site-packages", "dist-packages")


def files_with_imports(package: str) -> dict[str, dict[str, Path]]:
    """Return the files of a top-level package or module, and of those of its project that it imports.

    Returns:
        The files by their names within the package, by package; empty if the package is not found. Imported
        packages are followed in the order of their names, up to about ``MOST_FILES`` files.
    """
    files = files_of(package)
    if not files:
        return {}
    found, room = {package: files}, MOST_FILES - len(files)
    project = _project_of(package, files)
    waiting = sorted(_imported_by(files)) if project else []
    while waiting and room > 0:
        name = waiting.pop(0)
        if name in found or name == DISTRIBUTION or name in sys.stdlib_module_names:
            continue
        files = files_of(name, project)
        if not files:
            continue
        found[name] = dict(sorted(files.items())[:room])
        room -= len(found[name])
        waiting += sorted(_imported_by(found[name]) - set(waiting))
    return found


def files_of(package: str, project: Path | None = None) -> dict[str, Path]:
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
    folder = folder_of_files(files)
    assert folder is not None
    if set(files) != {f"{package}.py"}:  # a package: its own folder is below
        folder = folder.parent
    if set(INSTALLED) & set(folder.parts):
        return None
    marked = (it for it in (folder, *folder.parents) if any((it / name).exists() for name in PROJECT_FILES))
    return next(marked, folder)


def folder_of_files(files: Mapping[str, Path]) -> Path | None:
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
