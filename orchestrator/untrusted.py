"""Checks of files from untrusted sources, before any use.

Names become names of folders or files, and labels become titles, so both must follow the rules of grids.
Everything is checked at once, so that later code can rely on the types.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from recrl.orchestrator.redaction import printable
from recrl.orchestrator.validation import as_written, sentences

LONGEST_NAME = 200
_NAME = re.compile(r"[^\W_.-][^/\\\x00-\x1f]{0,127}")


def checked_name(value: Any) -> str:
    """Return a sweep's name if it can name a folder: one part of a path, without separators.

    Raises:
        ValueError: it cannot.

    >>> checked_name("demo")
    'demo'
    """
    if not isinstance(value, str) or not _NAME.fullmatch(value) or printable(value) != value:
        raise ValueError(f"the sweep's name must be a name for a folder, got {as_written(value)}")
    return value


def plain_text(text: str) -> str:
    """Return a name or a label if it has no control characters.

    Raises:
        ValueError: it holds control characters.
    """
    if printable(text) != text or "\n" in text or "\t" in text:
        raise ValueError(f"must hold no control characters, got {text!a}")
    return text


def _limits(values: list[float | str]) -> list[float | str]:
    for value in values:
        if not (value == "inf" or (isinstance(value, float | int) and math.isfinite(value) and value >= 0)):
            raise ValueError(f"must be numbers of at least 0, or 'inf', got {as_written(value)}")
    return values


PlainText = Annotated[str, AfterValidator(plain_text)]
ShortText = Annotated[PlainText, Field(min_length=1, max_length=LONGEST_NAME)]
LimitValues = Annotated[list[float | str], Field(min_length=1, max_length=64), AfterValidator(_limits)]
Steps = Annotated[int, Field(ge=0, le=10**13)]


class _Written(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


class _Choice(_Written):
    name: ShortText
    options: dict[str, Any]
    label: ShortText


class SpecFile(_Written):
    """A TrialSpec as JSON values."""

    task: _Choice
    agent: _Choice
    method: _Choice
    train_limits: LimitValues
    deploy_limits: LimitValues
    train_steps: Annotated[int, Field(ge=1, le=10**13)]
    deploy_steps: Steps
    num_envs: Annotated[int, Field(ge=1, le=10**6)]
    rollout_steps: Annotated[int, Field(ge=1, le=10**9)]
    evaluation_episodes: Annotated[int, Field(ge=0, le=10**9)]
    seed: Annotated[int, Field(ge=0, lt=2**63)]


_SPEC = TypeAdapter(SpecFile)


def checked_spec(value: Any) -> Mapping[str, Any]:
    """Return the unchanged JSON value of a TrialSpec, if it is valid.

    Raises:
        ValueError: it is invalid; the message is one line with the first mistake.
    """
    try:
        _SPEC.validate_python(value)
    except ValidationError as error:
        place, sentence = next(sentences(error, None))
        raise ValueError(f"{'.'.join(map(str, place)) or 'the spec'}: {sentence}") from error
    if len(value["train_limits"]) != len(value["deploy_limits"]):
        raise ValueError("train_limits and deploy_limits: must have the same length")
    checked: Mapping[str, Any] = value
    return checked
