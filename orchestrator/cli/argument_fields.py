"""How a request of ``recrl-sweep`` declares its arguments.

A class is a command: its name is the command's, its docstring the summary, and each field an argument with
its settings for ``argparse``. ``requests`` has the classes, ``arguments`` makes the parser. Imports only the
standard library, so that ``--help`` is fast.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Self


def by_place(**settings: Any) -> Any:
    """A field that is given by its place; ``settings`` are those of ``add_argument``."""
    return field(metadata={"flag": None, "settings": settings})


def by_flag(flag: str = "", *, group: str = "", **settings: Any) -> Any:
    """A field that is given by a flag.

    Args:
        flag: by default ``--`` and the field's name.
        group: options of one group exclude each other.
        settings: those of ``add_argument``.
    """
    return field(metadata={"flag": flag, "group": group, "settings": settings})


@dataclass(frozen=True)
class Request:
    """Common part of all requests.

    Attributes:
        given: the arguments as they were typed.
    """

    example: ClassVar[str] = ""  # a command line for --help
    trusted: ClassVar[bool] = False  # whether the command itself is the permission to follow import paths
    ends_with_reader: ClassVar[bool] = False  # whether a closed pipe ends the command: it does nothing else
    given: tuple[str, ...]

    @classmethod
    def of(cls, parsed: argparse.Namespace) -> Self:
        """Make a request of parsed arguments; lists become tuples."""
        values = {field.name: getattr(parsed, field.name) for field in fields(cls)}
        return cls(**{key: tuple(it) if isinstance(it, list) else it for key, it in values.items()})

    @classmethod
    def add_to(cls, command: argparse.ArgumentParser) -> None:
        """Add the arguments of all fields."""
        groups: dict[str, Any] = {"": command}
        for each in fields(cls):
            settings = each.metadata.get("settings")
            if settings is None:
                continue
            flag, group = each.metadata["flag"], each.metadata.get("group", "")
            if flag is None:
                command.add_argument(each.name, **settings)
                continue
            if group not in groups:
                groups[group] = command.add_mutually_exclusive_group()
            flag = flag or f"--{each.name.replace('_', '-')}"
            groups[group].add_argument(flag, dest=each.name, **settings)

    @property
    def about(self) -> Path | str | None:
        """The grid, the sweep, or the file to write, as it was typed."""
        names = (name for name in ("grid", "sweep", "to") if hasattr(self, name))
        return getattr(self, next(names, ""), None)

    @property
    def follows_import_paths(self) -> bool:
        """Whether import paths in files are followed."""
        return self.trusted or bool(getattr(self, "trust", False))
