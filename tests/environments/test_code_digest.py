"""Kept machine code is used again where nothing changed, and never where something did."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from recrl.environments.simulation.machine_code import source_digest

ELSEWHERE = "FACTOR = 2.0"
PROGRAM = """
import sys

import numpy as np

from elsewhere import FACTOR
from recrl.environments.simulation import machine_code

machine_code.source_digest = lambda: sys.argv[1]


@machine_code.compiled_for_arrays
def scaled(number):
    return FACTOR * number


print(scaled(5.0), sum(scaled.stats.cache_hits.values()))
"""


def run(folder: Path, digest: str) -> str:
    """What the program computed, and how often machine code was found."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    program = [sys.executable, "-W", "error", str(folder / "program.py"), digest]
    return subprocess.run(program, env=environment, check=True, capture_output=True, text=True).stdout.strip()


def test_machine_code_is_kept_under_its_digest(tmp_path: Path) -> None:
    (tmp_path / "elsewhere.py").write_text(ELSEWHERE)
    (tmp_path / "program.py").write_text(PROGRAM)
    assert run(tmp_path, "one") == "10.0 0"
    assert run(tmp_path, "one") == "10.0 1"
    (tmp_path / "elsewhere.py").write_text(ELSEWHERE.replace("2.0", "3.0"))
    assert run(tmp_path, "other") == "15.0 0", "compiled anew"
    assert run(tmp_path, "other") == "15.0 1"


def test_a_digest_changes_with_every_file_that_compiled_code_may_come_from(tmp_path: Path) -> None:
    digests = {source_digest(tmp_path)}
    for name in ("safety_gym/deeper/step.py", "simulation/code.py"):
        path = tmp_path / name
        path.parent.mkdir(parents=True)
        for text in ("FACTOR = 2.0", "FACTOR = 3.0"):
            path.write_text(text)
            source_digest.cache_clear()
            digests.add(source_digest(tmp_path))
    source_digest.cache_clear()
    assert len(digests) == 5
