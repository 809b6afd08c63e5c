"""The prose of the documentation and the README: short sentences, and the words of the glossary."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.project.documentation import PAGES, ROOT, label

MOST_WORDS = 35  # of a sentence; aim at 25
TEXTS = [
    *PAGES,
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    ROOT / "CODE_OF_CONDUCT.md",
    ROOT / "README.md",
]
# Words of our own for which the field has a word; quotations stand in code spans and are not read.
BANNED = {
    r"dry way": "safe path",
    r"quick way": "unsafe shortcut",
    r"must-cross\b": "no zero-cost path exists",
    r"wide river|narrow river": "costly or cheap shortcut",
    r"at the optimum with": "solved",
    r"most probable actions": "deterministic policy",
    r"what it cost beside": "cumulative cost against bounds",
    r"a nat is worth": "entropy coefficient",
    r"cooled": "annealed",
    r"stands still": "no-op local optimum",
    r"lessons?\b": "curriculum output",
    r"poses\b": "joint one-hot state",
    r"promises to|believes": "predicted by the linear model; realised",
    r"cross-fitted": "held-out estimate",
    r"trace decays?\b": "GAE lambda",
    r"pictures\b": "frames",
    r"the peer\b": "safety-gymnasium",
    r"share of bare": "fraction of raw MuJoCo throughput",
    r"held against": "checked against",
    r"worlds\b": "environments",
    r"letters:": "Notation:",
    r"to be known": "Warnings",
    r"calm(ed|er|ly)?\b": "smaller dual step size",
    r"mended": "corrected",
    r"price of (a|the|its) (violation|cost|constraint)|its price\b|prices\b": "Lagrange multiplier",
    r"(?<!paper's )students?\b(?! of the (RECRL )?paper|'s t)": "agent",
}
# The paper's own word, explained beside it.
ALLOWED = {
    "docs/glossary.md": {"student"},
    "docs/explanation/recrl-in-five-minutes.md": {"student"},
}


def prose(text: str) -> str:
    """Paragraphs and list items; without tables, code, equations, link targets and directives."""
    text = re.sub(r"\A---\n.*?^---\n", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^(`{3,}|:{3,}).*?^\1\s*$", "\n", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"\$\$.*?\$\$", "\n", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"\{\w+\}`[^`]*`|`[^`]*`", "code", text)
    text = re.sub(r"\$[^$\n]+\$", "symbol", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    lines = [line for line in text.split("\n") if not line.lstrip().startswith("|")]
    return re.sub(r"^\s*([-*]|\d+\.)\s+|^#+\s.*$|^\s*:\s+", "\n", "\n".join(lines), flags=re.MULTILINE)


def sentences(text: str) -> list[str]:
    """The sentences of some Markdown."""
    paragraphs = re.split(r"\n\s*\n", prose(text))
    found = [
        re.split(r"(?<=[.!?:])\s+(?=[A-Z*(]|code\b|symbol\b)|;\s", " ".join(each.split()))
        for each in paragraphs
    ]
    return [sentence for each in found for sentence in each if sentence]


@pytest.mark.parametrize("page", TEXTS, ids=label)
def test_sentences_are_short(page: Path) -> None:
    long = [it for it in sentences(page.read_text(encoding="utf-8")) if len(it.split()) > MOST_WORDS]
    assert not long, f"more than {MOST_WORDS} words: {long}"


@pytest.mark.parametrize("page", TEXTS, ids=label)
def test_words_are_those_of_the_field(page: Path) -> None:
    text = prose(page.read_text(encoding="utf-8"))
    wrong = [
        f"{match[0]!r}: write {better!r}"
        for word, better in BANNED.items()
        for match in re.finditer(rf"\b(?:{word})", text, re.IGNORECASE)
        if match[0].lower() not in ALLOWED.get(label(page), ())
    ]
    assert not wrong


def test_sentences_are_counted_without_code_tables_and_links() -> None:
    text = "# Title\n\nOne `two three` four. Five\nsix [seven](eight.md).\n\n| nine |\n\n"
    text += "```sh\nten\n```\n- eleven\n"
    assert sentences(text) == ["One code four.", "Five six seven.", "eleven"]
