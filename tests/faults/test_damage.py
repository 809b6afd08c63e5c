"""Every file of a sweep, damaged in every way: a sentence, the other trials as before, and never a traceback.

The long run is ``python -m tests.faults.damage --cases 3000 --seed 0``; here quick commands meet every damage
once.
"""

from pathlib import Path

import numpy as np
import pytest

from tests.faults import damage
from tests.faults.damage import Sweep

QUICK = {name: damage.READING[name] for name in ("status", "plan", "check")}
LASTING = ("state.json", "episodes.csv", "trials.jsonl")  # after these the launches are tried as well


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    folder = tmp_path_factory.mktemp("sweeps")
    other = damage.make(folder / "other", interrupted=False, limit=0.75)
    damage.make(folder / "complete", interrupted=False)
    return damage.undamaged(damage.make(folder / "interrupted", interrupted=True), other, damage.READING)


@pytest.mark.parametrize("kind", damage.DAMAGES)
def test_no_damage_to_any_file_is_a_traceback_or_changes_another_number(sweep: Sweep, kind: str) -> None:
    generator = np.random.default_rng(0)
    chosen = [each for each in damage.damages_of(sweep, generator) if each.kind == kind]
    wrong = [
        f"{each}: {command}: {mistake}"
        for each in chosen
        for command, mistake in damage.mistakes(sweep, each, QUICK, launches=False)
        if mistake
    ]
    assert len(chosen) > 20
    assert wrong == []


@pytest.mark.parametrize("name", LASTING)
def test_after_a_damage_a_launch_brings_every_result_back(sweep: Sweep, name: str) -> None:
    path = next(path for path in reversed(sweep.files) if path.name == name)
    for kind in ("cut", "flipped"):
        each = damage.Damage(path, kind, place=0.5, bits=1)
        assert [it for it in damage.mistakes(sweep, each, damage.READING, launches=True) if it[1]] == []


def test_the_harness_would_notice(sweep: Sweep, tmp_path: Path) -> None:
    """What it calls wrong: a traceback, other numbers without a word, other rows, and no word at all."""
    each = damage.Damage(Path("trials/x/episodes.csv"), "cut")
    whole = sweep.said["status"]
    for said in (
        damage.Said(None, "", "Traceback"),
        damage.Said(0, whole.out.replace("50%", "51%"), ""),
        damage.Said(0, whole.out.replace("50%", "51%"), "episodes.csv"),
        damage.Said(2, "", "something"),
    ):
        assert damage._wrong(sweep, each, "status", said, has_changed=True)
    assert damage._wrong(sweep, each, "check", sweep.said["check"], has_changed=True) == "check found nothing"
    other = {name: [*lines[:-1], lines[-1] + "1"] for name, lines in sweep.tables.items()}
    assert damage._wrong_tables(sweep.tables, other)
    assert damage._wrong_results(sweep.folder, sweep.other)
