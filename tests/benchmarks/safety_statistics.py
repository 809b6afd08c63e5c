"""Compare returns and costs of three policies with those recorded of safety-gymnasium 1.0.0.

python tests/benchmarks/safety_statistics.py [--episodes 32] [--tasks CarGoal2 ...] [--policies iid ...]

Physics is chaotic, so episodes are compared in their means: a row is fine if the difference is within two
standard errors of the difference. The recorded means are over 30 episodes (mujoco 2.3.7). Button and Push lay
their objects out as Safety Gym does, which is not quite how safety-gymnasium does.
"""

from __future__ import annotations

import argparse
import math

import numpy as np

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.safety_gym_batch import SafetyGymBatch
from recrl.environments.safety_gym.safety_gym_environments import SafetyGymVectorEnv
from recrl.environments.safety_gym.scene import rotation_matrices

HELD_STEPS = 25
# Task, policy: mean and standard error of return, cost and goals an episode of 1,000 steps.
PEER = {
    ("CarGoal2", "iid"): ((-0.80, 0.27), (118.3, 21.9), 0.20),
    ("CarGoal2", "held"): ((-0.96, 0.44), (102.1, 18.7), 0.20),
    ("CarGoal2", "scripted"): ((20.07, 0.21), (238.5, 18.4), 7.13),
    ("CarButton2", "iid"): ((-1.56, 0.26), (99.2, 20.4), 0.03),
    ("CarButton2", "held"): ((-1.20, 0.32), (109.7, 18.5), 0.10),
    ("CarButton2", "scripted"): ((10.50, 0.82), (440.3, 29.8), 4.83),
    ("CarPush2", "iid"): ((-1.41, 0.27), (39.6, 13.7), 0.0),
    ("CarPush2", "held"): ((-1.46, 0.38), (45.4, 11.6), 0.0),
    ("CarPush2", "scripted"): ((2.56, 1.38), (231.1, 54.8), 1.07),
}


def drive(target: Floats) -> Floats:
    """Turn the Car to a place in its own frame, (x, y), and drive; its front is -y."""
    angle = math.atan2(target[0], -target[1])
    forwards, turn = max(math.cos(angle), 0.0), min(max(angle, -1.0), 1.0)
    wheels: Floats = np.clip(np.array((forwards + turn, forwards - turn)), -1.0, 1.0)
    return wheels


def push(box: Floats, goal: Floats) -> Floats:
    """Drive to a place behind the box, opposite the goal, then through the box to the goal."""
    way = goal - box
    towards = way / (np.linalg.norm(way) + 1e-9)
    along = float(-box @ towards)
    across = -box - along * towards
    aside = float(np.linalg.norm(across))
    if along < -0.1 and aside < 0.12:
        return drive(box + 0.3 * towards)
    if along > -0.3:
        side = across / aside if aside > 1e-6 else np.array((-towards[1], towards[0]))
        return drive(box - 0.35 * towards + side * 0.35 * (along > -0.2))
    return drive(box - 0.35 * towards)


def scripted(batch: SafetyGymBatch) -> Floats:
    """The scripted policy's actions, [B, 2]."""
    rotation = rotation_matrices(batch.qpos[:, 3:7])
    flat = np.zeros((batch.number, batch.points.shape[1], 3))
    flat[..., :2] = batch.points
    ego = ((flat - batch.qpos[:, None, :3]) @ rotation)[..., :2]
    goal = ego[:, batch.group["goal"].start]
    if batch.task.goal != "Push":
        return np.stack([drive(place) for place in goal])
    box = ego[:, batch.group["box"].start]
    return np.stack([push(*places) for places in zip(box, goal, strict=True)])


def episodes(task: str, policy: str, number: int) -> tuple[Floats, Floats, Floats]:
    """Returns, costs and goals of so many episodes."""
    environment, generator = SafetyGymVectorEnv(task, number), np.random.default_rng(0)
    environment.reset(seed=12345)
    totals = np.zeros((3, number))
    actions = np.zeros((number, 2))
    for step in range(1000):
        if policy == "scripted":
            actions = scripted(environment.batch)
        elif policy == "iid" or step % HELD_STEPS == 0:
            actions = generator.uniform(-1.0, 1.0, (number, 2))
        _, rewards, _, _, info = environment.step(actions)
        totals += rewards, info["cost"][:, 0], info["goal_met"]
    return totals[0], totals[1], totals[2]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=32)
    parser.add_argument("--tasks", nargs="+", default=["CarGoal2", "CarButton2", "CarPush2"])
    parser.add_argument("--policies", nargs="+", default=["iid", "held", "scripted"])
    arguments = parser.parse_args()
    print("| task | policy | return: theirs / ours | z | cost: theirs / ours | z | goals: theirs / ours |")
    print("|---|---|---|---|---|---|---|")
    for task in arguments.tasks:
        for policy in arguments.policies:
            returns, costs, goals = episodes(task, policy, arguments.episodes)
            recorded, cells = PEER[task, policy], []
            for (mean, error), ours in zip(recorded[:2], (returns, costs), strict=True):
                ours_error = ours.std(ddof=1) / math.sqrt(len(ours))
                deviation = (ours.mean() - mean) / math.hypot(error, ours_error)
                cells.append(
                    f"{mean:.2f} +- {error:.2f} / {ours.mean():.2f} +- {ours_error:.2f} | {deviation:+.1f}"
                )
            print(
                f"| {task} | {policy} | {' | '.join(cells)} | {recorded[2]:.2f} / {goals.mean():.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
