"""Compiled functions read memory where it lies, call MuJoCo, and do without a place to be kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from recrl.environments.safety_gym.scene import make_scene
from recrl.environments.safety_gym.task_definitions import SAFETY_TASKS
from recrl.environments.simulation.machine_code import array_at, compiled_for_batch, kept, mj_forward, mj_step
from recrl.environments.simulation.mujoco_batch import Simulations

RECORD = np.dtype([("calls", np.int64), ("numbers", np.float64, (3,))], align=True)
NUMBER = 3
records_at = array_at(RECORD)


@compiled_for_batch
def advance(model: int, data: int, index: int, argument: int) -> None:
    record = records_at(argument, NUMBER)[index]
    record.calls += 1
    record.numbers[2] = 10.0 * record.numbers[1] + index
    mj_step(model, data)
    mj_forward(model, data)


def test_a_compiled_function_steps_each_simulation_and_writes_to_its_record() -> None:
    model = make_scene(SAFETY_TASKS["PointGoal0"]).model
    simulations, alone = Simulations(model, NUMBER, num_threads=2), mujoco.MjData(model)
    records = np.zeros(NUMBER, RECORD)
    records["numbers"][:, 1] = 1.0, 2.0, 3.0
    simulations.apply(advance, records.ctypes.data)
    simulations.apply(advance, records.ctypes.data, [0, 2])
    assert records["calls"].tolist() == [2, 1, 2]
    assert records["numbers"][:, 2].tolist() == [10.0, 21.0, 32.0]
    time = simulations.state(mujoco.mjtState.mjSTATE_TIME, (1,))[:, 0]
    assert time.tolist() == [2 * model.opt.timestep, model.opt.timestep, 2 * model.opt.timestep]
    mujoco.mj_step(model, alone, 2)
    qpos = simulations.state(mujoco.mjtState.mjSTATE_QPOS, (model.nq,))
    assert np.array_equal(qpos[0], alone.qpos)


def test_where_nothing_can_be_kept_functions_are_compiled_all_the_same() -> None:
    def compiler(*, cache: bool = False) -> Callable[[Any], str]:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda function: f"compiled {function.__name__}"

    def step() -> None: ...

    assert kept(compiler, step) == "compiled step"
