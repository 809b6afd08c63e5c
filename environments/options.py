"""The base of all options that a grid gives to a task, an agent or a curriculum, and how they are read."""

from __future__ import annotations

from collections.abc import Mapping
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


def validated(model: type[BaseModel], options: Mapping[str, Any]) -> BaseModel:
    """Return options as an instance of a model, also of a user's; its ``model_dump`` has the defaults.

    A key that is no field is a mistake, unless the model allows extra keys. Pydantic alone would ignore it.

    Raises:
        TypeError: the model is no pydantic model.
        pydantic.ValidationError: all mistakes in the options at once.
    """
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        raise TypeError(f"the options must have a pydantic model, a subclass of BaseModel, got {model!r}")
    allows_more = model.model_config.get("extra") == "allow"
    return model.model_validate(dict(options), extra=None if allows_more else "forbid")
