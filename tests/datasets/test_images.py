"""Logs of images: folders, videos, EuRoC, TUM RGB-D, KITTI's odometry, bags, native logs; damaged images."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import kalmark as km
from kalmark.bags.mcap_writer import Outgoing, header_fields
from kalmark.datasets.images.tum import published_calibration
from kalmark.errors import ConfigError, EventError, LogError
from kalmark.events import Control, Frame
from kalmark.logs import Log, write_native
from ros_bags import KINDS, write_bag

SIZE = 48, 64
T0 = 1_403_715_285_262_142_976


def picture(k: int, depth: bool = False) -> np.ndarray:
    rng = np.random.default_rng(k)
    return rng.integers(1000, 20000, SIZE).astype(np.uint16) if depth else rng.integers(0, 256, SIZE).astype(np.uint8)


def put(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def frames(log: Log) -> list[Frame]:
    return [event for event in log if isinstance(event, Frame)]


def refused(path: Path, **options: Any) -> str:
    with pytest.raises(LogError) as error:
        km.open_log(path, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


def camera(log: Log, sensor: str = "camera") -> dict[str, Any]:
    """Return the section of a camera without how its landmarks are found."""
    section = log.describes["robots"]["robot"]["sensors"][sensor]
    return {key: value for key, value in section.items() if key not in ("detector", "landmark")}


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


# ------------------------------------------------------------------ folders
@pytest.mark.parametrize(
    ("names", "t_ns"),
    [
        (["1305031102.175304.png", "1305031102.211214.png"], [1305031102175304000, 1305031102211214000]),
        (["1403715285262142976.jpg", "1403715285312143104.jpg"], [T0, T0 + 50000128]),
        (["0.5.pgm", "10.25.pgm"], [500_000_000, 10_250_000_000]),
        (["1305031102175304.bmp", "1305031102211214.bmp"], [1305031102175304000, 1305031102211214000]),
    ],
)
def test_the_names_of_images_are_their_times(tmp_path: Path, names: list[str], t_ns: list[int]) -> None:
    for k, name in enumerate(names):
        put(tmp_path / name, picture(k))
    log = km.open_log(tmp_path)
    assert (log.format, [f.t_ns for f in frames(log)]) == ("images", t_ns)
    assert (log.describes["estimator"], log.describes["map"]) == ({"type": "ekf"}, {"type": "dense"})  # as `visual`
    assert camera(log) == {"type": "pinhole", "width_px": 64, "height_px": 48}
    if not names[0].endswith(".jpg"):
        assert (frames(log)[1].pixels() == picture(1)).all()


def test_images_without_times_need_a_file_of_times_or_a_rate(tmp_path: Path) -> None:
    for k in (2, 10, 9):
        put(tmp_path / f"image{k}.png", picture(k))
    assert "the name 'image2.png' is no time, expected times" in refused(tmp_path)
    log = km.open_log(tmp_path, fps=20)
    assert [f.t_ns for f in log] == [0, 50_000_000, 100_000_000]
    assert (frames(log)[1].pixels() == picture(9)).all()  # in the order of their numbers
    (tmp_path / "times.txt").write_text("# s\n1.5\n1.75\n2\n", encoding="utf-8")
    assert [f.t_ns for f in km.open_log(tmp_path)] == [1_500_000_000, 1_750_000_000, 2_000_000_000]
    (tmp_path / "times.txt").write_text("1.5\n1.5\n2\n", encoding="utf-8")
    assert "times.txt:2: time 1.5 s after 1.5 s, expected increasing times" in refused(tmp_path)
    (tmp_path / "times.txt").write_text("1.5\n", encoding="utf-8")
    assert "times.txt: 1 times for 3 images" in refused(tmp_path)


def test_colour_becomes_grey_and_a_calibration_and_true_poses_beside_the_images_are_taken(tmp_path: Path) -> None:
    colour = np.random.default_rng(0).integers(0, 256, (*SIZE, 3)).astype(np.uint8)
    for k in range(2):
        put(tmp_path / "images" / f"{k + 1}.0.png", colour)
    (tmp_path / "calibration.yaml").write_text(
        "image_width: 128\nimage_height: 96\ncamera_matrix: {data: [100, 0, 63.5, 0, 102, 47.5, 0, 0, 1]}\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: {data: [-0.2, 0.1, 0, 0, 0]}\n",
        encoding="utf-8",
    )
    (tmp_path / "cam_traj_truth.txt").write_text(
        "0 0 0 1 0 0 0 1 0 0 0 1\n100 0 20 0 0 1 0 1 0 -1 0 0\n", encoding="utf-8"
    )
    log = km.open_log(tmp_path)
    assert np.abs(frames(log)[0].pixels().astype(int) - cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)).max() <= 1
    found = camera(log)
    assert (found["fx_px"], found["cx_px"], found["fy_px"], found["cy_px"]) == (50.0, 31.5, 51.0, 23.5)  # half the size
    assert (found["width_px"], found["lens"], found["distortion"][:2]) == (64, "radtan", [-0.2, 0.1])
    assert log.truth["robot"].poses[1] == pytest.approx([1.0, 0.0, 0.2, 0, -np.sqrt(0.5), 0, np.sqrt(0.5)])


# ------------------------------------------------------------------ videos
def video(path: Path, count: int, fps: float = 25.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), fps, (320, 240))
    for k in range(count):
        writer.write(np.full((240, 320, 3), 10 * k, np.uint8))
    writer.release()
    return path


def test_a_video_gives_its_images_in_any_order_and_in_another_process(tmp_path: Path) -> None:
    log = km.open_log(video(tmp_path / "a.avi", 12))
    assert (log.format, len(log), log.events[3].t_ns) == ("video", 12, 120_000_000)
    assert km.open_log(tmp_path / "a.avi", fps=10).events[3].t_ns == 300_000_000
    for k in (0, 1, 5, 2, 11, 11, 3):
        assert frames(log)[k].pixels().mean() == pytest.approx(10 * k, abs=2)
    again = pickle.loads(pickle.dumps(frames(log)[4].image))
    assert again().mean() == pytest.approx(40, abs=2)


def test_a_file_that_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video at all")
    assert "a.mp4: cannot be decoded, expected a video" in refused(tmp_path / "a.mp4")


# ------------------------------------------------------------------ damaged images
def test_missing_and_truncated_images_are_counted_in_one_line_and_left_out(tmp_path: Path) -> None:
    for k in range(6):
        put(tmp_path / "rgb" / f"{k}.png", picture(k))
    lines = [f"{k}.0 rgb/{k}.png" for k in range(7)]
    (tmp_path / "rgb.txt").write_text("\n".join(lines), encoding="utf-8")
    cut(tmp_path / "rgb" / "2.png")
    (tmp_path / "rgb" / "4.png").write_bytes(b"")
    log = km.open_log(tmp_path)
    assert [f.t_ns // 10**9 for f in log] == [0, 1, 3, 5]
    assert [str(line) for line in log.skipped] == [
        f"{tmp_path / 'rgb' / '2.png'}: of 7 images 2 cut short and 1 missing, this one first"
    ]
    for k in (0, 1, 3, 5):
        (tmp_path / "rgb" / f"{k}.png").unlink()
    assert "no image of 7 can be used" in refused(tmp_path)


def test_a_run_goes_on_without_an_image_that_cannot_be_decoded() -> None:
    def broken() -> np.ndarray:
        raise OSError("damaged inside")

    sensor = km.sensors.TagCorners(width_px=64, height_px=48)
    mount = km.Mount(sensor, detector=km.detect.Tags(size_m=0.1))
    robot = km.Robot("robot", motion=km.motion.ConstantVelocity3D(), sensors={"camera": mount})
    events = [Frame(t_s=t, robot="robot", sensor="camera", image=broken if t == 1 else picture(0)) for t in range(3)]
    run = km.record(km.Slam([robot]), events, progress=False)
    assert run.skipped == ["frame at t=1 s: damaged inside"]
    assert len(run.history.t_ns) == 2
    with pytest.raises(EventError, match="damaged inside"):
        km.Slam([robot]).process(events[1])


# ------------------------------------------------------------------ the layouts of benchmarks
def test_tum_rgbd_has_each_depth_at_the_nearest_image(tmp_path: Path) -> None:
    folder = tmp_path / "rgbd_dataset_freiburg1_xyz"
    for k, t in enumerate(("10.00", "10.03", "10.06")):
        put(folder / "rgb" / f"{t}.png", picture(k))
    for k, t in enumerate(("10.005", "10.04", "10.15")):
        put(folder / "depth" / f"{t}.png", picture(k, depth=True))
    (folder / "rgb.txt").write_text("# t file\n" + "".join(f"{t} rgb/{t}.png\n" for t in ("10.00", "10.03", "10.06")))
    (folder / "depth.txt").write_text("".join(f"{t} depth/{t}.png\n" for t in ("10.005", "10.04", "10.15")))
    (folder / "groundtruth.txt").write_text("10.0 1 2 3 0 0 0 1\n10.1 1.1 2 3 0 0 0 1\n")
    log = km.open_log(folder)
    depths = [f.depths() for f in frames(log)]
    assert depths[2] is None
    assert np.allclose(depths[0], picture(0, depth=True) / 5000)
    assert np.allclose(depths[1], picture(1, depth=True) / 5000)
    assert np.allclose(frames(km.open_log(folder, depth_scale=1000))[0].depths(), picture(0, depth=True) / 1000)
    assert camera(km.open_log(folder))["type"] == "pixel_depth"
    assert all(f.depth is None for f in frames(km.open_log(folder, depth="none")))
    assert camera(km.open_log(folder, depth="none"))["type"] == "pinhole"
    assert log.truth["robot"].at(10_050_000_000)[0] == pytest.approx(1.05)
    assert camera(log)["fx_px"] == pytest.approx(517.306 / 10)
    assert camera(log)["cx_px"] == pytest.approx((318.643 + 0.5) / 10 - 0.5)
    assert published_calibration("something_else") == {}
    assert published_calibration("fr3_office")["fx_px"] == 535.4


def test_kitti_odometry_has_the_left_camera_and_its_poses(tmp_path: Path) -> None:
    folder = tmp_path / "sequences" / "07"
    for k in range(3):
        put(folder / "image_0" / f"{k:06}.png", picture(k))
    (folder / "times.txt").write_text("0.0\n1.036224e-01\n2.072e-01\n")
    (folder / "calib.txt").write_text("P0: 700 0 30 0 0 700 20 0 0 0 1 0\nP1: 700 0 30 -380 0 700 20 0 0 0 1 0\n")
    poses = [f"1 0 0 {k} 0 1 0 0 0 0 1 {2 * k}\n" for k in range(3)]
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "07.txt").write_text("".join(poses))
    log = km.open_log(folder)
    assert (log.format, [f.t_ns for f in log]) == ("kitti_odometry", [0, 103_622_400, 207_200_000])
    assert camera(log) == {"type": "pinhole", "fx_px": 700.0, "fy_px": 700.0, "cx_px": 30.0, "cy_px": 20.0,
                           "width_px": 64, "height_px": 48}  # fmt: skip
    assert log.truth["robot"].poses[2] == pytest.approx([2, 0, 4, 0, 0, 0, 1])
    for k in (0, 2):  # the second of the right images is missing
        put(folder / "image_1" / f"{k:06}.png", picture(k + 5))
    pair = km.open_log(folder)
    assert (camera(pair)["type"], camera(pair)["baseline_m"]) == ("stereo", pytest.approx(380 / 700))
    rights = [f.right_grey() for f in frames(pair)]
    assert rights[1] is None
    assert np.array_equal(rights[2], picture(7))
    assert camera(km.open_log(folder, right="none"))["type"] == "pinhole"
    (folder / "calib.txt").write_text("P0: 700 0 30 0 0 700 20 0 0 0 1 0\nP1: 700 0 30 380 0 700 20 0 0 0 1 0\n")
    assert "camera 1 is -0.542857 m to the right of 0, expected more than 0" in refused(folder)
    (folder / "calib.txt").write_text("P1: 700 0 30\n")
    assert "calib.txt: no row P0:" in refused(folder)


def euroc(folder: Path, truth: bool) -> Path:
    sensor = "T_BS: {data: [0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1]}\nintrinsics: [45, 46, 32, 24]\n"
    sensor += "resolution: [64, 48]\ncamera_model: pinhole\ndistortion_model: radial-tangential\n"
    t_ns = [T0 + k * 50_000_000 for k in range(3)]
    for k, t in enumerate(t_ns):
        put(folder / "mav0" / "cam0" / "data" / f"{t}.png", picture(k))
    (folder / "mav0" / "cam0" / "sensor.yaml").write_text(sensor + "distortion_coefficients: [-0.2, 0.1, 0, 0]\n")
    rows = "".join(f"{t},{t}.png\r\n" for t in t_ns)
    (folder / "mav0" / "cam0" / "data.csv").write_text("#timestamp [ns],filename\r\n" + rows)
    readings = "".join(f"{T0 - 12_000_000 + k * 5_000_000},0,0,{k}e-3,0,0,9.81\n" for k in range(40))
    (folder / "mav0" / "imu0").mkdir()
    (folder / "mav0" / "imu0" / "data.csv").write_text("#t\n" + readings)
    if truth:
        states = "".join(f"{T0 - 10**7 + k * 10**8},{k},2,3,1,0,0,0,{k},0,0,.1,.2,.3,.4,.5,.6\n" for k in range(3))
        place = folder / "mav0" / "state_groundtruth_estimate0"
        place.mkdir()
        (place / "data.csv").write_text("#timestamp\n" + states)
    return folder


def test_euroc_has_the_unit_as_robot_and_starts_in_the_true_state(tmp_path: Path) -> None:
    log = km.open_log(euroc(tmp_path / "V1", truth=True))
    controls = [event for event in log if isinstance(event, Control)]
    assert (log.format, log.name, len(frames(log))) == ("euroc", "V1", 3)
    assert log.events[0].t_ns == T0 == controls[0].t_ns  # the reading before is held from the first image on
    assert controls[0].u[2] == 2e-3  # read 2 ms before, of the interval from 4.5 ms before to .5 ms after
    assert controls[1].t_ns == T0 + 500_000  # read at 3 ms
    assert controls[-1].t_ns <= T0 + 100_000_000
    robot = log.describes["robots"]["robot"]
    assert (robot["motion"]["type"], robot["motion"]["accelerometer_random_walk_mps2_per_sqrt_s"]) == ("inertial", 3e-3)
    start = robot["start"]
    assert (start["x_m"], start["vx_mps"], start["bias_wz_radps"], start["bias_ax_mps2"]) == pytest.approx(
        (0.1, 0.1, 0.3, 0.4)
    )
    mount = camera(log, "cam0")["mount"]
    assert (mount["x_m"], mount["yaw_deg"]) == pytest.approx((0.1, 90.0))
    assert "imu0" not in str(km.open_log(tmp_path / "V1" / "mav0", imu="none").events[0])
    assert "estimator" not in log.describes  # the default
    assert "no camera 'cam1', expected one of cam0" in refused(tmp_path / "V1", cameras=["cam1"])


def test_euroc_without_truth_starts_at_rest_with_all_readings_before(tmp_path: Path) -> None:
    log = km.open_log(euroc(tmp_path, truth=False))
    assert log.events[0].t_ns == T0 - 14_500_000  # half an interval before the first one was read
    assert log.describes["robots"]["robot"]["start"]["at_rest"] is True
    data = tmp_path / "mav0" / "imu0" / "data.csv"
    data.write_text(data.read_text() + f"{T0},0,0,0,0,0,9\n")
    assert "imu0/data.csv:42: " in refused(tmp_path)
    assert " ns, expected increasing times" in refused(tmp_path)


# ------------------------------------------------------------------ bags
@pytest.mark.parametrize("kind", KINDS)
def test_images_of_a_bag_are_read_when_they_are_needed(tmp_path: Path, kind: str) -> None:
    colour = np.random.default_rng(1).integers(0, 256, (*SIZE, 3)).astype(np.uint8)
    messages = []
    for k in range(4):
        t = T0 + k * 10**8
        image = {"header": header_fields(t, "camera"), "height": 48, "width": 64, "encoding": "mono8",
                 "is_bigendian": 0, "step": 70, "data": np.pad(picture(k), ((0, 0), (0, 6))).ravel()}  # fmt: skip
        if k == 2:
            image |= {"encoding": "rgb8", "step": 192, "data": colour.ravel()}
        if k == 3:
            image |= {"encoding": "yuv422"}
        messages.append(Outgoing("/cam/image_raw", "sensor_msgs/msg/Image", t, image))
        packed = cv2.imencode(".png", picture(k))[1].ravel()
        small = {"header": header_fields(t, "camera"), "format": "png", "data": packed}
        messages.append(Outgoing("/right/compressed", "sensor_msgs/msg/CompressedImage", t, small))
    matrix = {"k": [60.0, 0, 32, 0, 61, 24, 0, 0, 1], "d": [0.1, 0, 0, 0, 0], "distortion_model": "plumb_bob"}
    if kind == "ros1.bag":
        matrix = {"K": matrix["k"], "D": matrix["d"], "distortion_model": "plumb_bob"}
    info = {"header": header_fields(T0, "camera"), "width": 64, "height": 48} | matrix
    bag = write_bag(tmp_path, kind, [Outgoing("/cam/camera_info", "sensor_msgs/msg/CameraInfo", T0, info), *messages])
    topics = {"/cam/image_raw": {"type": "images", "sensor": "left"}, "/right/compressed": {"type": "images"}}
    log = km.open_log(bag, topics=topics)
    left, right = ([f for f in frames(log) if f.sensor == name] for name in ("left", "right_compressed"))
    assert (len(left), len(right), left[1].t_ns) == (4, 4, T0 + 10**8)
    for k in (1, 0, 1):
        assert (left[k].pixels() == picture(k)).all()
        assert (right[k + 2].pixels() == picture(k + 2)).all()
    assert (left[2].pixels() == cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)).all()
    with pytest.raises(EventError, match="encoding 'yuv422', expected one of mono8"):
        left[3].pixels()
    assert (camera(log, "left")["fy_px"], camera(log, "left")["lens"]) == (61.0, "radtan")


# ------------------------------------------------------------------ native logs, configurations
def test_a_native_log_keeps_frames_with_their_depths(tmp_path: Path) -> None:
    depth = picture(9, depth=True) / 5000
    events = [Frame(t_ns=T0 + k, robot="r", sensor="c", image=picture(k), depth=depth if k else None) for k in range(3)]
    folder = write_native(Log("a", ("r",), events), tmp_path / "log")
    log = km.open_log(folder)
    assert (log.format, [f.t_ns for f in log]) == ("native", [T0, T0 + 1, T0 + 2])
    assert all((a.pixels() == b.pixels()).all() for a, b in zip(frames(log), events, strict=True))
    assert frames(log)[0].depth is None
    assert np.allclose(frames(log)[1].depths(), depth, atol=1e-12)
    assert [f.t_ns for f in km.stream_log(folder)] == [T0, T0 + 1, T0 + 2]
    cut(next((folder / "images" / "r_c").glob(f"{T0 + 1}_image.png")))
    log = km.open_log(folder)
    assert len(log) == 2
    assert "of 3 images 1 cut short, this one first" in log.skipped[0]


def test_a_camera_without_a_calibration_or_with_that_of_other_images_is_refused(tmp_path: Path) -> None:
    from kalmark.config import build_slam, open_run

    for k in range(2):
        put(tmp_path / f"{k + 1}.0.png", picture(k))
    with pytest.raises(ConfigError, match=r"robots.robot.sensors.camera: got images by a camera without a calibration"):
        build_slam(*open_run(tmp_path))
    key = "robots.robot.sensors.camera"
    sized = [f"{key}.{name}={value}" for name, value in (("fx_px", 50), ("fy_px", 50), ("width_px", 640))]
    with pytest.raises(ConfigError, match=r"got a calibration for 640 x 48 px, expected one for the images of 64 x 48"):
        build_slam(*open_run(tmp_path, overrides=sized))
    assert build_slam(*open_run(tmp_path, overrides=sized[:2])) is not None
