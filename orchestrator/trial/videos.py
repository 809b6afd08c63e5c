"""Pictures into videos: GIF, which everything shows, and MP4, which is smooth.

GIF is Pillow's; MP4 (H.264, which browsers play) is PyAV's, an optional package. A video keeps the time of
the task: where fewer pictures are drawn, each is shown longer.
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

from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.files.small_files import write_atomically

Picture = npt.NDArray[np.uint8]

MOST_GIF_PICTURES = 250  # more would take long to draw and much memory to encode
MOST_PICTURES_PER_SECOND = 25.0
GIF_COLOURS = 128
PALETTE_PICTURES = 8  # from which a GIF's colours are chosen
LAST_SECONDS = 1.0  # how long the end is seen before the video begins anew
CAPTION_PIXELS = 24
CAPTION_FONT_SIZE = 13


class VideoFormat(StrEnum):
    """The kinds of video; each is its files' suffix."""

    GIF = "gif"
    MP4 = "mp4"


def stride(video_format: VideoFormat, *, pictures_per_second: float, longest: int | None) -> int:
    """How many steps there should be from one picture to the next, at least 1.

    Args:
        video_format: GIFs are kept short.
        pictures_per_second: with a picture a step, above 0.
        longest: the most steps there can be, or None.

    >>> stride(VideoFormat.MP4, pictures_per_second=50.0, longest=1000)
    2
    >>> stride(VideoFormat.GIF, pictures_per_second=10.0, longest=200)
    1
    """
    for_speed = -(-pictures_per_second // MOST_PICTURES_PER_SECOND)
    for_size = -(-(longest or 1) // MOST_GIF_PICTURES) if video_format is VideoFormat.GIF else 1
    return int(max(1, for_speed, for_size))


def captioned(picture: Picture, caption: str) -> Picture:
    """The picture above a line of text; both sides of the result are even, as H.264 wants them."""
    height, width, _ = picture.shape
    size = (width + width % 2, height + CAPTION_PIXELS + height % 2)
    canvas = Image.new("RGB", size, "black")
    canvas.paste(Image.fromarray(picture), (0, 0))
    font = ImageFont.load_default(CAPTION_FONT_SIZE)
    ImageDraw.Draw(canvas).text((6, height + 4), caption, fill="white", font=font)
    return np.asarray(canvas)


def write_video(path: Path, pictures: Iterable[Picture], *, pictures_per_second: float) -> None:
    """Write a video, whole or not at all.

    Args:
        path: its suffix says which format.
        pictures: at least one, all of one size, both sides even.
        pictures_per_second: how fast they are shown, above 0.

    Raises:
        RecrlError: MP4 is wanted and PyAV is not there.
    """
    encode = {VideoFormat.GIF: _gif, VideoFormat.MP4: _mp4}[VideoFormat(path.suffix.removeprefix("."))]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, encode(pictures, pictures_per_second))


def _gif(pictures: Iterable[Picture], pictures_per_second: float) -> bytes:
    """All pictures share their colours, so that only what moves is stored."""
    whole = list(pictures)
    chosen = whole[:: -(-len(whole) // PALETTE_PICTURES)]
    palette = Image.fromarray(np.concatenate([*chosen, whole[-1]])).quantize(GIF_COLOURS)
    first, *rest = (
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in whole
    )
    durations = [round(1000.0 / pictures_per_second)] * len(rest) + [round(LAST_SECONDS * 1000)]
    data = io.BytesIO()
    first.save(data, "gif", save_all=True, append_images=rest, duration=durations, loop=0)
    return data.getvalue()


def _mp4(pictures: Iterable[Picture], pictures_per_second: float) -> bytes:
    try:
        import av  # noqa: PLC0415  (optional)
    except ImportError as error:
        raise RecrlError(
            "MP4 needs the package av (pip install 'recrl[video]'), which is not there; GIF needs nothing"
        ) from error
    data = io.BytesIO()
    with av.open(data, "w", format="mp4") as container:
        rate = Fraction(pictures_per_second).limit_denominator(1000)
        stream: Any = container.add_stream("h264", rate=rate)
        stream.pix_fmt = "yuv420p"
        for index, picture in enumerate(_held(pictures, round(LAST_SECONDS * pictures_per_second))):
            if index == 0:
                stream.height, stream.width, _ = picture.shape
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return data.getvalue()


def _held(pictures: Iterable[Picture], times: int) -> Iterator[Picture]:
    """The pictures, the last one ``times`` more often."""
    last = None
    for picture in pictures:
        last = picture
        yield picture
    if last is not None:
        yield from itertools.repeat(last, times)
