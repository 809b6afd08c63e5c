"""Kept machine code is used again where nothing changed, and never where something did."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recrl.environments.simulation.code_digest import digest

ELSEWHERE = """
import numpy as np

from recrl.environments.simulation.machine_code import array_at, compiled

RECORD = np.dtype([("first", np.float64), ("second", np.float64)], align=True)
FACTOR = 2.0
records_at = array_at(RECORD)


@compiled
def scaled(number):
    return FACTOR * number


@compiled
def second(record):
    return scaled(record.second)
"""
PROGRAM = """
from elsewhere import RECORD, records_at, second
from recrl.environments.simulation.machine_code import compiled_for_batch

import ctypes

import numpy as np


@compiled_for_batch
def double(_model: int, _data: int, _index: int, argument: int) -> None:
    record = records_at(argument, 1)[0]
    record.first = second(record)


if __name__ == "__main__":
    records = np.zeros(1, RECORD)
    records["second"] = 5.0
    double.ctypes(0, 0, 0, records.ctypes.data)
    print(records["first"][0], double.cache_hits)
"""


def run(folder: Path) -> str:
    """What the program found in its record, and how often machine code was found."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    program = [sys.executable, "-W", "error", str(folder / "program.py")]
    return subprocess.run(program, env=environment, check=True, capture_output=True, text=True).stdout.strip()


CHANGES = {
    "record layout": ('("first", np.float64), (', '("first", np.float64), ("between", np.int64), (', "10.0"),
    "constant": ("FACTOR = 2.0", "FACTOR = 3.0", "15.0"),
    "helper of a helper": ("return FACTOR * number", "return FACTOR * number + 1.0", "11.0"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_machine_code_is_kept_until_something_elsewhere_changes(tmp_path: Path, change: str) -> None:
    before, after, found = CHANGES[change]
    (tmp_path / "elsewhere.py").write_text(ELSEWHERE)
    (tmp_path / "program.py").write_text(PROGRAM)
    assert run(tmp_path) == "10.0 0"
    assert run(tmp_path) == "10.0 1"
    (tmp_path / "elsewhere.py").write_text(ELSEWHERE.replace(before, after))
    assert run(tmp_path) == f"{found} 0", "compiled anew"
    assert run(tmp_path) == f"{found} 1"


def test_a_digest_knows_constants_of_nested_functions_and_of_arrays() -> None:
    def outer(constant: Any) -> Any:
        def inner(number: float) -> float:
            return math.sin(number) * float(constant[0])

        return inner

    one, same, other = outer((1.0,)), outer((1.0,)), outer((2.0,))
    assert digest(one) == digest(same) != digest(other)
    array = outer(np.array([1.0]))
    assert digest(array) == digest(outer(np.array([1.0]))) != digest(outer(np.array([2.0])))


def test_what_has_no_digest_is_refused() -> None:
    thing = object()

    def function() -> object:
        return thing

    with pytest.raises(TypeError) as error:
        digest(function)
    assert str(error.value).endswith(
        "function: compiled code may take numbers, tuples, arrays, records' types, modules and functions "
        "from outside, got object"
    )
