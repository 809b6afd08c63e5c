"""Finding tasks, students and teachers by name, so that a user's package plugs in without a fork.

A name is, in this order: one of ours; an entry point of an installed package; an import path
``package.module:attribute``. Imports nothing but the standard library.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any


class UnknownNameError(ValueError):
    """A task, student or teacher that nobody provides."""


def load_attribute(path: str) -> Any:
    """The object at ``package.module:attribute``.

    Raises:
        UnknownNameError: the module cannot be imported or has no such attribute.
    """
    module_name, _, attribute = path.partition(":")
    try:
        return getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise UnknownNameError(f"cannot import {path!r}: {error}") from error


def resolve(name: str, *, kind: str, group: str, ours: Mapping[str, Any]) -> Any:
    """What ``name`` stands for.

    Args:
        name: a name of ours, an entry point's name, or ``package.module:attribute``.
        kind: what is looked for, for the error: ``task``, ``agent`` or ``teacher``.
        group: the entry-point group, for example ``recrl.tasks``.
        ours: the built-in registry.

    Raises:
        UnknownNameError: nobody provides it; the message names the nearest known names.
    """
    if name in ours:
        return ours[name]
    plugged = {point.name: point for point in entry_points(group=group)}
    if name in plugged:
        return plugged[name].load()
    if ":" in name:
        return load_attribute(name)
    known = sorted({*ours, *plugged})
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise UnknownNameError(
        f"no {kind} is called {name!r}{hint} "
        f"(known: {', '.join(known)}; or an import path package.module:attribute)"
    )
