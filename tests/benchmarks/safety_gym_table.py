"""Draw the pages on relaxed limits and on the Safety Gym table again, from the files in results/safety-gym.

    python -m tests.benchmarks.safety_gym_table

From table.zip come the rows of final policies and of the deployment phase, the differences from ``none``,
the claims and the figures; from these rows and those of other experiments the power. Printed are the rows of
which the pages' tables are made.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from PIL import Image

import recrl
from recrl.orchestrator.cli.main import main as recrl_sweep
from tests.benchmarks.differences import paired_differences
from tests.benchmarks.velocity_table import Cell, number

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results" / "safety-gym"
COLOURS = 128  # of a figure in the documentation
CURRICULA = ("none", "linear", "cosine", "exponential", "dynamic")
PERIODS = ("phase", "first", "last")
POLICIES = ("stochastic", "deterministic")
PILOT = "curricula-today.csv"
COUNTED = (
    "agents.csv",
    PILOT,
    "margin-control.csv",
    "table.csv",
    "button-confirm.csv",
)  # for the spread of ppo-lag


def transcript(commands: Sequence[str], folder: Path = RESULTS) -> str:
    """Run Python scripts, and return what they print, each below its command."""
    texts = []
    for command in commands:
        script = [sys.executable, *shlex.split(command)]
        answer = subprocess.run(script, cwd=folder, check=True, capture_output=True, text=True)
        texts.append(f"$ python {command}\n{answer.stdout}")
    return "\n".join(texts)


def write_rows_and_tests() -> None:
    """Write the rows of the table, and the tests."""
    scripts = "../../tests/benchmarks"
    transcript(
        [
            f"{scripts}/final_policies.py table.zip --to table.csv",
            f"{scripts}/deployment_phase.py table.zip --to table-deployment-phase.csv",
            f"{scripts}/final_policies.py step.zip --to step.csv",
            f"{scripts}/deployment_phase.py step.zip --to step-deployment-phase.csv",
            f"{scripts}/final_policies.py button-confirm.zip --to button-confirm.csv",
        ]
    )
    tests = [
        f"{scripts}/differences.py {tables} --against none{how} --policy {policy}"
        for tables in ("table.csv", f"{PILOT} table.csv")
        for how in ("", " --groups")
        for policy in POLICIES
    ]
    (RESULTS / "table-differences.txt").write_text(transcript(tests))
    tables = " ".join(f"results/safety-gym/{name}" for name in COUNTED)
    powers = [
        f"tests/benchmarks/power.py {tables}{tests}"
        for tables in (tables, "results/safety-gym/cpo-curricula.csv")
        for tests in ("", " --tests 24")
    ]
    (RESULTS / "power.txt").write_text(transcript(powers, ROOT))
    earlier = f"results/safety-gym/{PILOT} results/safety-gym/table.csv"
    confirm = f"-m tests.benchmarks.button_confirm results/safety-gym/button-confirm.csv --earlier {earlier}"
    (RESULTS / "button-confirm.txt").write_text(transcript([confirm], ROOT))


def draw() -> None:
    """Draw the report; keep its claims, and its figures with fewer colours."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if code := recrl_sweep(["figures", str(RESULTS / "table.zip"), "--to", name]):
            raise SystemExit(code)
        (RESULTS / "table-claims.csv").write_bytes((folder / "claims.csv").read_bytes())
        for figure in [folder / "return-against-cost.png", *folder.glob("learning-curves_*.png")]:
            image = Image.open(figure).convert("RGB").quantize(COLOURS)
            image.save(ROOT / "docs/_static" / f"safety-gym-table-{figure.name}", optimize=True)


def policy_table(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the lines of the table of final policies, a column a seed."""
    seeds = sorted(rows["seed"].unique())
    yield "| task | agent | policy | curriculum | " + " | ".join(f"seed {it}" for it in seeds) + " | mean |"
    yield "|---" * (5 + len(seeds)) + "|"
    ordered = rows.assign(
        policy=pd.Categorical(rows["policy"], POLICIES), method=pd.Categorical(rows["method"], CURRICULA)
    )
    keys = ["task", "agent", "policy", "method"]
    for (task, agent, policy, method), group in ordered.groupby(keys, observed=True):
        cell = Cell.of(str(task), str(agent), group)
        of_seed = group.set_index("seed")[["return", "cost"]].map("{:.1f}".format).agg(" / ".join, axis=1)
        mean = f"{cell.interval} / {cell.costs.replace('+-', '±')}"
        each = [str(text) for text in of_seed.reindex(seeds, fill_value="")]
        yield f"| {task} | `{agent}` | {policy} | `{method}` | {' | '.join([*each, mean])} |"


def answer_table(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the lines of the table of answers: stochastic policies under three curricula, and differences."""
    stochastic = rows[rows["policy"] == "stochastic"]
    differences = paired_differences(stochastic, "none", "return")
    texts = {(row["task"], row["method"]): shown(row) for _, row in differences.iterrows()}
    for task, of_task in stochastic.groupby("task"):
        cells = [mean_cell(of_task, method) for method in ("none", "linear", "dynamic")]
        compared = [texts[str(task), method] for method in ("linear", "dynamic")]
        yield f"| {task} | {of_task['seed'].nunique()} | {' | '.join([*cells, *compared])} |"


def mean_cell(rows: pd.DataFrame, method: str) -> str:
    """Return the mean return / cost of one task and agent under a curriculum."""
    cell = Cell.of("", "", rows[rows["method"] == method])
    return f"{cell.episode_return:.1f} / {cell.costs.replace('+-', '±')}"


def late_limit_table(final: pd.DataFrame, phase: pd.DataFrame, updates: pd.DataFrame) -> Iterator[str]:
    """Yield the lines of the table of ``step``: deployment phase, final policies, multipliers."""
    deployed = updates[updates["phase"] == "deployment"]
    for task in ("CarGoal2", "CarButton2"):
        for method in ("none", "linear", "step"):
            of_phase, of_final, run = (
                rows[(rows["task"] == task) & (rows["method"] == method)] for rows in (phase, final, deployed)
            )
            means = of_phase.loc[of_phase["policy"] == "phase", ["return", "cost"]].mean()
            multipliers = run.groupby("seed")["multiplier_0"].agg(["first", "last"]).mean()
            cells = [
                f"{means['return']:.1f} / {means['cost']:.1f}",
                mean_cell(of_final[of_final["policy"] == "stochastic"], method),
                f"{multipliers['first']:.2f}, {multipliers['last']:.2f}",
            ]
            yield f"| {task} | `{method}` | {' | '.join(cells)} |"


def shown(row: pd.Series[Any]) -> str:
    """Return a difference with its interval and its corrected p value."""
    mean, low, high = (number(row[name]) for name in ("return", "low", "high"))
    return f"{mean} ({low} to {high}), p = {row['p_holm']:.3f}"


def difference_table(fresh: pd.DataFrame, seen: pd.DataFrame) -> Iterator[str]:
    """Yield the lines of the table of differences in return from ``none``, without and with the pilot."""
    yield "| task | agent | policy | curriculum | three fresh seeds | with the pilot |"
    yield "|---" * 6 + "|"
    keys = ["task", "agent", "method"]
    for policy in POLICIES:
        tables = [
            paired_differences(rows[rows["policy"] == policy], "none", "return").set_index(keys)
            for rows in (fresh, pd.concat([seen, fresh]))
        ]
        for key in tables[0].index:
            texts = [shown(table.loc[key]) for table in tables]
            yield f"| {key[0]} | `{key[1]}` | {policy} | `{key[2]}` | {' | '.join(texts)} |"


def phase_table(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the lines of the table of the deployment phase, means over the seeds."""
    yield "| task | agent | curriculum | whole phase | first 100,000 steps | last 100,000 steps |"
    yield "|---" * 6 + "|"
    for (task, agent), of_agent in rows.groupby(["task", "agent"]):
        means = of_agent.groupby(["method", "policy"])[["return", "cost"]].mean()
        cells = means.apply(lambda it: f"{it['return']:.1f} / {it['cost']:.1f}", axis=1).unstack()
        for method in CURRICULA:
            if method in cells.index:
                texts = " | ".join(str(cells.loc[method, period]) for period in PERIODS)
                yield f"| {task} | `{agent}` | `{method}` | {texts} |"


def main() -> None:
    """Write the files, and print the page's tables."""
    write_rows_and_tests()
    draw()
    fresh, seen = (pd.read_csv(RESULTS / name) for name in ("table.csv", PILOT))
    phase = pd.read_csv(RESULTS / "table-deployment-phase.csv")
    updates = pd.concat(recrl.load_sweep(RESULTS / name).updates for name in ("table.zip", "step.zip"))
    step, step_phase = (pd.read_csv(RESULTS / name) for name in ("step.csv", "step-deployment-phase.csv"))
    tables = (
        policy_table(fresh),
        difference_table(fresh, seen),
        phase_table(phase),
        answer_table(pd.concat([seen, fresh])),
        late_limit_table(pd.concat([fresh, step]), pd.concat([phase, step_phase]), updates),
    )
    for table in tables:
        print("\n" + "\n".join(table))


if __name__ == "__main__":
    main()
