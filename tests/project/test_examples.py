"""The README's worked examples, as their readers use them: packages of their own, found by entry point."""

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from recrl.orchestrator.errors import GridError
from recrl.orchestrator.executors import InlineExecutor
from recrl.orchestrator.files.store import SweepStore
from recrl.orchestrator.grid.grid import parse_grid
from recrl.orchestrator.places import LocalSweep
from recrl.orchestrator.spec import TrialState
from recrl.orchestrator.sweep import LaunchSettings, launch

EXAMPLES = Path(__file__).parents[1] / "examples"
README = Path(__file__).parents[2] / "README.md"
GRID = """\
name: plugged
tasks: [{name: corridor, deploy_limits: 3, options: {length: 6}}]
agents: [{name: priced, options: {price: 2.0}}]
methods: [{name: plateau, options: {hold: 0.25}}]
seeds: 1
run: {num_envs: 4, rollout_steps: 20, total_steps: 1600, evaluation_episodes: 4}
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the three examples, installed by pip."""
    target = tmp_path_factory.mktemp("site-packages")
    sources = tmp_path_factory.mktemp("sources")
    options = ["--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--disable-pip-version-check"]
    copies = []
    for source in sorted(EXAMPLES.iterdir()):  # copies, because a build leaves its litter at the source
        copies.append(sources / source.name)
        copies[-1].mkdir()
        for file in source.glob("*.*"):
            (copies[-1] / file.name).write_bytes(file.read_bytes())
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, "--target", target, *copies], check=True
    )
    return target


def test_a_trial_of_ones_own_task_student_and_teacher_runs(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(installed))
    grid = parse_grid(GRID.encode(), source="grid.yaml")
    store = SweepStore(tmp_path, grid.name)
    launch(LaunchSettings(grid, LocalSweep(store), InlineExecutor()), stop=threading.Event())
    (trial,) = store.trials()
    assert trial.record().status is TrialState.COMPLETE
    updates = trial.updates()
    held = updates["end_step"] <= 0.25 * 1520
    assert updates.loc[held, "limit_0"].iloc[1:].nunique() == 1  # the first is infinite
    assert updates["limit_0"].iloc[-1] == 3.0
    assert updates["episode_return"].max() > updates["episode_return"].iloc[0]


def test_options_of_ones_own_are_checked_before_anything_starts(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(installed))
    wrong = GRID.replace("price: 2.0", "prize: 2.0").replace("hold: 0.25", "hold: 1.5")
    with pytest.raises(GridError) as refusal:
        parse_grid(wrong.encode(), source="grid.yaml")
    assert "unknown key; did you mean 'price'?" in str(refusal.value)
    assert "methods.0.options.hold" in str(refusal.value)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*/*.py")), ids=lambda path: path.stem)
def test_an_example_is_short_and_the_readme_leads_to_it(path: Path) -> None:
    assert len(path.read_text().splitlines()) < 40
    assert f"({path.relative_to(README.parent)})" in README.read_text()
