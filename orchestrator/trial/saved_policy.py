"""Evaluate and film the policy in a trial's newest checkpoint.

The trial may be complete or running, and its own files do not change. Results are in two separate folders:

    evaluations/update-<update>__seed-<seed>.csv                one row per episode, as in evaluation.csv
    videos/update-<update>__seed-<seed>__<policy>.gif           one episode

``seed-own`` is the seed of the trial's own evaluation. With it and the trial's number of episodes, the result
equals a complete trial's ``evaluation.csv``.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from recrl.agents.agent import FinalPolicy, final_policy
from recrl.agents.evaluation import PolicyKind, Shot, film
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CMDPSpec
from recrl.environments.plugins import UntrustedNameError
from recrl.environments.registry import NotDrawnError, make_drawn
from recrl.orchestrator.errors import TRUST_HINT, USERS_ERRORS, RecrlError, described
from recrl.orchestrator.files.atomic_files import write_atomically
from recrl.orchestrator.files.row_files import rows_text
from recrl.orchestrator.files.trial_files import of_update
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.number_texts import with_error
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.trial.trial import TrialSeeds, evaluation_rows, open_environments
from recrl.orchestrator.trial.videos import VideoFormat, captioned, stride, write_video

DEFAULT_FRAMES_PER_SECOND = 10.0

logger = logging.getLogger("recrl.sweep")


class NoCheckpointError(RecrlError):
    """The trial has no intact checkpoint yet."""


@dataclass(frozen=True, eq=False)
class SavedEvaluation:
    """An evaluation of a trial's policy.

    Attributes:
        rows: one an episode, as in ``evaluation.csv``.
        path: the file with them.
        earlier: where an earlier evaluation of the same update and seed is kept, if it differs; None if none.
    """

    rows: pd.DataFrame
    path: Path
    earlier: Path | None


@dataclass(frozen=True, eq=False)
class SavedTrial:
    """The policy of a trial's newest intact checkpoint.

    Attributes:
        store: the trial's folder.
        spec: of the trial.
        policy: the final policy after these updates.
        cmdp: the task's CMDP.
        update: number of its policy updates.
        env_steps: number of its environment steps.
    """

    store: TrialStore
    spec: TrialSpec
    policy: FinalPolicy
    cmdp: CMDPSpec
    update: int
    env_steps: int

    @classmethod
    def load(cls, store: TrialStore) -> SavedTrial:
        """Load the policy from a trial's files.

        Raises:
            NoCheckpointError: there is no intact checkpoint.
            RecrlError: the task or the agent cannot be built, or the checkpoint does not fit them.
        """
        spec = store.spec
        checkpoint = store.latest_checkpoint()
        if checkpoint is None:
            raise NoCheckpointError(f"{spec.title}: has no intact checkpoint yet")
        try:
            tree = checkpoint["trial"]
            with open_environments(spec, 1) as environments:
                cmdp = environments.cmdp
            seed = TrialSeeds.of(spec).agent
            agent = make_agent(spec.agent.name, cmdp, spec.agent.options, seed)
            agent.load_state_dict(tree["agent"])
            return cls(store, spec, final_policy(agent), cmdp, tree["update"], tree["env_steps"])
        except UntrustedNameError as error:
            raise RecrlError(f"{spec.title}: {error}; {TRUST_HINT}") from error
        except USERS_ERRORS as error:
            raise RecrlError(
                f"{spec.title}: its checkpoint cannot be used with the installed task and agent: "
                f"{described(error)}"
            ) from error

    def evaluate(
        self, kinds: Sequence[PolicyKind], *, num_episodes: int, seed: int | None
    ) -> SavedEvaluation:
        """Evaluate the policy for whole episodes, and write a file with a row an episode.

        Args:
            kinds: stochastic, deterministic or both; at least one.
            num_episodes: for each, at least 1.
            seed: of the environments and the policy, at least 0; None for the trial's own.
        """
        rows = evaluate_saved(self.policy, self.spec, kinds, num_episodes=num_episodes, seed=seed)
        path = self.store.evaluations_folder / f"{self._file_name(seed)}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        text = rows_text(rows)
        differs = path.exists() and path.read_bytes() != text  # another number of episodes, or other kinds
        earlier = self.store.move_aside(path) if differs else None
        write_atomically(path, text)
        return SavedEvaluation(pd.DataFrame(rows), path, earlier)

    def film(self, kind: PolicyKind, video_format: VideoFormat, *, seed: int | None) -> Path:
        """Film one episode, with its return and costs below the frames.

        Args:
            kind: stochastic or deterministic.
            video_format: GIF or MP4.
            seed: of the environment and the policy, at least 0; None for the trial's own.

        Returns:
            The video.

        Raises:
            RecrlError: the task cannot be rendered, or this machine cannot render or encode it.
        """
        path, task = self.video_path(kind, video_format, seed=seed), self.spec.task
        try:
            environment = make_drawn(task.name, options=task.options)
        except NotDrawnError as error:
            raise RecrlError(f"{self.spec.title}: {error}") from error
        except USERS_ERRORS as error:
            raise RecrlError(f"{self.spec.title}: cannot be drawn: {described(error)}") from error
        try:
            speed = float(environment.metadata.get("render_fps") or DEFAULT_FRAMES_PER_SECOND)
            every = stride(video_format, frames_per_second=speed, longest=self.cmdp.horizon)
            shots = film(
                self.policy,
                environment,
                kind,
                num_costs=self.cmdp.num_costs,
                seed=_seed_sequence(self.spec, seed),
                every=every,
            )
            frames = (captioned(shot.frame, self._caption(shot)) for shot in shots)
            write_video(path, frames, frames_per_second=speed / every)
        except RecrlError:
            raise
        except NotDrawnError as error:
            raise RecrlError(f"{self.spec.title}: the task {task.name} cannot be filmed: {error}") from error
        except USERS_ERRORS as error:  # the user's task, or a missing graphics library
            raise RecrlError(f"{self.spec.title}: cannot be filmed: {described(error)}") from error
        finally:
            try:
                environment.close()
            except USERS_ERRORS as error:  # the video, or the error before, is what counts
                logger.warning("%s raised an error when it was closed: %s", task.name, described(error))
        return path

    def video_path(self, kind: PolicyKind, video_format: VideoFormat, *, seed: int | None) -> Path:
        """Return the path of the video of ``film``."""
        return self.store.videos_folder / f"{self._file_name(seed)}__{kind}.{video_format}"

    def _file_name(self, seed: int | None) -> str:
        return f"{of_update(self.update)}__seed-{'own' if seed is None else seed}"

    def _caption(self, shot: Shot) -> str:
        costs = ", ".join(
            f"{name} {cost:g} of {limit:g}"
            for name, cost, limit in zip(
                self.cmdp.cost_names, shot.costs.tolist(), self.spec.deploy_limits, strict=True
            )
        )
        return f"step {shot.step}   return {shot.episode_return:.1f}   {costs}"


def evaluate_saved(
    policy: FinalPolicy,
    spec: TrialSpec,
    kinds: Sequence[PolicyKind],
    *,
    num_episodes: int,
    seed: int | None,
) -> list[dict[str, Any]]:
    """Evaluate a policy on new environments of its trial; return the rows of ``trial.evaluation_rows``.

    Args:
        policy: chooses the actions.
        spec: of the trial.
        kinds: stochastic, deterministic or both; at least one.
        num_episodes: for each, at least 1.
        seed: of the environments and the policy, at least 0; None for the trial's own.

    Raises:
        RecrlError: the task cannot be made, or its code raises an error.
    """
    try:
        return evaluation_rows(
            policy, spec, kinds, num_episodes=num_episodes, seed=_seed_sequence(spec, seed)
        )
    except USERS_ERRORS as error:
        raise RecrlError(f"{spec.title}: cannot be evaluated: {described(error)}") from error


def _seed_sequence(spec: TrialSpec, seed: int | None) -> np.random.SeedSequence:
    return TrialSeeds.of(spec).evaluation if seed is None else np.random.SeedSequence(seed)


def summary(rows: pd.DataFrame, saved: SavedTrial) -> list[dict[str, Any]]:
    """Summarise an evaluation as text, one row per kind of policy.

    Means have standard errors, several costs their names; ``within`` is the fraction of the episodes in which
    no cost exceeded its d_d.
    """
    costs = [f"cost_{i}" for i in range(saved.cmdp.num_costs)]
    names = [f"{name} " for name in saved.cmdp.cost_names] if len(costs) > 1 else [""]
    limits = saved.spec.deploy_limits.array
    table = []
    for kind in PolicyKind:
        episodes = rows[rows["policy"] == kind]
        if episodes.empty:
            continue
        within = float((episodes[costs].to_numpy() <= limits).all(axis=1).mean())
        table.append(
            {
                "trial": saved.spec.title,
                "update": f"{saved.update} of {saved.spec.num_updates}",
                "policy": kind.value,
                "episodes": str(len(episodes)),
                "return": _mean_text(episodes["episode_return"]),
                "costs": ", ".join(
                    f"{name}{_mean_text(episodes[column])}" for name, column in zip(names, costs, strict=True)
                ),
                "d_d": ", ".join(f"{limit:g}" for limit in saved.spec.deploy_limits),
                "within": f"{within:.0%}",
            }
        )
    return table


def _mean_text(column: pd.Series[float]) -> str:
    """Format the mean and its standard error, ``9.50 ± 0.02``; the mean alone for a single value."""
    values = column.to_numpy(np.float64)
    error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return with_error(float(values.mean()), float(error))
