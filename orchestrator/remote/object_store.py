"""Object stores: read, write, create, list and delete whole objects.

The only module that imports fsspec, at its first use. fsspec has the protocols of S3, Google, Azure and
others. This module assumes their guarantees: objects are written atomically, and reads and lists see all
earlier writes. With ``file://`` objects are written to a temporary file and renamed. It leaves out
credentials: every machine has its own, where fsspec finds them (environment, files, role). They are not
passed on, stored or printed, and an address that contains one is refused.
"""

from __future__ import annotations

import copy
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from recrl.orchestrator.errors import RecrlError, StorageError, first_line
from recrl.orchestrator.files.atomic_files import write_atomically

EXAMPLE = "s3://bucket/folder"
FOLDERS = ("file", "local")  # schemes where parents must be created before a file; a bucket must not be
REASON_LENGTH = 200


class ObjectStore:
    """Everything below one address, by keys: paths relative to it, with slashes.

    Attributes:
        uri: the address, without a slash at its end.
    """

    def __init__(self, uri: str) -> None:
        """Check the address, without access to the store.

        Raises:
            RecrlError: the address is invalid, or the package for its kind of store is missing.
        """
        import fsspec  # noqa: PLC0415  (sweeps in a folder do not need it)

        self.uri = _checked(uri)
        protocol = self.uri.partition("://")[0]
        _require_package(self.uri, protocol)
        self._in_folder = protocol in FOLDERS
        options: dict[str, Any] = {"auto_mkdir": True} if self._in_folder else {}
        with self._as_storage_error("cannot be used"):
            self._system, path = fsspec.url_to_fs(self.uri, skip_instance_cache=True, **options)
        self._root = path.rstrip("/")
        self._is_walked = type(self._system).find is fsspec.AbstractFileSystem.find

    @property
    def folder(self) -> Path | None:
        """The folder of the objects, if they are files."""
        return Path(self._root) if self._in_folder else None

    def below(self, folder: str) -> ObjectStore:
        """Return the store of a folder below, over the same connections."""
        child = copy.copy(self)
        child.uri, child._root = f"{self.uri}/{folder}", self._path(folder)
        return child

    def read(self, key: str) -> bytes | None:
        """Read an object's bytes; None if it does not exist.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        return self.read_range(key, None, None)

    def read_range(self, key: str, start: int | None, end: int | None) -> bytes | None:
        """Read an object's bytes from one position to another, fewer if it is shorter; None if missing.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        with self._as_storage_error("cannot be read", unless=FileNotFoundError):
            return bytes(self._system.cat_file(self._path(key), start=start, end=end))
        return None

    def write(self, key: str, data: bytes) -> None:
        """Write a whole object, replacing an existing one.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        path = self._path(key)
        with self._as_storage_error("cannot be written"):
            if not self._in_folder:
                self._system.pipe_file(path, data)
                return
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            write_atomically(Path(path), data)

    def create(self, key: str, data: bytes) -> bool:
        """Create an object unless it exists; return whether it was created.

        That only one of several simultaneous calls succeeds is guaranteed by the store, not by fsspec: S3,
        Google and Azure have conditional writes. For other stores this checks first and writes then.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        path = self._path(key)
        with self._as_storage_error("cannot be written"):
            try:
                self._system.pipe_file(path, data, mode="create")
            except FileExistsError:
                return False
            except (NotImplementedError, TypeError, ValueError):  # the store has no such writes
                if self.read(key) is not None:
                    return False
                self.write(key, data)
        return True

    def keys_in(self, folder: str = "") -> list[str]:
        """List the keys of all objects below a folder, relative to it, in order.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        place = self._path(folder).rstrip("/")
        with self._as_storage_error("cannot be listed", unless=FileNotFoundError):
            self._system.invalidate_cache()  # other processes write here, too
            found = self._walked(place) if self._is_walked else self._system.find(place)
            return sorted(path[len(place) + 1 :] for path in found if path.startswith(f"{place}/"))
        return []

    def names(self, kind: Literal["file", "directory"]) -> list[str]:
        """List the names of the objects, or of the folders, directly below the address, in order.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        with self._as_storage_error("cannot be listed", unless=FileNotFoundError):
            self._system.invalidate_cache()
            entries = self._system.ls(self._root, detail=True)
            paths = (entry["name"].rstrip("/") for entry in entries if entry["type"] == kind)
            return sorted(path.rpartition("/")[2] for path in paths)
        return []

    def delete(self, keys: Iterable[str]) -> None:
        """Delete objects; missing ones are ignored.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        for key in keys:
            with self._as_storage_error("cannot be cleared", unless=FileNotFoundError):
                self._system.rm_file(self._path(key))

    def probe(self) -> None:
        """Write, read, list and delete a small object, so that problems are known before any work.

        Raises:
            StorageError: one of these fails.
        """
        key, data = f"probe-{secrets.token_hex(8)}", secrets.token_bytes(16)
        self.write(key, data)
        try:
            if self.read(key) != data or key not in self.keys_in():
                raise StorageError(f"{self.uri}: an object that was written a moment ago is missing")
        finally:
            self.delete([key])

    def _walked(self, folder: str) -> Iterator[str]:
        """Yield the paths of all objects below a folder.

        fsspec's own walk leaves out folders that cannot be listed. They would seem to be empty.

        Raises:
            FileNotFoundError: the folder does not exist.
            OSError: a folder cannot be listed.
        """
        for entry in self._system.ls(folder, detail=True):
            if entry["type"] != "directory":
                yield entry["name"]
                continue
            with suppress(FileNotFoundError):  # deleted meanwhile
                yield from self._walked(entry["name"])

    def _path(self, key: str) -> str:
        return f"{self._root}/{key}"

    @contextmanager
    def _as_storage_error(self, what: str, unless: type[Exception] | None = None) -> Iterator[None]:
        """Turn a package's errors into one sentence, except those that end the process."""
        try:
            yield
        except RecrlError:
            raise
        except Exception as error:  # every package has errors of its own, and few of them are OSErrors
            if unless is None or not isinstance(error, unless):
                raise StorageError(f"{self.uri}: {what} ({_reason(error)})") from error


def _checked(uri: str) -> str:
    """Return the address, if it is valid, and leads to one place from every working directory."""
    protocol, separator, path = uri.partition("://")
    if not protocol or not separator or not path.strip("/") or "::" in uri:
        raise RecrlError(f"the storage must be an address such as {EXAMPLE}, got {uri!r}")
    if protocol in FOLDERS and not path.startswith("/"):
        raise RecrlError(
            f"{uri}: the folder must be an absolute path, as in {protocol}:///folder, so that it is the same "
            "from every directory"
        )
    if re.match(r"[^/@]*:[^@]*@", path) or "?" in uri:  # Amazon's secrets may contain slashes
        hidden = re.sub(r"(://)[^@]*@|\?.*", r"\1", uri)
        raise RecrlError(
            f"{hidden}: credentials do not belong into the address; provide them as {protocol}:// "
            "requires, in the environment or its own files, on every machine"
        )
    return uri.rstrip("/")


def _require_package(uri: str, protocol: str) -> None:
    """Load the package for a kind of store.

    Raises:
        RecrlError: there is no such kind, or its package is missing.
    """
    import fsspec  # noqa: PLC0415

    try:
        fsspec.get_filesystem_class(protocol)
    except ValueError as error:
        raise RecrlError(
            f"{uri}: no kind of storage is called {protocol!r}; fsspec knows abfs, file, gs, s3"
        ) from error
    except ImportError as error:
        package = _package(protocol)
        install = f"pip install {package}, on every machine" if package else _reason(error)
        raise RecrlError(f"{uri}: {protocol}:// needs a package that is not installed: {install}") from error


def _package(protocol: str) -> str:
    """Return the package for a kind of store; empty if it is fsspec itself."""
    from fsspec.registry import known_implementations  # noqa: PLC0415

    package: str = known_implementations[protocol]["class"].partition(".")[0]
    return "" if package == "fsspec" else package


def _reason(error: BaseException) -> str:
    """Return the first line of an error, without queries in addresses, which may contain signatures."""
    text = re.sub(r"\?[^\s'\")]*", "", re.sub(r"(://)[^\s@]*@", r"\1", first_line(error)))
    return f"{type(error).__name__}: {text[:REASON_LENGTH]}" if text else type(error).__name__
