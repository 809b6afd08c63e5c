"""Batches of simulations: equal to MuJoCo's own loop, and restored to the last bit, sleepers too."""

from __future__ import annotations

import multiprocessing
import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.scene import make_scene
from recrl.environments.safety_gym.task_definitions import SAFETY_TASKS
from recrl.environments.saved_state import SavedState
from recrl.environments.simulation.mujoco_batch import PhysicsError, Simulations, _Batch

SCENE = make_scene(SAFETY_TASKS["CarGoal2"])
NUMBER = 2
COORDINATES = mujoco.mjtState.mjSTATE_QPOS
CONTROL = mujoco.mjtState.mjSTATE_CTRL
MANY = 12
FAILS = 5
TIME = mujoco.mjtState.mjSTATE_TIME


def many(num_threads: int) -> Simulations:
    return Simulations(make_scene(SAFETY_TASKS["PointGoal0"]).model, MANY, num_threads=num_threads)


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
        simulations.step(10, derive=True)
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
        restored.load(SavedState("a test", saved))
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
    restored.load(SavedState("a test", snapshot))
    assert first + run(restored, chosen[200:]) == run(crowd(), chosen)


def test_simulations_stepped_in_parts_move_as_those_stepped_together() -> None:
    together, apart = crowd(), crowd()
    for chosen in controls(50):
        for simulations in (together, apart):
            simulations.state(CONTROL, (2,))[...] = chosen
        together.step(10, derive=True)
        apart.step(10, [1], derive=True)
        apart.step(10, [0], derive=True)
    assert together.rows.tobytes() == apart.rows.tobytes()


def test_a_state_of_another_batch_is_refused() -> None:
    saved = crowd().save()
    with pytest.raises(ValueError) as error:
        Simulations(SCENE.model, 3).load(SavedState("a test", saved))
    assert str(error.value) == "a test: rows must be float64 of shape (3, 389), got float64 of shape (2, 389)"


def test_a_diverged_simulation_is_reported_until_it_is_reset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file where it runs
    simulations = crowd()
    simulations.state(COORDINATES, (SCENE.model.nq,))[1, 0] = np.nan
    simulations.step(10, derive=True)
    assert simulations.broken().tolist() == [False, True]
    simulations.reset([1])
    simulations.forward([1])
    assert not simulations.broken().any()


def test_no_simulations_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^there must be at least one simulation, got 0$"):
        Simulations(SCENE.model, 0)


def test_a_batch_that_mujoco_refuses_to_make_is_reported() -> None:
    with pytest.raises(PhysicsError) as error:
        _Batch(SCENE.model, 0, 1)
    assert str(error.value) == "MuJoCo cannot simulate this model in a batch: nsim must be positive"


def steps_taken(simulations: Simulations) -> list[int]:
    """Return how many physics steps each simulation has taken."""
    time = simulations.state(TIME, (1,))[:, 0]
    return [round(seconds) for seconds in time / simulations.model.opt.timestep]


@pytest.mark.parametrize("num_threads", [1, 2, 5, 20])
def test_every_simulation_chosen_is_stepped_once(num_threads: int) -> None:
    simulations = many(num_threads)
    simulations.step(1, derive=False)
    simulations.step(1, [7, 2, 11], derive=True)
    simulations.step(1, [], derive=True)
    assert steps_taken(simulations) == [2 if index in (2, 7, 11) else 1 for index in range(MANY)]


def test_inputs_of_each_step_are_those_given() -> None:
    """Steps with inputs end where steps with the same controls, one by one, do."""
    chosen, together, alone = np.array([3, 8]), many(2), many(1)
    inputs = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 10, 2))
    together.step_with_inputs(inputs, int(CONTROL), chosen)
    for step in range(10):
        alone.state(CONTROL, (2,))[chosen] = inputs[:, step]
        alone.step(1, chosen, derive=step == 9)
    assert together.rows.tobytes() == alone.rows.tobytes()


def test_outputs_are_what_mujoco_computed_last() -> None:
    simulations = crowd()
    acceleration = simulations.output("qacc", (SCENE.model.nv,))
    places = simulations.output("xpos", (SCENE.model.nbody, 3))
    run(simulations, controls(30))
    for index in range(NUMBER):
        data = simulations.data(index)
        assert np.array_equal(acceleration[index], data.qacc)
        assert np.array_equal(places[index], data.xpos)


def test_outputs_of_restored_simulations_are_those_saved() -> None:
    simulations, restored = crowd(), crowd()
    run(simulations, controls(30))
    places = restored.output("xpos", (SCENE.model.nbody, 3))
    restored.load(SavedState("a test", simulations.save()))
    assert np.array_equal(places[1], simulations.data(1).xpos)


def clouds(num_threads: int) -> Simulations:
    """Clouds of spheres in the air; that of simulation FAILS has more contacts than its memory is for."""
    spheres = "".join(f'<geom type="sphere" size="0.05" pos="{0.1 * index} 0 0"/>' for index in range(36))
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><size memory="4000"/><worldbody><geom type="plane" size="5 5 0.1"/>
        <body pos="0 0 5"><freejoint/>{spheres}</body></worldbody></mujoco>"""
    )
    simulations = Simulations(model, MANY, num_threads=num_threads)
    simulations.state(COORDINATES, (model.nq,))[FAILS, 2] = 0.04
    return simulations


@pytest.mark.parametrize("num_threads", [1, 2])
def test_an_error_of_mujoco_stops_one_simulation_alone(
    num_threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its errors to a file where it runs
    broken = clouds(num_threads)
    before = broken.rows[FAILS].copy()
    broken.step(1, derive=False)
    others = np.arange(MANY) != FAILS
    assert steps_taken(broken) == others.astype(int).tolist()
    assert broken.any_stopped
    assert np.array_equal(broken.stopped, ~others)
    assert np.array_equal(broken.broken(), ~others)
    assert np.array_equal(broken.rows[FAILS], before)
    broken.step(1, [2, 3], derive=False)
    assert np.array_equal(broken.stopped, ~others), "until it is reset"
    broken.reset([FAILS])
    assert not broken.any_stopped
    broken.step(1, derive=False)
    assert not broken.stopped.any()


def test_a_failure_in_an_interrupted_call_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    broken = clouds(2)
    run = broken._run

    def interrupted(*arguments: Any) -> None:
        run(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(broken, "_run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        broken.step(1, derive=False)
    assert np.flatnonzero(broken.broken()).tolist() == [FAILS]
    assert broken.any_stopped


@pytest.mark.parametrize("ids", [[3, 3, 4], [-1], [MANY], [True] * MANY, [0.5]])
def test_simulations_that_are_not_there_or_named_twice_are_refused(ids: list[Any]) -> None:
    with pytest.raises(ValueError, match=r"must be different whole numbers from 0 to 11, got \["):
        many(2).step(1, ids, derive=False)


def test_a_view_outlives_its_simulations() -> None:
    rows, expected = many(2).rows, many(1).rows.copy()
    assert np.array_equal(rows, expected)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
@pytest.mark.parametrize(("num_threads", "exit_code"), [(1, 2), (2, 42)])
def test_a_fork_uses_simulations_of_one_thread_and_gets_an_error_that_says_to_make_others(
    num_threads: int, exit_code: int
) -> None:
    simulations = many(num_threads)
    simulations.step(1, derive=False)
    child = multiprocessing.get_context("fork").Process(target=_step_and_exit, args=(simulations,))
    child.start()
    del simulations
    child.join(60.0)
    assert child.exitcode == exit_code


def _step_and_exit(simulations: Simulations) -> None:
    try:
        simulations.step(1, derive=False)
    except PhysicsError as error:
        assert str(error) == (
            "simulations with num_threads = 2 cannot be used in a forked process: "
            "make them anew here, or with num_threads = 1"
        )
        del simulations
        os._exit(42)
    os._exit(min(steps_taken(simulations)))
