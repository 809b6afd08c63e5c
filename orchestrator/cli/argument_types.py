"""Types of command-line arguments: folders, files, addresses and numbers.

Other values are an error of one sentence.
"""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path


def folder(text: str) -> Path:
    """A path that is a folder, or can become one."""
    from recrl.orchestrator.redaction import redacted  # noqa: PLC0415

    if "://" in text:  # trials append to files and lock them, which object stores do not support
        raise argparse.ArgumentTypeError(
            "must be a folder, on a file system that all nodes share where there are several; an object "
            f"store is given by --storage, got {redacted(text)!r}"
        )
    path = path_of(text)
    try:
        files = [each for each in (path, *path.parents) if each.exists() and not each.is_dir()]
        if files and files[0] == path:
            raise argparse.ArgumentTypeError(f"must be a folder, got the file {text!r}")
        if files:
            raise argparse.ArgumentTypeError(
                f"must be a folder, but {str(files[0])!r} is a file, got {text!r}"
            )
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(_nopath_of(text, error)) from error
    return path


def not_empty(text: str) -> str:
    """Any text but an empty one, which an unset variable of a shell leaves."""
    if not text.strip():
        raise argparse.ArgumentTypeError("must not be empty; leave it out, or check the shell's variable")
    return text


def path_of(text: str) -> Path:
    """A path that the system accepts, and that is not empty."""
    not_empty(text)
    if "\0" in text:
        raise argparse.ArgumentTypeError("must hold no NUL character")
    return Path(text)


def _nopath_of(text: str, error: OSError | ValueError) -> str:
    reason = getattr(error, "strerror", None) or error
    return f"cannot be used ({reason}), got {text[:60]!r}{'...' if len(text) > 60 else ''}"


def zip_file(text: str) -> Path:
    """A file that ends with ``.zip``, which distinguishes it from a sweep's name."""
    path = path_of(text)
    try:
        if path.suffix != ".zip" or path.is_dir():
            raise argparse.ArgumentTypeError(f"must be a file that ends with .zip, got {text!r}")
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(_nopath_of(text, error)) from error
    return path


def at_least_one(text: str) -> int:
    """An integer of at least 1."""
    return _whole(text, least=1)


def at_least_zero(text: str) -> int:
    """An integer of at least 0."""
    return _whole(text, least=0)


def port(text: str) -> int:
    """A port number."""
    return _whole(text, least=1, most=65535)


def _whole(text: str, *, least: int, most: int = 2**63 - 1) -> int:
    if not re.fullmatch(r"[+-]?[0-9]{1,20}", text):
        raise argparse.ArgumentTypeError(f"must be a whole number, written with digits only, got {text!r}")
    number = int(text)
    if not least <= number <= most:
        limit = f"at least {least}" if number < least else f"at most {most}"
        raise argparse.ArgumentTypeError(f"must be {limit}, got {number}")
    return number


def cost(text: str) -> float:
    """A finite number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"must be a finite number, got {text!r}")
    return number
