"""Checkpoints give back exactly what was stored, or say that they cannot; they never run code."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recrl.orchestrator.errors import CheckpointError
from recrl.orchestrator.files import checkpoint_format

TREE = {
    "weights": [np.arange(6, dtype=np.float32).reshape(2, 3), np.array(2.5)],
    "generator": np.random.default_rng(3).bit_generator.state,  # holds integers of 128 bits
    "flags": {"done": np.array([True, False]), "none": None, "inf": float("inf"), "text": "π"},
    "empty": np.zeros((0, 4)),
}


def test_a_tree_comes_back_exactly() -> None:
    again = checkpoint_format.decode(checkpoint_format.encode(TREE), source="here")
    np.testing.assert_equal(again, TREE)
    assert again["weights"][0].dtype == np.float32
    assert again["weights"][1].shape == ()
    assert again["empty"].shape == (0, 4)


def test_keys_with_dots_do_not_meet() -> None:
    """Names with dots are usual in a torch module's state."""
    one, two = np.zeros(2), np.ones(2)
    tree = {"net.w": one, "net": {"w": two}, "net.0": one, "list": [two]}
    np.testing.assert_equal(checkpoint_format.decode(checkpoint_format.encode(tree), source="here"), tree)


def test_equal_trees_give_equal_bytes() -> None:
    assert checkpoint_format.encode(TREE) == checkpoint_format.encode(TREE)


def test_a_transposed_array_keeps_its_values() -> None:
    array = np.arange(6).reshape(2, 3).T
    np.testing.assert_equal(
        checkpoint_format.decode(checkpoint_format.encode({"a": array}), source="here")["a"], array
    )


@given(st.data())
def test_damage_anywhere_is_noticed(data: st.DataObject) -> None:
    intact = checkpoint_format.encode(TREE)
    position = data.draw(st.integers(0, len(intact) - 1))
    flipped = bytes([intact[position] ^ data.draw(st.integers(1, 255))])
    with pytest.raises(CheckpointError):
        checkpoint_format.decode(intact[:position] + flipped + intact[position + 1 :], source="here")


@given(st.integers(0, len(checkpoint_format.encode(TREE)) - 1))
def test_truncation_is_noticed(length: int) -> None:
    with pytest.raises(CheckpointError):
        checkpoint_format.decode(checkpoint_format.encode(TREE)[:length], source="here")


def test_objects_are_refused() -> None:
    with pytest.raises(TypeError, match=r"checkpoint: \$\.a\.0: cannot store a PosixPath"):
        checkpoint_format.encode({"a": [Path("x")]})


def test_missing_file_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "gone.recrl"
    with pytest.raises(CheckpointError, match=rf"{path}: cannot be read: No such file or directory"):
        checkpoint_format.load(path)
