"""Sweeps and policies in Python: read results, and act with a trained policy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from recrl.environments.plugins import modules_here, refuse_import_paths
from recrl.orchestrator.errors import TRUST_HINT, RecrlError
from recrl.orchestrator.files.trial_files import DEFAULT_ROOT

NO_POLICIES = "an export and MLflow hold no policies; load the sweep from the folder it ran in"

if TYPE_CHECKING:
    import gymnasium
    import pandas as pd
    import torch

    from recrl.agents.agent import FinalPolicy
    from recrl.analysis.data.sweep_data import Sweep
    from recrl.environments.cmdp import CMDPSpec
    from recrl.orchestrator.files.sweep_store import SweepStore
    from recrl.orchestrator.files.trial_store import TrialStore
    from recrl.orchestrator.spec import TrialSpec


def load_sweep(
    source: str | Path, name: str | None = None, *, root: str | Path = DEFAULT_ROOT, trust: bool = False
) -> Sweep:
    """Read a finished or running sweep as tidy tables.

    Args:
        source: the sweep's folder (``runs/demo``), its name below ``root``, its grid file, an export
            (``demo.zip``), or an MLflow address (``http://host:port``, ``sqlite:///file.db``).
        name: of the sweep, only for an MLflow address; required there if it has several.
        root: the folder of all sweeps, for a name.
        trust: whether to follow the sweep's import paths, to compute the optimum of a task. This runs their
            code: do so only with files whose author you trust.

    Returns:
        An object with the data frames ``trials``, ``phases``, ``updates``, ``evaluations``, ``events`` and
        ``policies``. Each begins with the columns task, agent, method, seed. Returns and costs are
        undiscounted sums over an episode; ``recrl.analysis.data.sweep_data`` lists all columns.

    Raises:
        RecrlError: there is no such sweep, it cannot be read, or ``name`` is given without an address.

    Example:
        >>> import recrl
        >>> sweep = recrl.load_sweep("runs/demo")                      # doctest: +SKIP
        >>> final = sweep.evaluations.query("policy == 'stochastic'")   # doctest: +SKIP
        >>> by = ["task", "agent", "method", "seed"]                    # doctest: +SKIP
        >>> final.groupby(by, observed=True)["cost_0"].mean()           # doctest: +SKIP
    """
    from recrl.analysis.data import export, from_mlflow, sweep_data  # noqa: PLC0415
    from recrl.orchestrator.tracking.client import checked_uri  # noqa: PLC0415

    with following(trust):
        if "://" in str(source):
            return from_mlflow.load(checked_uri(str(source)), name)
        if name is not None:
            raise RecrlError(f"name: only an MLflow address takes one; give root and source, got {name!r}")
        if str(source).endswith(export.SUFFIX):
            return export.load(Path(source))
        return sweep_data.load(_up_to_date(Path(root), str(source)))


def load_policy(
    source: str | Path | Sweep, trial_id: str | None = None, *, seed: int | None = 0, trust: bool = False
) -> Policy:
    """Load the policy of a trial's newest checkpoint.

    Args:
        source: a sweep that ``load_sweep`` read from its folder; or, with ``trial_id``, the sweep's folder,
            or its name below ``runs``; or the folder of a trial, which ``recrl-sweep logs demo 3f2a
            --folder`` prints.
        trial_id: of the sweep's trial, from the column ``trial_id`` of ``sweep.trials``.
        seed: of the policy's random numbers; None for a random one.
        trust: whether to follow the trial's import paths. This runs their code: do so only with files whose
            author you trust.

    Returns:
        The policy, which does not learn.

    Raises:
        RecrlError: there is no such trial, it has no intact checkpoint, its code is not installed, or
            ``source`` is something else.

    Example:
        >>> import recrl
        >>> sweep = recrl.load_sweep("runs/demo")                      # doctest: +SKIP
        >>> policy = recrl.load_policy(sweep, sweep.trials.trial_id[0])  # doctest: +SKIP
        >>> policy.act(observation, deterministic=True)                 # doctest: +SKIP
    """
    from recrl.orchestrator.files.trial_store import TrialStore  # noqa: PLC0415

    if not isinstance(source, str | Path):
        folder = _folder_of(source, trial_id)
    elif str(source).endswith(".zip"):
        raise RecrlError(f"{source}: {NO_POLICIES}")
    elif trial_id is None:
        folder = Path(source)
    else:
        folder = _folder_below(source, trial_id)
    if not (folder / "spec.json").exists():
        raise RecrlError(
            f"{folder}: is not the folder of a trial; give the sweep and a trial_id, or see recrl-sweep logs "
            "SWEEP TRIAL --folder"
        )
    with following(trust):
        return policy_of(TrialStore(folder), seed=seed)


def _folder_of(sweep: Sweep, trial_id: str | None) -> Path:
    """The folder of a sweep's trial."""
    from recrl.analysis.data.sweep_data import Sweep  # noqa: PLC0415  (imports pandas)

    if not isinstance(sweep, Sweep):
        raise RecrlError(
            f"source: must be a sweep, a folder or a name, got {type(sweep).__name__}; a training has its "
            "policy already, training.policy"
        )
    if sweep.folder is None:
        raise RecrlError(f"{sweep.name}: {NO_POLICIES}")
    if trial_id is None:
        raise RecrlError(f"{sweep.name}: give a trial_id; sweep.trials has them")
    spec = next((it.spec for it in sweep.facts if it.spec.trial_id == trial_id), None)
    if spec is None:
        raise RecrlError(f"{sweep.name}: has no trial {trial_id!r}; sweep.trials has the column trial_id")
    folder = sweep.folder / "trials" / spec.folder_name
    if not folder.exists():
        raise RecrlError(f"{spec.title}: has not begun, so there is no policy yet")
    return folder


def _folder_below(source: str | Path, trial_id: str) -> Path:
    """The folder of a trial of the sweep with this name or folder."""
    store = _up_to_date(Path(DEFAULT_ROOT), str(source), checkpoints=True)
    trial = next((it for it in store.trials() if it.trial_id == trial_id), None)
    if trial is None:
        raise RecrlError(
            f"{store.name}: no trial {trial_id!r} has begun; load_sweep({str(source)!r}).trials has the "
            "column trial_id"
        )
    return trial.folder


def _up_to_date(root: Path, source: str, *, checkpoints: bool = False) -> SweepStore:
    """The folder of a sweep; a copy of one in an object store is brought up to date, or a warning logged."""
    from recrl.orchestrator.find_sweep import find_sweep  # noqa: PLC0415
    from recrl.orchestrator.remote.remote_sweep import sweep_place  # noqa: PLC0415

    place = sweep_place(find_sweep(root, source))
    place.refresh(checkpoints=checkpoints)
    return place.store


def policy_of(trial: TrialStore, *, seed: int | None) -> Policy:
    """Load the policy from a trial's files."""
    from recrl.orchestrator.trial.saved_policy import SavedTrial  # noqa: PLC0415

    trial.require_whole()
    saved = SavedTrial.load(trial)
    return Policy(saved.policy, saved.cmdp, saved.spec, saved.update, np.random.default_rng(seed))


@contextmanager
def following(trust: bool) -> Iterator[None]:
    """Follow the import paths of files only if their author is trusted; errors say how.

    Then modules in the working directory are found, too.
    """
    try:
        with modules_here() if trust else refuse_import_paths():
            yield
    except RecrlError as error:
        if TRUST_HINT not in str(error):
            raise
        raise RecrlError(str(error).replace(TRUST_HINT, "if you trust it, pass trust=True")) from error


@dataclass(eq=False, repr=False)
class Policy:
    """A trained policy pi(a | s) that does not learn.

    Attributes:
        final: chooses the actions.
        cmdp: the task's CMDP: ``observation_space``, ``action_space``, ``cost_names``, ``horizon``.
        spec: specification of its trial.
        update: number of its policy updates.
        generator: random numbers of ``act``.
    """

    final: FinalPolicy
    cmdp: CMDPSpec
    spec: TrialSpec
    update: int
    generator: np.random.Generator

    def __repr__(self) -> str:
        return f"<Policy of {self.spec.title} after {self.update} of {self.spec.num_updates} updates>"

    def act(self, observation: npt.ArrayLike, deterministic: bool = False) -> Any:
        """Choose actions.

        Args:
            observation: one observation [n], or a batch [B, n], as from ``recrl.make`` and
                ``recrl.make_env``.
            deterministic: whether to take the mode of the policy instead of a sample.

        Returns:
            For a batch, [B] (discrete actions) or [B, m], with the dtype of the action space
            (continuous ones, within the task's bounds). For one observation, an int or [m].

        Raises:
            ValueError: the observation has another shape, or is not finite.
        """
        from recrl.agents.spaces import environment_actions, observation_size  # noqa: PLC0415

        rows = np.asarray(observation, np.float32)
        size = observation_size(self.cmdp.observation_space)
        if rows.ndim not in (1, 2) or rows.shape[-1] != size:
            raise ValueError(
                f"an observation of {self.cmdp.name} must have shape ({size},), or (B, {size}) for a batch, "
                f"got {rows.shape}"
            )
        if not np.isfinite(rows).all():
            raise ValueError(f"an observation of {self.cmdp.name} must be finite")
        batch = np.atleast_2d(rows)
        chosen = self.final.act_greedily(batch) if deterministic else self.final.act(batch, self.generator)
        actions = environment_actions(self.cmdp.action_space, chosen)
        if rows.ndim == 2:
            return actions
        return int(actions[0]) if actions.ndim == 1 else actions[0]

    def evaluate(
        self, episodes: int = 100, *, seed: int | None = 0, deterministic: bool = False
    ) -> pd.DataFrame:
        """Run whole episodes on new environments of its task, without learning.

        The environments have the task's options and the number of the trial. Each runs the same number of
        episodes, give or take one: the first ones to end would mostly be short ones.

        Args:
            episodes: at least 1.
            seed: of the environments and of the policy; None for that of the trial's own evaluation.
            deterministic: whether to take the mode of the policy instead of a sample.

        Returns:
            One row per episode with index, length, episode_return and cost_i, undiscounted sums. They are
            those of ``recrl-sweep evaluate`` with this seed.

        Raises:
            RecrlError: the task cannot be made, or its code raises an error.
            ValueError: there are no episodes, or the seed is negative.

        Example:
            >>> policy.evaluate(500, seed=7)["cost_0"].agg(["mean", "sem"])  # doctest: +SKIP
        """
        import pandas as pd  # noqa: PLC0415

        from recrl.agents.evaluation import PolicyKind  # noqa: PLC0415
        from recrl.orchestrator.trial.saved_policy import evaluate_saved  # noqa: PLC0415

        if episodes < 1:
            raise ValueError(f"episodes: must be at least 1, got {episodes}")
        if seed is not None and seed < 0:
            raise ValueError(f"seed: must be at least 0 or None, got {seed}")
        kind = PolicyKind.DETERMINISTIC if deterministic else PolicyKind.STOCHASTIC
        with modules_here():
            rows = evaluate_saved(self.final, self.spec, (kind,), num_episodes=episodes, seed=seed)
        return pd.DataFrame(rows).drop(columns="policy")

    def make_env(self) -> gymnasium.Env[Any, Any]:
        """Make its task, with the trial's options, as one Gymnasium environment (``recrl.make_env``)."""
        from recrl._tasks import make_env  # noqa: PLC0415

        return make_env(self.spec.task.name, **self.spec.task.options)

    def to_torch_module(self) -> torch.nn.Module:
        """Return a copy of the policy as a module, for ``torch.export`` and ONNX.

        Returns:
            A module that maps observations, float32 [B, n], to logits [B, A] or, for continuous actions,
            means [B, m]; its buffer ``log_std`` holds their log standard deviations.

        Raises:
            RecrlError: the agent is your own and is not built on ``ActorCritic``.
        """
        from recrl.agents.learning.final_policy import NetworkPolicy  # noqa: PLC0415

        if not isinstance(self.final, NetworkPolicy):
            raise RecrlError(f"{self.spec.agent.label}: has no module; only agents built on ActorCritic do")
        return self.final.to_torch_module()

    def seed(self, seed: int) -> None:
        """Restart the policy's random numbers."""
        self.generator = np.random.default_rng(seed)
