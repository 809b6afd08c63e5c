"""The teachers by name; a user's own come in by entry point (``recrl.teachers``) or import path."""

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
    """What a teacher's name stands for; a user's entry point or import path leads to one of these.

    Attributes:
        summary: one sentence for people who choose a curriculum.
        config: the pydantic model of its options.
        make: builds it; may rely on options that ``config`` has accepted.
    """

    summary: str
    config: type[BaseModel]
    make: Callable[[TeacherSpec], Teacher]


TEACHERS: dict[str, TeacherKind] = {
    "none": TeacherKind("No curriculum: d_d from the start.", NoConfig, none_teacher),
    "step": TeacherKind("A control: d_t until B, then d_d at once.", NoConfig, step_teacher),
    "unconstrained": TeacherKind(
        "A control: no limit until B, whatever d_t is, then d_d at once.", NoConfig, unconstrained_teacher
    ),
    "linear": TeacherKind(
        "CLiC_L: from d_t to d_d in a straight line.", DecayConfig, partial(decay_teacher, decay=linear)
    ),
    "cosine": TeacherKind(
        "CLiC_C: from d_t to d_d, slowly at first.", DecayConfig, partial(decay_teacher, decay=cosine)
    ),
    "exponential": TeacherKind(
        "CLiC_E: from d_t to d_d, fast at first.", DecayConfig, partial(decay_teacher, decay=exponential)
    ),
    "dynamic": TeacherKind(
        "CLiC_D: lower limits for an agent that keeps them, noise for one that is stuck.",
        DynamicConfig,
        DynamicTeacher,
    ),
    "cooling": TeacherKind(
        "Ours: entropy is worth a reward that falls to 0, and the limit, relaxed as far, falls with it.",
        CoolingConfig,
        CoolingTeacher,
    ),
}


def find_teacher(name: str) -> TeacherKind:
    """The curriculum called ``name``.

    Raises:
        UnknownNameError: nobody provides it; the message names the nearest known one.
        TypeError: what the name leads to is not a TeacherKind.
    """
    kind = resolve(name, kind="teacher", group="recrl.teachers", ours=TEACHERS)
    if not isinstance(kind, TeacherKind):
        raise TypeError(f"teacher {name!r} must be a recrl.teachers.registry.TeacherKind, got {kind!r}")
    return kind


def teacher_config(name: str, options: Mapping[str, Any]) -> BaseModel:
    """The validated settings of a teacher, with its defaults and its preset filled in.

    Raises:
        UnknownNameError: nobody provides a teacher of that name.
        pydantic.ValidationError: an option is unknown or out of its range.
    """
    return find_teacher(name).config.model_validate(dict(options))


def make_teacher(spec: TeacherSpec) -> Teacher:
    """The teacher that ``spec`` describes.

    Raises:
        UnknownNameError: nobody provides a teacher of that name.
        pydantic.ValidationError: an option is unknown or out of its range.
    """
    kind = find_teacher(spec.name)
    kind.config.model_validate(dict(spec.options))
    return kind.make(spec)
