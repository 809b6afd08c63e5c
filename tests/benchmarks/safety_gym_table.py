"""Draw the pages on relaxed limits and on the Safety Gym table again, from the files in results/safety-gym.

    python -m tests.benchmarks.safety_gym_table

From table.zip (``ppo-lag``) and table-cpo.zip come the rows of final policies and of the deployment phase,
the differences from ``none``, the claims and the figures; from these rows and those of other experiments the
power. The controls and the confirmations have their own archives. The tables are written into the pages.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
from PIL import Image
from scipy.stats import fisher_exact

import recrl
from recrl.orchestrator.cli.main import main as recrl_sweep
from tests.benchmarks import safety_gym_pages
from tests.benchmarks.differences import differences_from
from tests.benchmarks.safety_gym_pages import (
    CLAIMS,
    CONFIRMATIONS,
    CONTROLS,
    FRESH,
    LEVEL_1,
    LONG,
    LONG_EARLY,
    MULTIPLIERS,
    NOISE,
    PAPER_PRESET,
    PILOT,
    POLICIES,
    RESULTS,
    ROOT,
    STEPS_UNDER_LIMIT,
    TASKS,
    of_policy,
    of_question,
    rows_of,
)

LIMIT = 25.0
COLOURS = 128  # of a figure in the documentation
TABLE_PARTS = ("table", "table-cpo")  # one archive would be too large for the repository
PERIOD, LONG_PERIOD = 250_000, 2_000_000  # steps, of a curve
FOLDER = "results/safety-gym"
JUDGED = {  # options of confirmations.py
    **{
        name: " ".join(["--earlier", *(f"{FOLDER}/{it}" for it in earlier)])
        for name, earlier in CONFIRMATIONS.items()
    },
    LEVEL_1: "",
    LONG: f"--shorter {FOLDER}/goal-confirm.csv",
    LONG_EARLY: f"--controls {FOLDER}/{LONG}.csv",
}
LABELS = ("ppo-lag min-std", "cpo")  # of each agent in the tables for the power
COUNTED = ("agents.csv", *PILOT, "margin-control.csv", FRESH, "button-confirm.csv")  # for the power


def transcript(commands: Sequence[str], folder: Path = RESULTS) -> str:
    """Run Python scripts, and return what they print, each below its command."""
    texts = []
    for command in commands:
        script = [sys.executable, *shlex.split(command)]
        answer = subprocess.run(script, cwd=folder, check=True, capture_output=True, text=True)
        texts.append(f"$ python {command}\n{answer.stdout}")
    return "\n".join(texts)


def archive_of(name: str) -> Path:
    """Return the path of an archive in the results."""
    return RESULTS / f"{name}.zip"


def write_rows_and_tests(archives: Mapping[str, Path]) -> None:
    """Write the rows of the table, and the tests."""
    scripts = "../../tests/benchmarks"
    finals = {
        **archives,
        **{name: archive_of(name) for name in (*JUDGED, PAPER_PRESET)},
    }
    rows = [f"{scripts}/final_policies.py {path} --to {it}.csv" for it, path in finals.items()]
    phases = [
        f"{scripts}/deployment_phase.py {path} --to {it}-deployment-phase.csv"
        for it, path in {**archives, LONG: archive_of(LONG)}.items()
    ]
    transcript([*rows, *phases])
    tests = [
        f"{scripts}/differences.py {tables} --against none{how} --policy {policy}"
        for tables in ("table.csv", f"{' '.join(PILOT)} table.csv")
        for how in ("", " --groups")
        for policy in POLICIES
    ]
    (RESULTS / "table-differences.txt").write_text(transcript(tests))
    tables = " ".join(f"{FOLDER}/{name}" for name in COUNTED)
    powers = [
        f"tests/benchmarks/power.py {tables} --agents {labels} --tests {tests} --difference 1"
        for labels in LABELS
        for tests in (1, 24)
    ]
    (RESULTS / "power.txt").write_text(transcript(powers, ROOT))
    for name, options in JUDGED.items():
        judge = f"-m tests.benchmarks.confirmations {FOLDER}/{name}.csv {options}".rstrip()
        (RESULTS / f"{name}.txt").write_text(transcript([judge], ROOT))


def draw(table: Path) -> None:
    """Draw the report of the whole table; keep its claims, and its figures with fewer colours."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if code := recrl_sweep(["figures", str(table), "--to", name]):
            raise SystemExit(code)
        (RESULTS / CLAIMS).write_bytes((folder / "claims.csv").read_bytes())
        for figure in [folder / "return-against-cost.png", *folder.glob("learning-curves_*.png")]:
            image = Image.open(figure).convert("RGB").quantize(COLOURS)
            image.save(ROOT / "docs/_static" / f"safety-gym-table-{figure.name}", optimize=True)


def control_differences(rows: pd.DataFrame, baselines: Sequence[str]) -> Iterator[str]:
    """Yield what policies earn and cost above those of each baseline.

    As they ran on several machines, two groups are right; paired by seed is what was planned.
    """
    for as_groups, how in ((True, "two groups"), (False, "paired by seed")):
        for policy in POLICIES:
            chosen = of_policy(rows, policy)
            for column in ("return", "cost"):
                for baseline in baselines:
                    table = differences_from(chosen, baseline, column, as_groups=as_groups)
                    yield f"{policy}, {column} above {baseline}, {how}: 95% interval, p (not corrected)"
                    yield table.drop(columns="p_holm").round(3).to_string(index=False)


def curve(updates: pd.DataFrame, period: int = PERIOD) -> pd.DataFrame:
    """Return means over seeds and over the updates that end in each ``period`` steps.

    A row is an agent, a curriculum and a period.
    """
    begin = (updates["end_step"] - 1) // period * period
    keys = ["agent", "method", "from_step"]
    columns = ["episode_return", "cost_0", "limit_0", "multiplier_0"]
    means = updates.assign(from_step=begin).groupby(keys, observed=True)[columns].mean()
    return means.round(2).reset_index()


def limit_counts(rows: pd.DataFrame, policy: str) -> Iterator[str]:
    """Yield how many policies exceed the limit by more than one standard error, with exact tests.

    Curricula are compared by Fisher's test, agents by the flips of the signs of their differences.
    """
    chosen = of_policy(rows, policy)
    exceeds = chosen.assign(exceeds=chosen["cost"] > LIMIT + chosen["cost_se"])
    for agent, of_agent in exceeds.groupby("agent", sort=False):
        yield f"{policy}, {agent}: {of_agent['exceeds'].sum()} of {len(of_agent)} exceed the limit"
        counts = of_agent.groupby("method", sort=False)["exceeds"].agg(["sum", "size"])
        yield "  " + ", ".join(f"{method} {it['sum']} of {it['size']}" for method, it in counts.iterrows())
        for method in counts.index.drop("none"):
            seeds = of_agent.loc[of_agent["method"] == method, ["task", "seed"]]
            both = of_agent.merge(seeds, on=["task", "seed"])  # cosine and exponential have fresh seeds only
            groups = [both.loc[both["method"] == it, "exceeds"] for it in (method, "none")]
            yield f"  {method} and none: {fisher(*groups)}"
    cells = exceeds.pivot_table("exceeds", ["task", "seed"], "agent", aggfunc="sum").astype(int)
    p = sign_flips((cells["cpo"] - cells["ppo-lag"]).to_numpy())
    yield (
        f"{policy}, cpo and ppo-lag: {cells['cpo'].sum()} and {cells['ppo-lag'].sum()} exceed the limit; "
        f"by task and seed, {len(cells)} pairs of counts, sign flips, p = {p:.2g}"
    )


def sign_flips(differences: npt.NDArray[np.int_]) -> float:
    """Return the exact p value of a mean of 0, if each difference is as likely to have the other sign.

    >>> sign_flips(np.array([1, 2, 3]))
    0.25
    """
    totals = np.zeros(1, np.int_)
    for each in differences:
        totals = np.concatenate([totals + each, totals - each])
    return float(np.mean(np.abs(totals) >= abs(differences.sum())))


def fisher(first: pd.Series[bool], second: pd.Series[bool]) -> str:
    """Return how many of two independent groups exceed the limit, and the exact p value."""
    exceed = [int(it.sum()) for it in (first, second)]
    table = [exceed, [len(it) - number for it, number in zip((first, second), exceed, strict=True)]]
    p = float(fisher_exact(np.array(table)).pvalue)
    return f"{exceed[0]} of {len(first)} and {exceed[1]} of {len(second)} exceed the limit, p = {p:.2g}"


def multipliers(updates: pd.DataFrame) -> pd.DataFrame:
    """Return those of the first and the last update of the deployment phase, a row a trial of ppo-lag."""
    deployed = updates[(updates["phase"] == "deployment") & (updates["agent"] == "ppo-lag")]
    keys = ["agent", "task", "method", "seed"]
    return deployed.groupby(keys, observed=True)["multiplier_0"].agg(["first", "last"]).reset_index()


def main() -> None:
    """Write the files, the figures and the tables of the pages."""
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "table.zip"
        if code := recrl_sweep(["merge", *map(str, map(archive_of, TABLE_PARTS)), "--to", str(whole)]):
            raise SystemExit(code)
        archives = {"table": whole, **{name: archive_of(name) for name in CONTROLS}}
        write_rows_and_tests(archives)
        draw(whole)
        updates = pd.concat(recrl.load_sweep(path).updates for path in archives.values())
    multipliers(updates).round(4).to_csv(RESULTS / MULTIPLIERS, index=False)
    controls = [f"{name}.csv" for name in CONTROLS]
    questions = (
        (
            "steps-under-limit",
            of_question(rows_of(*PILOT, FRESH, *controls), STEPS_UNDER_LIMIT),
            ("none", "linear"),
        ),
        ("noise", of_question(rows_of(FRESH, *controls), NOISE, TASKS), ("none", "dynamic")),
    )
    for name, rows, baselines in questions:
        lines = control_differences(rows, baselines)
        (RESULTS / f"{name}.txt").write_text("\n".join([*lines, ""]))
    counts: list[str] = []
    for names in ((FRESH,), (*PILOT, FRESH)):
        counts.append(f"{', '.join(names)}:")
        for policy in POLICIES:
            counts += limit_counts(rows_of(*names), policy)
    (RESULTS / "table-limit.txt").write_text("\n".join([*counts, ""]))
    periods = {PAPER_PRESET: PERIOD, LONG: LONG_PERIOD, LONG_EARLY: LONG_PERIOD}
    curves = {
        "steps-under-limit-curve": curve(of_question(updates, STEPS_UNDER_LIMIT)),
        **{
            f"{name}-learning": curve(recrl.load_sweep(archive_of(name)).updates, period)
            for name, period in periods.items()
        },
    }
    for name, rows in curves.items():
        rows.to_csv(RESULTS / f"{name}.csv", index=False)
    safety_gym_pages.main()


if __name__ == "__main__":
    main()
