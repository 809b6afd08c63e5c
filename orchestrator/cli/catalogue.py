"""``list``, ``options`` and ``schema``: the names and options that a grid file may use."""

from __future__ import annotations

import json

from rich.console import Console

from recrl.environments.plugins import UntrustedNameError
from recrl.orchestrator.cli import display
from recrl.orchestrator.cli.output import say
from recrl.orchestrator.cli.requests import ListRequest, OptionsRequest, SchemaRequest
from recrl.orchestrator.errors import USERS_ERRORS, RecrlError, described
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.grid.catalogue import KINDS, Kind, kinds_of, listed, options_of
from recrl.orchestrator.grid.json_schema import grid_schema


def run_list(request: ListRequest, console: Console) -> ExitCode:
    """List the tasks, agents or curricula, each with its summary."""
    kind = KINDS["curricula" if request.kind == "methods" else request.kind]
    console.print(display.text_table([kind.singular, "summary"], listed(kind)))
    say(console, f"\nOptions of one: recrl-sweep options {kind.ours[0]}")
    return ExitCode.OK


def run_options(request: OptionsRequest, console: Console) -> ExitCode:
    """List the options of a task, an agent or a curriculum."""
    for kind in _kinds(request.name):
        say(console, f"{request.name}, in a grid's {kind.section}: {kind.summary(request.name)}\n")
        options = options_of(kind, request.name)
        rows = [(it.name, it.type, it.default, it.description) for it in options]
        if rows:
            columns = ("option", "type", "default", "description")
            console.print(display.folded_table(columns, rows, width=console.width))
        else:
            say(console, "It has no options that recrl knows of.")
    return ExitCode.OK


def _kinds(name: str) -> list[Kind]:
    try:
        return kinds_of(name)
    except UntrustedNameError as error:
        raise RecrlError(f"{error}; if you trust it, add --trust") from error
    except RecrlError:
        raise
    except USERS_ERRORS as error:
        raise RecrlError(f"{name} cannot be used: {described(error)}") from error


def run_schema(request: SchemaRequest, console: Console) -> ExitCode:
    """Print the JSON schema of grid files."""
    say(console, json.dumps(grid_schema(), indent=1, ensure_ascii=False))
    return ExitCode.OK
