"""``recrl-sweep``: run a command, and turn errors into sentences and exit codes.

Imports almost nothing until the command is known, so that ``--help`` is fast.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from recrl.orchestrator.cli.argument_fields import Request
from recrl.orchestrator.cli.arguments import COMMANDS, parse, readable
from recrl.orchestrator.cli.lasting_streams import let_streams_last
from recrl.orchestrator.cli.requests import LaunchRequest
from recrl.orchestrator.errors import (
    NO_PATH,
    NO_ROOM,
    ClusterError,
    GridError,
    RecrlError,
    StorageError,
    SweepBusyError,
    TrackingError,
)
from recrl.orchestrator.exit_codes import ExitCode

if TYPE_CHECKING:
    from rich.console import Console


def main(given: Sequence[str] | None = None) -> int:
    """Run the command of the arguments.

    Args:
        given: the arguments; by default those of the process.

    Returns:
        An exit code.
    """
    given = list(sys.argv[1:] if given is None else given)
    if isinstance(sys.stdout, io.TextIOWrapper):  # its encoding may lack a sign such as ±
        sys.stdout.reconfigure(errors="replace")
    request = parse(given)
    let_streams_last(output=not request.ends_with_reader)
    try:
        return _run(request)
    except GridError as error:
        _complain(str(error))
        mistakes = f"{len(error.problems)} mistake{'s' if len(error.problems) > 1 else ''}"
        _complain(f"{mistakes} in {request.about}; nothing was started")
        return ExitCode.WRONG_INPUT
    except RecrlError as error:
        _complain(f"recrl-sweep: {error}")
        return _code_of(error)
    except KeyboardInterrupt:
        again = "; go on with the same command" if isinstance(request, LaunchRequest) else ""
        print(f"Stopped at once{again}.", file=sys.stderr)
        return ExitCode.STOPPED
    except BrokenPipeError:  # of a command that ends with its reader
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitCode.OK
    except OSError as error:
        if error.errno not in (*NO_ROOM, *NO_PATH):
            raise
        where = error.filename or getattr(request, "root", request.about)
        _complain(f"recrl-sweep: {where}: {error.strerror}; saved results are kept")
        return ExitCode.CANNOT_RUN if error.errno in NO_ROOM else ExitCode.WRONG_INPUT


def _run(request: Request) -> ExitCode:
    """Run the command; follow import paths in files only on request."""
    from recrl.environments.plugins import (  # noqa: PLC0415  (--help is to be quick)
        load_attribute,
        modules_in,
        refuse_import_paths,
    )
    from recrl.orchestrator.cli.output import TextConsole, logging_to_stderr  # noqa: PLC0415

    # a file or a pipe has no width that tables must fit
    console = TextConsole() if sys.stdout.isatty() else TextConsole(width=160)
    followed = modules_in(Path.cwd()) if request.follows_import_paths else refuse_import_paths()
    try:
        with logging_to_stderr(), followed:
            run: Callable[[Request, Console], ExitCode] = load_attribute(
                f"recrl.orchestrator.cli.{COMMANDS[type(request)]}"
            )
            return run(request, console)
    except SystemExit as error:
        raise RecrlError(f"code that the sweep names ended the process ({error.code})") from error


def _complain(sentence: str) -> None:
    """Print an error to the standard error; a sentence may quote an untrusted file."""
    print(readable(sentence), file=sys.stderr)


def _code_of(error: RecrlError) -> ExitCode:
    if isinstance(error, SweepBusyError):
        return ExitCode.BUSY
    cannot_run = isinstance(error, ClusterError | StorageError | TrackingError)
    return ExitCode.CANNOT_RUN if cannot_run else ExitCode.WRONG_INPUT
