"""Safety-Gymnasium's velocity tasks: B environments of one task, stepped together.

Observation: float32. The robot's coordinates without its position (the first one or two), then its velocities
(Hopper, Walker2d: clipped to +-10). Humanoid adds inertia (10 numbers) and velocity (6) of each of 14 bodies,
actuator forces (23), and each body's contact force (6). Gymnasium's Ant observes no
contact forces.
Action: the controls, within [-1, 1]; Humanoid: within [-0.4, 0.4].
Reward: w_v vx - w_a |a|^2 + the reward for being healthy, with the task's weights. vx is the distance along x
    over the step, divided by its seconds: of the first coordinate; Ant: of the torso; Humanoid: of the
    centre of mass.
Cost: 1 in a step in which the velocity exceeds the task's threshold, else 0. The velocity is vx; Ant and
    Humanoid: sqrt(vx^2 + vy^2).
Termination: when the robot has fallen (``VelocityTask.healthy``; HalfCheetah and Swimmer never do), or when
the physics diverges (reward and cost 0). Truncated after 1,000 steps.
Source: Gymnasium's MuJoCo environments of version 4 with the thresholds of safety-gymnasium 1.0.0, version 1.

As in Gymnasium, positions and velocities of bodies are those that MuJoCo computed last, up to one physics
step old. This concerns Ant's torso, and Humanoid's centre of mass, inertias, velocities and forces.

Notation: B environments, nq coordinates, nv velocities.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.saved_state import SavedState
from recrl.environments.simulation.environment_batch import MOST_STEPS, EnvironmentBatch, Observations
from recrl.environments.simulation.mujoco_batch import Simulations
from recrl.environments.velocity.model import make_model
from recrl.environments.velocity.task_definitions import HORIZON, Booleans, VelocityTask

TORSO = 1
"""The torso's body; body 0 is the floor."""


class VelocityOutcome(NamedTuple):
    """Result of one step.

    Attributes:
        rewards: [B].
        costs: 0 or 1, [B].
        velocities: velocities that are compared with the threshold, m/s, [B].
        terminated: [B].
        truncated: [B].
        broken: whether the physics diverged in this step, [B]; None if it did in no environment.
        finished: environments whose episode is over.
    """

    rewards: Floats
    costs: Floats
    velocities: Floats
    terminated: Booleans
    truncated: Booleans
    broken: Booleans | None
    finished: npt.NDArray[np.intp]


class VelocityBatch(EnvironmentBatch[VelocityTask, VelocityOutcome]):
    """B environments of one velocity task; see ``EnvironmentBatch``.

    Args:
        task: which task.
        number: B, at least 1.
        horizon: steps after which an episode is truncated, at most 1,000.
        num_threads: threads of the physics; results do not depend on it.

    Attributes:
        task, number, horizon: as given.
        model: the physics' model.
        simulations: the physics.
        generators: one generator for each environment.
        seconds: simulated time of a step.
        bound: of the actions, which are within plus or minus this.
        observed: numbers in an observation.
        qpos, qvel: coordinates and velocities, live views, [B, nq] and [B, nv].
        bodies: fields of the bodies that the task needs, by MuJoCo's name, as computed last, live views,
            [B, ...].
        places: last measured position of each robot, metres, [B, axes].
        steps: taken in this episode, [B].
    """

    def __init__(
        self, task: VelocityTask, number: int, *, horizon: int = HORIZON, num_threads: int = 1
    ) -> None:
        super().__init__(task, number, horizon=horizon, num_threads=num_threads)
        self.model = model = make_model(task)
        self.simulations = Simulations(model, number, num_threads=num_threads)
        self.seconds = float(model.opt.timestep) * task.frame_skip
        self.bound = float(np.float32(model.actuator_ctrlrange[0, 1]))
        state = mujoco.mjtState
        self.qpos = self.simulations.state(state.mjSTATE_QPOS, (model.nq,))
        self.qvel = self.simulations.state(state.mjSTATE_QVEL, (model.nv,))
        self._controls = self.simulations.state(state.mjSTATE_CTRL, (model.nu,))
        self._fresh = self.simulations.rows[0].copy()
        self._actions = np.zeros((number, model.nu))
        self.bodies = self._views_of_bodies()
        self.observed = sum(part.shape[1] for part in self._observed_parts())
        self.places = np.zeros((number, task.axes))
        self.steps = np.zeros(number, np.int64)

    def restart(self, ids: npt.NDArray[np.intp]) -> None:
        """Begin new episodes of some robots."""
        if self.simulations.broken()[ids].any():
            self.simulations.reset(ids)
        self.simulations.rows[ids] = self._fresh
        for index in ids:
            self._place_at_random(index)
        if self.bodies:
            self.simulations.forward(ids)
        if self.task.observes_bodies:
            self.bodies["cfrc_ext"][ids] = 0.0  # from before the reset
        self.places[ids] = self.measured()[ids]
        self.steps[ids] = 0

    def set_actions(self, actions: npt.NDArray[Any]) -> bool:
        """Set the next actions, [B, nu]; return False if one is not a number within the bounds."""
        self._actions[...] = actions
        return bool(np.abs(self._actions).max() <= self.bound)  # False with NaN

    def advance(self) -> VelocityOutcome:
        """Take one step with every robot, with the actions that were set."""
        self._controls[...] = self._actions
        self.simulations.step(self.task.frame_skip, derive=False)
        if self.task.observes_bodies:
            self.simulations.compute_body_forces()
        places = self.measured()
        passed = (places - self.places) / self.seconds
        self.places = places
        self.steps += 1
        rewards, velocities, costs = self.rewards_and_costs(passed, self._actions)
        terminated = self.fallen()
        broken = self.simulations.broken() if self.simulations.any_broken() else None
        if broken is not None:
            rewards[broken] = costs[broken] = 0.0
            terminated |= broken
        truncated = (self.steps >= self.horizon) & ~terminated
        finished = np.flatnonzero(terminated | truncated)
        return VelocityOutcome(rewards, costs, velocities, terminated, truncated, broken, finished)

    def rewards_and_costs(self, passed: Floats, actions: Floats) -> tuple[Floats, Floats, Floats]:
        """Compute rewards, velocities and costs of a step.

        Args:
            passed: velocities along each axis, m/s, [B, axes].
            actions: [B, nu].

        Returns:
            rewards, the velocities that are compared with the threshold, m/s, and costs, [B] each.
        """
        task, forward = self.task, passed[:, 0]
        effort = np.einsum("bi,bi->b", actions, actions)
        rewards = task.forward_weight * forward - task.control_weight * effort + task.healthy_reward
        velocities = forward if task.axes == 1 else np.hypot(forward, passed[:, 1])
        return rewards, velocities, (velocities > task.threshold).astype(np.float64)

    def fallen(self) -> Booleans:
        """Whether each robot has fallen, [B]."""
        if self.task.healthy is None:
            return np.zeros(self.number, np.bool_)
        return np.asarray(~self.task.healthy(self.qpos, self.qvel))

    def observations(self) -> Observations:
        """Return the present observations, [B, observed]."""
        seen, start = np.empty((self.number, self.observed), np.float32), 0
        for part in self._observed_parts():
            seen[:, start : start + part.shape[1]] = part
            start += part.shape[1]
        return seen

    def _own_state(self) -> dict[str, Any]:
        """State of physics, the fields of the bodies, measured positions, and counters."""
        return {
            "physics": self.simulations.save(),
            "bodies": {name: values.copy() for name, values in self.bodies.items()},
            "places": self.places.copy(),
            "steps": self.steps.copy(),
        }

    def _load_own_state(self, saved: SavedState) -> None:
        fields = saved.part("bodies")
        bodies = {name: fields.array(name, values) for name, values in self.bodies.items()}
        places = saved.array("places", self.places)
        steps = saved.array("steps", self.steps, least=0, most=MOST_STEPS)
        self.simulations.load(saved.part("physics"))
        for name, values in bodies.items():
            self.bodies[name][...] = values
        self.places = places
        self.steps[...] = steps

    def _place_at_random(self, index: int) -> None:
        task, generator, model = self.task, self.generators[index], self.model
        noise = generator.uniform(-task.position_noise, task.position_noise, model.nq)
        self.qpos[index] = model.qpos0 + noise
        if task.normal_velocities:
            self.qvel[index] = task.velocity_noise * generator.standard_normal(model.nv)
        else:
            self.qvel[index] = generator.uniform(-task.velocity_noise, task.velocity_noise, model.nv)

    def _views_of_bodies(self) -> dict[str, Floats]:
        """Return the fields of the bodies that the task needs, by MuJoCo's name, [B, ...]."""
        bodies, shapes = self.model.nbody, dict[str, tuple[int, ...]]()
        if self.task.measured == "torso":
            shapes["xpos"] = bodies, 3
        if self.task.measured == "mass":
            shapes["xipos"] = bodies, 3
        if self.task.observes_bodies:
            shapes |= {"cinert": (bodies, 10), "cvel": (bodies, 6)}
            shapes |= {"qfrc_actuator": (self.model.nv,), "cfrc_ext": (bodies, 6)}
        return {name: self.simulations.output(name, shape) for name, shape in shapes.items()}

    def measured(self) -> Floats:
        """Return the position of each robot, as MuJoCo computed it last, metres, [B, axes]."""
        axes = self.task.axes
        match self.task.measured:
            case "root":
                return self.qpos[:, :axes].copy()
            case "torso":
                return self.bodies["xpos"][:, TORSO, :axes].copy()
            case "mass":
                mass = self.model.body_mass
                return np.asarray((mass / mass.sum()) @ self.bodies["xipos"][:, :, :axes])

    def _observed_parts(self) -> list[Floats]:
        """Return the parts of an observation in order, [B, ...]."""
        bound = self.task.velocity_bound
        velocities = self.qvel if bound == np.inf else np.clip(self.qvel, -bound, bound)
        parts = [self.qpos[:, self.task.hidden :], velocities]
        if self.task.observes_bodies:
            names = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")
            parts += [self.bodies[name].reshape(self.number, -1) for name in names]
        return parts
