"""The pages of the documentation as tests read them: their fences and their prose."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
GENERATED = DOCS / "reference" / "generated"
PAGES = sorted(page for page in DOCS.rglob("*.md") if GENERATED not in page.parents)
README = ROOT / "README.md"
FENCE = re.compile(
    r"^(?P<ticks>`{3,}|:{3,})(?P<info>[^\n]*)\n(?P<body>.*?)^(?P=ticks)\s*$", re.DOTALL | re.MULTILINE
)
CAPTION = re.compile(r"\A(?::[\w-]+:[^\n]*\n)*?:caption: (?P<name>\S+)\n")
OPTIONS = re.compile(r"\A(?::[\w-]+:[^\n]*\n)+\n?")


@dataclass(frozen=True)
class Fence:
    """A fenced block.

    Attributes:
        language: ``shell``, ``yaml``, ... also of a ``code-block`` directive.
        caption: the file that it is to be saved as, or empty.
        text: its content.
    """

    language: str
    caption: str
    text: str


def fences(page: Path) -> list[Fence]:
    """The fenced blocks of a page, in order."""
    found = []
    for match in FENCE.finditer(page.read_text(encoding="utf-8")):
        info, body = match["info"].strip(), match["body"]
        caption = CAPTION.match(body)
        language = info.removeprefix("{code-block}").strip()
        found.append(Fence(language, caption["name"] if caption else "", OPTIONS.sub("", body)))
    return found


def label(page: Path) -> str:
    """A page's name in a test."""
    return str(page.relative_to(ROOT))
