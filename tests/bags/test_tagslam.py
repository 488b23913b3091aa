"""TagSLAM's tests as logs: the counts they are known for, and tags that reproject where its own batch puts them."""

from __future__ import annotations

import bz2
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kalmark.errors import LogError
from kalmark.logs import Log, open_log
from space_logs import Data, controls, in_sensor, opened, pose_of, scans

pytest.importorskip("rosbags", reason="rosbags is not installed: no bag can be read")

TESTS = {  # cameras, detections, tags, poses in the reference
    1: (1, 772, 4, 228),
    2: (2, 5712, 13, 461),
    3: (2, 5712, 13, 461),
    8: (4, 2217, 31, 158),
    13: (1, 12846, 96, 680),
    15: (2, 2469, 18, 2),
    21: (4, 3079, 23, 430),
    22: (1, 105, 2, 112),
}


def test_of(data: Data, number: int, **options: object) -> Log:
    return opened(data(f"tagslam_test/test_{number}"), **options)


test_of.__test__ = False  # type: ignore[attr-defined]


def rig(log: Log) -> dict[str, Any]:
    return log.describes["robots"]["rig"]


def project(p: np.ndarray, s: dict[str, Any]) -> np.ndarray:
    """Return the pixels (K, 2) of points (K, 3) through one of the two lenses, written down from their definition."""
    x, y, z = p.T
    d = [*s["distortion"], 0.0]
    if s["lens"] == "equidistant":
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        a, b = np.array([x, y]) / r * theta * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(d)))
    else:
        u, v = x / z, y / z
        r2 = u * u + v * v
        radial = 1 + d[0] * r2 + d[1] * r2**2 + d[4] * r2**3
        a = u * radial + 2 * d[2] * u * v + d[3] * (r2 + 2 * u * u)
        b = v * radial + d[2] * (r2 + 2 * v * v) + 2 * d[3] * u * v
    return np.column_stack([s["fx_px"] * a + s["cx_px"], s["fy_px"] * b + s["cy_px"]])


def corner_errors(log: Log, camera: str) -> np.ndarray:
    """Return the errors (K, 8) px of the corners one camera saw when the reference has a pose for it."""
    sensor, path, errors = rig(log)["sensors"][camera], log.truth["rig"], []
    for scan in scans(log, camera):
        pose = path.at(scan.t_ns)
        for tag, y in zip(scan.ids, scan.y, strict=True):
            if np.isnan(pose).any() or tag not in log.landmarks:
                continue
            T, s = log.landmarks[tag], y[8] / 2
            corners = Rotation.from_quat(T[3:]).apply([(-s, -s, 0), (s, -s, 0), (s, s, 0), (-s, s, 0)]) + T[:3]
            seen = project(in_sensor(corners, pose, sensor["mount"]), sensor)
            errors.append((y[:8].reshape(4, 2) - seen).ravel())
    return np.array(errors)


@pytest.mark.parametrize("number", TESTS)
def test_a_test_has_its_counts(number: int, data: Data) -> None:
    cameras, detections, tags, poses = TESTS[number]
    log = test_of(data, number)
    assert (log.format, log.robots) == ("tagslam", ("rig",))
    assert list(rig(log)["sensors"]) == [f"cam{i}" for i in range(cameras)]
    left_out = sum(int(line.split(": ")[1].split()[0]) for line in log.skipped)
    assert sum(len(scan.y) for scan in scans(log)) == detections - {13: 39, 22: 4}.get(number, left_out)
    assert len({tag for scan in scans(log) for tag in scan.ids}) == tags == len(log.landmarks)
    assert len(log.truth["rig"]) == poses


@pytest.mark.parametrize(
    ("number", "camera", "median"),
    [(1, 0, 0.23), (2, 0, 0.20), (2, 1, 0.30), (3, 1, 0.32), (8, 0, 0.24), (8, 2, 0.46), (8, 3, 0.30), (13, 0, 0.17),
     (15, 1, 0.14), (21, 0, 0.11), (21, 1, 0.11), (21, 2, 0.29), (21, 3, 0.27), (22, 0, 0.18)],
)  # fmt: skip
def test_tags_reproject_where_the_reference_puts_them(number: int, camera: int, median: float, data: Data) -> None:
    errors = abs(corner_errors(test_of(data, number), f"cam{camera}"))
    assert np.median(errors) < median
    assert len(errors) > 10 and np.sqrt(np.mean(errors**2)) < 1


@pytest.mark.parametrize("number", [1, 2, 3, 8, 13, 21, 22])
def test_the_rig_starts_where_the_reference_has_it(number: int, data: Data) -> None:
    log = test_of(data, number)
    start, pose = rig(log)["start"], log.truth["rig"].at(log.events[0].t_ns)
    np.testing.assert_allclose([start[f"{axis}_m"] for axis in "xyz"], pose[:3], atol=1e-12)
    assert len(scans(log)[0].y) > 0 or log.format == "tagslam"


@pytest.mark.parametrize(("number", "metres", "radians"), [(21, 0.13, 0.06), (22, 0.6, 0.15)])
def test_odometry_leads_along_the_reference(number: int, metres: float, radians: float, data: Data) -> None:
    log = test_of(data, number)
    path, moves, start = log.truth["rig"], controls(log), rig(log)["start"]
    (turn, place), away = pose_of(start), []
    for control in (control for control in moves if control.t_ns <= path.t_ns[-1]):
        place, turn = place + turn.apply(control.u[:3]), turn * Rotation.from_rotvec(control.u[3:])
        pose = path.at(control.t_ns, max_gap_s=2.0)
        away.append((np.linalg.norm(place - pose[:3]), (Rotation.from_quat(pose[3:]).inv() * turn).magnitude()))
    assert np.max(away, axis=0)[0] < metres and np.max(away, axis=0)[1] < radians
    assert len(moves) == len({scan.t_ns for scan in scans(log)}) - 1
    assert all(control.cov[0, 0] > 0 for control in moves)
    assert not controls(test_of(data, number, odometry="none"))


def test_a_camera_without_a_pose_calibrates_itself_or_is_left_out(data: Data) -> None:
    mount = rig(test_of(data, 2))["sensors"]["cam1"]["mount"]
    assert (mount["sigma_position_m"], mount["sigma_rotation_deg"]) == (0.05, 3.0)
    assert "sigma_position_m" not in rig(test_of(data, 3))["sensors"]["cam1"]["mount"]
    alone = test_of(data, 2, cameras="given")
    assert list(rig(alone)["sensors"]) == ["cam0"] and {scan.sensor for scan in scans(alone)} == {"cam0"}
    assert any("cam1, whose pose on the rig is not given" in line for line in alone.skipped)


def test_sizes_are_those_of_each_tag_and_can_be_given_where_they_are_not(data: Data) -> None:
    def sizes(log: Log) -> dict[int, float]:
        return {tag: y[8] for scan in scans(log) for tag, y in zip(scan.ids, scan.y, strict=True)}

    assert sizes(test_of(data, 15)) == {0: 0.104, 1: 0.104} | dict.fromkeys(range(2, 10), 0.05) | {
        tag: sizes(test_of(data, 15))[tag] for tag in range(10, 18)
    }
    known = sizes(test_of(data, 21))
    assert known[2] == 0.16 == known[22] and known[100] == 0.1
    other = sizes(test_of(data, 21, tag_size_m=0.2))
    assert other[2] == 0.16 and other[22] == 0.2 and other[100] == 0.1


def test_detections_that_are_squashed_are_left_out(data: Data) -> None:
    log = test_of(data, 13)
    assert log.skipped == [f"{log.path}/tag_detections.bag.bz2: 39 detections that tagslam.yaml squashes"]
    at = {scan.t_ns: scan.ids for scan in scans(log)}
    assert 85 not in at[1527206556891942748] and 8 not in at[1527206601617928627]


def test_a_static_rig_before_a_moving_block_is_a_rig_that_moves_about_the_block(data: Data) -> None:
    log = test_of(data, 15)
    assert len(log.truth["rig"]) == 2 and "x_m" not in rig(log)["start"]
    assert np.linalg.norm(log.landmarks[0][:3]) < 1e-3, "tag 0 is the origin of the block"
    assert 1 < np.linalg.norm(log.truth["rig"].poses[0, :3]) < 3


def test_a_link_to_another_test_s_bag_is_followed(data: Data, tmp_path: Path) -> None:
    two, three = test_of(data, 2), test_of(data, 3)
    assert len(two.events) == len(three.events) and np.array_equal(scans(two)[5].y, scans(three)[5].y)
    shutil.copytree(data("tagslam_test/test_3"), tmp_path / "test_3")
    with pytest.raises(LogError, match=r"test_3: no tag_detections\.bag"):
        open_log(tmp_path / "test_3")


def test_damaged_files_are_refused_in_one_line(data: Data, tmp_path: Path) -> None:
    folder = tmp_path / "test_22"
    shutil.copytree(data("tagslam_test/test_22"), folder)
    bag, whole = folder / "tag_detections.bag.bz2", data("tagslam_test/test_22/tag_detections.bag.bz2").read_bytes()
    bag.chmod(0o644)
    bag.write_bytes(whole[:2000])
    with pytest.raises(LogError, match=r"tag_detections\.bag\.bz2: cannot be unpacked"):
        open_log(folder)
    bag.write_bytes(bz2.compress(bz2.decompress(whole)[:9000]))
    with pytest.raises(LogError, match=r"tag_detections\.bag\.bz2: .*, expected a whole"):
        open_log(folder)
    bag.write_bytes(whole)
    cameras = folder / "cameras.yaml"
    cameras.chmod(0o644)
    cameras.write_text(cameras.read_text().replace("equidistant", "odd"))
    with pytest.raises(LogError, match=r"cameras\.yaml: cam0: distortion_model is 'odd', expected one of"):
        open_log(folder)
    cameras.write_text("cam0: [1, 2\nx: 3\n")
    with pytest.raises(LogError, match=r"cameras\.yaml:\d: not YAML"):
        open_log(folder)
