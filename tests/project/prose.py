"""Prose as tests read it: its sentences, and words for which the field has others."""

from __future__ import annotations

import re
from collections.abc import Iterator

# Words of our own, and what to write; quotations stand in code spans and are not read.
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
    r"promises?\b|promises to|believes": "predicted by the linear model; realised",
    r"cross-fitted": "held-out estimate",
    r"trace decays?\b": "GAE lambda",
    r"pictures?\b": "frame or image",
    r"the peer\b": "safety-gymnasium",
    r"share of bare": "fraction of raw MuJoCo throughput",
    r"held (against|to)\b": "checked against",
    r"(?<!grid )worlds?\b(?!('s)? (frame|y axis))": "environment",
    r"letters:": "Notation:",
    r"to be known": "Warnings",
    r"calm(ed|er|ly)?\b": "smaller dual step size",
    r"mended": "corrected",
    r"prices?\b": "Lagrange multiplier",
    r"(?<!paper's )students?\b(?!'s| of the (RECRL )?paper)": "agent",
    r"mirror(s|ed)?\b": "MLflow sync, or local copy",
    r"nobody|no one\b": "the passive, or who does not",
    r"whoever|somebody\b": "the caller, the user, another process",
    r"so many\b|as many as it\b": "the number itself",
    r"(is|are|was|were) told\b|tells? (us|apart)\b": "receives, is given",
    r"what is left\b": "the rest, or its name",
    r"by hand\b": "manually",
    r"(the )?one that\b|those of (it|them)\b|one's own\b": "the noun itself",
    r"at all\b(?! times)": "nothing",
    r"for ever\b": "without end",
    r"once and for all\b|all the while\b|whatever (it|they) (is|are)\b": "always",
    r"asked? of\b|heard of\b|a word of\b": "a plain verb",
}


def sentences(text: str) -> list[str]:
    """The sentences of a paragraph."""
    text = re.sub(r"\{\w+\}`[^`]*`|``[^`]*``|`[^`]*`", "code", text)
    text = re.sub(r'"[^"]{60,}"', "quotation", text)
    found = re.split(
        r"(?<=[.!?:])\s+(?=[A-Z*(]|code\b|symbol\b)|(?<!\bal)(?<=[.!?])\s+(?=[a-z])|;\s",
        " ".join(text.split()),
    )
    return [it for it in found if it]


def line_of(source: str, sentence: str) -> int:
    """The line of a source on which a sentence begins, by as many of its words as are found; 1 if none is."""
    words = sentence.split()
    for number in range(len(words), 0, -1):
        found = re.search(r"\W+".join(map(re.escape, words[:number])), source)
        if found:
            return source.count("\n", 0, found.start()) + 1
    return 1


def misnamed(text: str) -> Iterator[str]:
    """The banned words of a text, each with what to write."""
    for sentence in sentences(text):
        for word, better in BANNED.items():
            for match in re.finditer(rf"\b(?:{word})", sentence, re.IGNORECASE):
                yield f"{match[0]!r}: write {better!r}: {sentence}"
