"""Every measured number in the README is in a file under results/ that its section names.

A section names files in links and in code spans; a folder stands for the tables and logs in it. A number is
there if some number in such a file is equal to it at the digits that the README gives. Numbers that are no
measurements (limits, sizes, versions, optima of the maps) are listed below, each with what it is.
"""

import math
import re
from pathlib import Path

import pandas as pd
import pytest

from recrl.analysis.statistics.verdicts import solved
from tests.project.documentation import ROOT

README = (ROOT / "README.md").read_text()
CLAIMS = (ROOT / "docs/experiments/rivergrid-claims.md").read_text()
TABLES = (".csv", ".txt")

# Sections that tell how to use it, not what was measured.
MANUAL = {"Install", "Quickstart", "The same in Python", "What there is", "Documentation", "Citing"}
# No measurements: "number": what it is.
DEFINITIONS = {
    "": {"2024": "a year"},
    "What was found": {
        "2e6": "steps of a trial",
        "22.5": "a limit",
        "1e7": "steps of a published run",
        "120": "a count, see test_the_table_of_rivergrid_is_counted",
        "0.21": "a p-value, likewise",
    },
}
NUMBER = re.compile(r"(?<![\w.,/-])-?\d[\d,]*(?:\.\d+)*(?:e-?\d+)?%?(?![\w/-])")
MEASURED = re.compile(r"[.%,e]|\d{3}")  # small whole numbers are mostly counts of things


def sections() -> dict[str, str]:
    """The README's sections by title; what comes before the first has the title ""."""
    title, found = "", {"": ""}
    for line in README.split("\n"):
        if line.startswith("## "):
            title = line.removeprefix("## ")
            found[title] = ""
        else:
            found[title] += line + "\n"
    return found


def prose(text: str) -> str:
    """Without code blocks, code spans, link targets and pictures."""
    text = re.sub(r"^```.*?^```", " ", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"`[^`]*`", " ", text)
    return re.sub(r"\]\([^)]*\)", "]", text)


def sources(text: str) -> list[Path]:
    """The tables and logs under results/ that a section names."""
    named = sorted({ROOT / path.rstrip("/.") for path in re.findall(r"results/[\w./-]+", text)})
    files: list[Path] = []
    for path in named:
        folder = path if path.is_dir() else path.parent if path.suffix in (".md", ".png") else None
        files += sorted(folder.rglob("*")) if folder else [path]
    return [path for path in files if path.suffix in TABLES]


def numbers_in(path: Path) -> set[float]:
    text = path.read_text()
    if path.suffix == ".csv":
        text = text.replace(",", " ")
    found = re.findall(r"-?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?", text)
    return {float(number.replace(",", "")) for number in found}


def is_in(token: str, known: set[float]) -> bool:
    """Whether a number is among others at the digits it is given with; a percentage also as a share."""
    digits = token.rstrip("%").replace(",", "")
    places = len(digits.partition(".")[2])
    value, half = float(digits), 0.5 * 10.0**-places
    if token.endswith("%"):
        known = known | {100.0 * number for number in known}
    return any(abs(number - value) <= half * (1.0 + 1e-9) for number in known)


@pytest.mark.parametrize("title", [title for title in sections() if title not in MANUAL])
def test_every_measured_number_is_in_a_file_of_results(title: str) -> None:
    text = sections()[title]
    known: set[float] = set().union(*map(numbers_in, sources(text)))
    tokens = [token.rstrip(",") for token in NUMBER.findall(prose(text))]
    measured = [token for token in tokens if MEASURED.search(token)]
    unknown = [
        token for token in measured if token not in DEFINITIONS.get(title, {}) and not is_in(token, known)
    ]
    assert not unknown, f"{title or 'the beginning'}: in no file of results/ that it names: {unknown}"


def test_the_table_of_rivergrid_is_counted() -> None:
    """Solved policies of 20 seeds, pairs that differ, McNemar's exact test, and infeasible policies."""
    rows = pd.read_csv(ROOT / "results/rivergrid/today.csv")
    rows["optimal_return"] = rows["task"].map({"rivergrid-1a": 9.5, "rivergrid-1b": 9.1})
    rows["gap"] = rows["optimal_return"] - rows["return"]
    rows = rows.rename(columns={"cost": "cost_0", "limit": "deploy_limit_0"})
    rows = rows[rows["policy"] == "average"].assign(solved=solved(rows))
    outcomes = rows.pivot_table(index=["task", "agent", "seed"], columns="method", values="solved")
    for method in ("none", "linear", "cosine", "exponential", "dynamic"):
        counts = outcomes[method].groupby(["task", "agent"]).sum().astype(int)
        cells = [counts[f"rivergrid-{task}", agent] for task in ("1a", "1b") for agent in ("ppo-lag", "cpo")]
        assert f"| `{method}` | {' | '.join(map(str, cells))} |" in CLAIMS
    on_1b = rows[(rows["task"] == "rivergrid-1b") & ~rows["method"].isin(["none", "dynamic"])]
    infeasible = (on_1b["cost_0"] > 1.01 * on_1b["deploy_limit_0"]).sum()
    assert f"On 1b {infeasible} of {len(on_1b)} policies cost more than 1% above the limit" in CLAIMS
    assert not on_1b["solved"].any() and f"static curricula solve none of {len(on_1b)}." in README
    dynamic, none = outcomes["dynamic"].to_numpy(bool), outcomes["none"].to_numpy(bool)
    only_dynamic, only_none = int((dynamic & ~none).sum()), int((none & ~dynamic).sum())
    pairs = only_dynamic + only_none
    p_value = 2 * sum(math.comb(pairs, k) for k in range(min(only_dynamic, only_none) + 1)) / 2**pairs
    assert f"{only_dynamic} against {only_none} (McNemar's exact test, p = {p_value:.2f})" in CLAIMS
    solves = f"`dynamic` solves {dynamic.sum()} of {len(dynamic)} trials and `none` {none.sum()}"
    assert f"{solves} (p = {p_value:.2f})" in README


def test_definitions_are_still_used() -> None:
    for title, definitions in DEFINITIONS.items():
        tokens = {token.rstrip(",") for token in NUMBER.findall(prose(sections()[title]))}
        assert set(definitions) <= tokens, title


def test_numbers_are_compared_at_the_digits_given() -> None:
    assert is_in("9.50", {9.4962}) and not is_in("9.50", {9.4949})
    assert is_in("84%", {0.838}) and is_in("1,727", {1726.8}) and not is_in("84%", {0.83})
