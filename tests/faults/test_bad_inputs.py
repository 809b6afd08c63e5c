"""Every wrong input gets a sentence; the whole list is run by ``python tests/faults/bad_inputs.py``."""

import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.faults.bad_inputs import Case, ask, cases, workplace

EVERY = 12
ALWAYS = ("task: ", "--only ", "evaluate --video", "figures --to", "--cores", "status nope", "that is a bomb")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("bad-inputs")
    with workplace(folder):
        yield folder


def is_chosen(name: str) -> bool:
    """Whether a case is tried; a new case changes nothing for the others."""
    return zlib.crc32(name.encode()) % EVERY == 0 or any(word in name for word in ALWAYS)


def chosen() -> list[Case]:
    return [case for case in cases() if is_chosen(case.name)]


def test_there_are_hundreds_and_each_is_there_once() -> None:
    names = [case.name for case in cases()]
    assert len(names) == len(set(names)) >= 900


@pytest.mark.parametrize("case", chosen(), ids=lambda case: ascii(case.name))
def test_a_wrong_input_gets_a_sentence(case: Case, home: Path) -> None:
    answer = ask(case, home)
    assert answer.problem == "", answer.text
