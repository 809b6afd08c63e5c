"""The robots' models: those that come with Gymnasium, for its MuJoCo environments of version 4.

They were written for MuJoCo 2, in which two shapes touch when they are nearer than the larger of their two
margins. MuJoCo 3 and 4 add the margins up: unchanged, Ant, Hopper and Humanoid would hover, up to a
centimetre higher than in every published result. So margins are halved, which gives MuJoCo 2's contacts
back: all shapes of a model have the same one.
"""

from __future__ import annotations

import functools
from pathlib import Path

import gymnasium
import mujoco
import numpy as np

from recrl.environments.velocity.tasks import VelocityTask

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


@functools.lru_cache(maxsize=16)
def make_model(task: VelocityTask) -> mujoco.MjModel:
    """The task's compiled model; the same object every time, and read-only."""
    path = ASSETS / task.model
    if not path.is_file():
        raise ImportError(
            f"{task.name}: gymnasium must bring the model {path}, and does not: install it anew"
        )
    specification = mujoco.MjSpec.from_file(str(path))
    # MuJoCo scales masses no longer while it compiles a model, but asks for it afterwards.
    total_mass, specification.compiler.settotalmass = specification.compiler.settotalmass, -1.0
    model = specification.compile()
    if total_mass > 0.0:
        mujoco.mj_setTotalmass(model, total_mass)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    margins = np.unique(model.geom_margin)
    if len(margins) > 1:
        raise ValueError(
            f"{task.name}: all shapes of {path} must have the same margin, got {margins.tolist()}"
        )
    model.geom_margin[:] *= 0.5
    return model
