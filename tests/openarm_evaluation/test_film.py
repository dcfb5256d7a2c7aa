# SPDX-License-Identifier: Apache-2.0
"""Pictures and films can be read back, with the colours and the pace they had."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from openarm_common.errors import OpenArmError
from openarm_evaluation.judging.film import Film, save_picture


def red(width: int = 64, height: int = 48) -> np.ndarray:
    picture = np.zeros((height, width, 3), np.uint8)
    picture[..., 0] = 200
    return picture


def test_film_keeps_the_pace_of_simulated_time(tmp_path: Path) -> None:
    film = Film(tmp_path / "a.mp4", 10.0)
    for t in (0.0, 0.1, 0.2, 1.0, 2.0):  # frames were missed in between
        film.add(int((5.0 + t) * 1e9), red())
    assert film.close() == 21
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 21
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0)
    there, frame = video.read()
    assert there
    assert frame[..., 2].mean() > 150 > 60 > frame[..., 0].mean()
    assert film.dropped == 0


def test_animation_needs_two_frames_and_is_small(tmp_path: Path) -> None:
    film = Film(tmp_path / "a.mp4", 15.0)
    film.add(0, red())
    film.close()
    assert not film.save_animation(tmp_path / "a.webp")
    film = Film(tmp_path / "b.mp4", 15.0)
    for i in range(30):
        picture = red()
        picture[:, i : i + 8] = 255
        film.add(i * 10**8, picture)
    film.close()
    assert film.save_animation(tmp_path / "b.webp")
    there, animation = cv2.imreadanimation(str(tmp_path / "b.webp"))
    assert there
    assert 20 <= len(animation.frames) <= 26


def test_film_without_frames_ends(tmp_path: Path) -> None:
    assert Film(tmp_path / "a.mp4", 15.0).close() == 0


def test_picture_keeps_its_colours(tmp_path: Path) -> None:
    save_picture(tmp_path / "deep" / "a.png", red())
    assert (cv2.imread(str(tmp_path / "deep" / "a.png"))[..., 2] == 200).all()
    with pytest.raises((OpenArmError, cv2.error)):
        save_picture(tmp_path / "a.unknown", red())
