"""YAML with the line of every value, for error messages.

Only plain data is read: mappings with text keys, lists, text, numbers, booleans and null; any other tag is an
error and runs no code. Scalars follow YAML 1.2's core schema, not 1.1's: ``no`` and ``on`` are text, ``010``
is ten, and ``1e6`` is a number.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import yaml

# Place of a value: keys and list indices from the root, for example ("methods", 1, "options").
YamlPath = tuple[str | int, ...]

MAX_BYTES = 1 << 20
MAX_VALUES = 20_000  # aliases may repeat a part of the file; this bounds the growth
MAX_DEPTH = 40


@dataclass(frozen=True)
class Problem:
    """A mistake at a place.

    Attributes:
        line: counted from 1.
        place: the place's keys and indices; () for the whole document.
        sentence: the mistake and the allowed values, without the place.
    """

    line: int
    place: YamlPath
    sentence: str

    def __str__(self) -> str:
        where = ".".join(str(part) if str(part).isprintable() else repr(part) for part in self.place)
        return f"{self.line}: {where}: {self.sentence}" if where else f"{self.line}: {self.sentence}"


@dataclass(frozen=True)
class Document:
    """A parsed file.

    Attributes:
        value: dicts, lists and scalars; None if the file could not be parsed.
        lines: the line of each value, by its place; a mapping's value has the line of its key.
        problems: mistakes of YAML syntax.
    """

    value: Any
    lines: Mapping[YamlPath, int] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()

    def line(self, place: YamlPath) -> int:
        """Return the line of the value at ``place``, or of the nearest value around it."""
        while place and place not in self.lines:
            place = place[:-1]
        return self.lines.get(place, 1)


def parse(data: bytes) -> Document:
    """Read one YAML document; mistakes are in ``problems``, not raised."""
    reader = _Reader()
    try:
        value = reader.value(_root(data), ())
    except _UnreadableError as error:
        return Document(None, {}, (Problem(error.line, (), str(error)),))
    return Document(value, reader.lines, tuple(reader.problems))


class _UnreadableError(Exception):
    """The file is no document that could be checked further."""

    def __init__(self, line: int, sentence: str) -> None:
        super().__init__(sentence)
        self.line = line


def _root(data: bytes) -> yaml.Node:
    """Return the root node of the one document in ``data``."""
    if len(data) > MAX_BYTES:
        raise _UnreadableError(1, f"the file must have at most {MAX_BYTES} bytes, got {len(data)}")
    try:
        root = yaml.compose(data.decode("utf-8-sig"), Loader=_Loader)
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise _UnreadableError(line, "the file must be UTF-8 text, and this line is not") from error
    except yaml.reader.ReaderError as error:
        before = data.decode("utf-8-sig")[: error.position]
        raise _UnreadableError(
            before.count("\n") + 1, f"YAML does not allow the character U+{error.character:04X}"
        ) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        raise _UnreadableError(line, f"not valid YAML: {error.problem or error.context}") from error
    except RecursionError as error:
        raise _UnreadableError(1, f"nested deeper than {MAX_DEPTH} levels") from error
    except (ValueError, OverflowError) as error:
        raise _UnreadableError(1, "not valid YAML: a character is out of range") from error
    if root is None:
        raise _UnreadableError(1, "the file is empty")
    return root


class _Loader(yaml.SafeLoader):
    """Parser with the scalar rules of YAML 1.2's core schema."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  (PyYAML's name for its table)


for _tag, _pattern, _first in (
    ("null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", list("tTfF")),
    ("int", r"^[-+]?[0-9][0-9_]*$", list("-+0123456789")),
    (
        "float",
        r"^(?:[-+]?(?:\.[0-9]+|[0-9][0-9_]*(?:\.[0-9_]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)"
        r"|\.(?:nan|NaN|NAN))$",
        list("-+.0123456789"),
    ),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), _first)


_KINDS: tuple[Any, ...] = (dict, list, tuple, str, bool, int, float, type(None), None)  # None: refuses others
_PLAIN = {kind: yaml.SafeDumper.yaml_representers[kind] for kind in _KINDS}


class _Dumper(yaml.SafeDumper):
    """Writer of what ``_Loader`` reads as the same values."""

    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers
    yaml_representers = _PLAIN

    def ignore_aliases(self, data: Any) -> bool:
        """Write a list that occurs twice twice."""
        return True


_AS_PLAIN: Mapping[type, Callable[[Any, Any], yaml.Node]] = {  # also of subclasses
    dict: yaml.SafeDumper.represent_dict,
    list: yaml.SafeDumper.represent_list,
    tuple: yaml.SafeDumper.represent_list,
    int: lambda dumper, number: dumper.represent_int(int(number)),
    float: lambda dumper, number: dumper.represent_float(float(number)),
    str: lambda dumper, text: dumper.represent_str(str.__str__(text)),
    np.generic: lambda dumper, scalar: dumper.represent_data(scalar.item()),
    np.ndarray: lambda dumper, array: dumper.represent_data(array.tolist()),
}
for _type, _represent in _AS_PLAIN.items():
    _Dumper.add_multi_representer(_type, _represent)


def dump(value: Mapping[str, Any]) -> bytes:
    """Write plain values as YAML that ``parse`` reads; scalars and arrays of NumPy are plain.

    Raises:
        TypeError: a value is not plain.
    """
    try:
        text = yaml.dump(dict(value), Dumper=_Dumper, sort_keys=False, width=math.inf)
    except yaml.representer.RepresenterError as error:
        raise TypeError(f"{error.args[0]}: {error.args[-1]!r}") from error
    except ValueError as error:  # a number of thousands of digits, or no dictionary
        raise TypeError(str(error)) from error
    except RecursionError as error:
        raise TypeError("a value contains itself, or is nested too deeply") from error
    return text.encode()


_SCALARS: Mapping[str, Callable[[str], Any]] = {
    "tag:yaml.org,2002:str": str,
    "tag:yaml.org,2002:int": int,
    "tag:yaml.org,2002:float": lambda text: float(text.lower().replace(".inf", "inf").replace(".nan", "nan")),
    "tag:yaml.org,2002:bool": lambda text: text.lower() == "true",
    "tag:yaml.org,2002:null": lambda text: None,
}


class _Reader:
    """Converter of nodes to values that records their lines."""

    def __init__(self) -> None:
        self.lines: dict[YamlPath, int] = {}
        self.problems: list[Problem] = []

    def value(self, node: yaml.Node, place: YamlPath) -> Any:
        """Return the value of a node at ``place``."""
        line = self.lines.setdefault(place, _line(node))
        if len(place) > MAX_DEPTH:
            raise _UnreadableError(line, f"nested deeper than {MAX_DEPTH} levels")
        if len(self.lines) > MAX_VALUES:
            raise _UnreadableError(line, f"the file expands to more than {MAX_VALUES} values")
        if isinstance(node, yaml.ScalarNode):
            return self._scalar(node, place)
        expected = "map" if isinstance(node, yaml.MappingNode) else "seq"
        if node.tag != f"tag:yaml.org,2002:{expected}":
            self._problem(node, place, f"only plain values are allowed, got the tag {node.tag!r}")
        if isinstance(node, yaml.SequenceNode):
            return [self.value(item, (*place, index)) for index, item in enumerate(node.value)]
        return self._mapping(node, place)

    def _mapping(self, node: yaml.Node, place: YamlPath) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                self._problem(key_node, place, "a key must be text")
                continue
            key = key_node.value
            inner = (*place, key)
            if key in found:
                self._problem(key_node, inner, f"given twice, first on line {self.lines[inner]}")
                continue
            self.lines[inner] = _line(key_node)
            found[key] = self.value(value_node, inner)
        return found

    def _scalar(self, node: yaml.ScalarNode, place: YamlPath) -> Any:
        if node.tag not in _SCALARS:
            self._problem(node, place, f"only plain values are allowed, got the tag {node.tag!r}")
            return node.value
        try:
            return _SCALARS[node.tag](node.value)
        except ValueError:
            self._problem(node, place, f"cannot be read as a number: {node.value[:40]!r}")
            return node.value

    def _problem(self, node: yaml.Node, place: YamlPath, sentence: str) -> None:
        self.problems.append(Problem(_line(node), place, sentence))


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1
