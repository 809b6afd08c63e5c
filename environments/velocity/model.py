"""Models of the robots, from Gymnasium's MuJoCo environments of version 4.

They were written for MuJoCo 2, in which two shapes touch when they are nearer than the larger of their two
margins. MuJoCo 3 and 4 add the margins. Unchanged, Ant, Hopper and Humanoid would hover up to a centimetre
higher than in published results. So margins are halved. As all shapes of a model have the same margin, this
restores MuJoCo 2's contacts.
"""

from __future__ import annotations

import functools
from pathlib import Path

import gymnasium
import mujoco
import numpy as np

from recrl.environments.velocity.task_definitions import VelocityTask

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


@functools.lru_cache(maxsize=16)
def make_model(task: VelocityTask) -> mujoco.MjModel:
    """Return the task's compiled model; always the same object, and read-only."""
    path = ASSETS / task.model
    if not path.is_file():
        raise ImportError(f"{task.name}: gymnasium must contain the model {path}, and does not: reinstall it")
    specification = mujoco.MjSpec.from_file(str(path))
    # MuJoCo no longer scales masses while it compiles a model, but in a separate call.
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
