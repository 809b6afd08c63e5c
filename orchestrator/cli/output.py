"""Terminal output: control characters from files are escaped."""

from __future__ import annotations

import contextlib
import logging
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table

from recrl.orchestrator.cli import display
from recrl.orchestrator.redaction import printable, shown

if TYPE_CHECKING:
    import pandas as pd

UNLIMITED = 100_000  # characters of a line


class TextConsole(Console):
    """A console that shows labels, errors and logs as text, with control characters escaped.

    Rich would read ``[...]`` in a label as its markup, and ``:100:`` in a log as an emoji.
    """

    def __init__(self, *, width: int | None = None) -> None:
        super().__init__(width=width, markup=False, emoji=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render with escaped control characters of texts; colours are Rich's own."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=printable(segment.text))

    def on_broken_pipe(self) -> None:
        """Pass the error on to ``main``; Rich would end the process, as if the user's code had."""
        if threading.current_thread() is not threading.main_thread():
            super().on_broken_pipe()
        raise  # noqa: PLE0704  (Rich calls this while it handles the BrokenPipeError)


@contextmanager
def logging_to_stderr() -> Iterator[None]:
    """Write recrl's warnings to the standard error until the end of the block, without secrets."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setLevel(logging.WARNING)
    handler.setFormatter(_Sentence())
    root = logging.getLogger("recrl")
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)


class _Sentence(logging.Formatter):
    """Formatter without secrets and control characters; tracebacks are in the trials' own logs."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's message."""
        return shown(record.getMessage())


def short(path: Path) -> Path:
    """Return the path relative to the working directory, if it is below."""
    with contextlib.suppress(ValueError):
        return path.relative_to(Path.cwd())
    return path


def say(console: Console, sentence: str) -> None:
    """Print one line without secrets and control characters: no colours, no wrapping."""
    console.print(shown(sentence), markup=False, emoji=False, highlight=False, soft_wrap=True)


def show(table: pd.DataFrame, console: Console) -> None:
    """Print a table of finished text."""
    print_table(display.text_table(list(map(str, table)), table.to_numpy().tolist()), console)


def print_table(table: Table, console: Console) -> None:
    """Print a table; a file or a pipe has no width, so nothing is shortened there."""
    before = console.width
    if not console.is_terminal:
        unlimited = console.options.update(max_width=UNLIMITED)
        console.width = max(before, console.measure(table, options=unlimited).maximum)
    try:
        console.print(table)
    finally:
        console.width = before
