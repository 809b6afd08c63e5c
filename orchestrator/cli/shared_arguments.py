"""Arguments common to several commands: the parser's class, and groups of arguments."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NoReturn, TypeAlias

from recrl.orchestrator.cli.argument_types import at_least_one, folder, path_of
from recrl.orchestrator.cli.requests import PlaceRequest, Request

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
LONGEST_LINE = 1000  # characters of an error
SWEEP_HELP = "a sweep's name, folder or grid file; optional if there is only one"


def readable(sentence: str) -> str:
    """Return a sentence for display; lines with very long quotations are cut."""
    from recrl.orchestrator.redaction import shown  # noqa: PLC0415  (--help is to be quick)

    lines = shown(sentence).split("\n")
    return "\n".join(line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]}..." for line in lines)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Print what is wrong with the arguments, without secrets, and exit."""
        super().error(readable(message))


def new_parser(name: str, description: str, epilog: str) -> argparse.ArgumentParser:
    """A parser without commands, whose errors hide secrets."""
    return _Parser(
        prog=name,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_command(
    commands: Commands, name: str, request: type[Request], summary: str
) -> argparse.ArgumentParser:
    """Add a command that makes a ``request``; with the location of sweeps if the request has one."""
    command = commands.add_parser(name, help=summary, description=f"{summary[0].upper()}{summary[1:]}.")
    command.set_defaults(request=request)
    if issubclass(request, PlaceRequest):
        command.add_argument(
            "--root", type=folder, default=Path("runs"), help="the folder of all sweeps (default: runs)"
        )
        command.add_argument(
            "--storage",
            metavar="URI",
            help="keep the sweep in an object store (s3://bucket/folder, gs://, abfs://...) that all nodes "
            "reach; its folder under --root is then a local copy that stores the address",
        )
    return command


def add_grid(command: argparse.ArgumentParser) -> None:
    """Add the grid file."""
    command.add_argument("grid", type=path_of, metavar="GRID.yaml", help="what the sweep is made of")


def add_trust(command: argparse.ArgumentParser) -> None:
    """Add ``--trust``."""
    command.add_argument(
        "--trust",
        action="store_true",
        help="import and call what the file names by an import path, package.module:attribute: do so only "
        "with files whose author you trust; launch always does",
    )


def add_sweep(command: argparse.ArgumentParser) -> None:
    """Add the sweep."""
    command.add_argument("sweep", nargs="?", metavar="SWEEP", help=SWEEP_HELP)


def add_source(command: argparse.ArgumentParser) -> None:
    """Add a sweep that may also be an export or in MLflow."""
    command.add_argument(
        "sweep", nargs="?", metavar="SWEEP", help=f"{SWEEP_HELP}; or a file that export wrote (.zip)"
    )
    command.add_argument(
        "--tracking-uri",
        metavar="URI",
        help="read MLflow instead of files: a server (http://host:port) or database (sqlite:///file.db)",
    )


def add_only(command: argparse.ArgumentParser) -> None:
    """Add ``--only``."""
    command.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="only these trials: task, agent or method by label, or seed; several values with commas, "
        "method=none,dynamic",
    )


def add_selection(command: argparse.ArgumentParser) -> None:
    """Add the selection of a launch's trials."""
    add_only(command)
    command.add_argument(
        "--retry-failed", action="store_true", help="try failed trials again, from their last checkpoint"
    )
    command.add_argument(
        "--rerun-damaged",
        action="store_true",
        help="run damaged trials again that were complete or had failed; other damaged trials are "
        "repaired anyway",
    )
    command.add_argument(
        "--rerun-changed",
        action="store_true",
        help="run trials again that ran other code than is installed now; their old files are kept aside",
    )
    command.add_argument(
        "--max-concurrent",
        type=at_least_one,
        metavar="N",
        help="largest number of parallel trials; by default as fit (or the grid's)",
    )


def add_tracking(command: argparse.ArgumentParser) -> None:
    """Add MLflow's address."""
    command.add_argument(
        "--tracking-uri",
        metavar="URI",
        help="an MLflow server (http://host:port) or database (sqlite:///file.db); "
        "by default one in the sweep's folder",
    )
