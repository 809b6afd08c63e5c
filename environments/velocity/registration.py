"""The velocity tasks' names in Gymnasium's registry."""

from __future__ import annotations

import gymnasium

from recrl.environments.velocity.tasks import VELOCITY_TASKS


def register_velocity() -> None:
    """Make the tasks known to Gymnasium as ``recrl/<task>-v1``."""
    for name in VELOCITY_TASKS:
        identity = f"recrl/{name}-v1"
        if identity not in gymnasium.registry:
            gymnasium.register(
                identity,
                entry_point="recrl.environments.velocity.environments:VelocityEnv",
                vector_entry_point="recrl.environments.velocity.environments:VelocityVectorEnv",
                kwargs={"task": name},
                # Its checks would take a tenth of every step, and the tests have made them.
                disable_env_checker=True,
            )
