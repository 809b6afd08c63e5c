"""The base of all options that a grid gives to a task, an agent or a curriculum."""

from __future__ import annotations

from typing import Any, get_args

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator


class Options(BaseModel):
    """Options of one task, agent or curriculum: immutable, and an unknown one is an error.

    ``true`` and ``false`` are not taken for the numbers 1 and 0.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    @field_validator("*", mode="before")
    @classmethod
    def _truth_values_are_no_numbers(cls, value: Any, info: ValidationInfo) -> Any:
        values = value if isinstance(value, list | tuple) else [value]
        given = [each for each in values if isinstance(each, bool)]
        if given and info.field_name and _is_numeric(cls.model_fields[info.field_name].annotation):
            raise ValueError(f"must be a number, got {str(given[0]).lower()}")
        return value


def _is_numeric(annotation: Any) -> bool:
    """Whether a type has numbers, and neither truth values nor anything."""
    parts = list(_parts(annotation))
    return bool({int, float} & set(parts)) and bool not in parts and Any not in parts


def _parts(annotation: Any) -> list[Any]:
    """The types of which a type is made."""
    arguments = get_args(annotation)
    return [part for each in arguments for part in _parts(each)] if arguments else [annotation]


def require_model(config: object) -> None:
    """Check that an entry of a registry, possibly a user's, has a model of options.

    Raises:
        TypeError: it is no pydantic model.
    """
    if not (isinstance(config, type) and issubclass(config, BaseModel)):
        raise TypeError(f"options need a pydantic model, a subclass of BaseModel, got {config!r}")
