"""A curriculum of one's own: hold d_t for a while, then decay linearly to d_d."""

from pydantic import BaseModel, Field

from recrl.teachers.registry import TeacherKind
from recrl.teachers.static import StaticTeacher
from recrl.teachers.teacher import Teacher, TeacherSpec


class PlateauConfig(BaseModel, frozen=True, extra="forbid"):
    """``options: {hold: 0.3}`` in a grid."""

    hold: float = Field(default=0.5, ge=0.0, lt=1.0, description="Share of the budget spent at d_t.")


def plateau_teacher(spec: TeacherSpec) -> Teacher:
    """A curriculum of the clock alone is a decay; what looks at episodes implements ``Teacher.step``."""
    hold = PlateauConfig.model_validate(spec.options).hold

    def decay(p: float, train_limit: float, deploy_limit: float) -> float:
        gone = max(0.0, p - hold) / (1.0 - hold)
        return gone * deploy_limit + (1.0 - gone) * train_limit

    return StaticTeacher(spec, decay=decay)


PLATEAU = TeacherKind(
    "d_t for a while, then a straight line to d_d.", PlateauConfig, plateau_teacher, measures_start=True
)
