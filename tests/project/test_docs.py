"""What the documentation says is so: its grids are valid, its code runs, its lists are complete."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import recrl
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.registry import AGENTS, make_agent
from recrl.analysis.data import sweep_data
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.registry import make_vector
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files import trial_files
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_files import HARD_LANDING, POLICY_NOISE
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.grid.file_models import GridFile
from recrl.teachers.registry import TEACHERS
from tests.project.documentation import DOCS, PAGES, README, ROOT, Fence, fences, label

BASE: dict[str, Any] = {
    "name": "page",
    "tasks": ["rivergrid-1a"],
    "agents": ["ppo-lag"],
    "methods": ["none"],
    "seeds": 1,
    "deploy_limits": 5,
    "run": {"total_steps": 10_000},
}
WALK = """\
import gymnasium
import numpy as np

class Walk(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)
    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}
    def step(self, action):
        return np.zeros(2, np.float32), 0.0, False, True, {"cost": 1.0}

gymnasium.register("Walk-v0", Walk)
"""  # the environment of the README's reader
REFERENCE = DOCS / "reference"


def grids() -> Iterator[Any]:
    """Every fence that is a grid, or a part of one."""
    for page in (README, *PAGES):
        for number, fence in enumerate(fences(page)):
            if fence.language == "yaml":
                yield pytest.param(fence, id=f"{label(page)}-{number}")


@pytest.mark.parametrize("fence", list(grids()))
def test_every_grid_and_part_of_a_grid_is_valid(
    fence: Fence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_env.py").write_text(WALK)
    for folder in (tmp_path, *(ROOT / "examples").iterdir()):
        monkeypatch.syspath_prepend(str(folder))
    given = yaml.safe_load(fence.text)
    assert set(given) <= set(GridFile.model_fields), "a yaml fence must hold keys of a grid"
    complete = yaml.safe_dump(given if fence.caption else BASE | given)
    assert parse_grid(complete.encode(), source="page.yaml").trials()


@pytest.mark.parametrize(
    "page", [page for page in PAGES if any(it.language == "python" for it in fences(page))], ids=label
)
def test_python_in_fences_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for fence in fences(page):
        if fence.language == "python" and not fence.caption:
            exec(compile(fence.text, label(page), "exec"), names)


@pytest.mark.filterwarnings("ignore:hard landing:UserWarning")  # of two updates
def test_python_of_the_readme_runs(
    finished_sweep: SweepStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With the steps of two updates, and another sweep in the place of the demo."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "demo").symlink_to(finished_sweep.folder)
    monkeypatch.chdir(tmp_path)
    train = recrl.train
    short = {"total_steps": 1_600, "deploy_fraction": 0.5, "evaluation_episodes": 2}
    short |= {"num_envs": 4, "rollout_steps": 200}
    monkeypatch.setattr(recrl, "train", lambda *words, **options: train(*words, **options | short))
    names: dict[str, Any] = {}
    (fence,) = (fence for fence in fences(README) if fence.language == "python")
    exec(compile(fence.text, label(README), "exec"), names)
    assert list(names["training"].evaluations["policy"].unique()) == ["stochastic", "deterministic"]
    assert "cost_0" in capsys.readouterr().out
    assert len(names["sweep"].trials) == 36


def test_every_metric_of_every_agent_is_explained() -> None:
    explained = (REFERENCE / "metrics.md").read_text()
    for name in AGENTS:
        environments = make_vector("two-state", 4, options={"horizon": 10})
        agent = make_agent(name, environments.cmdp, {}, np.random.SeedSequence(0))
        collector = Collector(environments, num_steps=20)
        collector.reset(seed=0)
        rollout, finished = collector.collect(agent, np.random.default_rng(0))
        metrics = agent.update(rollout, episode_costs(finished, 1), CurriculumStep(CostLimits((5.0,))))
        for metric in metrics:
            row = f"`{re.sub(r'_0$', '_i', metric)}`"
            assert row in explained, f"give {row} of {name} a row in docs/reference/metrics.md"


def names_in(rows: str, cell: int = 0) -> list[str]:
    """Return the names in one cell of each row of a Markdown table, in order."""
    lines = [line.strip("|").split("|") for line in rows.splitlines() if line.startswith("| `")]
    return [name for line in lines for name in re.findall(r"`([^`]+)`", line[cell])]


@pytest.mark.parametrize(
    ("file", "columns"),
    [
        ("episodes.csv", (*trial_files.EPISODE_COLUMNS, "cost_i", "limit_i")),
        ("updates.csv", (*trial_files.UPDATE_COLUMNS, "cost_i", "limit_i")),
        ("evaluation.csv", (*trial_files.EVALUATION_COLUMNS, "cost_i")),
    ],
)
def test_a_files_table_has_its_columns_and_no_others(file: str, columns: tuple[str, ...]) -> None:
    section = (REFERENCE / "files.md").read_text().partition(f"\n## `{file}`\n")[2].partition("\n## ")[0]
    assert names_in(section) == list(columns)


@pytest.mark.parametrize(
    ("frame", "columns"),
    [
        ("trials", sweep_data.TRIAL_COLUMNS),
        (
            "phases",
            (*sweep_data.PHASE_COLUMNS, *(f"{it}_i{end}" for it, end in sweep_data.PHASE_COST_COLUMNS)),
        ),
        ("events", sweep_data.EVENT_COLUMNS),
    ],
)
def test_a_frame_has_the_listed_columns_and_no_others(frame: str, columns: tuple[str, ...]) -> None:
    (row,) = re.findall(rf"^\| `{frame}` \| .*$", (REFERENCE / "files.md").read_text(), re.MULTILINE)
    listed = names_in(row, cell=2)
    of_costs = ["train_limit_i", "deploy_limit_i", "start_limit_i"]  # before the optimum, one for each cost
    assert [name for name in listed if name not in of_costs] == list(columns)


def test_every_event_is_explained() -> None:
    explained = (REFERENCE / "events.md").read_text()
    literal = re.findall(r"_event\(\s*\"([^\"]+)\"", (ROOT / "orchestrator/trial/trial.py").read_text())
    events = [*literal, HARD_LANDING, POLICY_NOISE]
    assert len(events) >= 4
    assert not [event for event in events if f"`{event}`" not in explained]


def test_every_exit_code_is_explained() -> None:
    explained = (REFERENCE / "exit-codes.md").read_text()
    assert not [code for code in ExitCode if f"\n| {code.value} |" not in explained]


def test_every_agent_has_a_page_and_is_listed() -> None:
    folder = DOCS / "explanation/algorithms"
    assert {page.stem for page in folder.glob("*.md")} == {*AGENTS, "index"}
    assert set(names_in((folder / "index.md").read_text().replace("| [`", "| `"))) == {*AGENTS}
    readme = README.read_text()
    assert not [agent for agent in AGENTS if f"`{agent}`" not in readme]


def test_the_metrics_of_an_export_are_listed() -> None:
    section = (REFERENCE / "files.md").read_text().partition("\n### An export\n")[2].partition("Times and")[0]
    listed = {name for name in re.findall(r"`([^` ]+)`", section) if name != "updates"}
    metrics = names_in((REFERENCE / "metrics.md").read_text())
    columns = [re.sub(r"_i$", "_0", name) for name in (*trial_files.UPDATE_COLUMNS, *metrics)]
    exported = sweep_data.drawn_columns([*columns, "cost_0", "limit_0"])
    assert listed == {re.sub(r"_0$", "_i", name) for name in exported}


@pytest.mark.parametrize(
    "page", ["explanation/curricula.md", "explanation/bounds.md", "how-to/limits-and-curricula.md"]
)
def test_a_page_on_curricula_names_each_of_them(page: str) -> None:
    text = (DOCS / page).read_text()
    assert not [name for name in TEACHERS if f"`{name}`" not in text]


def test_no_page_quotes_a_test_that_is_not_there() -> None:
    tests = "".join(path.read_text() for path in (ROOT / "tests").rglob("*.py"))
    quoted = re.findall(r"`(?:test_\w+\.py::)?(test_\w+)`", (DOCS / "faults.md").read_text())
    assert quoted
    assert not [name for name in quoted if f"def {name}(" not in tests]


ELSEWHERE = {".venv", "build", "docs", "runs"}  # not ours, or checked by Sphinx
OUTSIDE = [page for page in sorted(ROOT.rglob("*.md")) if not ELSEWHERE & set(page.relative_to(ROOT).parts)]


@pytest.mark.parametrize("page", OUTSIDE, ids=label)
def test_relative_links_outside_the_site_lead_to_files(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    targets = [target for target in re.findall(r"\]\(([^)\s#]+)", text) if "://" not in target]
    assert not [target for target in targets if not (page.parent / target).exists()]
