"""``recrl-sweep``: what can be asked on the command line, and how errors become sentences and exit codes.

Imports next to nothing until it knows what is asked, so that ``--help`` is quick.
"""

from __future__ import annotations

import argparse
import errno
import importlib.metadata
import math
import os
import re
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import NoReturn, TypeAlias

from recrl.orchestrator.errors import (
    ClusterError,
    GridError,
    RecrlError,
    StorageError,
    SweepBusyError,
    TrackingError,
)
from recrl.orchestrator.exit_codes import ExitCode

DESCRIPTION = """\
Run constrained reinforcement learning under cost-limit curricula: every task x student x method x seed of a
grid file, on all cores or a Ray cluster, so that nothing is lost and nothing is run twice."""

EPILOG = """\
A first sweep:
  recrl-sweep validate grids/demo.yaml    is the file right? (all mistakes at once, with their lines)
  recrl-sweep plan grids/demo.yaml        what would run, how long, how much memory
  recrl-sweep launch grids/demo.yaml      run it, watch it, draw the figures
  recrl-sweep ui demo                     open MLflow's pages about it

Going on:
  recrl-sweep status demo                 from any terminal, whether it runs or not
  recrl-sweep launch grids/demo.yaml      after a crash, Ctrl-C or with more seeds: the same command; complete
                                          trials are kept, begun ones go on from their last checkpoint
  recrl-sweep stop demo                   from another terminal: trials save where they are, the launch ends
  recrl-sweep logs demo 3f2a --follow     a trial's log, by the beginning of its id or title
  recrl-sweep evaluate demo 3f2a --video  run its policy again, and film an episode
  recrl-sweep check demo                  are all files what was committed? one line for each that is not
  recrl-sweep launch grids/demo.yaml --retry-failed
  recrl-sweep launch grids/demo.yaml --only method=dynamic task=rivergrid-1b
  recrl-sweep launch grids/demo.yaml --address auto --storage s3://bucket/folder
  recrl-sweep status demo --storage s3://bucket/folder     from any machine that has its credentials

Exit codes:
  0    done, or nothing to do
  1    some trials failed, are damaged or could not be finished
  2    the grid or the arguments are wrong; nothing was started
  3    another process is running this sweep
  4    Ray, MLflow or the storage could not be reached, or files could not be written
  5    plan --check: a launch would have something to do
  130  stopped by Ctrl-C or SIGTERM; the same launch goes on"""

# Paths that cannot be: a file for a folder, a name that is too long, links in a circle.
NO_PATH = (
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EEXIST,
    errno.ENAMETOOLONG,
    errno.ELOOP,
    errno.ENOENT,
    errno.EINVAL,
)
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES)
Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
LISTS = ("--only", "--option")  # each takes several KEY=VALUE
PAIR = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*=.*(?<!\.yaml)(?<!\.yml)")
LONGEST_LINE = 1000  # characters of an error
VIDEOS = ("gif", "mp4")
SWEEP_HELP = "a sweep's name, or its grid file; may be left out where there is only one"


def parser() -> argparse.ArgumentParser:
    """Everything that can be asked."""
    top = _parser("recrl-sweep", DESCRIPTION, EPILOG)
    top.add_argument("--version", action="version", version=f"recrl {importlib.metadata.version('recrl')}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)

    _add_launch(commands)

    plan = _command(commands, "plan", "say what a launch would do, and about how long it takes")
    _add_grid(plan)
    _add_trust(plan)
    _add_selection(plan)
    plan.add_argument(
        "--check", action="store_true", help="end with 5 if a launch would have something to do"
    )
    room = plan.add_mutually_exclusive_group()
    room.add_argument(
        "--address",
        metavar="HOST:PORT",
        help="estimate for this Ray cluster, which is asked; by default for this machine",
    )
    room.add_argument("--cores", type=_at_least_one, metavar="N", help="estimate for so many cores")

    validate = _command(commands, "validate", "check a grid file; all mistakes at once, with their lines")
    _add_grid(validate)
    _add_trust(validate)

    status = _command(commands, "status", "say how far a sweep is, from its files alone")
    _add_sweep(status)
    status.add_argument("--brief", action="store_true", help="one line, without the table of trials")

    _add_sweep(
        _command(commands, "check", "hold every file of a sweep against its committed length and digest")
    )

    _add_sweep(
        _command(commands, "stop", "ask the launch that runs a sweep to save its trials and end, and wait")
    )

    _add_logs(commands)
    _add_evaluate(commands)
    _add_figures(commands)
    _add_export(commands)
    _add_merge(commands)
    _add_bound(commands)
    _add_replay(commands)
    _add_ui(commands)
    _add_sync(commands)
    return top


def main(given: Sequence[str] | None = None) -> int:
    """Do what is asked.

    Args:
        given: the arguments; those of the process by default.

    Returns:
        An exit code.
    """
    given = list(sys.argv[1:] if given is None else given)
    arguments = parser().parse_args(spread(given))
    arguments.given = given
    try:
        return _run(arguments)
    except GridError as error:
        _complain(str(error))
        mistakes = f"{len(error.problems)} mistake{'s' if len(error.problems) > 1 else ''}"
        grid = getattr(arguments, "grid", None) or arguments.sweep
        _complain(f"{mistakes} in {grid}; nothing was started")
        return ExitCode.WRONG_INPUT
    except RecrlError as error:
        _complain(f"recrl-sweep: {error}")
        return _code_of(error)
    except KeyboardInterrupt:
        again = "; go on with the same command" if arguments.command == "launch" else ""
        print(f"Stopped at once{again}.", file=sys.stderr)
        return ExitCode.STOPPED
    except BrokenPipeError:  # the reader, for example ``head``, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitCode.OK
    except OSError as error:
        if error.errno not in (*NO_ROOM, *NO_PATH):
            raise
        where = error.filename or getattr(arguments, "root", None) or arguments.to
        _complain(f"recrl-sweep: {where}: {error.strerror}; what was saved stays")
        return ExitCode.CANNOT_RUN if error.errno in NO_ROOM else ExitCode.WRONG_INPUT


def _run(arguments: argparse.Namespace) -> ExitCode:
    """Do it, without code that a file names unless that is asked for."""
    from recrl.environments.plugins import refuse_import_paths  # noqa: PLC0415  (--help is to be quick)
    from recrl.orchestrator.cli.commands import COMMANDS  # noqa: PLC0415
    from recrl.orchestrator.cli.output import TextConsole, logging_to_stderr  # noqa: PLC0415

    # a file or a pipe has no width that tables would have to fit in
    console = TextConsole() if sys.stdout.isatty() else TextConsole(width=160)
    trusted = arguments.command == "launch" or getattr(arguments, "trust", False)
    try:
        with logging_to_stderr(), nullcontext() if trusted else refuse_import_paths():
            return COMMANDS[arguments.command](arguments, console)
    except SystemExit as error:
        raise RecrlError(f"something that the sweep names ended the process ({error.code})") from error


def spread(given: Sequence[str]) -> list[str]:
    """The arguments, so that no list swallows the grid file or the sweep behind it.

    >>> spread(["--only", "method=none", "seed=0", "grid.yaml"])
    ['--only', 'method=none', '--only', 'seed=0', 'grid.yaml']
    >>> spread(["--video", "demo"]), spread(["--video", "mp4", "demo"])
    (['--video=gif', 'demo'], ['--video=mp4', 'demo'])
    """
    plain: list[str] = []
    rest = list(given)
    while rest:
        argument = rest.pop(0)
        if argument == "--video":
            plain.append(f"--video={rest.pop(0) if rest and rest[0] in VIDEOS else VIDEOS[0]}")
        elif argument in LISTS and rest:
            plain += [argument, rest.pop(0)]
            while rest and PAIR.fullmatch(rest[0]):
                plain += [argument, rest.pop(0)]
        else:
            plain.append(argument)
    return plain


def _complain(sentence: str) -> None:
    """Say on the standard error what is wrong; a sentence may quote a file that somebody else made."""
    print(_answer(sentence), file=sys.stderr)


def _answer(sentence: str) -> str:
    """What may be shown of a sentence, its lines cut where they quote something endless."""
    from recrl.orchestrator.redaction import shown  # noqa: PLC0415

    lines = shown(sentence).split("\n")
    return "\n".join(line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]}..." for line in lines)


def _code_of(error: RecrlError) -> ExitCode:
    if isinstance(error, SweepBusyError):
        return ExitCode.BUSY
    cannot_run = isinstance(error, ClusterError | StorageError | TrackingError)
    return ExitCode.CANNOT_RUN if cannot_run else ExitCode.WRONG_INPUT


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Say what is wrong with the arguments, which may hold a password, and exit."""
        super().error(_answer(message))


def _parser(name: str, description: str, epilog: str) -> argparse.ArgumentParser:
    return _Parser(
        prog=name,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _command(commands: Commands, name: str, summary: str) -> argparse.ArgumentParser:
    command = commands.add_parser(name, help=summary, description=f"{summary[0].upper()}{summary[1:]}.")
    if name not in ("validate", "merge"):  # these read only the files that they are given
        command.add_argument(
            "--root", type=_folder, default=Path("runs"), help="the folder of all sweeps (default: runs)"
        )
        command.add_argument(
            "--storage",
            metavar="URI",
            help="keep the sweep in an object store (s3://bucket/folder, gs://, abfs://...) that all nodes "
            "reach; its folder under --root is then a mirror, and remembers the address",
        )
    return command


def _add_launch(commands: Commands) -> None:
    launch = _command(
        commands, "launch", "run what is not complete, draw the figures, say where everything is"
    )
    _add_grid(launch)
    _add_selection(launch)
    _add_tracking(launch)
    launch.add_argument(
        "--executor",
        choices=("ray", "inline"),
        default="ray",
        help="ray: side by side on all cores or a cluster (default); inline: one after the other in this "
        "process, for debuggers",
    )
    launch.add_argument(
        "--address",
        metavar="HOST:PORT",
        help="an existing Ray cluster that this machine is a node of, or 'auto' to find it; by default one "
        "is started here",
    )
    launch.add_argument(
        "--ship-package",
        action="store_true",
        help="with --address: send recrl itself, without its dependencies, to the cluster's nodes",
    )
    launch.add_argument(
        "--no-mlflow",
        dest="mlflow",
        action="store_false",
        help="send nothing to MLflow; 'sync' can do it later",
    )
    launch.add_argument(
        "--no-figures", dest="figures", action="store_false", help="draw no figures at the end"
    )


def _add_logs(commands: Commands) -> None:
    logs = _command(commands, "logs", "print a trial's log")
    _add_sweep(logs)
    logs.add_argument(
        "trial",
        nargs="*",
        metavar="TRIAL",
        help="the beginning of its id, title or folder, as status shows them; by default the one that runs",
    )
    logs.add_argument("--follow", action="store_true", help="wait for more as long as the trial runs")
    logs.add_argument("--folder", action="store_true", help="print the trial's folder instead")


def _add_evaluate(commands: Commands) -> None:
    evaluate = _command(
        commands, "evaluate", "run the frozen policies of trials for whole episodes; film them on demand"
    )
    _add_sweep(evaluate)
    evaluate.add_argument(
        "trial",
        nargs="*",
        metavar="TRIAL",
        help="the beginning of its id, title or folder, or of several; by default all that have a checkpoint",
    )
    _add_only(evaluate)
    _add_trust(evaluate)
    evaluate.add_argument(
        "--episodes",
        type=_at_least_one,
        metavar="N",
        help="of each policy; by default as many as the trial itself evaluates at its end",
    )
    evaluate.add_argument(
        "--seed",
        type=_at_least_zero,
        metavar="S",
        help="of the episodes; by default that of the trial's own evaluation, which then comes out again",
    )
    evaluate.add_argument(
        "--policy",
        choices=("stochastic", "deterministic", "both"),
        default="both",
        help="act as in training, by the most likely action, or one after the other (default)",
    )
    evaluate.add_argument(
        "--video",
        choices=VIDEOS,
        help="also film one episode of each policy, as a GIF or, with the package av, as MP4; MLflow gets it",
    )
    _add_tracking(evaluate)


def _add_figures(commands: Commands) -> None:
    figures = _command(commands, "figures", "draw the figures, tables and report of what is there so far")
    _add_source(figures)
    _add_trust(figures)
    figures.add_argument(
        "--to", type=_folder, metavar="FOLDER", help="where to; by default the sweep's figures folder"
    )
    figures.add_argument(
        "--band",
        choices=("mean", "iqm"),
        default="mean",
        help="of learning curves: mean and standard error (default), or interquartile mean and 95%% "
        "bootstrap band",
    )
    figures.add_argument(
        "--sketch",
        action="store_true",
        help="only learning curves, limits and tables, no PDF: quick, as launch does while it runs",
    )


def _add_export(commands: Commands) -> None:
    export = _command(commands, "export", "write one small file that figures and tables can be drawn from")
    _add_source(export)
    export.add_argument(
        "--to", type=_zip_file, metavar="FILE.zip", help="by default the sweep's name, in this folder"
    )


def _add_merge(commands: Commands) -> None:
    merge = _command(commands, "merge", "join files that export wrote, of a sweep that ran in several places")
    merge.add_argument(
        "parts",
        type=_path,
        nargs="+",
        metavar="FILE.zip",
        help="the first gives the name; of a trial that several have, the one that got furthest is taken",
    )
    merge.add_argument("--to", type=_zip_file, metavar="FILE.zip", required=True, help="what to write")


def _add_bound(commands: Commands) -> None:
    bound = _command(commands, "bound", "what training cost beside its bounds; which d_t a budget allows")
    _add_source(bound)
    _add_trust(bound)
    bound.add_argument(
        "--budget",
        type=_cost,
        metavar="COST",
        help="cost above d_d that may be spent over all training episodes: say the largest d_t for it",
    )
    bound.add_argument(
        "--cost", type=_at_least_one, default=1, metavar="I", help="which of the costs (default: the first)"
    )


def _add_replay(commands: Commands) -> None:
    replay = _command(
        commands, "replay", "what limits another teacher would have set on the recorded episodes"
    )
    _add_sweep(replay)
    _add_trust(replay)
    replay.add_argument(
        "--teacher", required=True, metavar="NAME", help="a method of the sweep, or any teacher by its name"
    )
    replay.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="options of the teacher other than the sweep's, window=8",
    )
    _add_only(replay)


def _add_ui(commands: Commands) -> None:
    user_interface = _command(commands, "ui", "open MLflow's pages about a sweep, on this machine only")
    _add_sweep(user_interface)
    _add_tracking(user_interface)
    user_interface.add_argument(
        "--port", type=_port, default=5000, metavar="N", help="of 127.0.0.1 (default: 5000)"
    )


def _add_sync(commands: Commands) -> None:
    sync = _command(commands, "sync", "bring MLflow up to the files, for example after it was unreachable")
    _add_sweep(sync)
    _add_tracking(sync)
    sync.add_argument(
        "--rebuild", action="store_true", help="send everything again, for example to an empty MLflow"
    )


def _add_grid(command: argparse.ArgumentParser) -> None:
    command.add_argument("grid", type=_path, metavar="GRID.yaml", help="what the sweep is made of")


def _add_trust(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--trust",
        action="store_true",
        help="import and call what the file names by an import path, package.module:attribute: do so only "
        "with files whose author you trust; launch always does",
    )


def _add_sweep(command: argparse.ArgumentParser) -> None:
    command.add_argument("sweep", nargs="?", metavar="SWEEP", help=SWEEP_HELP)


def _add_source(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "sweep", nargs="?", metavar="SWEEP", help=f"{SWEEP_HELP}; or a file that export wrote (.zip)"
    )
    command.add_argument(
        "--tracking-uri",
        metavar="URI",
        help="read MLflow alone, no files: a server (http://host:port) or database (sqlite:///file.db)",
    )


def _add_only(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="only these trials: task, agent or method by label, or seed; several values with commas, "
        "method=none,dynamic",
    )


def _add_selection(command: argparse.ArgumentParser) -> None:
    _add_only(command)
    command.add_argument(
        "--retry-failed", action="store_true", help="try failed trials again, from their last checkpoint"
    )
    command.add_argument(
        "--rerun-damaged",
        action="store_true",
        help="run damaged trials again that were complete or had failed; others are by themselves",
    )
    command.add_argument(
        "--rerun-changed",
        action="store_true",
        help="run trials again that ran other code than is installed now; what they left is kept aside",
    )
    command.add_argument(
        "--max-concurrent",
        type=_at_least_one,
        metavar="N",
        help="trials at once, at most; by default as many as fit (or as the grid says)",
    )


def _add_tracking(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--tracking-uri",
        metavar="URI",
        help="an MLflow server (http://host:port) or database (sqlite:///file.db); "
        "by default one in the sweep's folder",
    )


def _folder(text: str) -> Path:
    from recrl.orchestrator.redaction import redacted  # noqa: PLC0415

    if "://" in text:  # trials append to their files and hold locks, which object stores know nothing of
        raise argparse.ArgumentTypeError(
            "must be a folder, on a file system that all nodes share where there are several; an object "
            f"store is given by --storage, got {redacted(text)!r}"
        )
    path = _path(text)
    try:
        files = [each for each in (path, *path.parents) if each.exists() and not each.is_dir()]
        if files and files[0] == path:
            raise argparse.ArgumentTypeError(f"must be a folder, got the file {text!r}")
        if files:
            raise argparse.ArgumentTypeError(
                f"must be a folder, but {str(files[0])!r} is a file, got {text!r}"
            )
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(_no_path(text, error)) from error
    return path


def _path(text: str) -> Path:
    if "\0" in text:
        raise argparse.ArgumentTypeError("must hold no NUL character")
    return Path(text)


def _no_path(text: str, error: OSError | ValueError) -> str:
    reason = getattr(error, "strerror", None) or error
    return f"cannot be used ({reason}), got {text[:60]!r}{'...' if len(text) > 60 else ''}"


def _zip_file(text: str) -> Path:
    """What export and merge write: all commands tell it from a sweep's name by its ending."""
    path = _path(text)
    try:
        if path.suffix != ".zip" or path.is_dir():
            raise argparse.ArgumentTypeError(f"must be a file that ends with .zip, got {text!r}")
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(_no_path(text, error)) from error
    return path


def _at_least_one(text: str) -> int:
    return _whole(text, least=1)


def _at_least_zero(text: str) -> int:
    return _whole(text, least=0)


def _port(text: str) -> int:
    return _whole(text, least=1, most=65535)


def _whole(text: str, *, least: int, most: int = 2**63 - 1) -> int:
    if not re.fullmatch(r"[+-]?[0-9]{1,20}", text):
        raise argparse.ArgumentTypeError(f"must be a whole number, written with digits only, got {text!r}")
    number = int(text)
    if not least <= number <= most:
        limit = f"at least {least}" if number < least else f"at most {most}"
        raise argparse.ArgumentTypeError(f"must be {limit}, got {number}")
    return number


def _cost(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"must be a finite number, got {text!r}")
    return number
