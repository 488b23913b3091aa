"""The images of a run: under what its cameras saw, in the figure, the report and the video, also of a loaded run."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from kalmark.config import build_slam, config_dict, open_run
from kalmark.events import Frame
from kalmark.logs import Log, open_log, write_native
from kalmark.results.camera_log import images_of_cameras
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.results.run_page import report_html
from kalmark.results.video import write_video
from kalmark.simulate import load_world, simulate

CONFIG = """
log: {path: log}
robots:
  each:
    motion: {type: constant_velocity_3d, sigma_v_mps_per_sqrt_s: 0.1, sigma_w_radps_per_sqrt_s: 0.1}
    sensors:
      camera: {type: tag_corners, fx_px: 300, fy_px: 300, cx_px: 159.5, cy_px: 119.5, width_px: 320, height_px: 240,
               detector: {type: tags, size_m: 0.2}}
landmarks: {type: tag}
"""


def tag_at(left: int) -> np.ndarray:
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = np.full((240, 320), 255, np.uint8)
    image[80:160, left : left + 80] = cv2.aruco.generateImageMarker(family, 7, 80)
    return image


def test_a_run_shows_the_images_of_its_log_also_when_it_is_loaded(tmp_path: Path) -> None:
    images = [tag_at(100 + 2 * k) for k in range(4)]
    frames = [Frame(t_s=0.1 * k, robot="robot", sensor="camera", image=image) for k, image in enumerate(images)]
    write_native(Log("log", ("robot",), frames), tmp_path / "log")
    (tmp_path / "config.yaml").write_text(CONFIG, encoding="utf-8")
    config, log = open_run(tmp_path / "config.yaml")
    run = record(build_slam(config, log), log, progress=False, config=config_dict(config))
    run.save(tmp_path / "run")
    camera = run.history.cameras[0]
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg;base64,") == 4
    loaded = Run.load(tmp_path / "run")
    for one in (run, loaded):
        pictures = images_of_cameras(one)
        assert pictures is not None
        assert all((pictures.at(camera, step) == images[step]).all() for step in range(4))
    video = write_video(loaded, tmp_path / "video.gif", fps=5, progress=False)
    with Image.open(video) as film:
        assert film.n_frames == 4
        shown = np.asarray(film.convert("L"), dtype=np.float64)
    assert (shown[:, shown.shape[1] // 2 :] < 60).mean() > 0.03  # the black of the tag
    shutil.rmtree(tmp_path / "log")
    assert images_of_cameras(loaded) is None
    assert "data:image/jpeg;base64," not in report_html(loaded)


def test_a_run_without_images_has_no_pictures() -> None:
    world = load_world("thick_cloister_pinhole", ["steps=3"])
    log = simulate(world, 1)
    run = record(build_slam(world.config(), log), log, progress=False)
    pictures = images_of_cameras(run)
    assert pictures is not None
    assert pictures.at(run.history.cameras[0], 1) is None


def test_a_pair_shows_each_of_its_images_also_from_files(tmp_path: Path) -> None:
    world = load_world("textured_room_stereo", ["steps=1", "world.pixel_m=0.02"])
    log = simulate(world, 0)
    write_native(log, tmp_path / "log")
    again = open_log(tmp_path / "log")
    run = record(build_slam(world.config(), again), again, progress=False)
    camera, frames = run.history.cameras[0], [event for event in log.events if isinstance(event, Frame)]
    pictures = images_of_cameras(run)
    assert pictures is not None
    for step, frame in enumerate(frames):
        right = frame.right_grey()
        assert not (right == frame.grey()).all()
        assert (pictures.at(camera, step, "left") == frame.grey()).all()
        assert (pictures.at(camera, step, "right") == right).all()
