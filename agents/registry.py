"""Every agent by name: its options and its constructor.

A name is one of ``AGENTS``, an entry point in the group ``recrl.agents``, or an import path
``package.module:attribute``; the last two refer to an ``AgentEntry``. This module does not import torch: an
agent's module is imported when one is made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel

from recrl.agents.agent import Agent
from recrl.agents.algorithms.own_options import (
    CPOConfig,
    CRPOConfig,
    FOCOPSConfig,
    IPOConfig,
    P3OConfig,
    PCPOConfig,
    PPOConfig,
    PPOLagConfig,
    TRPOConfig,
    TRPOLagConfig,
)
from recrl.environments.cmdp import CMDPSpec
from recrl.environments.options import require_model
from recrl.environments.plugins import WrongKindError, load_attribute, resolve


@dataclass(frozen=True)
class AgentEntry:
    """Entry of one agent.

    Attributes:
        summary: one sentence of description.
        config: a frozen pydantic model of its options.
        make: callable (cmdp, config, seed) -> Agent, or the import path of one.
    """

    summary: str
    config: type[BaseModel]
    make: str | Callable[[CMDPSpec, Any, np.random.SeedSequence], Agent]

    def __post_init__(self) -> None:
        require_model(self.config)


AGENTS: dict[str, AgentEntry] = {
    "ppo-lag": AgentEntry(
        "PPO on the Lagrangian, with a choice of multiplier rules.",
        PPOLagConfig,
        "recrl.agents.algorithms.ppo_lag:make_ppo_lag",
    ),
    "cpo": AgentEntry(
        "Constrained policy optimisation: a trust-region step that keeps the constraints.",
        CPOConfig,
        "recrl.agents.algorithms.cpo:make_cpo",
    ),
    "pcpo": AgentEntry(
        "Projection-based constrained policy optimisation: a reward step, projected onto the constraints.",
        PCPOConfig,
        "recrl.agents.algorithms.pcpo:make_pcpo",
    ),
    "focops": AgentEntry(
        "First-order constrained optimisation in policy space: multipliers, no second derivatives.",
        FOCOPSConfig,
        "recrl.agents.algorithms.focops:make_focops",
    ),
    "p3o": AgentEntry(
        "Penalised proximal policy optimisation: an exact penalty with a constant factor.",
        P3OConfig,
        "recrl.agents.algorithms.p3o:make_p3o",
    ),
    "ipo": AgentEntry(
        "Interior-point policy optimisation: a logarithmic barrier before each limit.",
        IPOConfig,
        "recrl.agents.algorithms.ipo:make_ipo",
    ),
    "crpo": AgentEntry(
        "Constraint-rectified policy optimisation: reward steps while the constraints hold, else cost steps.",
        CRPOConfig,
        "recrl.agents.algorithms.crpo:make_crpo",
    ),
    "trpo-lag": AgentEntry(
        "TRPO on the Lagrangian, with a choice of multiplier rules.",
        TRPOLagConfig,
        "recrl.agents.algorithms.trpo_lag:make_trpo_lag",
    ),
    "ppo": AgentEntry(
        "PPO without constraints: a control.",
        PPOConfig,
        "recrl.agents.algorithms.ppo:make_ppo",
    ),
    "trpo": AgentEntry(
        "TRPO without constraints: a control.",
        TRPOConfig,
        "recrl.agents.algorithms.trpo:make_trpo",
    ),
}


def find_agent(name: str) -> AgentEntry:
    """Return the entry of the agent called ``name``.

    Raises:
        UnknownNameError: the name is not known; the message names the nearest known agent.
        WrongKindError: the named object is not an AgentEntry.
    """
    found = resolve(name, kind="agent", group="recrl.agents", ours=AGENTS)
    if not isinstance(found, AgentEntry):
        raise WrongKindError(
            f"agent {name!r} must be an AgentEntry, got {type(found).__name__}; write MINE = "
            "recrl.agents.registry.AgentEntry('one sentence', Options, make_mine) and name MINE"
        )
    return found


def agent_config(name: str, options: Mapping[str, Any]) -> BaseModel:
    """Return the validated options of an agent with preset and defaults; their ``model_dump`` is canonical.

    Raises:
        UnknownNameError: the agent is not known.
        pydantic.ValidationError: all mistakes in the options at once.
    """
    return find_agent(name).config.model_validate(dict(options))


def make_agent(name: str, cmdp: CMDPSpec, options: Mapping[str, Any], seed: np.random.SeedSequence) -> Agent:
    """Make a new agent for a task; with the same networks and seed, all have the same initial policy.

    Args:
        name: a name of ours, an entry point's name, or ``package.module:attribute``.
        cmdp: the task's CMDP.
        options: the agent's settings.
        seed: of its initial parameters and its later randomness.
    """
    entry = find_agent(name)
    make = load_attribute(entry.make) if isinstance(entry.make, str) else entry.make
    agent: Agent = make(cmdp, agent_config(name, options), seed)
    return agent
