"""Every measured number in the README is in a file under results/ that its section names.

A section names files in links and in code spans; a folder stands for the tables and logs in it. A number is
there if some number in such a file is equal to it at the digits that the README gives. Numbers that are no
measurements (limits, sizes, versions, optima of the maps) are listed below, each with what it is.
"""

import re
from pathlib import Path

import pandas as pd
import pytest

from tests.benchmarks.solved_pairs import PAIR, judged
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
        "1.5e6": "steps of a trial with the published settings",
        "2e6": "steps of a trial",
        "1e7": "steps of a published run",
    },
}
# Curriculum and map of the first claims in the answer about RiverGrid.
CLAIMED = [
    ("none", "rivergrid-1a"),
    ("dynamic", "rivergrid-1a"),
    ("none", "rivergrid-1b"),
    ("dynamic", "rivergrid-1b"),
]
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


def outcomes(*names: str) -> pd.DataFrame:
    """Whether the averaged policy is solved, by pair (rows) and curriculum (columns)."""
    rows = judged(pd.concat([pd.read_csv(ROOT / f"results/rivergrid/{name}.csv") for name in names]))
    return rows[rows["policy"] == "average"].pivot(index=PAIR, columns="method", values="solved").astype(bool)


def cells(solved: "pd.Series[bool]") -> str:
    counts = solved.groupby(["task", "agent"]).sum()
    ordered = [counts[f"rivergrid-{task}", agent] for task in ("1a", "1b") for agent in ("ppo-lag", "cpo")]
    return f"{' | '.join(map(str, ordered))} |"


def test_the_table_of_rivergrid_is_counted() -> None:
    solved = outcomes("today")
    for method in ("none", "linear", "cosine", "exponential", "dynamic"):
        assert f"| `{method}` | {cells(solved[method])}" in CLAIMS
    rows = pd.read_csv(ROOT / "results/rivergrid/today.csv").query("policy == 'average'")
    on_1b = rows[(rows["task"] == "rivergrid-1b") & ~rows["method"].isin(["none", "dynamic"])]
    infeasible = (on_1b["cost"] > 1.01 * on_1b["limit"]).sum()
    assert f"On 1b {infeasible} of {len(on_1b)} policies cost more than 1% above the limit" in CLAIMS
    assert not solved.loc["rivergrid-1b", ["linear", "cosine", "exponential"]].to_numpy().any()
    assert solved.loc["rivergrid-1a", ["linear", "cosine", "exponential"]].to_numpy().all()
    assert f"under static curricula solve {len(on_1b)} of {len(on_1b)} trials on 1a and 0 on 1b." in CLAIMS


def test_the_claims_about_rivergrid_are_counted() -> None:
    """The table in the answer: dynamic and none with fresh seeds, static curricula with earlier ones."""
    fresh, earlier = outcomes("confirm"), outcomes("today")
    rows = pd.read_csv(ROOT / "results/rivergrid/today.csv").query("policy == 'average'")
    static = ["linear", "cosine", "exponential"]
    on_1b = rows[(rows["task"] == "rivergrid-1b") & rows["method"].isin(static)]
    violations = (on_1b["cost"] > 1.01 * on_1b["limit"]).groupby(on_1b["agent"]).sum()
    answer = CLAIMS.split("\nSo `dynamic`")[0]
    for i, agent in enumerate(("ppo-lag", "cpo")):
        counts = [fresh[method].groupby(["task", "agent"]).sum()[task, agent] for method, task in CLAIMED]
        on_1a = [earlier[it].groupby(["task", "agent"]).sum()["rivergrid-1a", agent] for it in static]
        counts += [sum(on_1a), violations[agent]]
        cells = [line.split(" | ")[2 + i] for line in answer.split("\n") if line.startswith("| ")][1:]
        assert [int(re.findall(r"\d+", it)[0]) for it in cells] == counts
    failed = pd.read_csv(ROOT / "results/rivergrid/confirm.csv").query("policy == 'average' & agent == 'cpo'")
    failed = failed.query("task == 'rivergrid-1a' & method == 'none' & `return` < 9.3")
    assert f"{len(failed)} earn {failed['return'].min():.1f} to {failed['return'].max():.1f}" in answer


def test_the_table_of_fresh_seeds_on_rivergrid_is_counted() -> None:
    """Solved policies, and the pairs of which only one is."""
    solved = outcomes("confirm", "without-noise", "noise-alone")
    names = {"`dynamic` without noise": "without-noise", "noise alone": "noise-alone"}
    for name, method in {"`none`": "none", "`dynamic`": "dynamic", **names}.items():
        assert f"| {name} | {cells(solved[method])}" in CLAIMS
    dynamic, none = solved["dynamic"], solved["none"]
    counted = f"`dynamic` solves {dynamic.sum()} of {len(solved)} trials and `none` {none.sum()}."
    only_dynamic, only_none = (dynamic & ~none).sum(), (none & ~dynamic).sum()
    pairs = f"Of the pairs of equal seeds {only_dynamic} are solved only by `dynamic` and {only_none} only by"
    assert f"{counted} {pairs} `none`." in README
    assert README.count(counted) == 2  # also beside the first sweep


def test_definitions_are_still_used() -> None:
    for title, definitions in DEFINITIONS.items():
        tokens = {token.rstrip(",") for token in NUMBER.findall(prose(sections()[title]))}
        assert set(definitions) <= tokens, title


def test_numbers_are_compared_at_the_digits_given() -> None:
    assert is_in("9.50", {9.4962}) and not is_in("9.50", {9.4949})
    assert is_in("84%", {0.838}) and is_in("1,727", {1726.8}) and not is_in("84%", {0.83})
