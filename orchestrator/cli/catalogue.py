"""``list``, ``options`` and ``schema``: the names and options that a grid file may use."""

from __future__ import annotations

import json

from pydantic import BaseModel
from rich.console import Console

from recrl.environments.plugins import UntrustedNameError
from recrl.orchestrator.cli import display
from recrl.orchestrator.cli.output import print_table, say
from recrl.orchestrator.cli.requests import ListRequest, OptionsRequest, SchemaRequest
from recrl.orchestrator.errors import TRUST_HINT, USERS_ERRORS, RecrlError, described
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.grid.catalogue import KINDS, LISTS, SECTIONS, Kind, kinds_of, listed, options_of
from recrl.orchestrator.grid.json_schema import grid_schema


def run_list(request: ListRequest, console: Console) -> ExitCode:
    """List the tasks, agents or curricula, each with its summary."""
    kind = KINDS["curricula" if request.kind == "methods" else request.kind]
    print_table(display.text_table([kind.singular, "summary"], listed(kind)), console)
    say(console, f"\nOptions of one: recrl-sweep options {kind.ours[0]}")
    return ExitCode.OK


def run_options(request: OptionsRequest, console: Console) -> ExitCode:
    """List the options of a task, an agent, a curriculum or a section of the grid."""
    name = request.name
    if name in SECTIONS:
        where = "at a grid's top level, or at a task" if name == "limits" else "a section of a grid"
        say(console, f"{name}, {where}: {SECTIONS[name].__doc__}\n")
        _print_options(SECTIONS[name], console)
        return ExitCode.OK
    if name in LISTS:
        kind = next(it for it in KINDS.values() if it.section == name)
        say(
            console,
            f"{name}, a section of a grid: a list; each entry is a name, or a mapping with these keys. "
            f"Names: recrl-sweep list {kind.plural}; options of one: recrl-sweep options {kind.ours[0]}\n",
        )
        _print_options(LISTS[name], console)
        return ExitCode.OK
    for kind in _kinds(name):
        say(console, f"{name}, in a grid's {kind.section}: {kind.summary(name)}\n")
        _print_options(kind.model(name), console)
    return ExitCode.OK


def _print_options(model: type[BaseModel], console: Console) -> None:
    rows = [(it.name, it.type, it.default, it.description) for it in options_of(model)]
    if rows:
        columns = ("option", "type", "default", "description")
        console.print(display.folded_table(columns, rows, width=console.width))
    else:
        takes_any = model.model_config.get("extra") == "allow"
        say(console, "Its options are these keyword arguments." if takes_any else "It has no options.")


def _kinds(name: str) -> list[Kind]:
    try:
        return kinds_of(name)
    except UntrustedNameError as error:
        raise RecrlError(f"{error}; {TRUST_HINT}") from error
    except RecrlError:
        raise
    except USERS_ERRORS as error:
        raise RecrlError(f"{name} cannot be used: {described(error)}") from error


def run_schema(request: SchemaRequest, console: Console) -> ExitCode:
    """Print the JSON schema of grid files."""
    say(console, json.dumps(grid_schema(), indent=1, ensure_ascii=False))
    return ExitCode.OK
