"""The curricula by name; users add theirs by entry point (``recrl.teachers``) or import path."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from pydantic import BaseModel

from recrl.environments.plugins import resolve
from recrl.teachers.cooling import CoolingConfig, CoolingTeacher
from recrl.teachers.dynamic import DynamicTeacher
from recrl.teachers.dynamic_options import DynamicConfig
from recrl.teachers.static import (
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
        make: builds it, from options that ``config`` has accepted.
    """

    summary: str
    config: type[BaseModel]
    make: Callable[[TeacherSpec], Teacher]


TEACHERS: dict[str, TeacherKind] = {
    "none": TeacherKind("No curriculum: d_d from the start.", NoConfig, none_teacher),
    "step": TeacherKind(
        "A control: d_t until the training steps end, then d_d at once.", NoConfig, step_teacher
    ),
    "unconstrained": TeacherKind(
        "A control: no limit until the training steps end, for any d_t, then d_d at once.",
        NoConfig,
        unconstrained_teacher,
    ),
    "linear": TeacherKind(
        "CLiC_L: from d_t to d_d linearly.", DecayConfig, partial(decay_teacher, decay=linear)
    ),
    "cosine": TeacherKind(
        "CLiC_C: from d_t to d_d, slowly at first.", DecayConfig, partial(decay_teacher, decay=cosine)
    ),
    "exponential": TeacherKind(
        "CLiC_E: from d_t to d_d, fast at first.", DecayConfig, partial(decay_teacher, decay=exponential)
    ),
    "dynamic": TeacherKind(
        "CLiC_D: lower limits for an agent that keeps them, noise for an agent that is stuck.",
        DynamicConfig,
        DynamicTeacher,
    ),
    "cooling": TeacherKind(
        "Ours: a rewarded entropy that is annealed, and a limit that falls with it.",
        CoolingConfig,
        CoolingTeacher,
    ),
}


def find_teacher(name: str) -> TeacherKind:
    """Return the entry of the curriculum called ``name``.

    Raises:
        UnknownNameError: the name is not known; the message names the nearest known one.
        TypeError: the named object is not a TeacherKind.
    """
    kind = resolve(name, kind="curriculum", group="recrl.teachers", ours=TEACHERS)
    if not isinstance(kind, TeacherKind):
        raise TypeError(
            f"curriculum {name!r} must be a TeacherKind, got {type(kind).__name__}; write MINE = "
            "recrl.teachers.registry.TeacherKind('one sentence', Options, MyCurriculum) and name MINE"
        )
    return kind


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
    """
    kind = find_teacher(spec.name)
    kind.config.model_validate(dict(spec.options))
    return kind.make(spec)
