"""``init``: write a commented grid file; existing files are never overwritten."""

from __future__ import annotations

import shlex
from importlib.resources import files
from pathlib import Path

from rich.console import Console

from recrl.orchestrator.cli.output import say
from recrl.orchestrator.cli.requests import InitRequest
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.exit_codes import ExitCode

OWN_TASK = "own-task"
MODULE = "my_task.py"


def run_init(request: InitRequest, console: Console) -> ExitCode:
    """Write the template, and print the next command."""
    grid = request.file or Path(f"{request.template}.yaml")
    if grid.suffix not in (".yaml", ".yml"):
        raise RecrlError(f"{grid}: the name of a grid file must end with .yaml")
    called, first = str(grid), ""
    # its module is imported from the current folder
    if request.template == OWN_TASK and grid.parent != Path():
        called, first = grid.name, f"{shlex.join(['cd', str(grid.parent)])} && "
    texts = {grid: _template(f"{request.template}.yaml").replace(f"{request.template}.yaml", called)}
    if request.template == OWN_TASK:
        texts[grid.with_name(MODULE)] = _template(f"{MODULE}.txt")
    for path in texts:
        if path.exists():
            raise RecrlError(f"{path}: exists already and is not overwritten; give another name or folder")
    grid.parent.mkdir(parents=True, exist_ok=True)
    for path, text in texts.items():
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
        say(console, f"Wrote {path}")
    say(console, f"Next: {first}{shlex.join(['recrl-sweep', 'launch', called])}")
    return ExitCode.OK


def _template(name: str) -> str:
    return (files("recrl.orchestrator.cli") / "templates" / name).read_text(encoding="utf-8")
