"""Whatever a file holds, reading it gives what was meant or one clear error, never a traceback.

``RECRL_FUZZ_EXAMPLES=10000 pytest tests/orchestrator/test_fuzzing.py`` looks long; by default each test looks
briefly.
"""

import hashlib
import json
import os
import struct
from collections import OrderedDict
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from recrl.orchestrator.errors import CheckpointError, GridError
from recrl.orchestrator.files.checkpoint_format import MAGIC, decode, encode
from recrl.orchestrator.grid.checked_grid import GridSpec
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.located_yaml import dump, parse

EXAMPLES = int(os.environ.get("RECRL_FUZZ_EXAMPLES", "60"))
FUZZED = settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck), print_blob=True)

RIGHT: dict[str, Any] = {
    "name": "fuzzed",
    "tasks": [{"name": "two-state", "deploy_limits": 2, "options": {"horizon": 10}}],
    "agents": ["ppo-lag", {"name": "cpo", "options": {"hidden_sizes": [8]}}],
    "methods": ["none", {"name": "dynamic", "label": "d", "options": {"window": 5}}],
    "seeds": 2,
    "run": {"total_steps": 160, "deploy_fraction": 0.5, "num_envs": 4, "rollout_steps": 10},
    "resources": {"cpus_per_trial": 1, "max_concurrent": 2},
    "exclude": [{"method": "none", "seed": [1]}],
}
WORDS = [
    "name",
    "tasks",
    "seeds",
    "run",
    "options",
    "label",
    "none",
    "two-state",
    "cpo",
    "auto",
    "inf",
    "../x",
]

scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats()
    | st.text(max_size=20)
    | st.sampled_from(WORDS)
)
values = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9) | st.sampled_from(WORDS), inner)
    ),
    max_leaves=8,
)


def places(value: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where something could be put in a tree, instead of what is there."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place, *(deeper for key, item in inner for deeper in places(item, (*place, key)))]


def put(value: Any, place: tuple[Any, ...], new: Any) -> Any:
    """The tree with something else at a place."""
    if not place:
        return new
    first, *rest = place
    copy = dict(value) if isinstance(value, dict) else list(value)
    copy[first] = put(value[first], tuple(rest), new)
    return copy


def assert_grid_or_error(data: bytes) -> None:
    try:
        grid = parse_grid(data, source="grid.yaml")
    except GridError as error:
        assert error.problems
        assert all(problem.startswith("grid.yaml:") for problem in error.problems)
        assert all("\n" not in problem for problem in error.problems)
        assert "Traceback" not in str(error)
    else:
        assert isinstance(grid, GridSpec)
        names = [spec.folder_name for spec in grid.trials()]
        assert len(names) == len(set(names))
        assert not any("/" in name or name.startswith(".") for name in names)


@given(st.binary(max_size=300) | st.text(max_size=300).map(str.encode))
@example(b"? '\n\n  '\n: null\n")  # a key of two lines
@FUZZED
def test_any_bytes_are_a_grid_or_an_error(data: bytes) -> None:
    assert_grid_or_error(data)


@given(st.data())
@FUZZED
def test_any_value_at_any_place_of_a_grid_is_taken_or_refused(data: st.DataObject) -> None:
    tree: Any = RIGHT
    for _ in range(data.draw(st.integers(1, 2))):
        tree = put(tree, data.draw(st.sampled_from(places(tree))), data.draw(values))
    assert_grid_or_error(yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "surrogatepass"))


@given(st.dictionaries(st.text(max_size=150), values, min_size=1))
@FUZZED
def test_any_plain_values_are_read_as_they_were_written(tree: dict[str, Any]) -> None:
    document = parse(dump(tree))
    assert document.problems == ()
    assert repr(document.value) == repr(tree)  # NaN is not equal to itself


class Number(IntEnum):
    ONE = 1


class Fraction(float):
    pass


class Pair(NamedTuple):
    first: int
    second: str


def test_values_of_derived_types_are_those_of_the_plain_ones() -> None:
    tree = {"a": Number.ONE, "b": Fraction(0.5), "c": Pair(1, "1"), "d": np.float32(0.5), "e": np.arange(2)}
    plain = {"a": 1, "b": 0.5, "c": [1, "1"], "d": 0.5, "e": [0, 1]}
    assert repr(parse(dump(OrderedDict(tree))).value) == repr(plain)


@pytest.mark.parametrize("value", [{1}, b"x", object(), print])
def test_other_values_are_not_written(value: object) -> None:
    with pytest.raises(TypeError, match="cannot represent an object"):
        dump({"a": [value]})


@pytest.mark.parametrize("tree", [{"a": 10**5000}, ["abc"], 5])
def test_a_number_too_long_and_what_is_no_mapping_are_not_written(tree: Any) -> None:
    with pytest.raises(TypeError):
        dump(tree)


def test_a_value_in_itself_is_not_written() -> None:
    endless: dict[str, Any] = {}
    endless["a"] = endless
    with pytest.raises(TypeError, match="a value contains itself, or is nested too deeply"):
        dump(endless)


@given(st.data())
@FUZZED
def test_a_grid_file_that_was_cut_or_changed_is_a_grid_or_an_error(data: st.DataObject) -> None:
    text = yaml.safe_dump(RIGHT).encode()
    start = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(start, min(len(text), start + 40)))
    new = data.draw(
        st.binary(max_size=8) | st.sampled_from([b"&a", b"*a", b"!!python/object:os.system", b"{", b"- "])
    )
    assert_grid_or_error(text[:start] + new + text[end:])


def assert_tree_or_error(data: bytes) -> None:
    try:
        assert isinstance(decode(data, source="checkpoint"), dict)
    except CheckpointError as error:
        assert str(error).startswith("checkpoint: ")


CHECKPOINT = encode({"trial": {"weights": [1.0, 2.0], "name": "x"}, "files": {"episodes.csv": 12}})


@given(st.data())
@FUZZED
def test_a_checkpoint_that_was_cut_or_changed_is_refused(data: st.DataObject) -> None:
    start = data.draw(st.integers(0, len(CHECKPOINT) - 1))
    end = data.draw(st.integers(start, len(CHECKPOINT)))
    changed = CHECKPOINT[:start] + data.draw(st.binary(max_size=8)) + CHECKPOINT[end:]
    if changed != CHECKPOINT:
        try:
            decode(changed, source="checkpoint")
        except CheckpointError:
            return
        raise AssertionError("a damaged checkpoint was read")


def signed(payload: bytes) -> bytes:
    """A checkpoint whose checksum is right, whatever it holds."""
    return MAGIC + hashlib.sha256(payload).digest() + payload


@given(st.data())
@FUZZED
def test_a_checkpoint_with_a_right_checksum_is_read_or_refused(data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(["any bytes", "any header", "any tree", "changed"]))
    if kind == "any bytes":
        payload = data.draw(st.binary(max_size=200))
    elif kind == "changed":
        whole = CHECKPOINT[len(MAGIC) + 32 :]
        start = data.draw(st.integers(0, len(whole) - 1))
        payload = whole[:start] + data.draw(st.binary(max_size=4)) + whole[start + 1 :]
    else:
        tree = json.dumps(data.draw(values | st.just({"__array__": ["x"]}) | st.just({"__array__": "y"})))
        header = {"__metadata__": {"tree": tree}} if kind == "any tree" else data.draw(values)
        text = json.dumps(header).encode()
        payload = struct.pack("<Q", len(text)) + text + data.draw(st.binary(max_size=16))
    assert_tree_or_error(signed(payload))


def deep(levels: int) -> bytes:
    tree = json.dumps({"tree": "[" * levels + "]" * levels})
    text = json.dumps({"__metadata__": json.loads(tree)}).encode()
    return signed(struct.pack("<Q", len(text)) + text)


def test_deep_nesting_is_refused() -> None:
    assert_tree_or_error(deep(100_000))
    assert_grid_or_error(b"[" * 100_000)
    assert_grid_or_error(b"a: " + b"{a: " * 5_000)
