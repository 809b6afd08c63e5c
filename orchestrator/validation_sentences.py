"""Pydantic's errors as sentences, each with its place in a file.

A sentence has the allowed and the given value: ``must be at least 1, got 0``. An unknown key names the
nearest known one, or says where it belongs.
"""

from __future__ import annotations

import json
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from recrl.environments.plugins import nearest_name
from recrl.orchestrator.located_yaml import YamlPath

_SENTENCES: Mapping[str, str] = {
    "missing": "is required",
    "greater_than": "must be greater than {gt}, got {given}",
    "greater_than_equal": "must be at least {ge}, got {given}",
    "less_than": "must be less than {lt}, got {given}",
    "less_than_equal": "must be at most {le}, got {given}",
    "multiple_of": "must be a multiple of {multiple_of}, got {given}",
    "finite_number": "must be finite, got {given}",
    "int_type": "must be a whole number, got {given}",
    "int_parsing": "must be a whole number, got {given}",
    "int_from_float": "must be a whole number, got {given}",
    "float_type": "must be a number, got {given}",
    "float_parsing": "must be a number, got {given}",
    "bool_type": "must be true or false, got {given}",
    "bool_parsing": "must be true or false, got {given}",
    "string_type": "must be text, got {given}",
    "string_too_short": "must have at least {min_length} characters, got {given}",
    "string_too_long": "must have at most {max_length} characters, got {given}",
    "literal_error": "must be {expected}, got {given}",
    "enum": "must be {expected}, got {given}",
    "list_type": "must be a list, got {given}",
    "tuple_type": "must be a list, got {given}",
    "dict_type": "must be a mapping of settings, got {given}",
    "mapping_type": "must be a mapping of settings, got {given}",
    "model_type": "must be a mapping of settings, got {given}",
    "model_attributes_type": "must be a mapping of settings, got {given}",
    "too_short": "must have at least {min_length} entries, got {actual_length}",
    "too_long": "must have at most {max_length} entries, got {actual_length}",
    "value_error": "{error}",
    "assertion_error": "{error}",
}


_MEANT: Mapping[str, str] = {  # names that others have for a key
    "curricula": "methods",
    "algorithms": "agents",
    "environments": "tasks",
    "cost_limit": "deploy_limits",
    "cost_limits": "deploy_limits",
    "total_timesteps": "total_steps",
    "n_envs": "num_envs",
    "gamma": "discount",
    "gae_lambda": "reward_trace_decay",
    "hidden_size": "hidden_sizes",
}
_SECTIONS: Mapping[str, str] = {  # keys that are often put beside options
    "num_envs": "run",
    "rollout_steps": "run",
    "total_steps": "run",
    "deploy_fraction": "run",
    "evaluation_episodes": "run",
}


def sentences(error: ValidationError, model: type[BaseModel] | None) -> Iterator[tuple[YamlPath, str]]:
    """Return all mistakes as (place relative to the validated value, sentence).

    A required key that is misspelt is one mistake: the unknown key, not the missing one beside it.

    Args:
        error: pydantic's error.
        model: the class that was validated, to name the nearest known key; None if unknown.
    """
    items = error.errors(include_url=False)
    wrong = {item["loc"][:length] for item in items for length in range(len(item["loc"]))}
    unknown = [item["loc"] for item in items if item["type"] == "extra_forbidden"]
    meant = {(*it[:-1], _intended(str(it[-1]), known_keys(model, it[:-1]))) for it in unknown}
    for item in items:
        place, kind = item["loc"], item["type"]
        if kind == "missing" and place in meant:
            continue
        if kind == "too_short" and place in wrong:  # pydantic does not count its wrong entries
            continue
        if kind == "extra_forbidden":
            yield place, _unknown_key(str(place[-1]), known_keys(model, place[:-1]))
            continue
        values = {**item.get("ctx", {}), "given": as_written(item["input"])}
        if kind in _SENTENCES:
            yield place, _SENTENCES[kind].format(**values)
        else:
            yield place, f"{item['msg'][:1].lower()}{item['msg'][1:]}, got {values['given']}"


def ignored_keys(model: type[BaseModel], given: Mapping[str, Any]) -> Iterator[tuple[YamlPath, str]]:
    """Yield the keys that validation ignores, with a sentence, unless the model says what to do with them.

    Nested models are left out.

    Args:
        model: a class, possibly a user's.
        given: a value that it accepts.
    """
    if "extra" in model.model_config:
        return
    try:
        model.model_validate(dict(given), extra="forbid")
    except ValidationError as error:
        for item in error.errors(include_url=False):
            if item["type"] == "extra_forbidden" and len(item["loc"]) == 1:
                yield item["loc"], _unknown_key(str(item["loc"][0]), list(model.model_fields))


def known_keys(model: type[BaseModel] | None, place: YamlPath) -> list[str]:
    """Return the allowed keys at ``place`` inside a value of ``model``; [] if unknown."""
    for part in place:
        if model is None:
            return []
        if isinstance(part, str) and part in model.model_fields:
            model = model_in(model.model_fields[part].annotation)
    return list(model.model_fields) if model else []


def misspells(key: str, wanted: str, model: type[BaseModel]) -> bool:
    """Return whether a key is unknown to ``model``, and ``wanted`` is the nearest of its keys."""
    known = list(model.model_fields)
    return key not in known and _intended(key, known) == wanted


_PLACES = {  # where an unknown key may belong
    "options": "an option goes below options",
    "keywords": "an argument of the environment goes below keywords",
}


def as_written(value: Any) -> str:
    """Return a value as the user wrote it, cut to a readable length."""
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError):
        text = repr(value)
    if isinstance(value, str):
        text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _intended(key: str, known: list[str]) -> str | None:
    """Return the known key that an unknown one stands for; None if there is none."""
    meant = _MEANT.get(key)
    return meant if meant in known else nearest_name(key, known)


def _unknown_key(key: str, known: list[str]) -> str:
    if section := _SECTIONS.get(key):
        return f"unknown key; it belongs in the section {section!r} of the grid"
    if meant := _intended(key, known):
        return f"unknown key; did you mean {meant!r}?"
    names = f" (known: {', '.join(known)})" if known else ""
    hints = "".join(f"; {hint}" for place, hint in _PLACES.items() if place in known)
    return f"unknown key{names}{hints}"


def model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the pydantic model in an annotation: itself, in a list, optional or annotated."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in typing.get_args(annotation):
        found = model_in(argument)
        if found is not None:
            return found
    return None


class NotJsonError(Exception):
    """A value cannot be written as JSON."""


def require_json(value: Mapping[str, Any]) -> None:
    """Check that a mapping can be written as JSON.

    Raises:
        NotJsonError: it holds other values, or numbers that are not finite.
    """
    try:
        json.dumps(value, allow_nan=False)
    except ValueError as error:
        raise NotJsonError(str(error)) from error
