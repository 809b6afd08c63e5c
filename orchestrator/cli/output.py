"""What a command writes to a terminal: nothing there is obeyed that came from a file."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from recrl.orchestrator.cli import display
from recrl.orchestrator.redaction import printable, shown

if TYPE_CHECKING:
    import pandas as pd


class TextConsole(Console):
    """A console on which labels, errors and logs are text, whatever control characters they hold."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render, with the control characters of texts escaped; colours are Rich's own."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=printable(segment.text))


@contextmanager
def logging_to_stderr() -> Iterator[None]:
    """Write recrl's warnings to the standard error, as they may be shown, until the end of the block."""
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
    """Formats records without secrets and control characters; tracebacks are in the trials' own logs."""

    def format(self, record: logging.LogRecord) -> str:
        """The record's message."""
        return shown(record.getMessage())


def short(path: Path) -> Path:
    """The path as seen from here, where it is below."""
    with contextlib.suppress(ValueError):
        return path.relative_to(Path.cwd())
    return path


def say(console: Console, sentence: str) -> None:
    """One line as it is, but for secrets and control characters: no markup, no colours, no wrapping."""
    console.print(shown(sentence), markup=False, highlight=False, soft_wrap=True)


def show(table: pd.DataFrame, console: Console) -> None:
    """A table of finished text."""
    console.print(display.text_table(list(map(str, table)), table.to_numpy().tolist()))
