"""Remove passwords, tokens and control characters from texts.

Addresses carry secrets in three places: the user info (``scheme://user:password@host``,
``scheme://TOKEN@host``),
the query (``?password=...``) and the fragment. A password may contain an ``@``, a ``:`` or a ``/`` that
should have been encoded. If it is unclear, more is hidden rather than less.
"""

from __future__ import annotations

import io
import re
from typing import TextIO

HIDDEN = "***"

_ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(\S+)")
_WORDS = r"passw(?:or)?d|passphrase|pwd|token|secret|credential|signature|(?:api|access|account)[_-]?key"
_SETTING = re.compile(
    rf"(?i)((?:\b[\w.-]*(?:{_WORDS})[\w.-]*|(?<=[?&;])(?:auth|key|sig|sas))\s*=\s*)"
    r"(\"[^\"]*\"|'[^']*'|[^\s&;,#'\")]+)"
)
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[^:@]*)(:[0-9]{1,5})?")  # an authority without a secret
# In these schemes the part before the @ is the name of a container.
_CONTAINERS = frozenset(("abfs", "abfss", "wasb", "wasbs"))
_UNSEEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069\ufeff\ud800-\udfff]"
)


def redacted(text: str) -> str:
    """Return the text with the secrets in all addresses hidden.

    >>> redacted("postgresql://me:p@ss/word@host/mlflow?sslmode=require&password=secret")
    'postgresql://***@host/mlflow?sslmode=require&password=***'
    >>> redacted("cannot reach http://TOKEN@host:5000/api/2.0")
    'cannot reach http://***@host:5000/api/2.0'
    >>> redacted("s3://bucket/folder@2 and abfs://container@account.net/folder")
    's3://bucket/folder@2 and abfs://container@account.net/folder'
    """
    return _SETTING.sub(rf"\g<1>{HIDDEN}", _ADDRESS.sub(_without_user, text))


def _without_user(address: re.Match[str]) -> str:
    scheme, rest = address.groups()
    authority = re.split(r"[/?#]", rest, maxsplit=1)[0]
    container = scheme.lower() in _CONTAINERS and ":" not in authority.partition("@")[0]
    if container or "@" not in rest or _HOST.fullmatch(authority):  # otherwise a password may contain slashes
        return address[0]
    return f"{scheme}://{HIDDEN}{rest[rest.rindex('@') :]}"


def printable(text: str) -> str:
    r"""Return the text with control characters escaped.

    Line feeds and tabs stay.

    >>> printable("a\x1b[31mb")
    'a\\x1b[31mb'
    """
    return _UNSEEN.sub(lambda found: ascii(found[0])[1:-1], text)


def shown(text: str) -> str:
    """Return the text for display: without secrets and control characters."""
    return printable(redacted(text))


class RedactedStream(io.TextIOBase):
    """An output stream that hides secrets, also in tracebacks and output of other packages.

    Args:
        stream: the underlying stream.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write the text without secrets, a line at a time, as logs and tracebacks do."""
        self._stream.write(redacted(text))
        return len(text)

    def flush(self) -> None:
        """Write what is buffered."""
        self._stream.flush()

    def fileno(self) -> int:
        """File descriptor of the underlying stream."""
        return self._stream.fileno()
