"""Checks of files from untrusted sources, before any use.

Names become names of folders or files, and labels become titles, so both must follow the rules of grids.
Everything is checked at once, so that later code can rely on the types.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping
from typing import Annotated, Any, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, create_model

from recrl.orchestrator.redaction import printable
from recrl.orchestrator.validation_sentences import as_written, sentences

LONGEST_NAME = 200
_NAME = re.compile(r"[^\W_.-][^/\\\x00-\x1f]{0,127}")


def check_name(value: Any) -> None:
    """Check that a sweep's name can name a folder: one part of a path, without separators.

    Raises:
        ValueError: it cannot.
    """
    if not isinstance(value, str) or not _NAME.fullmatch(value) or printable(value) != value:
        raise ValueError(
            "the sweep's name must be a name for a folder that begins with a letter or a digit, "
            f"got {as_written(value)}"
        )


def plain_text(text: str) -> str:
    """Return a name or a label if it has no control characters.

    Raises:
        ValueError: it holds control characters.
    """
    if printable(text) != text or "\n" in text or "\t" in text:
        raise ValueError(f"must hold no control characters, got {text!a}")
    return text


def as_seen(text: str) -> str:
    r"""Return a label as a reader sees it: composed, with single spaces, without zero-width characters.

    Left out is Unicode's category Cf, which has most of them.

    >>> as_seen("none\u200b ") == as_seen("none"), as_seen(" \u200b")
    (True, '')
    """
    visible = "".join(it for it in unicodedata.normalize("NFC", text) if unicodedata.category(it) != "Cf")
    return " ".join(visible.split())


def _limits(values: list[float | str]) -> list[float | str]:
    for value in values:
        if not (value == "inf" or (isinstance(value, float | int) and math.isfinite(value) and value >= 0)):
            raise ValueError(f"must be numbers of at least 0, or 'inf', got {as_written(value)}")
    return values


PlainText = Annotated[str, AfterValidator(plain_text)]
ShortText = Annotated[PlainText, Field(min_length=1, max_length=LONGEST_NAME)]
LimitValues = Annotated[list[float | str], Field(min_length=1, max_length=64), AfterValidator(_limits)]


class _Written(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


class ChoiceFile(_Written):
    """A task, agent or curriculum as JSON values."""

    name: ShortText
    options: dict[str, Any]
    label: ShortText


def file_model(of: type, written: Mapping[Any, Any]) -> type[BaseModel]:
    """Return the model of a dataclass as JSON values.

    Args:
        of: the dataclass; its fields' annotations may contain bounds.
        written: the JSON form of each type of field that is no JSON value itself.
    """
    hints = get_type_hints(of, include_extras=True)
    fields: dict[str, Any] = {name: (written.get(hint, hint), ...) for name, hint in hints.items()}
    return create_model(f"{of.__name__}File", __base__=_Written, **fields)


def check_json(value: Any, model: type[BaseModel]) -> None:
    """Check a JSON value against a model.

    Raises:
        ValueError: it is invalid; the message is one line with the first mistake.
    """
    try:
        model.model_validate(value)
    except ValidationError as error:
        place, sentence = next(sentences(error, None))
        raise ValueError(f"{'.'.join(map(str, place)) or 'the spec'}: {sentence}") from error
