"""Frames of environments, rendered on demand.

Off-screen rendering uses EGL or, if that is missing, OSMesa. The environment variable ``MUJOCO_GL`` may
select one of them. Importing this module imports neither.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Frame = npt.NDArray[np.uint8]


class RenderingUnavailableError(RuntimeError):
    """This machine cannot render off-screen."""


class Renderer(Protocol):
    """Renderer for single environments of a batch."""

    def frame(self, index: int) -> Frame:
        """Render the present state of environment ``index``, [height, width, 3]."""

    def close(self) -> None:
        """Free the memory of the graphics driver."""


class Camera:
    """Camera of a batch; copies of an environment get a camera of their own.

    Args:
        render_mode: None or ``rgb_array``.
        make_renderer: (batch) -> its renderer, called for the first frame; a module-level function.
    """

    def __init__(self, render_mode: str | None, make_renderer: Callable[[Any], Renderer]) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.render_mode = render_mode
        self._make_renderer = make_renderer
        self._renderer: Renderer | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return Camera, (self.render_mode, self._make_renderer)

    def frames(self, batch: Any) -> tuple[Frame, ...]:
        """Render one frame [height, width, 3] of each environment."""
        if self.render_mode is None:
            raise ValueError(
                f"{batch.task.name}: to render, make the environment with render_mode='rgb_array' in "
                "gymnasium.make or gymnasium.make_vec, or with recrl.make_env"
            )
        if not batch.generators:
            raise ValueError(f"{batch.task.name}: call reset before the first frame")
        if self._renderer is None:
            self._renderer = self._make_renderer(batch)
        return tuple(self._renderer.frame(index) for index in range(batch.number))

    def close(self) -> None:
        """Free the memory of the graphics driver."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def make_context(width: int, height: int) -> Any:
    """Return an off-screen rendering context of the first available library.

    Raises:
        RenderingUnavailableError: EGL and OSMesa are missing, or the library in MUJOCO_GL is.
    """
    defaults = {"darwin": ("cgl",), "win32": ("glfw",)}.get(sys.platform, ("egl", "osmesa"))
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    failures = []
    for name in (chosen,) if chosen in defaults else defaults:
        try:
            context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
            context.make_current()
        except Exception as error:  # each library fails in its own way
            failures.append(f"{name}: {error}".splitlines()[0])
        else:
            return context
    raise RenderingUnavailableError(
        "drawing off-screen needs EGL (Debian: libegl1) or OSMesa (Debian: libosmesa6, MUJOCO_GL=osmesa); "
        f"failed: {'; '.join(failures)}"
    )
