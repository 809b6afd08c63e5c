"""Which changes of a source change what is compared: those that can change a result."""

import pytest

from recrl.orchestrator.provenance.source_text import without_documentation

SOURCE = '''\
"""What the module is for.

Over several lines.
"""

import os


class Box:
    """A box."""

    size = 3  # as measured

    def area(self):
        """Return
        # the area.
        """
        # squared
        return self.size**2


MAP = """
# a wall

..
"""
'''


DOCUMENTATION = [
    ("What the module is for.", "A module."),
    ("Over several lines.\n", ""),
    ('    """A box."""\n\n', ""),
    ("# the area.", "the area, in square metres"),
    ("        # squared\n", ""),
    ("import os\n\n\n", "# for files\nimport os\n"),
]
CODE = [
    ("size = 3", "size = 4"),
    ("# a wall", "# a door"),  # within a string
    ("wall\n\n", "wall\n"),
    ('MAP = """', 'PLAN = """'),
    ("        return", "    return"),
]


@pytest.mark.parametrize(
    ("old", "new", "counts"),
    [(*change, False) for change in DOCUMENTATION] + [(*change, True) for change in CODE],
)
def test_code_and_strings_count_and_documentation_does_not(old: str, new: str, *, counts: bool) -> None:
    changed = SOURCE.replace(old, new)
    assert changed != SOURCE
    differs = without_documentation(changed.encode()) != without_documentation(SOURCE.encode())
    assert differs == counts


def test_code_on_the_line_of_a_docstring_counts() -> None:
    one, two = b'"Text."; a = 1\n', b'"Other text."; a = 2\n'
    assert without_documentation(one) == b"; a = 1"
    assert without_documentation(two) == b"; a = 2"


def test_letters_outside_ascii_are_cut_at_the_right_byte() -> None:
    assert without_documentation('"""Größe."""; a = "ß"\n'.encode()) == '; a = "ß"'.encode()


def test_a_file_in_another_encoding_is_cut_at_the_right_place() -> None:
    source = '# coding: latin-1\ndef f():\n    "éééééééééééé"; return 1\n'.encode("latin-1")
    assert without_documentation(source) == b"def f():\n    ; return 1"


def test_a_docstring_that_the_code_reads_counts() -> None:
    source = b'def f():\n    "3"\n    return int(f.__doc__)\n'
    assert without_documentation(source) == source


def test_warnings_of_the_source_change_nothing() -> None:
    assert without_documentation(b"a = '\\d'\n# b\n") == b"a = '\\d'"


@pytest.mark.parametrize("source", [b"def f(:\n    # x\n", b"\x00", b"\xff\xfe"])
def test_what_does_not_parse_stays(source: bytes) -> None:
    assert without_documentation(source) == source
