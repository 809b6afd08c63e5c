"""An object store that fails on demand: a kind of storage of its own, ``unreliable://folder``, for fsspec."""

from typing import Any, ClassVar

import fsspec
from fsspec.implementations.local import LocalFileSystem


class Unreliable(LocalFileSystem):  # type: ignore[misc]  # fsspec has no types
    """A folder as a kind of storage of its own, whose writes fail when they are told to.

    Attributes:
        plan: what becomes of the next writes: ``ok``, ``refused``, ``cut`` short and refused, or
            ``lost``: done, though it seems refused, or ``unsupported`` by the store. After the plan all is
            well.
    """

    protocol = ("unreliable",)
    plan: ClassVar[list[str]] = []

    def __init__(self, **options: Any) -> None:
        super().__init__(auto_mkdir=True, **options)

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **options: Any) -> None:
        fate = self.plan.pop(0) if self.plan else "ok"
        if fate == "unsupported":
            raise NotImplementedError(mode)
        if fate != "refused":
            super().pipe_file(path, value[: len(value) // 2] if fate == "cut" else value, mode, **options)
        if fate != "ok":
            raise OSError("the network is down")


fsspec.register_implementation("unreliable", Unreliable, clobber=True)
