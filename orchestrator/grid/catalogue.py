"""Names for grid files: tasks, agents and curricula, with a summary and all options of each.

Entry points of installed packages are included.
"""

from __future__ import annotations

import json
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ValidationError
from pydantic_core import PydanticUndefined

from recrl.agents.registry import AGENTS, find_agent
from recrl.environments.plugins import UnknownNameError, WrongKindError, nearest
from recrl.environments.registry import TASKS, find_task, options_model
from recrl.orchestrator.errors import USERS_ERRORS, RecrlError, described
from recrl.orchestrator.grid.file_models import (
    REQUIRED,
    DeployLimits,
    Entry,
    Limits,
    Resources,
    Run,
    ShownDefault,
    TaskEntry,
    TrainLimits,
)
from recrl.orchestrator.validation_sentences import model_in
from recrl.teachers.registry import TEACHERS, find_teacher


@dataclass(frozen=True)
class Kind:
    """One of the three kinds of names in a grid.

    Attributes:
        singular: ``task``, ``agent`` or ``curriculum``.
        plural: its name in ``recrl-sweep list``.
        section: its key in a grid file.
        group: of entry points.
        ours: recrl's own names.
        summary: returns one sentence on a name.
        model: returns the pydantic model of a name's options.
    """

    singular: str
    plural: str
    section: str
    group: str
    ours: tuple[str, ...]
    summary: Callable[[str], str]
    model: Callable[[str], type[BaseModel]]

    @property
    def names(self) -> list[str]:
        """Return every known name, recrl's own first."""
        return list(dict.fromkeys((*self.ours, *(point.name for point in entry_points(group=self.group)))))


@dataclass(frozen=True)
class Option:
    """One option of a task, an agent or a curriculum.

    Attributes:
        name: its key; of an option in an option, ``outer.inner``.
        type: allowed values, in words, with bounds of numbers.
        default: as JSON, or ``required``.
        description: one sentence.
    """

    name: str
    type: str
    default: str
    description: str


KINDS: Mapping[str, Kind] = {
    kind.plural: kind
    for kind in (
        Kind(
            "task",
            "tasks",
            "tasks",
            "recrl.tasks",
            tuple(TASKS),
            lambda name: find_task(name).summary,
            options_model,
        ),
        Kind(
            "agent",
            "agents",
            "agents",
            "recrl.agents",
            tuple(AGENTS),
            lambda name: find_agent(name).summary,
            lambda name: find_agent(name).config,
        ),
        Kind(
            "curriculum",
            "curricula",
            "methods",
            "recrl.teachers",
            tuple(TEACHERS),
            lambda name: find_teacher(name).summary,
            lambda name: find_teacher(name).config,
        ),
    )
}


SECTIONS: Mapping[str, type[BaseModel]] = {"run": Run, "resources": Resources, "limits": Limits}
LISTS: Mapping[str, type[BaseModel]] = {"tasks": TaskEntry, "agents": Entry, "methods": Entry}


def listed(kind: Kind) -> Iterator[tuple[str, str]]:
    """Yield every known name of a kind and its summary; for names that cannot be loaded, the reason."""
    for name in kind.names:
        try:
            yield name, kind.summary(name)
        except USERS_ERRORS as error:
            yield name, f"cannot be used: {described(error)}"


def kinds_of(name: str) -> list[Kind]:
    """Return the kinds of a name; an import path is imported for this.

    Raises:
        RecrlError: the name is not known.
        UntrustedNameError: it is an import path, and they are refused here.
    """
    if ":" not in name:
        found = [kind for kind in KINDS.values() if name in kind.names]
        if not found:
            known = [*SECTIONS, *(known for kind in KINDS.values() for known in kind.names)]
            raise RecrlError(
                f"no task, agent or curriculum is called {name!r}{nearest(name, known)}; "
                f"see recrl-sweep list tasks, list agents, list curricula; or {', '.join(SECTIONS)}"
            )
        return found
    return [_kind_of_path(name)]


def _kind_of_path(path: str) -> Kind:
    for plural in ("agents", "curricula", "tasks"):  # any callable can be a task
        try:
            KINDS[plural].model(path)
        except UnknownNameError as error:
            raise RecrlError(str(error)) from error
        except WrongKindError as error:
            reason = error
        else:
            return KINDS[plural]
    raise RecrlError(f"{path!r} is no task, agent or curriculum: {reason}")


def options_of(model: type[BaseModel]) -> list[Option]:
    """Return every option of a task, an agent, a curriculum or a section, in the order of its model."""
    try:
        defaults: BaseModel | None = model.model_validate({})
    except ValidationError:  # an option is required
        defaults = None
    return list(_options(model, defaults, ""))


def _options(model: type[BaseModel], defaults: BaseModel | None, prefix: str) -> Iterator[Option]:
    for name, field in model.model_fields.items():
        value = (
            getattr(defaults, name) if defaults is not None else field.get_default(call_default_factory=True)
        )
        shown = (it.text for it in field.metadata if isinstance(it, ShownDefault))
        default = next(shown, REQUIRED if value is PydanticUndefined else _json(value))
        allowed = _bounded(type_text(field.annotation), field.metadata)
        yield Option(f"{prefix}{name}", allowed, default, field.description or "")
        inner = model_in(field.annotation)
        if inner is not None:
            inner_defaults = value if isinstance(value, BaseModel) else None
            yield from _options(inner, inner_defaults, f"{prefix}{name}.")


def _json(value: Any) -> str:
    if isinstance(value, BaseModel):
        return value.model_dump_json()
    try:
        return json.dumps(value, ensure_ascii=False)
    except TypeError:
        return str(value)


_WORDS: Mapping[Any, str] = {
    bool: "true or false",
    int: "whole number",
    float: "number",
    str: "text",
    type(None): "null",
    Any: "any value",
    dict: "mapping",
    list: "list",
    tuple: "list",
}

_SIGNS: Mapping[str, str] = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}

# Types that a function reads: their annotation has only its result.
_WRITTEN = (
    (TrainLimits, "'auto' or number or list of number"),
    (DeployLimits, "number or list of number"),
)


def type_text(annotation: Any) -> str:
    """Describe the allowed values of an option.

    >>> type_text(Literal["mean", "cvar"]), type_text(int | None), type_text(tuple[float, ...])
    ("'mean' or 'cvar'", 'whole number or null', 'list of number')
    """
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        written = (text for kind, text in _WRITTEN if annotation == kind)
        return next(written, None) or type_text(arguments[0])
    if origin is Literal:
        return " or ".join(repr(value) for value in arguments)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(dict.fromkeys(type_text(each) for each in arguments))
    if origin in (list, tuple):
        inner = dict.fromkeys(type_text(each) for each in arguments if each is not Ellipsis)
        return f"list of {' and '.join(inner)}"
    if (origin is not None and issubclass(origin, Mapping)) or model_in(annotation):
        return "mapping"
    return _WORDS.get(annotation) or str(getattr(annotation, "__name__", annotation))


def _bounded(type_: str, metadata: Iterable[Any]) -> str:
    """Add the bounds of a number to the description of a type.

    >>> from annotated_types import Ge, Lt
    >>> _bounded("number or null", [Ge(0.0), Lt(1.0)]), _bounded("text", [])
    ('number >= 0, < 1 or null', 'text')
    """
    bounds = ", ".join(
        f"{sign} {getattr(it, key):g}" for it in metadata for key, sign in _SIGNS.items() if hasattr(it, key)
    )
    first, *others = type_.split(" or ")
    return " or ".join([f"{first} {bounds}" if bounds else first, *others])
