"""Runs as videos: what is written where, with ffmpeg and without."""

from __future__ import annotations

import stat
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import results_space
import results_world
from kalmark.errors import RunError
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.video import write_video


@pytest.fixture(scope="module")
def run() -> Run:
    slam, log = results_space.with_camera(results_space.spiral(steps=20))
    return record(slam, log, progress=False)


@pytest.fixture
def no_ffmpeg(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))


@pytest.mark.usefixtures("no_ffmpeg")
def test_without_ffmpeg_a_video_is_an_animated_picture_that_moves(run: Run, tmp_path: Path) -> None:
    path = write_video(run, tmp_path / "video.mp4", fps=5.0, frames=4, orbit_deg=30.0, progress=False)
    assert path == tmp_path / "video.gif"
    with Image.open(path) as gif:
        assert (gif.n_frames, gif.info["duration"]) == (4, 200)
        pictures = []
        for k in range(gif.n_frames):
            gif.seek(k)
            pictures.append(np.asarray(gif.convert("RGB"), dtype=float))
    assert all(np.abs(a - b).mean() > 0.1 for a, b in pairwise(pictures))
    assert [p.name for p in tmp_path.iterdir()] == ["video.gif"]


@pytest.mark.usefixtures("no_ffmpeg")
def test_a_run_in_the_plane_has_its_video_too(tmp_path: Path) -> None:
    log = results_world.circle(robots=("a", "b"), steps=10)
    run = record(results_world.slam_for(log), log, progress=False)
    with Image.open(write_video(run, tmp_path / "v.gif", frames=3, progress=False)) as gif:
        assert gif.n_frames == 3


def test_ffmpeg_is_given_every_frame(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text(f"#!{sys.executable}\nimport sys\nopen(sys.argv[-1], 'wb').write(sys.stdin.buffer.read())\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(program.parent))
    path = write_video(run, tmp_path / "video.mp4", frames=3, progress=False)
    assert path.name == "video.mp4"
    assert path.stat().st_size == 3 * 4 * 1024 * 576, "RGBA of three frames"


def test_what_cannot_become_a_video_is_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"expected \.mp4 or \.gif"):
        write_video(run, tmp_path / "video.avi")
    with pytest.raises(RunError, match="fps is 0"):
        write_video(run, tmp_path / "video.gif", fps=0.0)
    empty = replace(run.history, t_ns=run.history.t_ns[:0])
    with pytest.raises(RunError, match="no scan"):
        write_video(replace(run, history=empty), tmp_path / "video.gif")
