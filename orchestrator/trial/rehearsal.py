"""The first updates of a trial, in a temporary folder: does the user's code work and resume exactly?"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from recrl.agents.agent import final_policy
from recrl.agents.registry import AGENTS, agent_config, make_agent
from recrl.agents.spaces import environment_actions
from recrl.orchestrator.errors import USERS_ERRORS, described
from recrl.orchestrator.files.checkpoint_format import encode
from recrl.orchestrator.files.scratch import scratch_folder
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import Choice, TrialSpec
from recrl.orchestrator.trial.agent_answers import checked_noise
from recrl.orchestrator.trial.torch_settings import torch_settings
from recrl.orchestrator.trial.trial import Trial, TrialSeeds, open_environments
from recrl.teachers.registry import make_teacher
from recrl.teachers.teacher import TeacherSpec

UPDATES_BEFORE, UPDATES_AFTER = 2, 3  # the restart; the last update is in the deployment phase
MOST_ENVIRONMENTS, MOST_STEPS = 2, 16
MINIBATCH = 8  # of an own agent: so small that an update has several, as in a trial
SAVED = "what changes must be in the saved state"
DETERMINED = f"{SAVED}; reset(seed=...) and the actions must determine an episode"
NOISE = 0.1
OF_THE_CLOCK = ["time", "collect_seconds", "update_seconds"]


class PolicyError(Exception):
    """A rehearsed agent learns, but its final policy cannot act, or noise cannot be added to its policy."""


class RestartError(Exception):
    """A trial that was resumed from a checkpoint fails, or differs from the same one without interruption."""


def rehearse(spec: TrialSpec) -> None:
    """Run the beginning of a small copy of a trial twice: without interruption, and with a restart.

    Args:
        spec: of the trial; environments, steps, updates and minibatches are fewer or smaller.

    Raises:
        RestartError: the second one fails or differs.
        PolicyError: the updates are right, but the final policy or the noise fails.
        Exception: the first one fails.
    """
    num_envs, steps = min(spec.num_envs, MOST_ENVIRONMENTS), min(spec.rollout_steps, MOST_STEPS)
    small = replace(
        spec,
        agent=_with_small_minibatches(spec.agent),
        num_envs=num_envs,
        rollout_steps=steps,
        train_steps=(UPDATES_BEFORE + UPDATES_AFTER - 1) * num_envs * steps,
        deploy_steps=num_envs * steps,
        evaluation_episodes=0,
    )
    with torch_settings(), scratch_folder(tempfile.gettempdir()) as scratch:
        whole = _run(small, spec.teacher, scratch / "whole", restart=False)
        try:
            resumed = _run(small, spec.teacher, scratch / "resumed", restart=True)
        except USERS_ERRORS as error:
            raise RestartError(f"{described(error)}; {SAVED}") from error
        _compare(whole, resumed)
        _act(whole)


def _with_small_minibatches(agent: Choice) -> Choice:
    """Return an agent of the user's own with an option ``minibatch_size`` that few samples exceed."""
    size = getattr(agent_config(agent.name, agent.options), "minibatch_size", None)
    if agent.name in AGENTS or not isinstance(size, int) or size <= MINIBATCH:
        return agent
    options = {**agent.options, "minibatch_size": MINIBATCH}
    try:
        agent_config(agent.name, options)
    except ValidationError:  # too small for it
        return agent
    return replace(agent, options=options)


def _compare(whole: TrialStore, resumed: TrialStore) -> None:
    """Compare the rows of all updates, and the state after the last one."""
    rows = whole.updates(), resumed.updates()
    for name in rows[0].columns.drop(OF_THE_CLOCK):
        without, after = (each[name].iloc[UPDATES_BEFORE:].to_numpy() for each in rows)
        if not np.array_equal(without, after, equal_nan=without.dtype.kind == "f"):
            raise RestartError(f"{name} is {after.tolist()} and not {without.tolist()}; {DETERMINED}")
    states = [_final_state(store) for store in (whole, resumed)]
    for name, state in states[0].items():
        if states[1].get(name) != state:
            raise RestartError(f"the {name} differs after {UPDATES_AFTER} more updates; {DETERMINED}")


def _final_tree(store: TrialStore) -> dict[str, Any]:
    """Return the state of a trial after its last update."""
    checkpoint = store.latest_checkpoint()
    assert checkpoint is not None
    tree: dict[str, Any] = checkpoint["trial"]
    return tree


def _final_state(store: TrialStore) -> dict[str, bytes]:
    """Return each part of the agent's and the curriculum's state, as bytes that can be compared."""
    tree = _final_tree(store)
    if not isinstance(tree["agent"], dict):
        raise RestartError(f"an agent's state_dict must return a dict, got {type(tree['agent']).__name__}")
    parts = {"state of the curriculum": tree["teacher"]}
    parts |= {f"part {name!r} of the agent's state": part for name, part in tree["agent"].items()}
    return {name: encode({"part": _sorted(part)}) for name, part in parts.items()}


def _sorted(tree: Any) -> Any:
    """Return a tree with the keys of its dicts in order."""
    if isinstance(tree, dict):
        return {key: _sorted(tree[key]) for key in sorted(tree)}
    return [_sorted(part) for part in tree] if isinstance(tree, list) else tree


def _act(store: TrialStore) -> None:
    """Take a step with the final policy, stochastic and deterministic; add noise to the agent's policy."""
    spec, seeds = store.spec, TrialSeeds.of(store.spec)
    with open_environments(spec, 1) as environments:
        agent = make_agent(spec.agent.name, environments.cmdp, spec.agent.options, seeds.agent)
        agent.load_state_dict(_final_tree(store)["agent"])
        observations, _ = environments.reset(seed=0)
        generator = np.random.default_rng(seeds.exploration)
        with _saying("its final policy fails"):
            policy = final_policy(agent)
            for actions in (policy.act(observations, generator), policy.act_greedily(observations)):
                environments.step(environment_actions(environments.single_action_space, actions))
        with _saying("noise cannot be added to its policy"):
            checked_noise(spec.agent.label, agent.add_noise(NOISE, observations))


@contextmanager
def _saying(what: str) -> Iterator[None]:
    """Say what fails if the user's code does.

    Raises:
        PolicyError: it does.
    """
    try:
        yield
    except USERS_ERRORS as error:
        raise PolicyError(f"{what}: {described(error)}") from error


def _run(spec: TrialSpec, curriculum: TeacherSpec, folder: Path, *, restart: bool) -> TrialStore:
    """Run a trial to its end; its curriculum has the budget of the whole trial."""
    store = TrialStore(folder / spec.folder_name)
    parts = [UPDATES_BEFORE, UPDATES_AFTER] if restart else [UPDATES_BEFORE + UPDATES_AFTER]
    for updates in parts:
        with closing(Trial(spec, store.begin(spec), make_teacher(curriculum))) as trial:
            for _ in range(updates):
                trial.advance()
            trial.save()
    return store
