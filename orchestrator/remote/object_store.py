"""An object store, as the little that is asked of one: read, write, create, list and delete whole objects.

The only importer of fsspec, and so the one place that knows what S3, Google, Azure and the others are
called. Assumes what they promise: an object is there whole or not at all, and whoever reads or lists after a
write sees it. (In a folder behind ``file://`` objects are written beside and renamed.) Leaves out
credentials: every machine has its own, where its fsspec package looks for them (environment, files, the
machine's role). None is passed on, stored or printed, and an address that holds one is refused.
"""

from __future__ import annotations

import copy
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

import fsspec
from fsspec.registry import known_implementations

from recrl.orchestrator.errors import RecrlError, StorageError

EXAMPLE = "s3://bucket/folder"
FOLDERS = ("file", "local")  # where parents must be made before a file; a bucket must not be
REASON_LENGTH = 200


class ObjectStore:
    """Everything below one address, by keys: paths relative to it, with slashes.

    Attributes:
        uri: the address, without a slash at its end.
    """

    def __init__(self, uri: str) -> None:
        """Look at nothing yet.

        Raises:
            RecrlError: the address is none, or names no kind of store that this machine has a package for.
        """
        self.uri = _checked(uri)
        protocol = self.uri.partition("://")[0]
        _require_package(self.uri, protocol)
        self._in_folder = protocol in FOLDERS
        options: dict[str, Any] = {"auto_mkdir": True} if self._in_folder else {}
        with self._speaking("cannot be used"):
            self._system, path = fsspec.url_to_fs(self.uri, skip_instance_cache=True, **options)
        self._root = path.rstrip("/")

    def below(self, folder: str) -> ObjectStore:
        """What lies in a folder of this one, over the same connections."""
        child = copy.copy(self)
        child.uri, child._root = f"{self.uri}/{folder}", self._path(folder)
        return child

    def read(self, key: str) -> bytes | None:
        """An object's bytes, or None if there is none.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        return self.read_range(key, None, None)

    def read_range(self, key: str, start: int | None, end: int | None) -> bytes | None:
        """An object's bytes from one position to another, fewer if it is shorter; None if there is none.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        with self._speaking("cannot be read", unless=FileNotFoundError):
            return bytes(self._system.cat_file(self._path(key), start=start, end=end))
        return None

    def write(self, key: str, data: bytes) -> None:
        """Write an object whole, over whatever was there.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        path = self._path(key)
        with self._speaking("cannot be written"):
            if not self._in_folder:
                self._system.pipe_file(path, data)
                return
            beside = f"{path}.{secrets.token_hex(4)}"
            self._system.pipe_file(beside, data)
            self._system.mv(beside, path)

    def create(self, key: str, data: bytes) -> bool:
        """Write an object unless there is one, and say whether there was none.

        That only one of several at the same moment hears yes is the store's promise, not fsspec's: S3, Google
        and Azure keep it by conditional writes. Where a store has none, this looks first and writes then.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        path = self._path(key)
        with self._speaking("cannot be written"):
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
        """The keys of all objects in a folder and the folders below it, relative to it, in their order.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        place = self._path(folder).rstrip("/")
        with self._speaking("cannot be listed", unless=FileNotFoundError):
            self._system.invalidate_cache()  # others write here too
            found = self._system.find(place)
            return sorted(path[len(place) + 1 :] for path in found if path.startswith(f"{place}/"))
        return []

    def names(self, kind: Literal["file", "directory"]) -> list[str]:
        """The names of the objects, or of the folders, right below the address, in their order.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        with self._speaking("cannot be listed", unless=FileNotFoundError):
            self._system.invalidate_cache()
            entries = self._system.ls(self._root, detail=True)
            paths = (entry["name"].rstrip("/") for entry in entries if entry["type"] == kind)
            return sorted(path.rpartition("/")[2] for path in paths)
        return []

    def delete(self, keys: Iterable[str]) -> None:
        """Delete objects; those that are not there any more do not matter.

        Raises:
            StorageError: the store does not answer, or refuses.
        """
        for key in keys:
            with self._speaking("cannot be cleared", unless=FileNotFoundError):
                self._system.rm_file(self._path(key))

    def probe(self) -> None:
        """Write, read, list and delete a small object, so that what is wrong is known before any work.

        Raises:
            StorageError: any of it fails.
        """
        key, data = f"probe-{secrets.token_hex(8)}", secrets.token_bytes(16)
        self.write(key, data)
        try:
            if self.read(key) != data or key not in self.keys_in():
                raise StorageError(f"{self.uri}: what was written there a moment ago is not there")
        finally:
            self.delete([key])

    def _path(self, key: str) -> str:
        return f"{self._root}/{key}"

    @contextmanager
    def _speaking(self, what: str, unless: type[Exception] | None = None) -> Iterator[None]:
        """Turn whatever a package raises into one sentence, but for what ends the body without one."""
        try:
            yield
        except RecrlError:
            raise
        except Exception as error:  # every package has errors of its own, and few of them are OSErrors
            if unless is None or not isinstance(error, unless):
                raise StorageError(f"{self.uri}: {what} ({_reason(error)})") from error


def _checked(uri: str) -> str:
    """The address, if it is one."""
    protocol, separator, path = uri.partition("://")
    if not protocol or not separator or not path.strip("/") or "::" in uri:
        raise RecrlError(f"the storage must be an address such as {EXAMPLE}, got {uri!r}")
    if re.match(r"[^/@]*:[^@]*@", path) or "?" in uri:  # there are slashes in Amazon's secrets
        hidden = re.sub(r"(://)[^@]*@|\?.*", r"\1", uri)
        raise RecrlError(
            f"{hidden}: credentials do not belong into the address; give them as {protocol}:// wants "
            "them, in the environment or its own files, on every machine"
        )
    return uri.rstrip("/")


def _require_package(uri: str, protocol: str) -> None:
    """Load the package for a kind of store.

    Raises:
        RecrlError: there is no such kind, or no such package.
    """
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
    """The package that a kind of store is in, empty if that is fsspec itself."""
    package: str = known_implementations[protocol]["class"].partition(".")[0]
    return "" if package == "fsspec" else package


def _reason(error: BaseException) -> str:
    """The first line of an error, without what an address has behind a question mark: a signature, maybe."""
    text = next(iter(str(error).splitlines()), "")
    text = re.sub(r"\?[^\s'\")]*", "", re.sub(r"(://)[^\s@]*@", r"\1", text))
    return f"{type(error).__name__}: {text[:REASON_LENGTH]}" if text else type(error).__name__
