"""Safety Gym's tasks: B environments of one task, stepped together.

Observation: float32, the parts sorted by name (``SafetyTask.components``): the robot's sensors, and 16
pseudo-lidar bins for every kind of visible object. CarGoal2 has 72 numbers.
Action: two numbers in [-1, 1]; Car: the motors of the left and right wheel; Point: force forwards, turning
    speed.
Reward: decrease in this step of the distance from the robot to the goal, in metres. In Push: decrease of the
distance to the box, plus decrease of the distance from the box to the goal. Clipped to +-10. Plus 1 when the
goal is reached; then there is a new goal.
Cost: the indicator of each term of ``SafetyTask.cost_terms``: the robot is over a hazard; touches a vase,
    pillar, gremlin or wrong button; a vase moves.
Termination: when there is no room for a new goal, or when the physics breaks down (reward -10). Truncated
    after 1,000 steps.
Source: openai/safety-gym ``engine.py``; where safety-gymnasium 1.0.0 differs, this follows Safety Gym.

Notation: B environments, P objects that the lidar sees, k costs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.compiled_step import finish, review
from recrl.environments.safety_gym.gremlin_body import Body, choose_bodies, lead_gremlins
from recrl.environments.safety_gym.layout import keepouts, sample_goal, sample_layout
from recrl.environments.safety_gym.scene import make_scene, upright
from recrl.environments.safety_gym.step_records import ENVIRONMENT, NOT_YET, Physics, World
from recrl.environments.safety_gym.task_definitions import (
    BUTTON_DELAY,
    EXCEPTION_REWARD,
    HORIZON,
    SUBSTEPS,
    SafetyTask,
)
from recrl.environments.safety_gym.task_record import allocate, places_of_objects, task_record
from recrl.environments.saved_state import SavedState
from recrl.environments.simulation.environment_batch import (
    MOST_STEPS,
    Booleans,
    EnvironmentBatch,
    Observations,
)
from recrl.environments.simulation.mujoco_batch import Simulations

Integers = npt.NDArray[np.int64]

_NOBODY = np.zeros(0, np.intp)
_INPUTS = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS)


class SafetyGymOutcome(NamedTuple):
    """Result of one step.

    Attributes:
        rewards: [B].
        costs: whether any term costs, 0 or 1, [1, B].
        terms: the indicator of each cost term, in the order of ``SafetyTask.cost_terms``, [terms, B].
        goal_met: [B].
        terminated: [B].
        truncated: [B].
        broken: whether the physics diverged in this step, [B]; None if it did in no environment.
        finished: environments whose episode is over.
    """

    rewards: Floats
    costs: Floats
    terms: Floats
    goal_met: Booleans
    terminated: Booleans
    truncated: Booleans
    broken: Booleans | None
    finished: npt.NDArray[np.intp]


class SafetyGymBatch(EnvironmentBatch[SafetyTask, SafetyGymOutcome]):
    """B environments of one Safety Gym task; see ``EnvironmentBatch``.

    Args:
        task: which task.
        number: B, at least 1.
        horizon: steps after which an episode is truncated, at most 1,000.
        num_threads: threads of the physics; results do not depend on it.

    Attributes:
        task: as given.
        number: B.
        horizon: as given.
        scene: the physics' model.
        simulations: the physics.
        generators: one generator for each environment.
        qpos, qvel: coordinates and velocities, live views, [B, ...].
        group: for each kind of object that the lidar sees, its slice of P.

    The rest are live views of the records. After writing to them call ``refresh``. After writing to ``qpos``
    or ``qvel`` call ``simulations.forward`` first.
        points: (x, y) of everything that the lidar sees, metres, [B, P, 2], in the order of ``group``.
        steps: taken in this episode, [B].
        distances: distances before the step, for the reward, metres, [B, 1 or 2].
        measured: the same distances now. Goal and Button: from the robot to the goal, horizontally. Push:
        from the robot to the box and from the box to the goal, in three dimensions.
        terms: the indicator of each cost term, [B, terms].
        goal_met: whether the goal is reached, [B].
        goal_button: index of the button to press, [B].
        button_timer: steps until buttons are visible and active again, [B].
        circles: centres of the gremlins' circles, metres, [B, gremlins, 2].
        gremlin_yaws: radians, [B, gremlins].
        embodied: the gremlin that is a body, or a negative number, [B].
        acceleration: the robot's, in the world's frame, m/s^2, [B, 3].
        touching: bodies of ``scene.touchable`` that the robot touches, [B, bodies].
        record: the record ``TASK``, for compiled functions.
        world: all of this, for compiled functions.
    """

    def __init__(
        self, task: SafetyTask, number: int, *, horizon: int = HORIZON, num_threads: int = 1
    ) -> None:
        super().__init__(task, number, horizon=horizon, num_threads=num_threads)
        self.scene = make_scene(task)
        model = self.scene.model
        self.simulations = Simulations(model, number, num_threads=num_threads)
        self.group = places_of_objects(task)

        state = mujoco.mjtState
        self.qpos = self.simulations.state(state.mjSTATE_QPOS, (model.nq,))
        self.qvel = self.simulations.state(state.mjSTATE_QVEL, (model.nv,))
        self.mocap_pos = self.simulations.state(state.mjSTATE_MOCAP_POS, (model.nmocap, 3))
        self._controls = self.simulations.state(state.mjSTATE_CTRL, (model.nu,))
        self._action = np.zeros((number, model.nu))  # of the next step; not yet checked
        self._bodies = self._views_of_gremlins() if task.gremlins.number else None
        self._memory = memory = allocate(self.scene, number)
        physics = self._views_of_physics()
        self.world = World(memory.environments, physics, memory.course, memory.outcomes, memory.observations)
        self.record = task_record(self.scene, horizon)
        self._view_records()
        self.embodied[:] = NOT_YET

    def restart(self, ids: npt.NDArray[np.intp]) -> None:
        """Begin new episodes in some environments."""
        layouts = [sample_layout(self.task, self.generators[index]) for index in ids]
        self.simulations.reset(ids)
        for index, layout in zip(ids, layouts, strict=True):
            self._put_down(index, layout)
        self.simulations.forward(ids)
        self.steps[ids] = 0
        self.button_timer[ids] = 0
        self.embodied[ids] = NOT_YET
        self._renew_goals(ids)  # where there is no room for another one, that of the layout stays

    def set_actions(self, actions: npt.NDArray[Any]) -> bool:
        """Set the actions of the next step, [B, 2]; return False if one is not a number within [-1, 1]."""
        self._action[...] = given = np.asarray(actions, np.float64)
        return bool(np.abs(given).max() <= 1.0)  # False with NaN

    def advance(self) -> SafetyGymOutcome:
        """Take one step in every environment, with the actions that were set."""
        self._controls[...] = self._action
        if self._bodies is None:
            self.simulations.step(SUBSTEPS, derive=True)
        else:
            self._step_with_gremlins(self._bodies)
        finish(self.record, self.world)
        results, (goal_met, truncated) = self._memory.results.copy(), self._memory.flags.copy()
        rewards, costs, terms = results[0], results[1:2], results[2:]
        terminated, any_broken = np.zeros(self.number, np.bool_), self.simulations.any_broken()
        if not (any_broken or goal_met.any() or truncated.any()):
            return SafetyGymOutcome(rewards, costs, terms, goal_met, terminated, truncated, None, _NOBODY)
        broken = self.simulations.broken()
        rewards[broken] = EXCEPTION_REWARD
        results[1:, broken] = 0.0
        goal_met &= ~broken
        terminated |= broken
        if goal_met.any():
            rewards[goal_met] += 1.0
            reached = np.flatnonzero(goal_met)
            self.button_timer[reached] = BUTTON_DELAY
            terminated[reached] = ~self._renew_goals(reached)
        truncated &= ~terminated
        finished = np.flatnonzero(terminated | truncated)
        failed = broken if any_broken else None
        return SafetyGymOutcome(rewards, costs, terms, goal_met, terminated, truncated, failed, finished)

    def observations(self) -> Observations:
        """The last observations, [B, size]."""
        return self._memory.observations.copy()

    def refresh(self, ids: npt.NDArray[np.intp] | None = None) -> None:
        """Recompute distances, costs and observations of some environments, or all."""
        review(self.record, self.world, np.arange(self.number) if ids is None else ids)

    def _own_state(self) -> dict[str, Any]:
        """State of physics, layout, goals and counters."""
        return {
            "physics": self.simulations.save(),
            "environments": {
                name: self._memory.environments[name].copy() for name in ENVIRONMENT.names or ()
            },
            "observations": self.observations(),
        }

    def _load_own_state(self, saved: SavedState) -> None:
        records, bounds = saved.part("environments"), _bounds(self.task)
        environments = {}
        for name in ENVIRONMENT.names or ():
            least, most = bounds.get(name, (-np.inf, np.inf))
            environments[name] = records.array(name, self._memory.environments[name], least=least, most=most)
        observations = saved.array("observations", self._memory.observations)
        self.simulations.load(saved.part("physics"))
        for name, values in environments.items():
            self._memory.environments[name] = values
        self._memory.observations[...] = observations

    def _view_records(self) -> None:
        """Name the parts of the environments' records, cut to the sizes of this task."""
        records, task = self._memory.environments, self.task
        self.points: Floats = records["points"][:, : max(places.stop for places in self.group.values())]
        distances = 2 if task.goal == "Push" else 1
        self.distances: Floats = records["distances"][:, :distances]
        self.measured: Floats = records["measured"][:, :distances]
        self.terms: Floats = records["terms"][:, : len(task.cost_terms)]
        self.goal_met: Booleans = records["goal_met"]
        self.steps: Integers = records["steps"]
        self.goal_button: Integers = records["goal_button"]
        self.button_timer: Integers = records["button_timer"]
        self.circles: Floats = records["circles"][:, : task.gremlins.number]
        self.gremlin_yaws: Floats = records["gremlin_yaws"][:, : task.gremlins.number]
        self.embodied: Integers = records["embodied"]
        self.acceleration: Floats = records["acceleration"]
        self.touching: Booleans = records["touching"].view(np.bool_)[:, : self.scene.model.nbody]

    def _views_of_physics(self) -> Physics:
        """Return what MuJoCo computed, live views."""
        model, robot, output = self.scene.model, self.scene.robot_body, self.simulations.output
        return Physics(
            self.qpos,
            self.qvel,
            output("qacc", (model.nv,)),
            output("xpos", (model.nbody, 3))[:, robot],
            output("xmat", (model.nbody, 9))[:, robot],
            output("sensordata", (model.nsensordata,)),
        )

    def _views_of_gremlins(self) -> Body:
        """Return the state of the gremlins' bodies, live views."""
        scene, model, state = self.scene, self.scene.model, mujoco.mjtState
        velocities = slice(scene.gremlin_qvel, scene.gremlin_qvel + 6)
        turns = self.simulations.state(state.mjSTATE_MOCAP_QUAT, (model.nmocap, 4))
        return Body(
            self.qpos[:, scene.gremlin_qpos : scene.gremlin_qpos + 7],
            self.qvel[:, velocities],
            self.simulations.state(state.mjSTATE_QFRC_APPLIED, (model.nv,))[:, velocities],
            self.simulations.state(state.mjSTATE_EQ_ACTIVE, (model.neq,)),
            turns[:, scene.gremlin_mocap],
            self._controls,
            self.mocap_pos.reshape(self.number, -1),
        )

    def _step_with_gremlins(self, bodies: Body) -> None:
        """Take the physics steps of one step; leads of gremlins move before each of them."""
        choose_bodies(self.record, self.world, bodies)
        is_led = self.embodied >= 0
        led = np.flatnonzero(is_led)
        if len(led) < self.number:
            self.simulations.step(SUBSTEPS, np.flatnonzero(~is_led) if len(led) else None, derive=True)
        if len(led):
            numbers = bodies.controls.shape[1] + bodies.places.shape[1]
            inputs = np.empty((len(led), SUBSTEPS, numbers))
            lead_gremlins(self.record, self.world, bodies, led, inputs)
            self.simulations.step_with_inputs(inputs, _INPUTS, led if len(led) < self.number else None)

    def _put_down(self, index: int, layout: dict[str, Floats]) -> None:
        """Write one environment's layout into its simulation, with random orientations."""
        task, scene, generator = self.task, self.scene, self.generators[index]
        yaw = generator.uniform(0.0, 2.0 * np.pi)
        if task.robot == "Car":
            self.qpos[index, :2] = layout["robot"][0]
            self.qpos[index, 3:7] = upright(yaw)
        else:
            self.qpos[index, :3] = (*layout["robot"][0], yaw)
        for address, place in zip(scene.vase_qpos, layout["vases"], strict=True):
            self.qpos[index, address : address + 2] = place
            self.qpos[index, address + 3 : address + 7] = upright(generator.uniform(0.0, 2.0 * np.pi))
        for address, place in zip((scene.box_qpos,), layout["box"], strict=False):
            self.qpos[index, address : address + 2] = place
            self.qpos[index, address + 3 : address + 7] = upright(generator.uniform(0.0, 2.0 * np.pi))
        for kind, mocap in (("buttons", scene.button_mocap), ("pillars", scene.pillar_mocap)):
            self.mocap_pos[index, list(mocap), :2] = layout[kind]
        for kind, places in self.group.items():
            if len(layout[kind]):  # in Button no goal is placed: it is one of the buttons
                self.points[index, places] = layout[kind]
        self.circles[index] = layout["gremlins"]
        self.gremlin_yaws[index] = generator.uniform(0.0, 2.0 * np.pi, task.gremlins.number)

    def _renew_goals(self, ids: npt.NDArray[np.intp]) -> Booleans:
        """Sample new goals in some environments; return False if there is no room for one."""
        found = np.array([self._renew_goal(index) for index in ids])
        self.refresh(ids)
        self.distances[ids] = self.measured[ids]
        return found

    def _renew_goal(self, index: int) -> bool:
        generator = self.generators[index]
        goal = self.points[index, self.group["goal"].start]
        if self.task.goal == "Button":
            button = int(generator.integers(self.task.buttons.number))
            self.goal_button[index] = button
            goal[:] = self.points[index, self.group["buttons"].start + button]
            return True
        places, radii = [self.qpos[index, :2]], [keepouts(self.task)["robot"][1]]
        for kind, (number, keepout) in keepouts(self.task).items():
            if kind in self.group and kind != "goal":
                places.extend(self.points[index, self.group[kind]])
                radii.extend([keepout] * number)
        found = sample_goal(self.task, np.array(places), np.array(radii), generator)
        if found is None:
            return False
        goal[:] = found
        return True


def _bounds(task: SafetyTask) -> dict[str, tuple[int, int]]:
    """Return bounds of the saved counters and indices; compiled code does not check them."""
    return {
        "steps": (0, MOST_STEPS),
        "goal_button": (0, max(task.buttons.number - 1, 0)),
        "button_timer": (0, BUTTON_DELAY),
        "embodied": (NOT_YET, task.gremlins.number - 1),
        "touching": (0, 1),
    }
