"""Encode frames as videos: GIF, which all viewers support, and MP4, which is smooth.

GIF is Pillow's; MP4 (H.264, which browsers play) is PyAV's, an optional package. A video keeps the time of
the task: with fewer frames, each is shown longer.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Iterator
from enum import StrEnum
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from recrl.agents.evaluation import MAX_FILMED_STEPS
from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.files.atomic_files import write_atomically

Frame = npt.NDArray[np.uint8]

MOST_GIF_FRAMES = 250  # more would take long to render and much memory to encode
MOST_FRAMES_PER_SECOND = 25.0
GIF_COLOURS = 128
PALETTE_FRAMES = 8  # for choosing a GIF's colours
LAST_SECONDS = 1.0  # time for which the last frame is shown before the video restarts
CAPTION_PIXELS = 24
CAPTION_FONT_SIZE = 13


class VideoFormat(StrEnum):
    """Video formats; each is its files' suffix."""

    GIF = "gif"
    MP4 = "mp4"


def stride(video_format: VideoFormat, *, frames_per_second: float, longest: int | None) -> int:
    """Return the number of steps between frames, at least 1.

    Args:
        video_format: GIFs are kept short.
        frames_per_second: with one frame per step, above 0.
        longest: largest number of steps; None if unknown, then ``MAX_FILMED_STEPS``.

    >>> stride(VideoFormat.MP4, frames_per_second=50.0, longest=1000)
    2
    >>> stride(VideoFormat.GIF, frames_per_second=10.0, longest=200)
    1
    """
    for_speed = -(-frames_per_second // MOST_FRAMES_PER_SECOND)
    for_size = -(-(longest or MAX_FILMED_STEPS) // MOST_GIF_FRAMES) if video_format is VideoFormat.GIF else 1
    return int(max(1, for_speed, for_size))


def captioned(frame: Frame, caption: str) -> Frame:
    """Return the frame above a line of text; both sides of the result are even, as H.264 requires."""
    height, width, _ = frame.shape
    size = (width + width % 2, height + CAPTION_PIXELS + height % 2)
    canvas = Image.new("RGB", size, "black")
    canvas.paste(Image.fromarray(frame), (0, 0))
    font = ImageFont.load_default(CAPTION_FONT_SIZE)
    ImageDraw.Draw(canvas).text((6, height + 4), caption, fill="white", font=font)
    return np.asarray(canvas)


def write_video(path: Path, frames: Iterable[Frame], *, frames_per_second: float) -> None:
    """Write a video atomically.

    Args:
        path: its suffix determines the format.
        frames: at least one, all of one size, both sides even.
        frames_per_second: above 0.

    Raises:
        RecrlError: MP4 is requested and PyAV is missing.
    """
    encode = {VideoFormat.GIF: _gif, VideoFormat.MP4: _mp4}[VideoFormat(path.suffix.removeprefix("."))]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, encode(frames, frames_per_second))


def _gif(frames: Iterable[Frame], frames_per_second: float) -> bytes:
    """Write a GIF with one palette for all frames, so that only changes are stored."""
    whole = list(frames)
    chosen = whole[:: -(-len(whole) // PALETTE_FRAMES)]
    palette = Image.fromarray(np.concatenate([*chosen, whole[-1]])).quantize(GIF_COLOURS)
    first, *rest = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in whole
    )
    durations = [round(1000.0 / frames_per_second)] * len(rest) + [round(LAST_SECONDS * 1000)]
    data = io.BytesIO()
    first.save(data, "gif", save_all=True, append_images=rest, duration=durations, loop=0)
    return data.getvalue()


def _mp4(frames: Iterable[Frame], frames_per_second: float) -> bytes:
    try:
        import av  # noqa: PLC0415  (optional)
    except ImportError as error:
        raise RecrlError(
            "MP4 needs the package av, which is missing: pip install av; GIF needs no package"
        ) from error
    data = io.BytesIO()
    with av.open(data, "w", format="mp4") as container:
        rate = Fraction(frames_per_second).limit_denominator(1000)
        stream: Any = container.add_stream("h264", rate=rate)
        stream.pix_fmt = "yuv420p"
        for index, frame in enumerate(_held(frames, round(LAST_SECONDS * frames_per_second))):
            if index == 0:
                stream.height, stream.width, _ = frame.shape
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return data.getvalue()


def _held(frames: Iterable[Frame], times: int) -> Iterator[Frame]:
    """Yield the frames, the last one ``times`` more often."""
    last = None
    for frame in frames:
        last = frame
        yield frame
    if last is not None:
        yield from itertools.repeat(last, times)
