"""Look up tasks, agents and curricula by name, including those of users' packages.

A name is, in this order: one of ours; an entry point of an installed package; an import path
``package.module:attribute``. Imports nothing but the standard library.

An import path runs the code that it names, and names come from files that others may have made. Who only
reads such files does so in ``refuse_import_paths``. Then only installed entry points are imported.
SECURITY.md lists the commands that do so.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import marshal
import os
import re
import sys
import threading
import warnings
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any


class UnknownNameError(ValueError):
    """A task, agent or curriculum name that is not known."""


class WrongKindError(ValueError):
    """A name leads to an object of another kind, for example an agent's name to a function."""


class UntrustedNameError(Exception):
    """An import path that is not followed, in ``refuse_import_paths``.

    It is not a ValueError, because pydantic would report that as an invalid option.
    """

    def __init__(self, path: str) -> None:
        super().__init__(f"{path!r} was not imported, because a file that is only read must run no code")
        self.path = path


IMPORT_PATH = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")
BYTECODE_HEADER = 16  # bytes
MODULES = "RECRL_MODULES"  # an environment variable: a folder of modules, searched last
_refused = ContextVar("_refused", default=False)  # of a thread: others may follow import paths meanwhile
# Folders of modules: that of the parent process, and those of the open blocks of ``modules_in``.
_folders = [os.environ[MODULES]] if MODULES in os.environ else []
_appended: set[str] = set()  # folders that import_module has appended to sys.path
_changing = threading.Lock()


@contextmanager
def refuse_import_paths() -> Iterator[None]:
    """Refuse import paths until the end of the ``with`` block.

    This holds in the thread of the block. It also holds in threads that start in the block with a copy of its
    context, as all threads of this package do. It does not hold in other threads.
    """
    token = _refused.set(True)
    try:
        yield
    finally:
        _refused.reset(token)


def require_trust(path: str) -> None:
    """Check that an import path from a file may be followed here.

    Args:
        path: ``package.module:attribute``, or an id of Gymnasium's with a module in front.

    Raises:
        UntrustedNameError: import paths are refused here.
    """
    if _refused.get():
        raise UntrustedNameError(path)


@contextmanager
def modules_in(folder: Path) -> Iterator[None]:
    """Add a folder of modules for import paths until the end of the block, also in child processes.

    The folder is searched last, so that it cannot shadow an installed package. It is added for the whole
    process. Blocks may overlap in several threads; names are then searched in the folder of the newest one.

    Args:
        folder: of modules.
    """
    added = str(folder.absolute())
    with _changing:
        _folders.append(added)
        os.environ[MODULES] = added
    try:
        yield
    finally:
        with _changing:
            _folders.remove(added)
            if added in _appended - set(_folders):
                _appended.remove(added)
                if added in sys.path:
                    sys.path.remove(added)
            if _folders:
                os.environ[MODULES] = _folders[-1]
            else:
                os.environ.pop(MODULES, None)


def modules_here() -> AbstractContextManager[None]:
    """Add the working directory as ``modules_in`` does, unless it has been deleted."""
    try:
        return modules_in(Path.cwd())
    except FileNotFoundError:
        return nullcontext()


def modules_folder() -> str | None:
    """Return the folder of ``modules_in``, else the working directory; None if that has been deleted."""
    if MODULES in os.environ:
        return os.environ[MODULES]
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        return None


def import_module(name: str) -> ModuleType:
    """Import a module by its dotted name, also from the folder of ``modules_in``.

    If the user's module ``is_edited`` since this process imported it, that is a warning: the code of before
    runs.

    Raises:
        ImportError: it cannot be imported; or this process imported it from another folder than the one in
            which it is found now.
    """
    folder = os.environ.get(MODULES)
    with _changing:
        if folder and folder not in sys.path and not name.startswith("recrl."):
            sys.path.append(folder)
            _appended.add(folder)
    module = importlib.import_module(name)
    _require_same_place(name.partition(".")[0])
    if not name.startswith("recrl.") and module.__spec__ is not None and is_edited(module.__spec__):
        warnings.warn(
            f"{module.__spec__.origin} has changed since this process imported it; the code of before runs "
            f"until you start a new Python process or call importlib.reload(sys.modules[{name!r}])",
            stacklevel=2,
        )
    return module


def is_edited(spec: ModuleSpec) -> bool:
    """Whether the source of an imported module has other code now than at the import.

    It is compared with the bytecode that Python then wrote or read. Where Python writes none, the answer is
    no. So it is if another process has imported the module since.
    """
    writes = not sys.dont_write_bytecode and type(spec.loader) is SourceFileLoader
    if not writes or not spec.cached or not spec.origin or not os.access(Path(spec.cached).parent, os.W_OK):
        return False
    try:
        imported = marshal.loads(Path(spec.cached).read_bytes()[BYTECODE_HEADER:])
        return not _is_same_code(
            imported, compile(Path(spec.origin).read_bytes(), spec.origin, "exec", dont_inherit=True)
        )
    except SyntaxError:  # it is being edited
        return True
    except (EOFError, OSError, TypeError, ValueError):
        return False


def _is_same_code(one: Any, other: Any) -> bool:
    """Compare two code objects, or constants of code, but for the numbers of lines."""
    if not isinstance(one, CodeType) or not isinstance(other, CodeType):
        return type(one) is type(other) and bool(one == other)
    parts = ("co_code", "co_names", "co_varnames", "co_freevars", "co_cellvars")
    return (
        all(getattr(one, part) == getattr(other, part) for part in parts)
        and len(one.co_consts) == len(other.co_consts)
        and all(map(_is_same_code, one.co_consts, other.co_consts))
    )


def _require_same_place(package: str) -> None:
    """Raise ImportError if an imported package or module would now be found elsewhere."""
    spec: ModuleSpec | None = getattr(sys.modules.get(package), "__spec__", None)
    if spec is None or spec.name != package:  # __main__
        return
    found = PathFinder.find_spec(package)
    if found is not None and found.origin and spec.origin and not _is_same_file(found.origin, spec.origin):
        raise ImportError(
            f"this process imported {package} from {spec.origin}, and now {found.origin} is found; start a "
            "new Python process"
        )


def _is_same_file(one: str, other: str) -> bool:
    """Whether two paths lead to one file or to a copy of it; True if that is unknown, as in an archive."""
    try:
        return Path(one).samefile(other) or Path(one).read_bytes() == Path(other).read_bytes()
    except OSError:
        return True


def load_attribute(path: str) -> Any:
    """Load the object at ``package.module:attribute``.

    Raises:
        UnknownNameError: the module cannot be imported or has no such attribute.
    """
    module_name, _, attribute = path.partition(":")
    try:
        return getattr(import_module(module_name), attribute)
    except ModuleNotFoundError as error:
        if error.name != module_name.partition(".")[0]:
            raise UnknownNameError(f"cannot import {path!r}: {error}") from error
        raise UnknownNameError(
            f"cannot import {path!r}: there is no module {error.name}; start the command in the folder that "
            "holds it, name that folder in PYTHONPATH, or install the module's package"
        ) from error
    except (ImportError, AttributeError) as error:
        names = dir(sys.modules[module_name]) if module_name in sys.modules else []
        is_missing = isinstance(error, AttributeError) and attribute not in names
        hint = nearest(attribute, names) if is_missing else ""
        raise UnknownNameError(f"cannot import {path!r}: {error}{hint}") from error
    except SystemExit as error:
        raise UnknownNameError(
            f"cannot import {path!r}: it ends the process (exit code {error.code})"
        ) from error


def trusted_attribute(path: str) -> Any:
    """Load the object at ``package.module:attribute`` that an option names.

    Raises:
        UnknownNameError: the module cannot be imported or has no such attribute.
        UntrustedNameError: import paths are refused here.
    """
    require_trust(path)
    return load_attribute(path)


def resolve(name: str, *, kind: str, group: str, ours: Mapping[str, Any]) -> Any:
    """Return the object that ``name`` refers to.

    Args:
        name: a name of ours, an entry point's name, or ``package.module:attribute``.
        kind: what is looked for, for the error: ``task``, ``agent`` or ``curriculum``.
        group: the entry-point group, for example ``recrl.tasks``.
        ours: the built-in registry.

    Raises:
        UnknownNameError: the name is not known, and the message names the nearest known names; or its entry
            point cannot be loaded; or several packages have an entry point of that name.
        UntrustedNameError: it is an import path, and they are refused here.
    """
    if name in ours:
        return ours[name]
    points = entry_points(group=group)
    named = [point for point in points if point.name == name]
    if len({point.value for point in named}) > 1:
        raise UnknownNameError(
            f"the {kind} {name!r} is an entry point of several packages, {', '.join(map(_origin, named))}; "
            "write an import path instead, or uninstall all but one of the packages"
        )
    if named:
        return _loaded(named[0])
    if IMPORT_PATH.fullmatch(name):
        require_trust(name)
        return load_attribute(name)
    if IMPORT_PATH.fullmatch(with_colon := ":".join(name.rsplit(".", 1))):
        raise UnknownNameError(f"no {kind} is called {name!r}; an import path has a colon, {with_colon!r}")
    known = sorted({*ours, *(point.name for point in points)})
    raise UnknownNameError(
        f"no {kind} is called {name!r}{nearest(name, known)} "
        f"(known: {', '.join(known)}; or an import path package.module:attribute)"
    )


def refuse_shadowed_entry_point(name: str, *, kind: str, group: str, ours: Container[str]) -> None:
    """Check that no package has an entry point with a name of ours, which ``resolve`` would never load.

    Otherwise a name of theirs would mean something else after a new version of recrl takes it.

    Args:
        name: of ours, or any other.
        kind: ``task``, ``agent`` or ``curriculum``.
        group: the entry-point group.
        ours: the names of the built-in registry.

    Raises:
        UnknownNameError: a package has an entry point of this name.
    """
    if name not in ours:
        return
    for point in entry_points(group=group):
        if point.name == name:
            raise UnknownNameError(
                f"the {kind} {name!r} is recrl's, and also an entry point, {_origin(point)}; rename that "
                "entry point, or uninstall its package to use recrl's"
            )


def _origin(point: EntryPoint) -> str:
    return f"{point.value!r}{_of_package(point)}"


def _of_package(point: EntryPoint) -> str:
    return f" of the package {point.dist.name}" if point.dist is not None else ""


def _loaded(point: EntryPoint) -> Any:
    """Load the object of an entry point.

    Raises:
        UnknownNameError: its module cannot be imported or has no such attribute.
    """
    problem = f"the entry point {point.name}{_of_package(point)} cannot load {point.value!r}"
    try:
        return point.load()
    except (ImportError, AttributeError) as error:
        raise UnknownNameError(f"{problem}: {error}") from error
    except SystemExit as error:
        raise UnknownNameError(f"{problem}: it ends the process (exit code {error.code})") from error


def nearest(name: str, known: Sequence[str]) -> str:
    """Return ``; did you mean 'window'?``, or nothing if no known name is near."""
    near = nearest_name(name, known)
    return f"; did you mean {near!r}?" if near is not None else ""


def nearest_name(name: str, known: Sequence[str]) -> str | None:
    """Return the known name that is nearest; None if no name is near."""
    spelt = {each.lower(): each for each in known}
    near = difflib.get_close_matches(name.lower(), spelt, n=1)
    return spelt[near[0]] if near else None


def check_keywords(
    function: Callable[..., Any], name: str, keywords: Mapping[str, Any], *, called: str = "option"
) -> None:
    """Check that a user's callable takes the keywords, as far as its signature says.

    Args:
        function: the callable.
        name: of what it makes, for the error.
        keywords: for it.
        called: what the grid calls one of them, for the error.

    Raises:
        ValueError: it takes no such keyword.
    """
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # a callable without a signature
        return
    if any(each.kind is each.VAR_KEYWORD for each in parameters):
        return
    known = [each.name for each in parameters if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)]
    for key in (key for key in keywords if key not in known):
        known_ones = f"its {called}s: {', '.join(known)}" if known else f"it has no {called}s"
        raise ValueError(f"{name} takes no {called} {key!r}{nearest(key, known)} ({known_ones})")
