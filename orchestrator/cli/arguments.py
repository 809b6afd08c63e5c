"""The arguments of ``recrl-sweep``: the parser, and its result as a typed request.

Imports almost nothing, so that ``--help`` is fast.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import re
from collections.abc import Mapping, Sequence
from typing import NoReturn

from recrl.orchestrator.cli import requests
from recrl.orchestrator.cli.argument_fields import Request
from recrl.orchestrator.cli.requests import VIDEOS
from recrl.orchestrator.grid.only_selection import number_of_pairs

DESCRIPTION = """\
Run constrained reinforcement learning under cost-limit curricula: every task x agent x method x seed of a
grid file, on all cores or a Ray cluster. Interrupted sweeps resume exactly."""

EPILOG = """\
A first sweep:
  recrl-sweep init                        write demo.yaml, a grid file with comments
  recrl-sweep validate demo.yaml          check the file; mistakes have their lines
  recrl-sweep plan demo.yaml --measure    show the trials, and estimates of time and memory
  recrl-sweep launch demo.yaml            run it, show progress, draw figures, print results
  recrl-sweep ui demo                     open it in MLflow

Reference:
  recrl-sweep list tasks                  also: agents, curricula
  recrl-sweep options cpo                 all options of a task, an agent or a curriculum
  recrl-sweep schema                      the grid file's JSON schema, for editors

Later:
  recrl-sweep status demo                 from any terminal, whether it runs or not
  recrl-sweep launch demo.yaml            after a crash, Ctrl-C or with more seeds: the same command; complete
                                          trials are kept, others continue from their last checkpoint
  recrl-sweep stop demo                   from another terminal: trials save their state, the launch ends
  recrl-sweep logs demo 3f2a --follow     a trial's log, by the beginning of its id or title
  recrl-sweep evaluate demo 3f2a --video  evaluate its policy again, and film an episode
  recrl-sweep check demo                  check all files against their digests
  recrl-sweep bound demo                  compare the cost of training with its theoretical bounds
  recrl-sweep replay demo --teacher dynamic --option window=8
                                          the limits that another curriculum would have set
  recrl-sweep launch demo.yaml --retry-failed
  recrl-sweep launch demo.yaml --only method=dynamic task=rivergrid-1b
  recrl-sweep launch demo.yaml --address auto --storage s3://bucket/folder
  recrl-sweep status demo --storage s3://bucket/folder     from any machine with credentials

Exit codes:
  0    done, or nothing to do
  1    some trials failed, are damaged or could not be finished; evaluate: some were left out
  2    the grid or the arguments are wrong; nothing was started
  3    another process is running this sweep
  4    Ray, MLflow or the storage could not be reached, or files could not be written
  5    plan --check: trials are left to run, or come from other code
  130  stopped by Ctrl-C or SIGTERM; the same launch continues"""

# Each command and the function that does it, in the order of the help. The function's module is imported when
# it is needed.
COMMANDS: Mapping[type[Request], str] = {
    requests.InitRequest: "init:run_init",
    requests.ListRequest: "catalogue:run_list",
    requests.OptionsRequest: "catalogue:run_options",
    requests.SchemaRequest: "catalogue:run_schema",
    requests.ValidateRequest: "plan:run_validate",
    requests.PlanRequest: "plan:run_plan",
    requests.LaunchRequest: "launch:run_launch",
    requests.StatusRequest: "status:run_status",
    requests.CheckRequest: "status:run_check",
    requests.StopRequest: "status:run_stop",
    requests.LogsRequest: "status:run_logs",
    requests.EvaluateRequest: "evaluate:run_evaluate",
    requests.FiguresRequest: "results:run_figures",
    requests.ExportRequest: "results:run_export",
    requests.MergeRequest: "results:run_merge",
    requests.BoundRequest: "curricula:run_bound",
    requests.ReplayRequest: "curricula:run_replay",
    requests.UIRequest: "tracking:run_ui",
    requests.SyncRequest: "tracking:run_sync",
}
_CHOICE = re.compile(r"invalid choice: '(.*)' \(choose from (.*)\)")  # argparse's own sentences
_UNKNOWN = re.compile(r"unrecognized arguments: (--[\w-]+).*")
LISTS = ("--only", "--option")  # each takes several KEY=VALUE
LONGEST_LINE = 1000  # characters of an error


def readable(sentence: str) -> str:
    """Return a sentence for display: passwords hidden, long lines cut."""
    from recrl.orchestrator.redaction import shown  # noqa: PLC0415  (--help is to be quick)

    lines = shown(sentence).split("\n")
    return "\n".join(line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]}..." for line in lines)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Say what is wrong with the arguments, which may hold a password, and what was meant, and exit."""
        super().error(readable(f"{message}{self._hint(message)}"))

    def _hint(self, message: str) -> str:
        from recrl.environments.plugins import nearest  # noqa: PLC0415  (--help is to be quick)

        if choice := _CHOICE.search(message):
            return nearest(choice[1], re.findall(r"[\w.-]+", choice[2]))
        if unknown := _UNKNOWN.fullmatch(message):
            return nearest(unknown[1], list(self._option_string_actions))
        return f"; see {self.prog} --help" if "required" in message else ""


def parse(given: Sequence[str]) -> Request:
    """Parse arguments to a request.

    Raises:
        SystemExit: they are wrong, or contain ``--help``.
    """
    parsed, unknown = parser().parse_known_args(spread(given))
    if unknown:
        parsed.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    parsed.given = tuple(given)
    request: Request = parsed.request.of(parsed)
    return request


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    top = _Parser(
        prog="recrl-sweep",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"recrl {importlib.metadata.version('recrl')}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for request in COMMANDS:
        name, summary = request.__name__.removesuffix("Request").lower(), request.__doc__ or ""
        short = summary[:1].lower() + summary[1:].removesuffix(".")
        command = commands.add_parser(
            name, help=short, description=summary, epilog=f"Example: {request.example}"
        )
        command.set_defaults(request=request, parser=command)
        request.add_to(command)
    return top


def spread(given: Sequence[str]) -> list[str]:
    """Return the arguments with lists split, so that no list includes the grid file or sweep after it.

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
            pairs = [rest.pop(0) for _ in range(number_of_pairs(rest))]
            plain += [it for pair in pairs for it in (argument, pair)]
        else:
            plain.append(argument)
    return plain
