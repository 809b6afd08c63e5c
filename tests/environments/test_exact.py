"""The exact solvers: against the ground truth, against each other, against brute force and simulation."""

from __future__ import annotations

import itertools
import math
import time
import tracemalloc

import numpy as np
import pytest

from recrl.environments.cmdp import CostLimits, Floats
from recrl.environments.finite import exact_solver
from recrl.environments.finite.exact_solver import ConstrainedOptimum, evaluate_policy, solve_by_lagrangian
from recrl.environments.finite.finite_cmdp import FiniteCMDP, FiniteVectorEnv, InfeasibleLimitsError
from recrl.environments.registry import make_vector, optimal_return
from recrl.environments.rivergrid.grid_world import river_cmdp
from recrl.environments.rivergrid.instances import InstanceSettings, draw_instance
from recrl.environments.rivergrid.maps import MAPS, parse_map
from tests.environments.linear_program import ProgramSolution, solve_by_linear_program

Solution = ConstrainedOptimum | ProgramSolution


def random_cmdp(
    seed: int, *, num_states: int = 4, num_actions: int = 3, num_costs: int = 1, horizon: int = 5
) -> FiniteCMDP:
    generator = np.random.default_rng(seed)
    pairs = (num_states, num_actions)
    terminal = np.zeros(num_states, np.bool_)
    terminal[-1] = True
    start = generator.dirichlet(np.ones(num_states - 1))
    return FiniteCMDP(
        successors=np.tile(np.arange(num_states), (*pairs, 1)),
        probabilities=generator.dirichlet(np.ones(num_states), size=pairs),
        rewards=generator.normal(size=pairs),
        costs=generator.uniform(size=(*pairs, num_costs)) * (generator.uniform(size=(*pairs, 1)) > 0.3),
        terminal=terminal,
        start=np.append(start, 0.0),
        horizon=horizon,
        cost_names=tuple(f"cost_{index}" for index in range(num_costs)),
    )


def least_costs(model: FiniteCMDP) -> Floats:
    """The least each cost can be on its own, [k]: below it limits cannot be kept."""
    never = CostLimits.unlimited(model.num_costs)
    least = []
    for index in range(model.num_costs):
        as_reward = FiniteCMDP(
            **{**vars(model), "rewards": -model.costs[:, :, index]},
        )
        least.append(-solve_by_lagrangian(as_reward, never).episode_return)
    return np.array(least)


@pytest.mark.parametrize("limit", [0.0, 0.5, 1.0, 2.5, 4.0, 5.0])
def test_the_optimum_of_rivergrid_1a_is_a_mixture_of_staying_and_crossing(limit: float) -> None:
    optimum = optimal_return("rivergrid-1a", {}, CostLimits((limit,)))
    assert optimum == pytest.approx(-20.0 + 5.9 * limit, abs=1e-8)


@pytest.mark.parametrize("limit", [0.0, 0.5, 1.0, 2.5, 4.0, 5.0])
def test_the_optimum_of_rivergrid_1b_is_a_mixture_of_round_and_across(limit: float) -> None:
    optimum = optimal_return("rivergrid-1b", {}, CostLimits((limit,)))
    assert optimum == pytest.approx(9.0 + 0.1 * limit, abs=1e-8)


@pytest.mark.parametrize("name", ["rivergrid-1a", "rivergrid-1b"])
@pytest.mark.parametrize("limit", [5.5, 200.0, math.inf])
def test_beyond_a_limit_of_five_rivergrid_is_crossed(name: str, limit: float) -> None:
    assert optimal_return(name, {}, CostLimits((limit,))) == pytest.approx(9.5, abs=1e-8)


@pytest.mark.parametrize(("name", "limit"), [("1a", 3.0), ("1b", 1.0)])
def test_both_solvers_agree_on_rivergrid(name: str, limit: float) -> None:
    model = river_cmdp(parse_map(MAPS[name]), costs=("river",), horizon=30)
    limits = CostLimits((limit,))
    by_lagrangian, by_program = solve_by_lagrangian(model, limits), solve_by_linear_program(model, limits)
    assert by_lagrangian.episode_return == pytest.approx(by_program.episode_return, abs=1e-6)


def test_an_action_may_have_any_index() -> None:
    model = FiniteCMDP(
        successors=np.zeros((1, 200, 1), np.int64),
        probabilities=np.ones((1, 200, 1)),
        rewards=np.arange(200.0)[None],
        costs=np.arange(200.0)[None, :, None],
        terminal=np.zeros(1, np.bool_),
        start=np.ones(1),
        horizon=1,
        cost_names=("cost",),
    )
    for limit, best in ((math.inf, 199.0), (150.5, 150.5)):
        assert solve_by_lagrangian(model, CostLimits((limit,))).episode_return == pytest.approx(best)


def test_both_solvers_agree_on_rivergrid_with_two_constraints_of_which_both_bind() -> None:
    model = river_cmdp(parse_map(MAPS["1b"]), costs=("river", "turns"), horizon=15)
    limits = CostLimits((1.0, 1.5))
    solutions: list[Solution] = [solve_by_lagrangian(model, limits), solve_by_linear_program(model, limits)]
    assert solutions[0].episode_return == pytest.approx(solutions[1].episode_return, abs=1e-6)
    for solution in solutions:
        assert (solution.multipliers > 0.1).all()
        np.testing.assert_allclose(solution.costs, [1.0, 1.5], atol=1e-6)


def test_both_solvers_agree_on_random_maps() -> None:
    for seed in range(3):
        river_map = draw_instance(
            InstanceSettings(map_seed=seed, width=6, height=6, river_width=(1, 2), safe_path=False)
        )
        model = river_cmdp(river_map, costs=("river",), horizon=12)
        limits = CostLimits((0.7,))
        assert solve_by_lagrangian(model, limits).episode_return == pytest.approx(
            solve_by_linear_program(model, limits).episode_return, abs=1e-6
        )


def test_on_generated_maps_the_constraint_matters() -> None:
    for seed in range(10):
        options = {"map_seed": seed, "safe_path": True, "horizon": 60}
        free, dry = (
            optimal_return("rivergrid-generated", options, CostLimits((limit,))) for limit in (math.inf, 0.0)
        )
        assert free is not None
        assert dry is not None
        assert free > dry + 0.05


@pytest.mark.parametrize("num_costs", [1, 2, 3])
def test_both_solvers_agree_on_random_cmdps_and_their_policies_do_what_they_say(num_costs: int) -> None:
    binding = 0
    for seed in range(12):
        model = random_cmdp(seed, num_costs=num_costs)
        limits = CostLimits(tuple(least_costs(model) + 0.3))
        try:
            expected: Solution = solve_by_linear_program(model, limits)
        except InfeasibleLimitsError:  # each limit can be kept, but not all of them together
            with pytest.raises(InfeasibleLimitsError):
                solve_by_lagrangian(model, limits)
            continue
        solutions = [solve_by_lagrangian(model, limits), expected]
        assert solutions[0].episode_return == pytest.approx(solutions[1].episode_return, abs=1e-7)
        for solution in solutions:
            value = evaluate_policy(model, solution.policy)
            assert value.episode_return == pytest.approx(solution.episode_return, abs=1e-6)
            np.testing.assert_allclose(value.costs, solution.costs, atol=1e-6)
            assert (value.costs <= limits.array + 1e-6).all()
            slack = limits.array - value.costs
            np.testing.assert_allclose(solution.multipliers * slack, 0.0, atol=1e-5)
        binding += int((solutions[0].multipliers > 1e-6).any())
    assert binding >= 6


def test_without_limits_the_optimum_is_the_best_of_all_deterministic_policies() -> None:
    model = random_cmdp(0, num_states=3, num_actions=2, horizon=3)
    best = -math.inf
    for choices in itertools.product(range(2), repeat=6):  # terminal state 2 never acts
        policy = np.zeros((3, 3, 2))
        policy[:, 2, 0] = 1.0
        for index, choice in enumerate(choices):
            policy[index // 2, index % 2, choice] = 1.0
        best = max(best, evaluate_policy(model, policy).episode_return)
    assert solve_by_lagrangian(model, CostLimits((math.inf,))).episode_return == pytest.approx(best)


def test_an_infinite_limit_leaves_the_other_constraint_alone() -> None:
    model = random_cmdp(1, num_costs=2)
    alone = FiniteCMDP(**{**vars(model), "costs": model.costs[:, :, 1:], "cost_names": ("cost_1",)})
    limit = float(least_costs(model)[1]) + 0.2
    for solve in (solve_by_lagrangian, solve_by_linear_program):
        both = solve(model, CostLimits((math.inf, limit)))
        assert both.episode_return == pytest.approx(solve(alone, CostLimits((limit,))).episode_return)
        assert both.multipliers[0] == 0.0


@pytest.mark.parametrize("solve", [solve_by_lagrangian, solve_by_linear_program])
def test_limits_that_nobody_can_keep_are_an_error(solve: type) -> None:
    model = FiniteCMDP(
        successors=np.zeros((1, 1, 1), np.int64),
        probabilities=np.ones((1, 1, 1)),
        rewards=np.ones((1, 1)),
        costs=np.ones((1, 1, 1)),
        terminal=np.zeros(1, np.bool_),
        start=np.ones(1),
        horizon=3,
        cost_names=("cost",),
    )
    with pytest.raises(InfeasibleLimitsError, match=r"no policy keeps the limits \[2\.5\]"):
        solve(model, CostLimits((2.5,)))
    assert solve(model, CostLimits((3.0,))).episode_return == pytest.approx(3.0)


@pytest.mark.parametrize("loose", [10.0, 1e6, 1e9, math.inf])
def test_a_loose_limit_makes_no_other_one_feasible(loose: float) -> None:
    """Without a turn every way from the start leads into the river."""
    options = {"costs": ["river", "turns", "mud"]}
    assert optimal_return("rivergrid-1a", options, CostLimits((0.0, 0.5, loose))) == -math.inf
    assert optimal_return("rivergrid-1a", options, CostLimits((0.0, 200.0, loose))) == pytest.approx(-20.0)


def test_the_optimum_alone_builds_no_table_of_times_states_and_actions() -> None:
    river_map = draw_instance(InstanceSettings(map_seed=3, width=14, height=14))
    model = river_cmdp(river_map, costs=("river",), horizon=800)
    table = 8 * model.horizon * model.num_states * model.num_actions
    tracemalloc.start()
    optimum = solve_by_lagrangian(model, CostLimits((0.4,)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < table / 2
    assert evaluate_policy(model, optimum.policy).costs == pytest.approx([0.4])


def test_the_number_of_limits_must_be_the_number_of_costs() -> None:
    with pytest.raises(ValueError, match="the CMDP has 2 costs, got 1 limits"):
        solve_by_lagrangian(random_cmdp(0, num_costs=2), CostLimits((1.0,)))


def test_a_policy_evaluated_by_hand() -> None:
    # Heading east at the start of 1a: forward with probability 1/2, else turn left; one step of two.
    model = river_cmdp(parse_map(MAPS["1a"]), costs=("river", "turns"), horizon=2)
    policy = np.tile([0.5, 0.0, 0.5], (model.num_states, 1))
    value = evaluate_policy(model, policy)
    assert value.episode_return == pytest.approx(-0.2)
    # River after step 1: 1/2. After step 2: forward, then anything: 1/2; turned north, never.
    np.testing.assert_allclose(value.costs, [1.0, 1.0])
    assert value.visits.sum() == pytest.approx(2.0)


def test_the_exact_value_is_the_mean_over_simulated_episodes() -> None:
    model = random_cmdp(2, num_costs=2, horizon=8)
    policy = np.random.default_rng(0).dirichlet(np.ones(3), size=model.num_states)
    number = 20_000
    environment = FiniteVectorEnv(
        "random", model, np.eye(model.num_states, dtype=np.float32), num_envs=number
    )
    environment.reset(seed=0)
    generator = np.random.default_rng(1)
    returns, costs, alive = np.zeros(number), np.zeros((number, 2)), np.ones(number, np.bool_)
    for _ in range(model.horizon):
        drawn = generator.random(number)[:, None]
        actions = (drawn >= policy[environment.states].cumsum(axis=1)[:, :-1]).sum(axis=1)
        _, rewards, terminated, truncated, info = environment.step(actions)
        returns += rewards * alive
        costs += info["cost"] * alive[:, None]
        alive &= ~(terminated | truncated)
    value = evaluate_policy(model, policy)
    tolerance = 4.0 * returns.std() / math.sqrt(number)
    assert returns.mean() == pytest.approx(value.episode_return, abs=tolerance)
    for index in range(2):
        tolerance = 4.0 * costs[:, index].std() / math.sqrt(number)
        assert costs[:, index].mean() == pytest.approx(value.costs[index], abs=tolerance)


def test_rounding_leads_to_no_state_of_probability_0() -> None:
    rounded = np.array([[[0.5, 0.499995, 0.0]], [[0.0, 0.99999, 0.0]], [[1.0, 0.0, 0.0]]])
    model = FiniteCMDP(
        successors=np.tile(np.arange(3), (3, 1, 1)),
        probabilities=rounded,
        rewards=np.zeros((3, 1)),
        costs=np.zeros((3, 1, 1)),
        terminal=np.zeros(3, np.bool_),
        start=np.array([1.0, 0.0, 0.0]),
        horizon=100,
        cost_names=("cost",),
    )
    envs = FiniteVectorEnv("rounded", model, np.eye(3, dtype=np.float32), num_envs=20_000)
    envs.reset(seed=0)
    for _ in range(50):
        envs.step(np.zeros(20_000, np.int64))
        assert envs.states.max() == 1


def test_a_policy_of_the_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"the policy must have shape \(4, 3\) or \(5, 4, 3\), got \(3, 4\)"):
        evaluate_policy(random_cmdp(0), np.ones((3, 4)))


@pytest.mark.parametrize("row", [[1.0, 1.0, 1.0], [1.5, -0.5, 0.0], [0.5, 0.4, 0.0], [np.nan, 0.5, 0.5]])
def test_a_policy_whose_rows_are_no_probabilities_is_refused(row: list[float]) -> None:
    policy = np.eye(3)[[0, 1, 2, 0]]
    exact = evaluate_policy(random_cmdp(0), policy)
    rounded = evaluate_policy(random_cmdp(0), policy + np.array([1e-4, 0.0, -1e-17]))
    assert rounded.episode_return == pytest.approx(exact.episode_return, abs=1e-2)
    policy[2] = row
    for table in (policy, np.tile(policy, (5, 1, 1))):
        with pytest.raises(ValueError) as caught:
            evaluate_policy(random_cmdp(0), table)
        assert str(caught.value) == (
            "each row of the policy must be probabilities, at least 0 and with a sum of 1"
        )


def test_the_optimum_is_solved_once_in_well_under_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = []

    def timed(model: FiniteCMDP, limits: CostLimits) -> ConstrainedOptimum:
        before = time.thread_time()  # without what other threads of the process do
        solved = solve_by_lagrangian(model, limits)
        seconds.append(time.thread_time() - before)
        return solved

    monkeypatch.setattr(exact_solver, "solve_by_lagrangian", timed)
    limits = CostLimits((1.2345,))
    first, again = (optimal_return("rivergrid-1b", {}, limits) for _ in range(2))
    assert first == again
    assert len(seconds) == 1
    assert seconds[0] < 1.0


@pytest.mark.parametrize("name", ["two-state", "two-state-2", "rivergrid-1a"])
def test_tasks_with_tables_hand_them_over(name: str) -> None:
    environment = make_vector(name, 2)
    assert isinstance(environment, FiniteVectorEnv)
    model = environment.finite_cmdp()
    assert model.cost_names == environment.cmdp.cost_names
    assert model.horizon == environment.cmdp.horizon
    assert len(environment.observations) == model.num_states


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"rewards": np.zeros((3, 3))}, r"successors must have shape \(3, 3\), got \(4, 3\)"),
        ({"probabilities": np.ones((4, 3, 4))}, "probabilities must be at least 0 and sum to 1"),
        ({"start": np.array([0.0, 0.0, 0.0, 1.0])}, "an episode must not start in a terminal state"),
        ({"costs": -np.ones((4, 3, 1))}, r"costs must be finite and at least 0, got -1\.0"),
        ({"costs": np.full((4, 3, 1), np.nan)}, "costs must be finite and at least 0, got nan"),
        ({"rewards": np.full((4, 3), np.nan)}, "rewards must be finite numbers"),
        ({"start": np.full(4, np.nan)}, "start must be at least 0 and sum to 1"),
        ({"horizon": 0}, "the horizon must be at least 1 step, got 0"),
        ({"successors": np.full((4, 3, 4), 4)}, "successors must be states 0 to 3"),
    ],
)
def test_tables_that_are_no_cmdp_are_refused(changed: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FiniteCMDP(**{**vars(random_cmdp(0)), **changed})
