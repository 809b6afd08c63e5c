"""Generate pages of the reference from the code, whenever the documentation is built.

    reference/generated/command-line.md   every command and option of recrl-sweep, from its parser
    reference/generated/grid-file.md      every key of a grid file
    reference/generated/agents.md         every option of every agent
    reference/generated/curricula.md      every option of every curriculum
    reference/generated/tasks.md          every option of every task
    reference/generated/presets.md        the options whose value differs between the presets

Options are fields of pydantic models, with name, type, default and description.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import presets
from pydantic import BaseModel
from sphinx.application import Sphinx

from recrl.agents.registry import AGENTS
from recrl.environments.plugins import load_attribute
from recrl.environments.registry import TASKS
from recrl.orchestrator.cli.arguments import parser
from recrl.orchestrator.grid.file_models import (
    REQUIRED,
    Entry,
    Exclusion,
    GridFile,
    Resources,
    Run,
    ShownDefault,
    TaskEntry,
)
from recrl.teachers.registry import TEACHERS

NOTE = "<!-- made from the code by docs/_ext/generated_reference.py; changes here are lost -->\n\n"
# Fields with validators of their own, whose types are not in the schema.
WRITTEN = {
    "train_limits": "`auto`, number, or list of numbers",
    "deploy_limits": "number, or list of numbers",
    "seeds": "whole number, or list of whole numbers",
    "custom_per_trial": "mapping of names to numbers",
    "tasks": "list of names or mappings",
    "agents": "list of names or mappings",
    "methods": "list of names or mappings",
    "name": "text",
}
BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
TYPES = {
    "integer": "whole number",
    "number": "number",
    "boolean": "true or false",
    "string": "text",
    "object": "mapping",
    "null": "null",
}
SHOWN_NAMES = 12


def pages() -> dict[str, str]:
    """Return every page by its file name."""
    return {
        "command-line.md": command_line(),
        "grid-file.md": grid_file(),
        "agents.md": agents(),
        "curricula.md": curricula(),
        "tasks.md": tasks(),
        "presets.md": presets_page(),
    }


# Command line ---------------------------------------------------------------------------------------------


def command_line() -> str:
    """Return the page of all commands with their options."""
    top = parser()
    (commands,) = (it for it in top._actions if isinstance(it, argparse._SubParsersAction))
    summaries = {it.dest: it.help or "" for it in commands._choices_actions}
    lines = [
        NOTE,
        "# Command line\n",
        f"{cell(top.description)}\n",
        "`recrl-sweep COMMAND --help` prints this.\n",
    ]
    lines += ["| command | what it does |", "|---|---|"]
    lines += [f"| [`{name}`](#recrl-sweep-{name}) | {cell(text)} |" for name, text in summaries.items()]
    for name, command in commands.choices.items():
        lines += [f"\n## recrl-sweep {name}\n", f"{cell(command.description)}\n", usage(command)]
        lines += [f"```console\n{(command.epilog or '').removeprefix('Example: ')}\n```\n"]
        lines += ["| argument | meaning |", "|---|---|", *map(argument, arguments_of(command))]
    return "\n".join(lines) + "\n"


def usage(command: argparse.ArgumentParser) -> str:
    """Return the usage line of a command."""
    text = " ".join(command.format_usage().removeprefix("usage: ").split())
    return f"```text\n{text}\n```\n"


def arguments_of(command: argparse.ArgumentParser) -> list[argparse.Action]:
    """Return a command's arguments, except ``--help``."""
    return [it for it in command._actions if not isinstance(it, argparse._HelpAction)]


def argument(action: argparse.Action) -> str:
    """Return one row of a command's table."""
    value = action.metavar or ("|".join(map(str, action.choices)) if action.choices else action.dest.upper())
    shown = value if isinstance(value, str) else " ".join(value)
    takes_none = action.nargs == 0
    if not action.option_strings:
        name = shown
    else:
        name = ", ".join(it if takes_none else f"{it} {shown}" for it in action.option_strings)
    return f"| `{name.replace('|', ' or ')}` | {cell(action.help).replace('%%', '%')} |"


# Options --------------------------------------------------------------------------------------------------


def grid_file() -> str:
    """Return the page of all keys of a grid file."""
    lines = [
        NOTE,
        "# Grid file\n",
        "A grid is a product: every task x agent x method x seed, less what `exclude` names.",
        "All mistakes are reported at once, each with its line. No trial starts before the file "
        "is correct.\n",
        "`recrl-sweep schema > recrl.schema.json` writes the JSON schema. With it editors that have the YAML "
        "language server complete keys, if the grid begins with the line "
        "`# yaml-language-server: $schema=recrl.schema.json`.\n",
        "## Top level\n",
        *option_table(GridFile),
        "\n## An entry of `tasks`\n",
        "A name, or a mapping with these keys. Its options are on the page [](tasks.md).\n",
        *option_table(TaskEntry),
        "\n## An entry of `agents` or `methods`\n",
        "A name, or a mapping with these keys. Options: [](agents.md), [](curricula.md).\n",
        *option_table(Entry),
        "\n## `run`\n",
        *option_table(Run),
        "\n## `resources`\n",
        "Results depend only on whether a trial learns on a GPU, and on the kind of it.\n",
        *option_table(Resources),
        "\n## An entry of `exclude`\n",
        "Trials that match everything given here are left out. A key takes one label or a list of labels.\n",
        *option_table(Exclusion),
    ]
    return "\n".join(lines) + "\n"


def agents() -> str:
    """Return the page of all agents' options: first the common ones."""
    models = {name: entry.config for name, entry in AGENTS.items()}
    shared = common_options(models.values())
    lines = [
        NOTE,
        "# Agents\n",
        "Options are given in a grid: `agents: [{name: ppo-lag, options: {...}}]`.\n",
    ]
    lines += ["| agent | what it is |", "|---|---|"]
    lines += [f"| [`{name}`](#{anchor(name)}) | {cell(entry.summary)} |" for name, entry in AGENTS.items()]
    first = next(iter(models.values()))
    lines += ["\n## Options of every agent\n", *option_table(first, only=shared)]
    for name, model in models.items():
        own = [it for it in model.model_fields if it not in shared]
        lines += [f"\n## {name}\n", f"{cell(AGENTS[name].summary)}\n", *option_table(model, only=own)]
    return "\n".join(lines) + "\n"


def curricula() -> str:
    """Return the page of all curricula's options."""
    lines = [
        NOTE,
        "# Curricula\n",
        "Options are given in a grid: `methods: [{name: dynamic, options: {...}}]`.\n",
    ]
    lines += ["| curriculum | what it does |", "|---|---|"]
    lines += [f"| [`{name}`](#{anchor(name)}) | {cell(kind.summary)} |" for name, kind in TEACHERS.items()]
    for name, kind in TEACHERS.items():
        lines += [f"\n## {name}\n", f"{cell(kind.summary)}\n", *option_table(kind.config)]
    return "\n".join(lines) + "\n"


def tasks() -> str:
    """Return the page of all tasks' options; tasks with the same options share a table."""
    families: dict[type[BaseModel], list[str]] = {}
    for name, task in TASKS.items():
        model = load_attribute(task.options) if isinstance(task.options, str) else task.options
        families.setdefault(model, []).append(name)
    lines = [
        NOTE,
        "# Tasks\n",
        "Options are given in a grid: `tasks: [{name: rivergrid-1a, options: {...}}]`.\n",
    ]
    lines += ["| task | what it is |", "|---|---|"]
    lines += [f"| `{name}` | {cell(task.summary)} |" for name, task in TASKS.items()]
    for model, names in families.items():
        shown = ", ".join(f"`{name}`" for name in names[:SHOWN_NAMES])
        more = f" and {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
        title = names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"
        lines += [f"\n## {title}\n", f"Options of {shown}{more}.\n", *option_table(model)]
    return "\n".join(lines) + "\n"


def presets_page() -> str:
    """Return the page of the presets."""
    return (
        f"{NOTE}# Presets\n\n`recommended` is every option's default. `preset: paper` sets the "
        "options below to the values of\nsafety-starter-agents, which the paper took over "
        "unchanged. For `focops`, `p3o`, `ipo` and `crpo` some values are those\nof their own papers. "
        "They assume rollouts of 30,000 steps, which the grid gives: "
        "`run: {num_envs: 30, rollout_steps: 1000}`. An option given together with `preset` overrides it. "
        "The table of options is complete.\n\n"
        f"{presets.table()}\n"
    )


def common_options(models: Iterable[type[BaseModel]]) -> list[str]:
    """Return the options that all models have, with the same default and description."""
    first, *others = models
    return [
        name
        for name, field in first.model_fields.items()
        if all(
            name in other.model_fields
            and other.model_fields[name].default == field.default
            and other.model_fields[name].description == field.description
            for other in others
        )
    ]


def option_table(model: type[BaseModel], *, only: Iterable[str] | None = None) -> list[str]:
    """Return the options of a model as rows of a Markdown table."""
    schema = model.model_json_schema()
    wanted = list(model.model_fields) if only is None else list(only)
    if not wanted:
        return ["It has no options of its own."]
    rows = ["| option | type | default | meaning |", "|---|---|---|---|"]
    for name in wanted:
        field, declared = schema["properties"][name], model.model_fields[name]
        shown = [it.text for it in declared.metadata if isinstance(it, ShownDefault)]
        default = REQUIRED if name in schema.get("required", ()) else default_text(field)
        rows.append(
            f"| `{name}` | {type_text(name, field, schema)} | {code(shown[0]) if shown else default} "
            f"| {cell(declared.description)} |"
        )
    return rows


def code(default: str) -> str:
    """Return a default as code, but the word that there is none as it is."""
    return default if default == REQUIRED else f"`{default}`"


def type_text(name: str, field: Mapping[str, Any], schema: Mapping[str, Any]) -> str:
    """Return the allowed values of an option, in words."""
    if name in WRITTEN and "enum" not in field:
        return WRITTEN[name]
    return words(field, schema)


def words(field: Mapping[str, Any], schema: Mapping[str, Any]) -> str:
    """Describe a JSON schema in words."""
    if "$ref" in field:
        return words(schema["$defs"][field["$ref"].rsplit("/", 1)[1]], schema)
    if "anyOf" in field:
        return " or ".join(words(each, schema) for each in field["anyOf"])
    if "const" in field or "enum" in field:
        return ", ".join(f"`{value}`" for value in field.get("enum", [field.get("const")]))
    if field.get("type") == "array":
        items = field.get("items") or next(iter(field.get("prefixItems", ())), {})
        return f"list of: {words(items, schema)}" if items else "list"
    bounds = " ".join(f"{sign} {field[key]:g}," for key, sign in BOUNDS.items() if key in field)
    return f"{TYPES.get(str(field.get('type')), 'any')} {bounds}".rstrip(" ,")


def default_text(field: Mapping[str, Any]) -> str:
    """Return an option's default; nothing for a mapping."""
    if "default" not in field or isinstance(field["default"], dict):
        return ""
    return code(json.dumps(field["default"]))


def cell(text: str | None) -> str:
    """Format text for a table: one line, with Markdown's special characters escaped."""
    line = " ".join((text or "").split())
    if re.match(r"[a-z]{2,}\b(?!_)", line):  # a symbol such as d_t or W does not change
        line = line[:1].upper() + line[1:]
    line = re.sub(r"([|<>*_\[\]$])", r"\\\1", line)
    return line if not line or line.endswith((".", "?", "!")) else f"{line}."


def anchor(name: str) -> str:
    """Return the anchor of a heading that is a name."""
    return re.sub(r"[^a-z0-9-]", "", name.lower())


def write_pages(app: Sphinx) -> None:
    """Write changed pages only, so that the others are not built again."""
    folder = Path(app.srcdir) / "reference" / "generated"
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
