"""recrl's own files as this process imports them: their digest, and a copy for other machines."""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from recrl.orchestrator.provenance.source_text import without_documentation
from recrl.orchestrator.provenance.versions import DISTRIBUTION

FOLDERS = ("agents", "analysis", "environments", "orchestrator", "teachers")
METADATA = ("METADATA", "PKG-INFO", "entry_points.txt")  # an editable install has one of the first two


def source_digest() -> str:
    """Return ten hex digits that change with any Python file of recrl; the version alone is not enough."""
    files = {path.name: path for path in _own_files()}
    for name in FOLDERS:  # links in a source checkout: walking the parent would not follow them
        folder = folder_of(name)
        files |= {f"{name}/{path.relative_to(folder).as_posix()}": path for path in folder.rglob("*.py")}
    return _digest(files, Path.read_bytes)[:10]


def digest_of_code(files: Mapping[str, Path]) -> str:
    """Return 64 hex digits that change with the name of a file and with the code in it.

    Docstrings and lines that only have a comment are not code. Other files than Python's count as a whole.
    """
    return _digest(files, _code)


def _code(path: Path) -> bytes:
    content = path.read_bytes()
    return without_documentation(content) if path.suffix == ".py" else content


def _digest(files: Mapping[str, Path], read: Callable[[Path], bytes]) -> str:
    """Return the digest of the names of files and of what ``read`` gives of each."""
    digest = hashlib.sha256()
    for name, path in sorted(files.items()):
        with suppress(OSError):  # an editor's file that came and went
            digest.update(hashlib.sha256(read(path)).digest() + f"{name}\n".encode())
    return digest.hexdigest()


def copy_package(parent: Path) -> list[Path]:
    """Copy recrl, without its dependencies.

    Args:
        parent: an empty folder that exists.

    Returns:
        The folders to put on a path, each in a separate parent: the package, and its metadata with entry
            points and version.
    """
    package = parent / "package" / DISTRIBUTION
    package.mkdir(parents=True)
    for path in _own_files():
        shutil.copy(path, package)
    for name in FOLDERS:
        shutil.copytree(folder_of(name), package / name, ignore=shutil.ignore_patterns("__pycache__"))
    distribution = importlib.metadata.distribution(DISTRIBUTION)
    metadata = parent / "metadata" / f"{DISTRIBUTION}-{distribution.version}.dist-info"
    metadata.mkdir(parents=True)
    for name in METADATA:
        text = distribution.read_text(name)
        if text is not None:
            (metadata / name.replace("PKG-INFO", "METADATA")).write_text(text)
    return [package, metadata]


def _own_files() -> list[Path]:
    """Return the files of the package itself, outside the five folders."""
    spec = importlib.util.find_spec(DISTRIBUTION)
    assert spec is not None and spec.submodule_search_locations
    return sorted(
        path for path in Path(next(iter(spec.submodule_search_locations))).iterdir() if path.is_file()
    )


def folder_of(name: str) -> Path:
    """Return the folder of one of recrl's packages."""
    spec = importlib.util.find_spec(f"{DISTRIBUTION}.{name}")
    assert spec is not None and spec.submodule_search_locations
    return Path(next(iter(spec.submodule_search_locations)))
