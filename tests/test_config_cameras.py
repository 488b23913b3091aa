"""The configuration of a camera: calibrations of OpenCV, Kalibr, ROS, EuRoC and ORB-SLAM, and a bad one in one line."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kalmark.config import load_config
from kalmark.errors import ConfigError
from kalmark.geometry.frames3d import from_euler_pose
from kalmark.models.sensors import PinHole
from kalmark.vision.calibration_key import calibration

OPENCV = """%YAML:1.0
---
calibration_time: "Fri 01 May 2026 10:00:00"
image_width: 640
image_height: 480
flags: 0
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 6.5e+02, 0., 3.2e+02, 0., 6.6e+02, 2.4e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.8e-01, 7.0e-02, 1.0e-03, -2.0e-03, 1.0e-02 ]
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.02, -0.03, 0.004]
  distortion_model: equidistant
  intrinsics: [461.6, 460.1, 362.7, 246.0]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.1]
  - [0.0, 0.0, -1.0, 0.2]
  - [1.0, 0.0, 0.0, 0.3]
  - [0.0, 0.0, 0.0, 1.0]
cam1:
  camera_model: pinhole
  distortion_coeffs: [0.9]
  distortion_model: fov
  intrinsics: [462.0, 463.0, 364.0, 248.0]
  resolution: [752, 480]
"""
ROS = """image_width: 800
image_height: 600
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [500.5, 0, 400, 0, 501.5, 300, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.01, 0, 0, 0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
EUROC = """sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, 0.0, 1.0, 0.5,
        -1.0, 0.0, 0.0, 0.6,
         0.0, -1.0, 0.0, 0.7,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375]
distortion_model: radial-tangential
distortion_coefficients: [-0.283, 0.074, 0.0002, 1.8e-05]
"""
ORB = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: 517.3
Camera.fy: 516.5
Camera.cx: 318.6
Camera.cy: 255.3
Camera.k1: 0.2624
Camera.k2: -0.9531
Camera.p1: -0.0054
Camera.p2: 0.0026
Camera.k3: 1.1633
Camera.width: 640
Camera.height: 480
ORBextractor.nFeatures: 1000
"""
TSAI = """%YAML:1.0

CameraCalibration:
  S3:
    PixelsX: "640"
    PixelsY: "480"
    FX: "525.0"
    FY: "525.0"
    K1: "-7.6e-003"
    K2: "9.4e-004"
    CX: "308.6"
    CY: "236.5"
    DX: "0.007"
    DY: "0.007"
"""
AHEAD = {"x_m": 0.5, "y_m": 0.6, "z_m": 0.7, "roll_deg": -90.0, "pitch_deg": 0.0, "yaw_deg": -90.0}
PARTS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px", "lens")


def read(folder: Path, text: str, camera: str | None = None) -> dict[str, Any]:
    (folder / "camera.yaml").write_text(text)
    return calibration(folder / "camera.yaml", camera)


@pytest.mark.parametrize(
    ("text", "camera", "parts", "distortion"),
    [
        (OPENCV, None, (650, 660, 320, 240, 640, 480, "radtan"), [-0.28, 0.07, 0.001, -0.002, 0.01]),
        (KALIBR, "cam0", (461.6, 460.1, 362.7, 246.0, 752, 480, "equidistant"), [-0.01, 0.02, -0.03, 0.004]),
        (KALIBR, "cam1", (462.0, 463.0, 364.0, 248.0, 752, 480, "fov"), [0.9]),
        (ROS, None, (500.5, 501.5, 400, 300, 800, 600, "radtan"), [-0.1, 0.01, 0, 0, 0]),
        (EUROC, None, (458.654, 457.296, 367.215, 248.375, 752, 480, "radtan"), [-0.283, 0.074, 0.0002, 1.8e-5]),
        (ORB, None, (517.3, 516.5, 318.6, 255.3, 640, 480, "radtan"), [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]),
        (TSAI, "S3", (525, 525, 308.6, 236.5, 640, 480, "tsai"), [-0.0076 * 3.675**2, 0.00094 * 3.675**4]),
    ],
)  # fmt: skip
def test_a_calibration_is_the_parameters_of_a_pinhole(
    tmp_path: Path, text: str, camera: str | None, parts: tuple[Any, ...], distortion: list[float]
) -> None:
    found = read(tmp_path, text, camera)
    assert tuple(found[name] for name in PARTS) == parts
    np.testing.assert_allclose(found["distortion"], distortion, rtol=1e-12)
    found.pop("mount", None)
    PinHole(**found)


def test_fish_eyes_of_opencv_and_lenses_without_distortion_are_told_apart(tmp_path: Path) -> None:
    fish = OPENCV.replace("fisheye_model: 0", "fisheye_model: 1").replace(", 1.0e-02 ]", " ]")
    assert read(tmp_path, fish)["lens"] == "equidistant"
    none = OPENCV.replace("-2.8e-01, 7.0e-02, 1.0e-03, -2.0e-03, 1.0e-02", "0., 0., 0., 0., 0.")
    assert not any(read(tmp_path, none)["distortion"])
    rational = ROS.replace("-0.1, 0.01, 0, 0, 0", "-0.1, 0.01, 0, 0, 0, 0, 0, 0").replace(
        "plumb_bob", "rational_polynomial"
    )
    assert read(tmp_path, rational)["distortion"] == [-0.1, 0.01, 0, 0, 0]


def test_the_mount_is_the_pose_of_the_camera_in_the_body(tmp_path: Path) -> None:
    assert read(tmp_path, EUROC)["mount"] == AHEAD
    mount = read(tmp_path, KALIBR, "cam0")["mount"]  # T_cam_imu goes from the body to the camera
    assert (mount["x_m"], mount["y_m"], mount["z_m"]) == pytest.approx((-0.3, 0.1, 0.2))
    pose = from_euler_pose(np.array([0, 0, 0, *np.radians([mount[f"{n}_deg"] for n in ("roll", "pitch", "yaw")])]))[0]
    np.testing.assert_allclose(pose[3:], [-0.5, 0.5, -0.5, 0.5], atol=1e-12)


def written(folder: Path, key: str, text: str = EUROC, kind: str = "pinhole") -> Path:
    (folder / "camera.yaml").write_text(text)
    config = (
        f"robots: {{each: {{motion: {{type: constant_velocity_3d}}, sensors: {{cam: {{type: {kind}, {key}}}}}}}}}\n"
    )
    (folder / "config.yaml").write_text(config)
    return folder / "config.yaml"


def test_a_camera_of_a_configuration_names_its_calibration(tmp_path: Path) -> None:
    camera: Any = load_config(written(tmp_path, "calibration: camera.yaml")).robots["each"].sensors["cam"]
    assert (camera.fx_px, camera.lens, camera.distortion[0], camera.mount.x_m) == (458.654, "radtan", -0.283, 0.5)
    of_two = written(tmp_path, "calibration: {file: camera.yaml, camera: cam1}", KALIBR)
    camera = load_config(of_two, ["robots.each.sensors.cam.cx_px=7"]).robots["each"].sensors["cam"]
    assert (camera.fx_px, camera.cx_px, camera.lens) == (462.0, 7, "fov")


@pytest.mark.parametrize(
    ("text", "key", "kind", "what"),
    [
        (KALIBR, "camera.yaml", "pinhole", "camera.yaml: the cameras cam0, cam1, expected the name of one of them"),
        (KALIBR, "{file: camera.yaml, camera: cam2}", "pinhole", "no camera 'cam2', expected one of cam0, cam1"),
        (KALIBR.replace("pinhole", "omni"), "{file: camera.yaml, camera: cam0}", "pinhole", "camera_model is 'omni', "
         "expected pinhole"),
        (ROS.replace("500.5", "-3"), "camera.yaml", "pinhole", "focal lengths is [-3.0, 501.5], expected numbers > 0"),
        (ROS.replace("500.5", "many"), "camera.yaml", "pinhole", "camera_matrix is ['many', 0,"),
        (ROS.replace("plumb_bob", "odd"), "camera.yaml", "pinhole", "distortion_model is 'odd', expected one of"),
        (ROS.replace("0, 0, 0]", "0, 0, 0, 1.5]"), "camera.yaml", "pinhole", "expected at most the 5 coefficients"),
        (EUROC.replace("0.5,", "0.5, 3,"), "camera.yaml", "pinhole", "t_bs is "),
        (EUROC.replace("1.0, 0.5", "2.0, 0.5"), "camera.yaml", "pinhole", "expected a rigid transformation"),
        (ORB.replace("517.3", "nan"), "camera.yaml", "pinhole", "fx is 'nan', expected a finite number"),
        ("rate_hz: 20\n", "camera.yaml", "pinhole", "camera.yaml: no calibration of a camera, expected camera_matrix"),
        ("- 1\n", "camera.yaml", "pinhole", "camera.yaml:1: holds list, expected a mapping"),
        (EUROC, "7", "pinhole", "got 7, expected the path of a camera's calibration"),
        (EUROC, "none.yaml", "pinhole", "none.yaml: No such file or directory, expected a readable file"),
        (EUROC, "camera.yaml", "segments", "got a lens with distortion, expected one without: segments has none"),
        (EUROC, "camera.yaml", "range_bearing_3d", "calibration: got an unknown key"),
    ],
)  # fmt: skip
def test_a_bad_calibration_is_refused_in_one_line(tmp_path: Path, text: str, key: str, kind: str, what: str) -> None:
    path = written(tmp_path, f"calibration: {key}", text, kind)
    with pytest.raises(ConfigError) as refused:
        load_config(path)
    line = str(refused.value)
    assert line.startswith(f"{path}:1:")
    assert what in line
    assert "\n" not in line


def test_a_calibration_of_a_source_project_is_read(tmp_path: Path) -> None:

    root = os.environ.get("KALMARK_DATA")
    path = Path(root or "") / "visual/openekf_s3/config.yml"
    if not root or not path.is_file():
        pytest.skip("KALMARK_DATA does not have it")
    found = calibration(path)
    assert (found["lens"], found["width_px"], round(found["fx_px"], 3)) == ("tsai", 640, 525.06)
