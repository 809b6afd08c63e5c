"""A JSON schema of grid files, for completion and checks in editors.

It has the names and options of recrl's own tasks, agents and curricula. ``read_grid`` also checks rules that
a schema cannot express.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaMode, models_json_schema

from recrl.environments.plugins import IMPORT_PATH
from recrl.orchestrator.grid.catalogue import KINDS, Kind
from recrl.orchestrator.grid.file_models import GridFile

DIALECT = "https://json-schema.org/draft/2020-12/schema"
MODE: JsonSchemaMode = "validation"


class _Lenient(GenerateJsonSchema):
    """Schema generator that accepts anything where only Python code can check the value."""

    def handle_invalid_for_json_schema(self, schema: Any, error_info: str) -> dict[str, Any]:
        """No restriction."""
        return {}


def grid_schema() -> dict[str, Any]:
    """Return the schema as JSON values."""
    models = {(kind.plural, name): kind.model(name) for kind in KINDS.values() for name in kind.ours}
    distinct: dict[type[BaseModel], None] = dict.fromkeys((GridFile, *models.values()))
    inputs = [(model, MODE) for model in distinct]
    references, rest = models_json_schema(inputs, schema_generator=_Lenient)
    definitions = rest["$defs"]
    grid = definitions.pop("GridFile")
    for kind in KINDS.values():
        entry = "TaskEntry" if kind.plural == "tasks" else "Entry"
        options = {name: references[models[kind.plural, name], MODE] for name in kind.ours}
        definitions[kind.singular] = _entry(kind, definitions[entry], options)
        grid["properties"][kind.section]["items"] = {"$ref": f"#/$defs/{kind.singular}"}
    return {"$schema": DIALECT, **grid, "title": "recrl grid file", "$defs": definitions}


def _entry(kind: Kind, mapping: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """Schema of a name alone, or a mapping with a name and its options."""
    name = {
        "anyOf": [
            {"enum": kind.names},
            {"type": "string", "pattern": f"^{IMPORT_PATH.pattern}$"},
        ],
        "description": f"A {kind.singular}, or the import path package.module:attribute of one.",
    }
    chosen = [
        {
            "if": {"properties": {"name": {"const": each}}, "required": ["name"]},
            "then": {"properties": {"options": schema}},
        }
        for each, schema in options.items()
    ]
    full = {**mapping, "properties": {**mapping["properties"], "name": name}, "allOf": chosen}
    return {"anyOf": [name, full]}
