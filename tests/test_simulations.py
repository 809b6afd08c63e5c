"""Batches of simulations: equal to MuJoCo's own loop, and restored to the last bit, sleepers too."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from recrl.environments.cmdp import Floats
from recrl.environments.safety_tasks import SAFETY_TASKS
from recrl.environments.scene import make_scene
from recrl.environments.simulations import PhysicsError, Simulations

SCENE = make_scene(SAFETY_TASKS["CarGoal2"])
NUMBER = 2
COORDINATES = mujoco.mjtState.mjSTATE_QPOS
CONTROL = mujoco.mjtState.mjSTATE_CTRL


def crowd(*, num_threads: int = 1) -> Simulations:
    """Cars with vases: four around them, the others far away."""
    simulations = Simulations(SCENE.model, NUMBER, num_threads=num_threads)
    everyone = list(range(NUMBER))
    simulations.reset(everyone)
    qpos = simulations.state(COORDINATES, (SCENE.model.nq,))
    for index, address in enumerate(SCENE.vase_qpos):
        near = 0.4 * (index % 2) - 0.2, 0.4 * (index // 2) - 0.2 + np.sign(index // 2 - 0.5) * 0.2
        qpos[:, address : address + 2] = near if index < 4 else (0.3 * index, 1.5)
    simulations.forward(everyone)
    return simulations


def controls(steps: int) -> Floats:
    """Random, held for 20 steps, so that the cars get somewhere."""
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, (steps // 20 + 1, NUMBER, 2))
    return np.repeat(drawn, 20, axis=0)[:steps]


def run(simulations: Simulations, chosen: Floats) -> list[bytes]:
    control = simulations.state(CONTROL, (2,))
    robot = slice(0, SCENE.robot_qvel)
    past = []
    for number, step in enumerate(chosen):
        control[...] = step
        simulations.step(10)
        past.append(simulations.rows.tobytes())
        if number % 20 == 19:
            datas = [simulations.data(index) for index in range(NUMBER)]
            past += [data.tree_awake.tobytes() + data.qacc[robot].tobytes() for data in datas]
    return past


def test_a_batch_moves_as_mujoco_alone_does() -> None:
    simulations, chosen = crowd(), controls(100)
    start = simulations.state(COORDINATES, (SCENE.model.nq,))[1].copy()
    run(simulations, chosen)
    data = mujoco.MjData(SCENE.model)
    data.qpos[:] = start
    mujoco.mj_forward(SCENE.model, data)
    for step in chosen[:, 1]:
        data.ctrl[:] = step
        mujoco.mj_step(SCENE.model, data, 10)
        mujoco.mj_forward(SCENE.model, data)
    np.testing.assert_allclose(
        simulations.state(COORDINATES, (SCENE.model.nq,))[1], data.qpos, rtol=0.0, atol=1e-9
    )


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    chosen = controls(60)
    assert run(crowd(num_threads=1), chosen) == run(crowd(num_threads=3), chosen)


def test_restored_simulations_with_sleeping_bodies_continue_to_the_last_bit() -> None:
    chosen, simulations = controls(3000), crowd()
    run(simulations, chosen[:1500])
    for start in range(1500, 2000, 100):
        saved = simulations.save()
        assert (saved["asleep"] >= 0).any()
        restored = Simulations(SCENE.model, NUMBER, num_threads=2)
        restored.load(saved)
        assert restored.rows.tobytes() == simulations.rows.tobytes()
        ahead = chosen[start : start + 100]
        assert run(restored, ahead) == run(simulations, ahead)
    assert run(restored, chosen[2000:]) == run(simulations, chosen[2000:])


def test_saving_changes_nothing() -> None:
    chosen = controls(400)
    undisturbed, saved = crowd(), crowd()
    first = run(saved, chosen[:200])
    snapshot = saved.save()
    assert first + run(saved, chosen[200:]) == run(undisturbed, chosen)
    restored = Simulations(SCENE.model, NUMBER)
    restored.load(snapshot)
    assert first + run(restored, chosen[200:]) == run(crowd(), chosen)


def test_simulations_stepped_in_parts_move_as_those_stepped_together() -> None:
    together, apart = crowd(), crowd()
    for chosen in controls(50):
        for simulations in (together, apart):
            simulations.state(CONTROL, (2,))[...] = chosen
        together.step(10)
        apart.step(10, [1])
        apart.step(10, [0])
    assert together.rows.tobytes() == apart.rows.tobytes()


def test_a_state_of_another_batch_is_refused() -> None:
    saved = crowd().save()
    with pytest.raises(ValueError, match=r"saved physics must have shape \(3, 389\), got \(2, 389\)"):
        Simulations(SCENE.model, 3).load(saved)


def test_a_diverged_simulation_is_reported_until_it_is_reset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file where it runs
    simulations = crowd()
    simulations.state(COORDINATES, (SCENE.model.nq,))[1, 0] = np.nan
    simulations.step(10)
    assert simulations.broken().tolist() == [False, True]
    simulations.reset([1])
    simulations.forward([1])
    assert not simulations.broken().any()


def test_a_model_that_cannot_be_batched_is_reported() -> None:
    with pytest.raises((PhysicsError, ValueError)):
        Simulations(SCENE.model, 0)
