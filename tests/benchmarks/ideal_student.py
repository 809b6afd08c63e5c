"""What keeps agents from a safe path beside a cheap shortcut: their samples, or what they see?

    OMP_NUM_THREADS=1 python tests/benchmarks/ideal_student.py [--maps 13 14 16 23]

An agent that needs no samples: all its advantages are computed exactly. It climbs reward minus a fixed price
of the river's cost plus a bonus on each state's entropy, by natural gradient steps (Kakade 2002):

    theta <- (1 - eta) theta + eta w / tau,   w = argmin_w E_visits[(A - phi w)^2],   A = A_r - price A_c

with phi the features of (state, action) in which its logits are linear, centred under its policy; where it
hardly goes it hardly learns. With ``pose`` every (x, y, heading) has features of its own, and w is A itself;
with ``coordinates``, one-hot x, y and heading, what is learnt of a tile is learnt of its row and column.
Printed: return / cost / share of episodes that reach the goal, exact, over the task's 200 steps, and whether
the policy is within 0.2 of J*(0) at a cost of at most 0.05 once its temperature tau, which falls in equal
ratios, is at its end. "Linear": whether logits linear in the coordinates could walk the best safe path at all
(a linear program).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from scipy.optimize import linprog

from recrl.environments.cmdp import CostLimits, Floats
from recrl.environments.finite.exact_solver import evaluate_policy, solve_by_lagrangian
from recrl.environments.finite.finite_cmdp import FiniteCMDP
from recrl.environments.rivergrid.grid_world import (
    HORIZON,
    RiverGridGeneratedOptions,
    river_cmdp,
    river_observations,
)

ITERATIONS, STEP, DISCOUNT = 400, 0.05, 0.99
FIRST_TEMPERATURE, LAST_TEMPERATURE = 1.0, 0.02
RIDGE = 1e-6  # share of the trace
Direction = Callable[[Floats, Floats, Floats], Floats]
"""Of policy [S, A], advantages [S, A] and visits [S]: the logits phi w, [S, A], for the w above."""


def advantages(model: FiniteCMDP, policy: Floats, worth: Floats) -> tuple[Floats, Floats]:
    """A(s, a) of what each pair is worth, [S, A], and the discounted visits of each state, [S]."""
    number = model.num_states
    successors, alive = model.successors[:, :, 0], ~model.terminal
    moves = np.zeros((number, number))
    for action in range(model.num_actions):
        np.add.at(moves, (np.arange(number), successors[:, action]), policy[:, action] * alive)
    system = np.eye(number) - DISCOUNT * moves
    values = np.linalg.solve(system, (policy * worth).sum(axis=1) * alive)
    actions = np.where(alive[:, None], worth + DISCOUNT * values[successors], 0.0)
    visits: Floats = np.asarray(np.linalg.solve(system.T, model.start) * alive, np.float64)
    centred: Floats = actions - (policy * actions).sum(axis=1, keepdims=True)
    return centred, visits


def softmax(logits: Floats) -> Floats:
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    shares: Floats = weights / weights.sum(axis=1, keepdims=True)
    return shares


def by_pose(policy: Floats, advantage: Floats, visits: Floats) -> Floats:
    """Each state has logits of its own: a system of A equations a state."""
    spread = np.einsum("sa,ab->sab", policy, np.eye(policy.shape[1])) - policy[:, :, None] * policy[:, None]
    gram = visits[:, None, None] * spread
    ridge = RIDGE * np.trace(gram, axis1=1, axis2=2).sum() * np.eye(policy.shape[1])
    target = (visits[:, None] * policy * advantage)[:, :, None]
    return np.asarray(np.linalg.solve(gram + ridge, target)[:, :, 0], np.float64)


def by_features(features: Floats) -> Direction:
    """Logits linear in what is seen of a state, [S, n]."""

    def direction(policy: Floats, advantage: Floats, visits: Floats) -> Floats:
        size, actions = features.shape[1], policy.shape[1]
        # phi(s, a) = f(s) x (e_a - pi(. | s)), [S, A, n A]
        centred = np.eye(actions)[None] - policy[:, None, :]
        phi = (features[:, None, :, None] * centred[:, :, None, :]).reshape(-1, size * actions)
        weights = (visits[:, None] * policy).reshape(-1)
        gram = phi.T @ (weights[:, None] * phi)
        target = phi.T @ (weights * advantage.reshape(-1))
        solution = np.linalg.solve(gram + RIDGE * np.trace(gram) * np.eye(len(gram)), target)
        return np.asarray(features @ solution.reshape(size, actions), np.float64)

    return direction


def linear(model: FiniteCMDP, features: Floats) -> bool:
    """Whether the best policy that costs nothing takes actions, from its start, that features separate."""
    policy = solve_by_lagrangian(model, CostLimits((0.0,))).policy
    state, rows = int(model.start.argmax()), []
    for shares in policy:
        taken = int(shares[state].argmax())
        for other in range(model.num_actions):
            if other != taken:
                row = np.zeros((model.num_actions, features.shape[1]))
                row[other], row[taken] = features[state], -features[state]
                rows.append(row.reshape(-1))
        state = int(model.successors[state, taken, 0])
        if model.terminal[state]:
            break
    margins = np.array(rows)
    solution = linprog(np.zeros(margins.shape[1]), margins, -np.ones(len(margins)), bounds=(None, None))
    return bool(solution.status == 0)


def train(model: FiniteCMDP, direction: Direction, price: float) -> Floats:
    """The last policy, [S, A]."""
    worth = model.rewards - price * model.costs[:, :, 0]
    logits = np.zeros((model.num_states, model.num_actions))
    for temperature in np.geomspace(FIRST_TEMPERATURE, LAST_TEMPERATURE, ITERATIONS):
        policy = softmax(logits)
        advantage, visits = advantages(model, policy, worth)
        logits = (1.0 - STEP) * logits + STEP / temperature * direction(policy, advantage, visits)
    return softmax(logits)


def report(model: FiniteCMDP, policy: Floats) -> str:
    """Return / cost / share of episodes at the goal, and whether this is the optimum for a limit of 0."""
    value, best = evaluate_policy(model, policy), solve_by_lagrangian(model, CostLimits((0.0,)))
    cost = float(value.costs[0])
    share = float(value.visits[model.terminal[model.successors[:, :, 0]]].sum())
    found = value.episode_return >= best.episode_return - 0.2 and cost <= 0.05
    return f"{value.episode_return:.2f} / {cost:.2f} / {share:.2f}{' found' if found else ''}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--maps", type=int, nargs="+", default=[13, 14, 16, 23], help="map seeds")
    arguments = parser.parse_args()
    print("| map | linear | price | pose | coordinates |")
    print("|---|---|---|---|---|")
    for map_seed in arguments.maps:
        river_map = RiverGridGeneratedOptions(map_seed=map_seed).river_map()
        model = river_cmdp(river_map, costs=("river",), horizon=HORIZON)
        coordinates = river_observations(river_map, "factored").astype(np.float64)
        expressible = "yes" if linear(model, coordinates) else "no"
        for price in (3.0, 10.0):
            directions = (by_pose, by_features(coordinates))
            cells = " | ".join(report(model, train(model, each, price)) for each in directions)
            print(f"| {map_seed} | {expressible} | {price:g} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
