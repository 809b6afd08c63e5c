"""A curriculum that reads episodes: a kept limit moves halfway from their mean cost to d_d."""

from statistics import fmean

from pydantic import BaseModel, Field

from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.teachers.registry import TeacherKind
from recrl.teachers.teacher import already_seen, progress


class HalvingConfig(BaseModel, frozen=True, extra="forbid"):
    """``options: {episodes: 50}`` in a grid."""

    episodes: int = Field(default=20, ge=1, description="Episodes under one limit before it is judged.")


def halved(limit, deploy_limit, cost):
    """The next limit of one cost; a violated limit stays."""
    return max(deploy_limit, (deploy_limit + cost) / 2) if cost <= limit else limit


class Halving:
    """Everything that must survive a crash is in the state, which holds JSON values only."""

    def __init__(self, spec):
        self.spec = spec
        self.config = HalvingConfig.model_validate(dict(spec.options))

    def start(self):
        return self._state(0, self.spec.train_limits, since=0)

    def step(self, state, report):
        if already_seen(state, report):  # asked again after a crash: the same answer
            return CurriculumStep.from_json(state), state
        limits, since = CostLimits.from_json(state["limits"]), state["since"]
        if progress(report.env_steps, self.spec.train_steps) >= 1.0:
            return self._state(report.update, self.spec.deploy_limits, report.env_steps)
        # an episode that began before the last judgement may have begun under another limit
        new = [list(episode.costs) for episode in report.episodes if episode.begin_step >= since]
        costs = [*state["costs"], *new]
        if len(costs) < self.config.episodes:
            return self._state(report.update, limits, since, costs)
        means = map(fmean, zip(*costs, strict=True))
        lower = map(halved, limits, self.spec.deploy_limits, means)
        return self._state(report.update, CostLimits(tuple(lower)), report.env_steps)

    def _state(self, update, limits, since, costs=()):
        asked = CurriculumStep(limits)
        return asked, {"update": update, "since": since, "costs": list(costs), **asked.to_json()}


HALVING = TeacherKind(
    "A limit that the last episodes kept moves halfway from their mean cost to d_d.",
    HalvingConfig,
    Halving,
    compares_costs=True,
)
