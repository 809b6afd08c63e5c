"""Safety Gym's tasks: B worlds of one task, stepped together.

Observation: float32, the parts sorted by name (``SafetyTask.components``): the robot's sensors, and 16 bins
    of pseudo-lidar for every kind of object that can be seen. CarGoal2 has 72 numbers.
Action: two numbers in [-1, 1]; Car: the motors of the left and right wheel; Point: force forwards, turning
    speed.
Reward: metres by which the robot came nearer to the goal in this step; in Push, by which it came nearer to
    the box, plus those by which the box came nearer to the goal. Clipped to +-10. Plus 1 when the goal is
    reached, after which there is a new goal.
Cost: the indicator of each term of ``SafetyTask.cost_terms``: the robot is over a hazard; touches a vase,
    pillar, gremlin or wrong button; a vase moves.
Termination: when there is no room for a new goal, or when the physics breaks down (reward -10). Truncated
    after 1,000 steps.
Source: openai/safety-gym ``engine.py``; where safety-gymnasium 1.0.0 differs, this follows Safety Gym.

Letters: B worlds, P objects that the lidar sees, k costs.
"""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.gremlins import ALERT, IDLE_PLACE, NO_GREMLIN, ON_COURSE, gremlin_course, leads
from recrl.environments.layout import keepouts, sample_goal, sample_layout
from recrl.environments.lidar import egocentric, lidar
from recrl.environments.robot_sensors import RobotSensors, make_sensors
from recrl.environments.safety_tasks import (
    BUTTON_DELAY,
    EXCEPTION_REWARD,
    HORIZON,
    LIDAR_BINS,
    REWARD_BOUND,
    ROBOT_HEIGHT,
    SUBSTEPS,
    VASE_SPEED,
    SafetyTask,
)
from recrl.environments.scene import Scene, make_scene, upright
from recrl.environments.simulations import Simulations, anything

Booleans = npt.NDArray[np.bool_]
Observations = npt.NDArray[np.float32]

GOAL_HEIGHT = 0.16
"""Height of the goal area's middle, metres: in Push, distances to it are three-dimensional."""
_LEAST, _MOST = np.array(-REWARD_BOUND), np.array(REWARD_BOUND)
_NOBODY = np.zeros(0, np.intp)
_NONE = slice(0, 0)


class Outcome(NamedTuple):
    """What one step brought.

    Attributes:
        rewards: [B].
        terms: the indicator of each cost term, in the order of ``SafetyTask.cost_terms``, [B, terms].
        goal_met: [B].
        terminated: [B].
        truncated: [B].
        broken: the physics broke down in this step, [B]; None if it did so nowhere.
        finished: worlds whose episode is over.
    """

    rewards: Floats
    terms: Floats
    goal_met: Booleans
    terminated: Booleans
    truncated: Booleans
    broken: Booleans | None
    finished: npt.NDArray[np.intp]


class SafetyWorlds:
    """B worlds of one task. Whoever uses them restarts those that are over.

    Args:
        task: which task.
        number: B, at least 1.
        horizon: steps after which an episode is truncated, at most 1,000.
        num_threads: threads that step the physics; results do not depend on it.

    Attributes:
        task: as given.
        number: B.
        horizon: as given.
        scene: the physics' model.
        simulations: the physics.
        generators: one generator for each world.
        qpos, qvel, qacc: coordinates, velocities and accelerations, live views, [B, ...].
        points: (x, y) of everything that the lidar sees, metres, [B, P, 2]; ``group`` tells which is which.
        ranges: distances from the robot to all of them, seen from above, metres, [B, P].
        group: for each kind, its slice of P.
        steps: taken in this episode, [B].
        distances: those that the reward compares with, metres, [B, 1 or 2].
        goal_button: index of the button to press, [B].
        button_timer: steps until buttons are seen and felt again, [B].
        circles: middles of the gremlins' circles, metres, [B, gremlins, 2].
        gremlin_yaws: radians, [B, gremlins].
        embodied: the gremlin that is a body, or NO_GREMLIN, [B].
        touching: bodies of the model that the robot touches, of those that matter, [B, bodies].
    """

    distances: Floats
    button_timer: npt.NDArray[np.int64]

    def __init__(
        self, task: SafetyTask, number: int, *, horizon: int = HORIZON, num_threads: int = 1
    ) -> None:
        self.task = task
        self.number = number
        self.horizon = horizon
        self._num_threads = num_threads
        self.scene = make_scene(task)
        model = self.scene.model
        self.simulations = Simulations(model, number, num_threads=num_threads)
        self.generators: list[np.random.Generator] = []

        state = mujoco.mjtState
        self.qpos = self.simulations.state(state.mjSTATE_QPOS, (model.nq,))
        self.qvel = self.simulations.state(state.mjSTATE_QVEL, (model.nv,))
        self.mocap_pos = self.simulations.state(state.mjSTATE_MOCAP_POS, (model.nmocap, 3))
        self.mocap_quat = self.simulations.state(state.mjSTATE_MOCAP_QUAT, (model.nmocap, 4))
        self._control = self.simulations.state(state.mjSTATE_CTRL, (model.nu,))
        self.qacc = self.simulations.output("qacc", (model.nv,))
        self._object_awake = self.simulations.output("tree_awake", (model.ntree,), np.int32)[:, 1:]
        self.touching = np.zeros((number, model.nbody), np.bool_)
        self._touched: list[tuple[int, int]] = []
        self._root = model.body_rootid[model.geom_bodyid].tolist()

        self._lay_out_objects()
        self._lay_out_observations()
        self._indicators = [_INDICATORS[term] for term in task.cost_terms]
        self._everyone = np.arange(number)
        self._kinds = list(self.group.values())
        self._begin()
        self.refresh()

    def __reduce__(self) -> tuple[Any, ...]:
        state = self.state_dict() if self.generators else None
        return _rebuilt, (self.task, self.number, self.horizon, self._num_threads, state)

    def seed(self, seed: int | None) -> None:
        """Give each world a generator; world i has the same one whatever B is."""
        streams = np.random.SeedSequence(seed).spawn(self.number)
        self.generators = [np.random.Generator(np.random.PCG64(stream)) for stream in streams]

    def restart(self, ids: npt.NDArray[np.intp]) -> None:
        """Begin new episodes in some worlds."""
        layouts = [sample_layout(self.task, self.generators[index]) for index in ids]
        self.simulations.reset(ids)
        for index, layout in zip(ids, layouts, strict=True):
            self._put_down(index, layout)
        self.simulations.forward(ids)
        self.steps[ids] = 0
        self.button_timer[ids] = 0
        self._rest = self.horizon - int(self.steps.max())
        self.refresh()
        self._renew_goals(ids)

    def advance(self, actions: npt.NDArray[Any]) -> Outcome:
        """Take one step in every world.

        Args:
            actions: finite and within [-1, 1], [B, 2].
        """
        self._simulate(actions)
        self.steps += 1
        self._rest -= 1
        self.refresh()
        distances = self.measure()
        progress = self.distances - distances
        rewards = progress[:, 0] + progress[:, 1] if self.task.goal == "Push" else progress[:, 0]
        np.minimum(rewards, _MOST, out=rewards)
        np.maximum(rewards, _LEAST, out=rewards)
        self.distances = distances
        terms = self.cost_terms()
        if self._is_button and anything(self.button_timer):
            np.maximum(self.button_timer - 1, 0, out=self.button_timer)
        goal_met = self.goal_met()
        terminated = np.zeros(self.number, np.bool_)
        truncated = np.zeros(self.number, np.bool_)
        if self._rest <= 0:
            np.greater_equal(self.steps, self.horizon, out=truncated)
        broken = None
        if not self.simulations.intact() and (failed := self.simulations.broken()).any():
            broken = failed
            rewards[broken] = EXCEPTION_REWARD
            terms[broken] = 0.0
            goal_met &= ~broken
            terminated |= broken
        eventful = broken is not None
        if anything(goal_met):
            eventful = True
            rewards[goal_met] += 1.0
            met = np.flatnonzero(goal_met)
            self.button_timer[met] = BUTTON_DELAY
            terminated[met] = ~self._renew_goals(met)
        finished = _NOBODY
        if eventful or self._rest <= 0:
            truncated &= ~terminated
            finished = np.flatnonzero(terminated | truncated)
        return Outcome(rewards, terms, goal_met, terminated, truncated, broken, finished)

    def observations(self) -> Observations:
        """What the robots perceive now, [B, size]."""
        self._sensors.read()
        self._felt[...] = self._sensors.readings
        lidar(
            egocentric(self._sensors.turned, self._sensors.position),
            self._kinds,
            self._seen,
        )
        if self._is_button and anything(self.button_timer):
            self._seen[list(self.group).index("buttons"), self.button_timer > 0] = 0.0
        observations: Observations = self._readings.take(self._order)
        return observations

    def refresh(self) -> None:
        """Find everything where the simulations have it now."""
        self._place_movers()
        np.subtract(self._plane, self._robot_plane, out=self._offsets)
        np.abs(self._offsets, out=self.ranges)
        np.less(self.ranges, self._reaches, out=self._near)
        self._anything_near = anything(self._near)
        self._anything_stirs = anything(self._object_awake)
        self._feel()

    def measure(self) -> Floats:
        """The distances that the reward is made of, metres, [B, 1 or 2].

        Goal and Button: from the robot to the goal, seen from above. Push: from the robot to the box and
        from the box to the goal, in space.
        """
        goal = self.group["goal"].start
        if self.task.goal != "Push":
            return self.ranges[:, goal : goal + 1].copy()
        box = self.group["box"].start
        height = self._box[:, 2]
        robot_height = self.qpos[:, 2] if self.task.robot == "Car" else ROBOT_HEIGHT
        distances = np.empty((self.number, 2))
        np.hypot(self.ranges[:, box], height - robot_height, out=distances[:, 0])
        to_goal = np.abs(self._plane[:, goal] - self._plane[:, box])
        np.hypot(to_goal, height - GOAL_HEIGHT, out=distances[:, 1])
        return distances

    def goal_met(self) -> Booleans:
        """Whether the goal is reached, [B]; ``distances`` must be of now."""
        if not self._is_button:
            reached: Booleans = self.distances[:, -1] <= self.task.target.size
            return reached
        met = np.zeros(self.number, np.bool_)
        for index, button in self._pressed():
            met[index] |= button == self.goal_button[index]
        return met

    def pressed(self) -> Booleans:
        """Whether the robot touches each button, [B, buttons]."""
        return self.touching[:, self.scene.touchable["buttons"][0]].copy()

    def cost_terms(self) -> Floats:
        """The indicator of each cost term, [B, terms]."""
        terms = np.zeros((self.number, len(self.task.cost_terms)))
        for column, indicator in enumerate(self._indicators):
            indicator(self, terms[:, column])
        return terms

    def state_dict(self) -> dict[str, Any]:
        """Everything the future depends on: physics, layout, goals, counters, generators."""
        return {
            "physics": self.simulations.save(),
            "points": self.points.copy(),
            "steps": self.steps.copy(),
            "distances": self.distances.copy(),
            "goal_button": self.goal_button.copy(),
            "button_timer": self.button_timer.copy(),
            "circles": self.circles.copy(),
            "gremlin_yaws": self.gremlin_yaws.copy(),
            "embodied": self.embodied.copy(),
            "qacc": self.qacc.copy(),
            "touching": self.touching.copy(),
            "generators": [copy.deepcopy(dict(one.bit_generator.state)) for one in self.generators],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        if len(state["generators"]) != self.number:
            raise ValueError(
                f"{self.task.name}: the saved state is of {len(state['generators'])} environments, "
                f"these are {self.number}"
            )
        self.simulations.load(state["physics"])
        # Loading computes nothing: what the last step computed is put back as well.
        self.qacc[...] = state["qacc"]
        for name in (
            "points",
            "steps",
            "distances",
            "goal_button",
            "button_timer",
            "circles",
            "gremlin_yaws",
            "embodied",
        ):
            getattr(self, name)[...] = state[name]
        if self._has_gremlins:
            self._controls[:, :, self._control.shape[1] :] = self.mocap_pos.reshape(self.number, 1, -1)
        self.seed(0)
        for generator, saved in zip(self.generators, state["generators"], strict=True):
            generator.bit_generator.state = saved
        self.refresh()
        self.touching[...] = state["touching"]
        self._touched = [(int(index), int(body)) for index, body in np.argwhere(self.touching)]
        self._rest = self.horizon - int(self.steps.max())

    def _lay_out_objects(self) -> None:
        """Give everything that the lidar sees its place in ``points``."""
        task, number = self.task, self.number
        counts = {"goal": 1} | {
            kind: number for kind, (number, _) in keepouts(task).items() if kind != "goal"
        }
        self.group: dict[str, slice] = {}
        end = 0
        for kind in task.lidars:
            self.group[kind] = slice(end, end + counts[kind])
            end += counts[kind]
        self._sensors = make_sensors(task.robot, self.qpos, self.qvel, self.qacc, end)
        self.points = self._sensors.points
        self.ranges = np.zeros((number, end))
        # (x, y) as x + iy: one operation instead of five for a distance.
        self._plane = self.points.view(np.complex128)[..., 0]
        self._offsets = np.zeros_like(self._plane)
        self._robot_plane = self.qpos[:, :2].view(np.complex128)
        # Which objects are so near that it may matter.
        self._near = np.zeros((number, end), np.bool_)
        self._reaches = np.concatenate(
            [np.full(counts[kind], _reach(task, self.scene, kind)) for kind in task.lidars]
        )
        self._near_hazards = self._near[:, self.group.get("hazards", _NONE)]
        # What can be touched follows on one another, but for a goal, which is not felt.
        touchable = [self.group[kind] for kind in self.scene.touchable] or [_NONE]
        self._near_touchable = self._near[:, touchable[0].start : touchable[-1].stop]
        self._touchable = {
            body for bodies, _ in self.scene.touchable.values() for body in range(bodies.start, bodies.stop)
        }

        vases, box = task.vases.number, task.box.number
        self._has_vases, self._has_box, self._is_button = vases > 0, box > 0, task.goal == "Button"
        self._vases = self.qpos[:, self.scene.robot_qpos :][:, : 7 * vases].reshape(number, vases, 7)[..., :2]
        self._vase_velocities = self.qvel[:, self.scene.robot_qvel :][:, : 6 * vases].reshape(
            number, vases, 6
        )[..., :3]
        self._box = self.qpos[:, self.scene.box_qpos :][:, :3]
        self._vase_points = self.points[:, self.group.get("vases", _NONE)]
        self._box_points = self.points[:, self.group.get("box", _NONE)]

    def _lay_out_observations(self) -> None:
        """Decide where the parts of an observation are computed, and from where they are taken."""
        task, number = self.task, self.number
        seen = (len(task.lidars), number, LIDAR_BINS)
        self._readings = np.zeros(len(self._sensors.readings) + math.prod(seen), np.float32)
        self._felt, self._seen = np.split(self._readings, [len(self._sensors.readings)])
        self._seen = self._seen.reshape(seen)
        self._order = _sorted_order(task, self._sensors, seen)

    def _begin(self) -> None:
        """Make room for what changes within an episode, and for what leads the gremlins."""
        task, number, model = self.task, self.number, self.scene.model
        self.steps = np.zeros(number, np.int64)
        self.distances = np.zeros((number, 2 if task.goal == "Push" else 1))
        self.goal_button = np.zeros(number, np.int64)
        self.button_timer = np.zeros(number, np.int64)
        self.circles = np.zeros((number, task.gremlins.number, 2))
        self.gremlin_yaws = np.zeros((number, task.gremlins.number))
        self.embodied = np.full(number, NO_GREMLIN)
        self._has_gremlins = task.gremlins.number > 0
        if self._has_gremlins:
            gremlin, velocity = self.scene.gremlin_qpos, self.scene.gremlin_qvel
            self._gremlin = self.qpos[:, gremlin : gremlin + 7]
            self._gremlin_velocity = self.qvel[:, velocity : velocity + 6]
            state = mujoco.mjtState
            self._tied = self.simulations.state(state.mjSTATE_EQ_ACTIVE, (model.neq,))[:, 0]
            self._lift = self.simulations.state(state.mjSTATE_QFRC_APPLIED, (model.nv,))[:, velocity + 2]
            self._gremlin_weight = -float(model.body("gremlin").mass[0] * model.opt.gravity[2])
            self._gremlin_ranges = self.ranges[:, self.group["gremlins"]]
            self._alert = self.scene.touchable["gremlins"][1] + ALERT
            self._gremlin_points = self.points[:, self.group["gremlins"]]
            self._course = gremlin_course(task)
            self._course_points = np.ascontiguousarray(self._course.positions[:, None, :2])
            self._leads = leads(task.timestep, np.arange(HORIZON + 1.0) * SUBSTEPS)[..., :2].copy()
            self._controls = np.zeros((number, SUBSTEPS, model.nu + 3 * model.nmocap))
            lead = model.nu + 3 * self.scene.gremlin_mocap
            self._lead = slice(lead, lead + 2)

    def _place_movers(self) -> None:
        """Find the objects that move."""
        if self._has_vases:
            self._vase_points[...] = self._vases
        elif self._has_box:
            self._box_points[...] = self._box[:, None, :2]
        elif self._has_gremlins:
            np.add(self.circles, self._course_points.take(self.steps, axis=0), out=self._gremlin_points)
            for index, gremlin in enumerate(self.embodied.tolist()):
                if gremlin != NO_GREMLIN:
                    self._gremlin_points[index, gremlin] = self._gremlin[index, :2]

    def _feel(self) -> None:
        """Find what the robots touch.

        Contacts are looked up only where something can be touched: it is near, and, if it is a vase, awake.
        A sensor for them would cost time in every physics step.
        """
        if self._touched:
            self.touching[...] = False
            self._touched = []
        if not (self._anything_near and self.scene.touchable):
            return
        if self._has_vases and not self._anything_stirs:
            return
        robot, roots = self.scene.robot_body, self._root
        for index in np.logical_or.reduce(self._near_touchable, axis=1).nonzero()[0].tolist():
            if self._has_vases and not anything(self._object_awake[index]):
                continue
            for one, other in self.simulations.contacts(index).tolist():
                pair = roots[one], roots[other]
                body = pair[pair[0] == robot]
                if robot in pair and body in self._touchable:
                    self.touching[index, body] = True
                    self._touched.append((index, body))

    def _simulate(self, actions: npt.NDArray[Any]) -> None:
        self._control[...] = actions
        if not self._has_gremlins:
            self.simulations.step(SUBSTEPS)
            return
        self._embody_near()
        bodies = self.embodied != NO_GREMLIN
        met = bodies.nonzero()[0]
        if len(met) < self.number:
            self.simulations.step(SUBSTEPS, (~bodies).nonzero()[0])
        if len(met):
            controls = self._controls[met]
            controls[:, :, : self._control.shape[1]] = actions[met, None]
            own_circles = self.circles[met, self.embodied[met]]
            controls[:, :, self._lead] = self._leads[self.steps[met]] + own_circles[:, None]
            state = mujoco.mjtState
            components = state.mjSTATE_CTRL.value | state.mjSTATE_MOCAP_POS.value
            self.simulations.step_under(controls, components, met)

    def _embody_near(self) -> None:
        """Make the gremlin that the robot may meet next a body, or none, where that changes nothing."""
        wanted = self._gremlin_ranges.argmin(axis=1)
        wanted[np.minimum.reduce(self._gremlin_ranges, axis=1) > self._alert] = NO_GREMLIN
        for index in (wanted != self.embodied).nonzero()[0].tolist():
            if self._on_course(index):
                self._embody(index, wanted[index])

    def _on_course(self, index: int) -> bool:
        """Whether the gremlin that is a body, if one is, could as well be none."""
        if self.embodied[index] == NO_GREMLIN:
            return True
        astray = self._gremlin[index, :3] - self._course.positions[self.steps[index]]
        astray[:2] -= self.circles[index, self.embodied[index]]
        touched = self.touching[index, self.scene.touchable["gremlins"][0]][0]
        return not touched and bool(np.square(astray).sum() < ON_COURSE**2)

    def _embody(self, index: int, gremlin: int) -> None:
        """Make this gremlin the body, or none: the body then hovers, untied, where nothing is."""
        self.embodied[index] = gremlin
        self._tied[index] = gremlin != NO_GREMLIN
        self._lift[index] = 0.0
        if gremlin == NO_GREMLIN:
            self._gremlin[index, :3] = IDLE_PLACE
            self._gremlin_velocity[index] = 0.0
            self._lift[index] = self._gremlin_weight
            return
        step = self.steps[index]
        orientation = upright(self.gremlin_yaws[index, gremlin])
        self._gremlin[index, :3] = self._course.positions[step]
        self._gremlin[index, :2] += self.circles[index, gremlin]
        self._gremlin[index, 3:] = orientation
        self._gremlin_velocity[index] = self._course.velocities[step]
        self.mocap_quat[index, self.scene.gremlin_mocap] = orientation

    def _put_down(self, index: int, layout: dict[str, Floats]) -> None:
        """Write one world's layout into its simulation, everything turned at random."""
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
        for kind in ("hazards", "buttons", "pillars"):
            if kind in self.group:
                self.points[index, self.group[kind]] = layout[kind]
        if task.gremlins.number:
            self.circles[index] = layout["gremlins"]
            self.gremlin_yaws[index] = generator.uniform(0.0, 2.0 * np.pi, task.gremlins.number)
            self.steps[index] = 0
            apart = np.hypot(*(layout["gremlins"] - layout["robot"]).T)
            self._embody(index, int(apart.argmin()) if apart.min() <= self._alert else NO_GREMLIN)
            self._controls[index, :, self._control.shape[1] :] = self.mocap_pos[index].reshape(-1)

    def _renew_goals(self, ids: npt.NDArray[np.intp]) -> Booleans:
        """Choose new goals in some worlds; False where there is no room for one."""
        found = np.ones(len(ids), np.bool_)
        for position, index in enumerate(ids):
            found[position] = self._renew_goal(index)
        goal = self.group["goal"].start
        self.ranges[ids, goal] = np.abs(self._plane[ids, goal] - self._robot_plane[ids, 0])
        self.distances[ids] = self.measure()[ids]
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

    def _cost_of_hazards(self, costly: Floats) -> None:
        if self._anything_near:
            costly[...] = np.logical_or.reduce(self._near_hazards, axis=1)

    def _cost_of_vases_contact(self, costly: Floats) -> None:
        self._cost_of_touching("vases", costly)

    def _cost_of_vases_velocity(self, costly: Floats) -> None:
        if self._anything_stirs:  # what sleeps has no velocity
            squares = np.add.reduce(self._vase_velocities * self._vase_velocities, axis=2)
            costly[...] = np.maximum.reduce(squares, axis=1) >= VASE_SPEED**2

    def _cost_of_pillars(self, costly: Floats) -> None:
        self._cost_of_touching("pillars", costly)

    def _cost_of_buttons(self, costly: Floats) -> None:
        for index, button in self._pressed():
            if button != self.goal_button[index] and not self.button_timer[index]:
                costly[index] = 1.0

    def _cost_of_gremlins(self, costly: Floats) -> None:
        self._cost_of_touching("gremlins", costly)

    def _cost_of_touching(self, kind: str, costly: Floats) -> None:
        bodies = self.scene.touchable[kind][0]
        for index, body in self._touched:
            if bodies.start <= body < bodies.stop:
                costly[index] = 1.0

    def _pressed(self) -> list[tuple[int, int]]:
        """Worlds and the buttons that are pressed in them."""
        buttons = self.scene.touchable["buttons"][0]
        return [
            (index, body - buttons.start)
            for index, body in self._touched
            if buttons.start <= body < buttons.stop
        ]


_INDICATORS = {
    "hazards": SafetyWorlds._cost_of_hazards,
    "vases_contact": SafetyWorlds._cost_of_vases_contact,
    "vases_velocity": SafetyWorlds._cost_of_vases_velocity,
    "pillars": SafetyWorlds._cost_of_pillars,
    "buttons": SafetyWorlds._cost_of_buttons,
    "gremlins": SafetyWorlds._cost_of_gremlins,
}
"""For each cost term, what writes 1 where it costs into zeros, [B]."""


def _reach(task: SafetyTask, scene: Scene, kind: str) -> float:
    """The distance within which it matters, metres, that an object of this kind is near."""
    if kind == "hazards":
        return task.hazards.size
    return scene.touchable[kind][1] if kind in scene.touchable else 0.0


def _sorted_order(
    task: SafetyTask, sensors: RobotSensors, seen: tuple[int, int, int]
) -> npt.NDArray[np.intp]:
    """Where each number of the observations is found among the readings as they are computed, [B, size].

    Args:
        task: gives the parts of an observation.
        sensors: their readings come first.
        seen: the shape of the lidar's readings, (kinds, B, bins), which follow.
    """
    places = len(sensors.readings) + np.arange(math.prod(seen)).reshape(seen)
    computed = sensors.places | {f"{kind}_lidar": places[row] for row, kind in enumerate(task.lidars)}
    return np.concatenate([computed[name] for name, _ in task.components], axis=1)


def _rebuilt(
    task: SafetyTask, number: int, horizon: int, num_threads: int, state: dict[str, Any] | None
) -> SafetyWorlds:
    """A copy of pickled worlds."""
    worlds = SafetyWorlds(task, number, horizon=horizon, num_threads=num_threads)
    if state is not None:
        worlds.load_state_dict(state)
    return worlds
