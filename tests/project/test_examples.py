"""The worked examples, as their readers use them: packages of their own, found by entry point."""

import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from recrl.environments.registry import make_vector
from recrl.orchestrator.errors import GridError
from recrl.orchestrator.executors import InlineExecutor
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.grid.checking import parse_grid
from recrl.orchestrator.run_sweep import SweepRunSettings, run_sweep
from recrl.orchestrator.spec import TrialStatus
from recrl.orchestrator.sweep_place import SweepPlace
from tests.project.documentation import ROOT

EXAMPLES = ROOT / "examples"
GRID = """\
name: plugged
tasks: [{name: corridor, deploy_limits: 3, options: {length: 6}}]
agents: [{name: fixed-multiplier, options: {multiplier: 2.0}}]
methods: [{name: plateau, options: {hold: 0.25}}]
seeds: 1
run: {num_envs: 4, rollout_steps: 20, total_steps: 1600, evaluation_episodes: 4}
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the examples, installed by pip."""
    target = tmp_path_factory.mktemp("site-packages")
    sources = tmp_path_factory.mktemp("sources")
    options = ["--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--disable-pip-version-check"]
    copies = []
    for source in sorted(
        it.parent for it in EXAMPLES.glob("*/pyproject.toml")
    ):  # copies, because a build leaves its litter at the source
        copies.append(sources / source.name)
        copies[-1].mkdir()
        for file in source.glob("*.*"):
            (copies[-1] / file.name).write_bytes(file.read_bytes())
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, "--target", target, *copies], check=True
    )
    return target


def test_a_trial_of_ones_own_task_agent_and_teacher_runs(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(installed))
    grid = parse_grid(GRID.encode(), source="grid.yaml")
    store = SweepStore(tmp_path, grid.name)
    run_sweep(SweepRunSettings(grid, SweepPlace(store), InlineExecutor()), stop=threading.Event())
    (trial,) = store.trials()
    assert trial.record().status is TrialStatus.COMPLETE
    updates = trial.updates()
    held = updates["end_step"] <= 0.25 * 1520
    assert updates.loc[held, "limit_0"].iloc[1:].nunique() == 1  # the first is infinite
    assert updates["limit_0"].iloc[-1] == 3.0
    assert updates["episode_return"].max() > updates["episode_return"].iloc[0]


def test_the_corridor_ends_at_its_declared_horizon(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(installed))
    corridor = make_vector("corridor", 1, options={"length": 30})
    corridor.reset(seed=0)
    ends = [bool(corridor.step(np.zeros(1, np.int64))[2][0]) for _ in range(30)]
    assert ends == [False] * 29 + [True]
    assert corridor.cmdp.horizon == 30


def test_options_of_ones_own_are_checked_before_anything_starts(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(installed))
    wrong = GRID.replace("multiplier: 2.0", "multiplyer: 2.0").replace("hold: 0.25", "hold: 1.5")
    with pytest.raises(GridError) as refusal:
        parse_grid(wrong.encode(), source="grid.yaml")
    assert "unknown key; did you mean 'multiplier'?" in str(refusal.value)
    assert "methods.0.options.hold" in str(refusal.value)


def test_a_curriculum_that_reads_episodes_lowers_its_limit(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(installed))
    text = GRID.replace("{name: plateau, options: {hold: 0.25}}", "{name: halving, options: {episodes: 12}}")
    text = text.replace("deploy_limits: 3", "deploy_limits: 0.5")
    grid = parse_grid(text.encode(), source="grid.yaml")
    store = SweepStore(tmp_path, grid.name)
    run_sweep(SweepRunSettings(grid, SweepPlace(store), InlineExecutor()), stop=threading.Event())
    (trial,) = store.trials()
    limits = trial.updates()["limit_0"]
    assert limits.iloc[0] == float("inf") and limits.iloc[-1] == 0.5
    assert limits.is_monotonic_decreasing and limits.nunique() > 3


def test_an_agent_learns_with_a_network_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES / "residual_network"))
    own = "{name: ppo-lag, options: {network: 'residual_network:residual_network'}}"
    text = GRID.replace("{name: fixed-multiplier, options: {multiplier: 2.0}}", own)
    text = text.replace("{name: plateau, options: {hold: 0.25}}", "none")
    text = text.replace("name: corridor", "name: two-state, options: {horizon: 20}").replace(
        ", options: {length: 6}", ""
    )
    grid = parse_grid(text.encode(), source="grid.yaml")
    store = SweepStore(tmp_path, grid.name)
    run_sweep(SweepRunSettings(grid, SweepPlace(store), InlineExecutor()), stop=threading.Event())
    assert store.trials()[0].record().status is TrialStatus.COMPLETE


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*/*.py")), ids=lambda path: path.stem)
def test_an_example_is_short_and_the_documentation_shows_it(path: Path) -> None:
    assert len(path.read_text().splitlines()) < 60
    pages = "".join(page.read_text() for page in (ROOT / "docs").rglob("*.md"))
    assert str(path.relative_to(ROOT)) in pages
