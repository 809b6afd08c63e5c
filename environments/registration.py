"""Names of our tasks in Gymnasium's registry.

    gymnasium.make("recrl.environments.registration:recrl/CarGoal2-v0")

Gymnasium imports the module before the colon, which registers all tasks. Without it, import this module
first: since version 1.0 Gymnasium loads no entry points of other packages. The tasks themselves are imported
when one of them is made. The name of this module is part of every id, in users' code and in grids, so it must
not change. ``registry.py`` beside it has the tasks by the names that a grid uses.
"""

from __future__ import annotations

from typing import Any

import gymnasium

from recrl.environments.rivergrid.maps import MAPS
from recrl.environments.safety_gym.task_definitions import SAFETY_TASKS
from recrl.environments.velocity.task_definitions import VELOCITY_TASKS

RIVER_GRID = "recrl.environments.rivergrid"
SAFETY_GYM = "recrl.environments.safety_gym.safety_gym_environments"
VELOCITY = "recrl.environments.velocity.velocity_environments"


def register_all() -> None:
    """Register all tasks with Gymnasium: ``recrl/RiverGrid-1a-v0``, ``recrl/CarGoal2-v0``, and so on."""
    if "recrl/RiverGrid-v0" in gymnasium.registry:
        return
    river_grid = f"{RIVER_GRID}.minigrid_env:RiverGridEnv", f"{RIVER_GRID}.grid_world:vector_of_task"
    _register("recrl/RiverGrid-v0", "rivergrid", *river_grid, map=MAPS["1a"])
    for name in MAPS:
        _register(f"recrl/RiverGrid-{name}-v0", f"rivergrid-{name}", *river_grid)
    for name in SAFETY_TASKS:
        _register(f"recrl/{name}-v0", name, f"{SAFETY_GYM}:SafetyGymEnv", f"{SAFETY_GYM}:SafetyGymVectorEnv")
    for name in VELOCITY_TASKS:
        _register(f"recrl/{name}-v1", name, f"{VELOCITY}:VelocityEnv", f"{VELOCITY}:VelocityVectorEnv")


def _register(identifier: str, task: str, single: str, batch: str, **options: Any) -> None:
    gymnasium.register(
        identifier,
        entry_point=single,
        vector_entry_point=batch,
        kwargs={"task": task, **options},
        disable_env_checker=True,  # its checks would take a tenth of every step; the tests apply them
    )


register_all()
