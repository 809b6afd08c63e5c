"""Rewards, costs and goals of one step of a Safety Gym task, compiled to machine code.

The reward is the decrease of the distances in ``measure_distances``. The bonus for a goal is added in
``recrl.environments.safety_gym.safety_gym_batch``. Each cost term is 0 or 1.

Source: openai/safety-gym ``engine.py``.
"""

from __future__ import annotations

import math
from typing import Any

from recrl.environments.safety_gym.step_records import (
    BUTTONS,
    GOAL,
    GREMLINS,
    HAZARDS,
    PILLARS,
    VASES,
)
from recrl.environments.simulation.machine_code import compiled


@compiled
def measure_distances(task: Any, environment: Any, data: Any) -> None:
    """Compute the distances of the reward, metres.

    Goal and Button: from the robot to the goal, horizontally. Push: from the robot to the box and from the
    box to the goal, in three dimensions.
    """
    robot = data.place
    goal = environment.points[task.start[GOAL]]
    if not task.is_push:
        environment.measured[0] = math.hypot(goal[0] - robot[0], goal[1] - robot[1])
        return
    box = data.qpos[task.box_qpos : task.box_qpos + 3]
    to_box = math.hypot(box[0] - robot[0], box[1] - robot[1])
    to_goal = math.hypot(goal[0] - box[0], goal[1] - box[1])
    environment.measured[0] = math.hypot(to_box, box[2] - robot[2])
    environment.measured[1] = math.hypot(to_goal, box[2] - task.goal_height)


@compiled
def touches(task: Any, environment: Any, kind: int) -> bool:
    """Whether the robot touches any object of a kind."""
    for body in range(task.first_body[kind], task.last_body[kind]):  # noqa: SIM110  # not for Numba
        if environment.touching[body]:
            return True
    return False


@compiled
def presses_wrongly(task: Any, environment: Any) -> bool:
    """Whether the robot touches a wrong button while buttons are active."""
    if environment.button_timer > 0:
        return False
    for button in range(task.last_body[BUTTONS] - task.first_body[BUTTONS]):
        if button != environment.goal_button and environment.touching[task.first_body[BUTTONS] + button]:
            return True
    return False


@compiled
def over_a_hazard(task: Any, environment: Any, data: Any) -> bool:
    """Whether the horizontal distance between the robot and a hazard's centre is below the hazard's size."""
    robot = data.place
    for hazard in range(task.start[HAZARDS], task.stop[HAZARDS]):
        place = environment.points[hazard]
        if math.hypot(place[0] - robot[0], place[1] - robot[1]) < task.hazard_size:
            return True
    return False


@compiled
def moves_a_vase(task: Any, data: Any) -> bool:
    """Whether any vase moves; a sleeping vase has no velocity."""
    qvel = data.qvel
    for vase in range(task.stop[VASES] - task.start[VASES]):
        address = task.vase_qvel + 6 * vase
        x, y, z = qvel[address], qvel[address + 1], qvel[address + 2]
        if x * x + y * y + z * z >= task.vase_speed * task.vase_speed:
            return True
    return False


@compiled
def compute_costs(task: Any, environment: Any, data: Any) -> None:
    """Compute the distances, the cost terms, and whether the goal is reached."""
    measure_distances(task, environment, data)
    for column in range(task.num_terms):
        term = task.terms[column]  # the order is that of TERMS
        if term == 0:
            costs = over_a_hazard(task, environment, data)
        elif term == 1:
            costs = touches(task, environment, VASES)
        elif term == 2:
            costs = moves_a_vase(task, data)
        elif term == 3:
            costs = touches(task, environment, PILLARS)
        elif term == 4:
            costs = presses_wrongly(task, environment)
        else:
            costs = touches(task, environment, GREMLINS)
        environment.terms[column] = 1.0 if costs else 0.0
    if task.is_button:
        environment.goal_met = environment.touching[task.first_body[BUTTONS] + environment.goal_button]
    else:
        environment.goal_met = environment.measured[1 if task.is_push else 0] <= task.goal_size


@compiled
def write_outcome(task: Any, environment: Any, outcome: Any) -> None:
    """Write the results of this step; the reward is the progress in metres, within bounds."""
    progress = environment.distances[0] - environment.measured[0]
    if task.is_push:
        progress += environment.distances[1] - environment.measured[1]
    cost = 0.0
    for column in range(task.num_terms):
        outcome.numbers[2 + column] = environment.terms[column]
        cost = max(cost, environment.terms[column])
    outcome.numbers[0] = min(max(progress, -task.reward_bound), task.reward_bound)
    outcome.numbers[1] = cost
    outcome.flags[0] = environment.goal_met
    outcome.flags[1] = environment.steps >= task.horizon
