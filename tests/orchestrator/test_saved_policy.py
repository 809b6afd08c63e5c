"""A trial can be looked at afterwards, as it was, and is not changed by it."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from recrl.agents import evaluation
from recrl.agents.collection import Collector
from recrl.agents.evaluation import PolicyKind, evaluate, film
from recrl.environments.cmdp import CostLimits
from recrl.environments.registry import make_drawn, make_vector
from recrl.environments.rivergrid.minigrid_env import RiverGridEnv
from recrl.orchestrator.cli.main import main
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.exit_codes import ExitCode
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import Choice, TrialSpec, TrialStatus
from recrl.orchestrator.trial.attempt import run_recorded
from recrl.orchestrator.trial.saved_policy import NoCheckpointError, SavedTrial, summary
from recrl.orchestrator.trial.videos import VideoFormat
from tests.environments.sample_options import sample_options

SPEC = TrialSpec(
    task=Choice("two-state", {"horizon": 10}),
    agent=Choice("ppo-lag", {"hidden_sizes": [8]}),
    method=Choice("none"),
    train_limits=CostLimits.unlimited(1),
    deploy_limits=CostLimits((3.0,)),
    train_steps=160,
    deploy_steps=40,
    num_envs=4,
    rollout_steps=10,
    evaluation_episodes=6,
    seed=5,
)
RIVER = replace(SPEC, task=Choice("rivergrid-1a", {"horizon": 12}), num_envs=2, rollout_steps=12)
BOTH = tuple(PolicyKind)


def run(folder: Path, spec: TrialSpec, *, updates: int | None = None) -> TrialStore:
    """The trial, stopped after some updates or run to its end."""
    store = SweepStore(folder, "small")
    answers = itertools.chain([False] * updates, [True]) if updates is not None else itertools.repeat(False)
    run_recorded(spec, store.trial(spec), should_stop=lambda: next(answers))
    store.write_info({"name": store.name})
    store.write_specs([spec])
    return store.trial(spec)


def contents(store: TrialStore) -> dict[str, bytes]:
    """Every file of the trial's own."""
    return {
        str(path.relative_to(store.folder)): path.read_bytes()
        for path in store.folder.rglob("*")
        if path.is_file() and path.parent not in (store.evaluations_folder, store.videos_folder)
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, TrialStore]:
    """Complete trials, by the name of their task."""
    return {spec.task.name: run(tmp_path_factory.mktemp("made"), spec) for spec in (SPEC, RIVER)}


def copied(trial: TrialStore, folder: Path) -> TrialStore:
    """A copy of a trial and its sweep."""
    shutil.copytree(trial.folder.parents[2], folder, dirs_exist_ok=True)
    [copy] = SweepStore(folder, "small").trials()
    return copy


@pytest.fixture
def complete(made: dict[str, TrialStore], tmp_path: Path) -> TrialStore:
    return copied(made["two-state"], tmp_path)


@pytest.fixture
def crossing(made: dict[str, TrialStore], tmp_path: Path) -> TrialStore:
    return copied(made["rivergrid-1a"], tmp_path)


def test_a_complete_trials_evaluation_comes_out_again(complete: TrialStore) -> None:
    before = contents(complete)
    saved = SavedTrial.load(complete)
    assert (saved.update, saved.env_steps) == (5, 200)
    evaluation = saved.evaluate(BOTH, num_episodes=6, seed=None)
    path = evaluation.path
    assert path == complete.evaluations_folder / "update-00000005__seed-own.csv"
    assert path.read_bytes() == complete.evaluation_path.read_bytes()
    pd.testing.assert_frame_equal(evaluation.rows, complete.evaluation(), check_dtype=False)
    assert contents(complete) == before


def test_a_smaller_evaluation_does_not_replace_a_larger_one(complete: TrialStore) -> None:
    saved = SavedTrial.load(complete)
    path = saved.evaluate(BOTH, num_episodes=20, seed=7).path
    larger = path.read_bytes()
    assert saved.evaluate(BOTH, num_episodes=20, seed=7).earlier is None  # the same again
    assert not complete.aside_folder.exists()
    earlier = saved.evaluate(BOTH[:1], num_episodes=4, seed=7).earlier
    assert len(path.read_bytes()) < len(larger)
    assert earlier is not None and earlier.read_bytes() == larger
    assert list(complete.aside_folder.iterdir()) == [earlier]


def test_another_seed_gives_other_episodes_and_the_same_seed_the_same(complete: TrialStore) -> None:
    saved = SavedTrial.load(complete)
    once, again, other = (saved.evaluate(BOTH[:1], num_episodes=20, seed=seed) for seed in (7, 7, 8))
    assert once.path.name == "update-00000005__seed-7.csv"
    assert once.rows.equals(again.rows)
    assert not once.rows.equals(other.rows)


@pytest.mark.parametrize(("horizon", "most"), [(10, "1,000"), (600, "1,200")])
def test_an_evaluation_ends_although_only_some_episodes_do(
    horizon: int, most: str, complete: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "MAX_STEPS", 1_000)
    environments = make_vector("two-state", 2, options={"horizon": horizon})
    collect = Collector.collect

    def without_the_second(self: Collector, *rest: Any) -> Any:
        rollout, finished = collect(self, *rest)
        return rollout, tuple(episode for episode in finished if episode.environment == 0)

    monkeypatch.setattr(Collector, "collect", without_the_second)
    policy, seed = SavedTrial.load(complete).policy, np.random.SeedSequence(0)
    with pytest.raises(RuntimeError, match=f"no episode ended in {most} steps of environment 1"):
        evaluate(policy, environments, PolicyKind.STOCHASTIC, num_episodes=8, seed=seed)


def test_a_stopped_trial_is_looked_at_as_far_as_it_is(tmp_path: Path) -> None:
    store = run(tmp_path, SPEC, updates=2)
    assert store.record().status is TrialStatus.WAITING
    assert SavedTrial.load(store).update == 2
    assert not store.evaluation_path.exists()


def test_a_damaged_checkpoint_is_passed_over_and_left_where_it_is(tmp_path: Path) -> None:
    run(tmp_path, SPEC, updates=2)
    store = run(tmp_path, SPEC)
    newest, _ = store.checkpoints()
    newest.write_bytes(newest.read_bytes()[:-1])
    assert SavedTrial.load(store).update == 2
    assert newest.exists()


def test_a_trial_without_a_checkpoint_is_a_sentence(tmp_path: Path) -> None:
    store = SweepStore(tmp_path, "small").trial(SPEC)
    store.begin(SPEC)
    with pytest.raises(NoCheckpointError, match=r"^two-state ppo-lag none seed 5: has no intact checkpoint"):
        SavedTrial.load(store)


def test_a_checkpoint_that_does_not_fit_is_a_sentence(complete: TrialStore) -> None:
    """Its tree has the networks of another agent, as if the agent's code had changed since."""
    other = replace(SPEC, agent=Choice("ppo-lag", {"hidden_sizes": [16]}))
    tree = complete.latest_checkpoint()
    assert tree is not None
    changed = TrialStore(complete.folder.parent / other.folder_name)
    changed.begin(other).commit(tree["trial"], update=5, env_steps=200)
    with pytest.raises(
        RecrlError, match=r"^two-state ppo-lag none seed 5: its checkpoint cannot be used with the installed "
    ):
        SavedTrial.load(changed)


def test_a_summary_is_hand_computed(complete: TrialStore) -> None:
    rows = pd.DataFrame(
        {
            "policy": ["stochastic"] * 3 + ["deterministic"],
            "episode_return": [1.0, 2.0, 3.0, 5.0],
            "cost_0": [2.0, 3.0, 4.0, 0.5],
        }
    )
    one, other = summary(rows, SavedTrial.load(complete))
    assert one["return"] == "2.00 ± 0.58"  # standard deviation 1, over the root of 3
    assert (one["costs"], one["d_d"], one["within"]) == ("3.00 ± 0.58", "3", "67%")
    assert (other["policy"], other["return"], other["within"]) == ("deterministic", "5.00", "100%")


def test_several_costs_of_a_summary_have_names(complete: TrialStore) -> None:
    saved = SavedTrial.load(complete)
    limits = CostLimits((3.0, 0.0))
    spec = replace(saved.spec, train_limits=limits, deploy_limits=limits)
    cmdp = replace(saved.cmdp, cost_names=("fuel", "crash"))
    rows = pd.DataFrame(
        {"policy": ["stochastic"] * 2, "episode_return": 1.0, "cost_0": [2.0, 4.0], "cost_1": [0.0, 0.0]}
    )
    [one] = summary(rows, replace(saved, spec=spec, cmdp=cmdp))
    assert (one["costs"], one["d_d"]) == ("fuel 3.00 ± 1.00, crash 0.00 ± 0.00", "3, 0")


def test_a_film_is_of_the_task_that_was_learnt(crossing: TrialStore) -> None:
    saved = SavedTrial.load(crossing)
    options = RIVER.task.options
    shots = list(
        film(
            saved.policy,
            make_drawn("rivergrid-1a", options=options),
            PolicyKind.DETERMINISTIC,
            num_costs=1,
            seed=np.random.SeedSequence(0),
        )
    )
    environments = make_vector("rivergrid-1a", 1, options=options)
    seed = np.random.SeedSequence(0)
    (episode,) = evaluate(saved.policy, environments, PolicyKind.DETERMINISTIC, num_episodes=1, seed=seed)
    assert [shot.step for shot in shots] == list(range(episode.length + 1))
    assert shots[-1].episode_return == pytest.approx(episode.episode_return)
    assert tuple(shots[-1].costs) == episode.costs
    assert shots[0].frame.shape == (288, 288, 3)
    drawn = make_drawn("rivergrid-1a", options=options)
    seldom = film(saved.policy, drawn, PolicyKind.DETERMINISTIC, num_costs=1, seed=seed, every=5)
    assert [shot.step for shot in seldom] == sorted({*range(0, episode.length + 1, 5), episode.length})


def test_a_video_has_a_picture_a_step(crossing: TrialStore) -> None:
    before = contents(crossing)
    path = SavedTrial.load(crossing).film(PolicyKind.STOCHASTIC, VideoFormat.GIF, seed=3)
    assert path == crossing.videos_folder / "update-00000009__seed-3__stochastic.gif"
    with Image.open(path) as video:
        assert 2 <= video.n_frames <= 13  # type: ignore[attr-defined]  # frames without a change are one
        assert video.size == (288, 312)
    assert contents(crossing) == before


def test_a_task_without_rendering_is_a_sentence(complete: TrialStore) -> None:
    with pytest.raises(
        RecrlError, match=r"^two-state ppo-lag none seed 5: the task two-state cannot be rendered"
    ):
        SavedTrial.load(complete).film(PolicyKind.STOCHASTIC, VideoFormat.GIF, seed=None)


@pytest.mark.parametrize(
    ("render", "reason"),
    [
        (lambda _: None, "render() must return an RGB image, a uint8 array of shape (H, W, 3), got NoneType"),
        (
            lambda _: np.zeros((4, 4, 3)),
            "render() must return an RGB image, a uint8 array of shape (H, W, 3), got float64 (4, 4, 3)",
        ),
        (
            gymnasium.Env.render,
            "it has no render(), which must return an RGB image, a uint8 array of shape (H, W, 3)",
        ),
    ],
)
def test_a_task_that_does_not_render_rgb_is_a_sentence(
    crossing: TrialStore, monkeypatch: pytest.MonkeyPatch, render: Any, reason: str
) -> None:
    monkeypatch.setattr(RiverGridEnv, "render", render)
    with pytest.raises(RecrlError) as error:
        SavedTrial.load(crossing).film(PolicyKind.STOCHASTIC, VideoFormat.GIF, seed=None)
    title = "rivergrid-1a ppo-lag none seed 5"
    assert str(error.value) == f"{title}: the task rivergrid-1a cannot be filmed: {reason}"


def test_an_error_of_a_tasks_own_rendering_is_kept(
    crossing: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def render(_: RiverGridEnv) -> None:
        raise NotImplementedError("only for people")

    monkeypatch.setattr(RiverGridEnv, "render", render)
    with pytest.raises(RecrlError, match=r"cannot be filmed: NotImplementedError: only for people$"):
        SavedTrial.load(crossing).film(PolicyKind.STOCHASTIC, VideoFormat.GIF, seed=None)


def test_a_task_with_a_wrong_frame_rate_is_a_sentence(
    crossing: TrialStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RiverGridEnv, "metadata", {**RiverGridEnv.metadata, "render_fps": "fast"})
    with pytest.raises(RecrlError, match="cannot be filmed: ValueError: could not convert string to float"):
        SavedTrial.load(crossing).film(PolicyKind.STOCHASTIC, VideoFormat.GIF, seed=None)


def test_a_task_that_cannot_be_closed_has_its_video(
    crossing: TrialStore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def close(_: RiverGridEnv) -> None:
        raise OSError("no display")

    monkeypatch.setattr(RiverGridEnv, "close", close)
    assert SavedTrial.load(crossing).film(PolicyKind.STOCHASTIC, VideoFormat.GIF, seed=None).exists()
    assert "rivergrid-1a raised an error when it was closed: OSError: no display" in caplog.text


@pytest.mark.parametrize("name", ["rivergrid-1b", "rivergrid", "gymnasium"])
def test_a_drawn_task_is_the_task(name: str) -> None:
    options = sample_options(name)
    environments, drawn = make_vector(name, 1, options=options), make_drawn(name, options=options)
    first, _ = environments.reset(seed=1)
    observation, _ = drawn.reset(seed=1)
    assert np.shape(observation) == first.shape[1:]
    info = drawn.step(drawn.action_space.sample())[4]
    assert np.size(info["cost"]) == environments.cmdp.num_costs
    frame = drawn.render()
    assert isinstance(frame, np.ndarray)
    assert frame.dtype == np.uint8
    drawn.close()


def test_evaluate_says_what_it_found_and_where(
    complete: TrialStore, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = complete.folder.parents[2]
    monkeypatch.chdir(root)
    command = "evaluate small two-state ppo-lag --root . --episodes 8 --seed 1"
    assert main(command.split()) == ExitCode.OK
    heads, stochastic, deterministic, legend, file = capsys.readouterr().out.splitlines()
    assert heads.split() == ["trial", "update", "policy", "episodes", "return", "costs", "d_d", "within"]
    assert stochastic.startswith("two-state ppo-lag none seed 5  5 of 5  stochastic     8         ")
    assert "  deterministic  8  " in deterministic
    assert legend == (
        "Means and standard errors. d_d: deployment limits; within: episodes in which no cost exceeded them."
    )
    csv = f"small/trials/{complete.folder.name}/evaluations/update-00000005__seed-1.csv"
    assert file == f"Episodes   {csv}"
    assert len(Path(csv).read_text().splitlines()) == 1 + 2 * 8


def test_evaluate_leaves_out_what_has_no_checkpoint(
    complete: TrialStore, capsys: pytest.CaptureFixture[str]
) -> None:
    root = str(complete.folder.parents[2])
    store = SweepStore(Path(root), "small")
    begun = replace(SPEC, seed=6)
    store.write_specs([SPEC, begun])
    store.trial(begun).begin(begun)
    assert main(["evaluate", "--root", root]) == ExitCode.TRIALS_FAILED
    sentence = "two-state ppo-lag none seed 6: has no intact checkpoint yet\n"
    assert capsys.readouterr().out.endswith(f"left out   {sentence}")
    assert main(["evaluate", "--root", root, "--only", "seed=6"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == f"recrl-sweep: {sentence}"
    assert main(["evaluate", "--root", root, "small", "nobody"]) == ExitCode.WRONG_INPUT
    assert capsys.readouterr().err == (
        "recrl-sweep: small: no trials on disk begin with 'nobody'; "
        f"see recrl-sweep status small --root {root}\n"
    )


def test_evaluate_films_on_demand(crossing: TrialStore, capsys: pytest.CaptureFixture[str]) -> None:
    root = str(crossing.folder.parents[2])
    arguments = ["evaluate", "--root", root, "--video", "--policy", "deterministic", "--episodes", "1"]
    assert main(arguments) == ExitCode.OK
    (video,) = crossing.videos_folder.iterdir()
    assert video.name == "update-00000009__seed-own__deterministic.gif"
    assert capsys.readouterr().out.splitlines()[-1] == f"Video      {video}"


def test_a_missing_film_is_no_success(complete: TrialStore, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["evaluate", "--root", str(complete.folder.parents[2]), "--video", "--episodes", "1"]
    assert main(arguments) == ExitCode.TRIALS_FAILED
    assert (
        "no video   two-state ppo-lag none seed 5: the task two-state cannot be rendered"
        in capsys.readouterr().out
    )


def test_a_launch_films_what_the_grid_wants(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grid.yaml").write_text(
        "name: small\n"
        "tasks: [{name: rivergrid-1a, deploy_limits: 5, options: {horizon: 12}}]\n"
        "agents: [ppo-lag]\n"
        "methods: [none]\n"
        "seeds: [3, 4]\n"
        "run: {total_steps: 96, num_envs: 4, evaluation_episodes: 2, videos: first-seed}\n"
    )
    launch = ["launch", "grid.yaml", "--executor", "inline", "--no-mlflow", "--no-figures"]
    assert main(launch) == ExitCode.OK
    assert "Videos     runs/small/trials/*/videos\n" in capsys.readouterr().out
    (video,) = Path("runs").rglob("videos/*")
    assert "__s3__" in video.parts[-3]
    assert main(launch) == ExitCode.OK
    assert "Videos" not in capsys.readouterr().out
    video.rename(
        video.with_name(video.name.replace("update-00000001", "update-00000000"))
    )  # an earlier policy
    assert main(launch) == ExitCode.OK
    assert video.exists()
