"""Videos keep a task's time, show what was drawn, and are there whole or not at all."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from recrl.orchestrator.errors import RecrlError
from recrl.orchestrator.trial.videos import Frame, VideoFormat, captioned, stride, write_video

BLUE, GREEN = (0, 0, 255), (0, 255, 0)


def plain(colour: tuple[int, int, int]) -> Frame:
    return np.full((40, 60, 3), colour, np.uint8)


@pytest.mark.parametrize(
    ("kind", "speed", "longest", "expected"),
    [
        (VideoFormat.GIF, 10.0, 200, 1),
        (VideoFormat.GIF, 25.0, 1000, 4),
        (VideoFormat.GIF, 50.0, None, 40),  # a film has 10,000 steps at most
        (VideoFormat.MP4, 50.0, 1000, 2),
        (VideoFormat.MP4, 25.0, 1000, 1),
    ],
)
def test_long_and_fast_episodes_are_drawn_seldom(
    kind: VideoFormat, speed: float, longest: int | None, expected: int
) -> None:
    assert stride(kind, frames_per_second=speed, longest=longest) == expected


def test_a_gif_shows_every_picture_for_its_time(tmp_path: Path) -> None:
    path = tmp_path / "videos" / "film.gif"
    write_video(path, [plain(BLUE), plain(GREEN), plain(BLUE)], frames_per_second=10.0)
    with Image.open(path) as film:
        assert (film.n_frames, film.size, film.info["loop"]) == (3, (60, 40), 0)  # type: ignore[attr-defined]
        durations, colours = [], []
        for index in range(3):
            film.seek(index)
            durations.append(film.info["duration"])
            colours.append(film.convert("RGB").getpixel((30, 20)))
    assert durations == [100, 100, 1000]
    assert colours[0] == colours[2] == BLUE


def test_the_caption_stands_below_and_both_sides_are_even() -> None:
    frame = np.random.default_rng(0).integers(256, size=(41, 63, 3), dtype=np.uint8)
    result = captioned(frame, "step 3   return 0.1   river 2 of 5")
    assert result.shape == (66, 64, 3)
    assert np.array_equal(result[:41, :63], frame)
    assert result[41:].max() > 200  # something is written


def test_what_fails_midway_leaves_no_video(tmp_path: Path) -> None:
    def broken() -> Iterator[Frame]:
        yield plain(BLUE)
        raise RuntimeError("the camera fell into the river")

    with pytest.raises(RuntimeError, match="river"):
        write_video(tmp_path / "film.gif", broken(), frames_per_second=10.0)
    assert list(tmp_path.iterdir()) == []


def test_mp4_without_its_package_is_one_clear_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(RecrlError) as error:
        write_video(tmp_path / "film.mp4", [plain(BLUE)], frames_per_second=10.0)
    assert str(error.value) == (
        "MP4 needs the package av, which is missing: pip install av; GIF needs no package"
    )
    assert list(tmp_path.iterdir()) == []


def test_an_mp4_shows_every_picture(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    path = tmp_path / "film.mp4"
    write_video(path, [plain(BLUE), plain(GREEN)], frames_per_second=10.0)
    with av.open(path) as film:
        frames = [it.to_ndarray(format="rgb24") for it in film.decode(video=0)]
        assert film.streams.video[0].average_rate == 10
    assert len(frames) == 12  # and the last one for a second more
    np.testing.assert_allclose(frames[0][20, 30], BLUE, atol=8)
    np.testing.assert_allclose(frames[-1][20, 30], GREEN, atol=8)
