"""The curricula by name; users add theirs by entry point (``recrl.teachers``) or import path."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any

from pydantic import BaseModel

from recrl.environments.cmdp import CurriculumStep
from recrl.environments.options import require_model
from recrl.environments.plugins import WrongKindError, resolve
from recrl.teachers.algorithm_2 import Algorithm2Teacher
from recrl.teachers.cooling import CoolingConfig, CoolingTeacher
from recrl.teachers.dynamic import DynamicTeacher
from recrl.teachers.dynamic_options import DynamicConfig
from recrl.teachers.static import (
    Decay,
    DecayConfig,
    NoConfig,
    cosine,
    decay_teacher,
    exponential,
    linear,
    none_teacher,
    step_teacher,
    unconstrained_teacher,
)
from recrl.teachers.teacher import Teacher, TeacherSpec


@dataclass(frozen=True)
class TeacherKind:
    """Entry of a curriculum in the registry; users' entry points and import paths refer to one.

    Attributes:
        summary: one sentence of description.
        config: the pydantic model of its options.
        make: builds it. ``config`` has accepted the options, but they are as given, without defaults:
            ``config.model_validate`` adds these.
        measures_start: whether it measures an infinite d_t, as a mean cost, as ``StartMeasurement`` does.
            Otherwise ``start_limits`` that come after the first step are an error.
        compares_costs: whether it compares mean costs of episodes with its limits.
        rewards_entropy: whether its steps may have an entropy coefficient; otherwise such a step is an
            error. A curriculum that rewards entropy is refused for continuous actions, because the entropy
            of a Gaussian policy has no bound.
        is_control: whether it keeps d_t until the deployment phase, so that a hard landing is no mistake.
    """

    summary: str
    config: type[BaseModel]
    make: Callable[[TeacherSpec], Teacher]
    _: KW_ONLY
    measures_start: bool = False
    compares_costs: bool = False
    rewards_entropy: bool = False
    is_control: bool = False

    def __post_init__(self) -> None:
        require_model(self.config)

    def require_declared(
        self, step: CurriculumStep, before: CurriculumStep | None, *, curriculum: str
    ) -> None:
        """Check that a step has nothing that must be declared here and is not.

        Args:
            step: the step.
            before: the one before it; None at the start.
            curriculum: its label, for errors.

        Raises:
            TypeError: it has an entropy coefficient, or start limits that were measured.
        """
        if step.entropy_coefficient is not None and not self.rewards_entropy:
            raise TypeError(
                f"curriculum {curriculum}: a step has an entropy_coefficient, so its TeacherKind must have "
                "rewards_entropy=True"
            )
        is_measured = before is not None and step.start_limits not in (None, before.start_limits)
        if is_measured and not self.measures_start:
            raise TypeError(
                f"curriculum {curriculum}: start_limits came after the first step, so its TeacherKind must "
                "have measures_start=True"
            )


def _decay(summary: str, decay: Decay) -> TeacherKind:
    """Return the entry of a decay from d_t, or from the measured costs, to d_d."""
    return TeacherKind(summary, DecayConfig, partial(decay_teacher, decay=decay), measures_start=True)


def _dynamic_teacher(spec: TeacherSpec) -> Teacher:
    """Make our dynamic curriculum, or with ``preset: paper`` Algorithm 2."""
    is_paper = DynamicConfig.model_validate(dict(spec.options)).preset == "paper"
    return Algorithm2Teacher(spec) if is_paper else DynamicTeacher(spec)


TEACHERS: dict[str, TeacherKind] = {
    "none": TeacherKind("No curriculum: d_d from the start.", NoConfig, none_teacher),
    "step": TeacherKind(
        "A control: d_t until the training steps end, then d_d at once.",
        NoConfig,
        step_teacher,
        is_control=True,
    ),
    "unconstrained": TeacherKind(
        "A control: no limit until the training steps end, for any d_t, then d_d at once.",
        NoConfig,
        unconstrained_teacher,
        is_control=True,
    ),
    "linear": _decay("CLiC_L: from d_t to d_d linearly.", linear),
    "cosine": _decay("CLiC_C: from d_t to d_d, slowly at first.", cosine),
    "exponential": _decay("CLiC_E: from d_t to d_d, fast at first.", exponential),
    "dynamic": TeacherKind(
        "CLiC_D: lower limits for an agent that keeps them, noise for an agent that is stuck.",
        DynamicConfig,
        _dynamic_teacher,
        measures_start=True,
        compares_costs=True,
    ),
    "cooling": TeacherKind(
        "Ours: a rewarded entropy that is annealed, and a limit that falls with it.",
        CoolingConfig,
        CoolingTeacher,
        rewards_entropy=True,
    ),
}


def find_teacher(name: str) -> TeacherKind:
    """Return the entry of the curriculum called ``name``.

    Raises:
        UnknownNameError: the name is not known; the message names the nearest known one.
        WrongKindError: the named object is not a TeacherKind.
    """
    kind = resolve(name, kind="curriculum", group="recrl.teachers", ours=TEACHERS)
    if not isinstance(kind, TeacherKind):
        raise WrongKindError(
            f"curriculum {name!r} must be a TeacherKind, got {type(kind).__name__}; write MINE = "
            "recrl.teachers.registry.TeacherKind('one sentence', Options, MyCurriculum) and name MINE"
        )
    return kind


def may_measure_start(name: str) -> bool:
    """Return whether a curriculum that was run may have measured an infinite d_t.

    A user's curriculum may have; its code need not be there where results are read.

    >>> may_measure_start("linear"), may_measure_start("none"), may_measure_start("their_package:MINE")
    (True, False, True)
    """
    return name not in TEACHERS or TEACHERS[name].measures_start


def is_known_control(name: str) -> bool:
    """Return whether a curriculum is a control of this package.

    Their trials had the event of a hard landing before curricula declared ``is_control``.
    """
    return name in TEACHERS and TEACHERS[name].is_control


def teacher_config(name: str, options: Mapping[str, Any]) -> BaseModel:
    """Return the validated settings of a curriculum, with its defaults and preset.

    Raises:
        UnknownNameError: there is no curriculum of that name.
        pydantic.ValidationError: an option is unknown or out of its range.
    """
    return find_teacher(name).config.model_validate(dict(options))


def make_teacher(spec: TeacherSpec) -> Teacher:
    """Make the curriculum of ``spec``.

    Raises:
        UnknownNameError: there is no curriculum of that name.
        pydantic.ValidationError: an option is unknown or out of its range.
        TypeError: what a user's ``make`` returns is no curriculum.
    """
    kind = find_teacher(spec.name)
    kind.config.model_validate(dict(spec.options))
    teacher = kind.make(spec)
    if not all(callable(getattr(teacher, method, None)) for method in ("start", "step")):
        raise TypeError(
            f"curriculum {spec.name}: make must return an object with the methods start and step, got "
            f"{type(teacher).__name__}"
        )
    return teacher
