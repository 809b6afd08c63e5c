"""Draw the pages on relaxed limits and on the Safety Gym table again, from the files in results/safety-gym.

    python -m tests.benchmarks.safety_gym_table

From table.zip (``ppo-lag``) and table-cpo.zip come the rows of final policies and of the deployment phase,
the differences from ``none``, the claims and the figures; from these rows and those of other experiments the
power. The controls and the confirmation have their own archives. Printed are the rows of the pages' tables.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
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
TABLE_PARTS = ("table", "table-cpo")  # one archive would be too large for the repository
CONTROLS = ("controls", "early-landing", "short-training")  # with rows of the deployment phase, as the table
STEPS_UNDER_LIMIT = ("none", "none-short", "linear", "linear-early")  # differ in these on CarGoal2
NOISE = ("none", "dynamic", "dynamic-without-noise")
CURRICULA = (*STEPS_UNDER_LIMIT, "cosine", "exponential", *NOISE[1:], "step")
PERIODS = ("phase", "first", "last")
POLICIES = ("stochastic", "deterministic")
PERIOD = 250_000  # steps, of a curve
AGENTS = ("ppo-lag", "cpo")
LABELS = ("ppo-lag min-std", "cpo")  # of each agent in the tables for the power
PILOT = ("curricula-today.csv", "cpo-curricula.csv")
COUNTED = ("agents.csv", *PILOT, "margin-control.csv", "table.csv", "button-confirm.csv")  # for the power


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
    finals = {**archives, "button-confirm": archive_of("button-confirm")}
    rows = [f"{scripts}/final_policies.py {path} --to {it}.csv" for it, path in finals.items()]
    phases = [
        f"{scripts}/deployment_phase.py {path} --to {it}-deployment-phase.csv"
        for it, path in archives.items()
    ]
    transcript([*rows, *phases])
    tests = [
        f"{scripts}/differences.py {tables} --against none{how} --policy {policy}"
        for tables in ("table.csv", f"{' '.join(PILOT)} table.csv")
        for how in ("", " --groups")
        for policy in POLICIES
    ]
    (RESULTS / "table-differences.txt").write_text(transcript(tests))
    tables = " ".join(f"results/safety-gym/{name}" for name in COUNTED)
    powers = [
        f"tests/benchmarks/power.py {tables} --agents {labels} --tests {tests} --difference 1"
        for labels in LABELS
        for tests in (1, 18, 24)  # those of the answer page, and of the paper's table
    ]
    (RESULTS / "power.txt").write_text(transcript(powers, ROOT))
    earlier = f"results/safety-gym/{PILOT[0]} results/safety-gym/table.csv"
    confirm = f"-m tests.benchmarks.button_confirm results/safety-gym/button-confirm.csv --earlier {earlier}"
    (RESULTS / "button-confirm.txt").write_text(transcript([confirm], ROOT))


def draw(table: Path) -> None:
    """Draw the report of the whole table; keep its claims, and its figures with fewer colours."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if code := recrl_sweep(["figures", str(table), "--to", name]):
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
        mean = f"{cell.interval} / {costs_of(cell)}"
        each = [str(text) for text in of_seed.reindex(seeds, fill_value="")]
        yield f"| {task} | `{agent}` | {policy} | `{method}` | {' | '.join([*each, mean])} |"


def answer_table(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the lines of the table of answers: stochastic policies, and differences from none."""
    ordered = rows.assign(agent=pd.Categorical(rows["agent"], AGENTS))
    stochastic = ordered[ordered["policy"] == "stochastic"]
    differences = paired_differences(stochastic.astype({"agent": str}), "none", "return")
    texts = {tuple(row[["agent", "task", "method"]]): shown(row) for _, row in differences.iterrows()}
    for (agent, task), of_cell in stochastic.groupby(["agent", "task"], observed=True):
        none = mean_cell(of_cell, "none")
        yield f"| `{agent}` | {task} | `none` | {seeds_of(of_cell, 'none')} | {none} | |"
        for method in CURRICULA:
            if text := texts.get((agent, task, method)):
                cells = f"{seeds_of(of_cell, method)} | {mean_cell(of_cell, method)}"
                yield f"| `{agent}` | {task} | `{method}` | {cells} | {text} |"


def seeds_of(rows: pd.DataFrame, method: str) -> int:
    """Return the number of seeds of one task and agent under a curriculum."""
    return int((rows["method"] == method).sum())


def of_question(rows: pd.DataFrame, methods: Sequence[str]) -> pd.DataFrame:
    """Return the rows of ppo-lag on CarGoal2 under some curricula."""
    chosen = (rows["task"] == "CarGoal2") & (rows["agent"] == "ppo-lag")
    return rows[chosen & rows["method"].isin(methods)]


def control_differences(rows: pd.DataFrame, baselines: Sequence[str]) -> Iterator[str]:
    """Yield what policies earn and cost above those of each baseline; they ran on several machines."""
    for policy in POLICIES:
        of_policy = rows[rows["policy"] == policy]
        for column in ("return", "cost"):
            for baseline in baselines:
                table = paired_differences(of_policy, baseline, column, as_groups=True).drop(columns="p_holm")
                yield f"{policy}, {column} above {baseline}, two groups: 95% interval, p (not corrected)"
                yield table.round(3).to_string(index=False)


def curve(updates: pd.DataFrame) -> pd.DataFrame:
    """Return means over seeds and over the updates that end in each PERIOD steps, by curriculum."""
    begin = (updates["end_step"] - 1) // PERIOD * PERIOD
    columns = ["episode_return", "cost_0", "limit_0", "multiplier_0"]
    means = updates.assign(from_step=begin).groupby(["method", "from_step"], observed=True)[columns].mean()
    return means.round(2).reset_index()


def mean_cell(rows: pd.DataFrame, method: str) -> str:
    """Return the mean return / cost of one task and agent under a curriculum."""
    cell = Cell.of("", "", rows[rows["method"] == method])
    return f"{cell.episode_return:.1f} / {costs_of(cell)}"


def costs_of(cell: Cell) -> str:
    """Return the mean cost with its error, for a page."""
    return cell.costs.replace("+-", "±")


def landing_table(
    final: pd.DataFrame, phase: pd.DataFrame, updates: pd.DataFrame, methods: Sequence[str]
) -> Iterator[str]:
    """Yield the lines of a table of ppo-lag: deployment phase, final policies, multipliers."""
    final, phase, updates = (rows[rows["agent"] == "ppo-lag"] for rows in (final, phase, updates))
    for task in ("CarGoal2", "CarButton2"):
        for method in methods:
            of_phase, of_final, run = (
                rows[(rows["task"] == task) & (rows["method"] == method)] for rows in (phase, final, updates)
            )
            if of_phase.empty:
                continue
            means = of_phase.loc[of_phase["policy"] == "phase", ["return", "cost"]].mean()
            deployed = run[run["phase"] == "deployment"]
            multipliers = deployed.groupby("seed")["multiplier_0"].agg(["first", "last"]).mean()
            cells = [
                f"{means['return']:.1f} / {means['cost']:.1f}",
                mean_cell(of_final[of_final["policy"] == "stochastic"], method),
                f"{multipliers['first']:.2f}, {multipliers['last']:.2f}",
            ]
            yield f"| {task} | `{method}` | {' | '.join(cells)} |"


def shown(row: pd.Series[Any]) -> str:
    """Return a difference with its interval and its corrected p value."""
    mean, low, high = (number(row[name]) for name in ("return", "low", "high"))
    return f"{mean} ({low} to {high}), p = {row['p_holm']:.2g}"


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
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "table.zip"
        if code := recrl_sweep(["merge", *map(str, map(archive_of, TABLE_PARTS)), "--to", str(whole)]):
            raise SystemExit(code)
        archives = {"table": whole, **{name: archive_of(name) for name in CONTROLS}}
        write_rows_and_tests(archives)
        draw(whole)
        updates = pd.concat(recrl.load_sweep(path).updates for path in archives.values())
    finals = [pd.read_csv(RESULTS / f"{name}.csv") for name in archives]
    fresh = finals[0]
    seen = pd.concat(pd.read_csv(RESULTS / name) for name in PILOT)
    phases = [pd.read_csv(RESULTS / f"{name}-deployment-phase.csv") for name in archives]
    everything = pd.concat(finals), pd.concat(phases), updates
    by_steps = of_question(pd.concat([seen, *finals]), STEPS_UNDER_LIMIT)
    by_noise = of_question(everything[0], NOISE)
    questions = (
        ("steps-under-limit", by_steps, ("none", "linear")),
        ("noise", by_noise, ("none", "dynamic")),
    )
    for name, rows, baselines in questions:
        lines = control_differences(rows, baselines)
        (RESULTS / f"{name}.txt").write_text("\n".join([*lines, ""]))
    curve(of_question(updates, STEPS_UNDER_LIMIT)).to_csv(
        RESULTS / "steps-under-limit-curve.csv", index=False
    )
    tables = (
        policy_table(fresh),
        difference_table(fresh, seen),
        phase_table(phases[0]),
        answer_table(pd.concat([seen, fresh])),
        landing_table(*everything, CURRICULA),
        policy_table(by_steps),
        policy_table(by_noise),
    )
    for table in tables:
        print("\n" + "\n".join(table))


if __name__ == "__main__":
    main()
