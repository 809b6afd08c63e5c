"""Output that outlives its reader: in ``recrl-sweep launch grid.yaml | head`` the trials go on."""

from __future__ import annotations

import io
import os
import sys
from typing import Any, TextIO


class _LastingFile(io.FileIO):
    """A file whose bytes go nowhere once it is a pipe without a reader."""

    def write(self, data: memoryview | bytes) -> int:  # type: ignore[override]
        """Write bytes; return how many were taken."""
        try:
            return super().write(data)
        except BrokenPipeError:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self.fileno())
            os.close(null)
            return memoryview(data).nbytes


def let_streams_last(*, output: bool) -> None:
    """Replace the standard error of this process, and its standard output, unless they were replaced before.

    Also what a user's code prints goes nowhere then, instead of failing. So does output to closed streams.

    Args:
        output: whether the output is to last, too.
    """
    for name, lasts in (("stdout", output), ("stderr", True)):
        stream = getattr(sys, name)
        if stream is None:  # closed, as by >&-
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115  (until the end)
        elif lasts and stream is getattr(sys, f"__{name}__"):
            setattr(sys, name, _lasting(stream))


def _lasting(stream: Any) -> TextIO:
    stream.flush()
    file: Any = _LastingFile(stream.fileno(), "wb", closefd=False)
    buffer = io.BufferedWriter(file)
    return io.TextIOWrapper(buffer, stream.encoding, stream.errors, line_buffering=stream.line_buffering)
