"""The logs of space on the real data: their counts, and residuals that only right frames and signs can give."""

from __future__ import annotations

import gzip
import json
import shutil
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from scipy.spatial.transform import Rotation

from kalmark.errors import LogError
from kalmark.events import Control
from kalmark.logs import Log, open_log, write_native
from kalmark.models.cameras import OMNI, lens_parameters, project, project_pinhole
from space_logs import Data, controls, in_sensor, opened, pose_of, scans


def stereo(p: np.ndarray, s: dict[str, Any]) -> np.ndarray:
    """Return ul, vl, ur, vr (K, 4) of points (K, 3) in the camera's frame."""
    x, y, z = p.T
    u, v = s["fx_px"] * x / z + s["cx_px"], s["fy_px"] * y / z + s["cy_px"]
    return np.column_stack([u, v, u - s["fx_px"] * s["baseline_m"] / z, v])


def held_rates(start: np.ndarray, controls: list[Control]) -> np.ndarray:
    """Return the positions (N, 3) that rates (v, w) in the robot's frame lead to, each held until the next."""
    turn, place, path = Rotation.from_quat(start[3:]), start[:3], [start[:3]]
    for control, after in pairwise(controls):
        dt = after.t_s - control.t_s
        place = place + turn.apply(control.u[:3] * dt)
        turn = turn * Rotation.from_rotvec(control.u[3:] * dt)
        path.append(place)
    return np.array(path)


def test_starry_night_has_its_counts(data: Data) -> None:
    log = opened(data("starry_night"))
    assert (log.format, log.robots, len(controls(log)), len(scans(log))) == ("starry_night", ("robot",), 1900, 1900)
    assert sum(len(scan.y) for scan in scans(log)) == 9410
    assert sum(len(scan.y) == 0 for scan in scans(log)) == 212
    assert set(log.landmarks) == set(range(1, 21)) and len(log.truth["robot"]) == 1900
    assert log.skipped == []
    assert np.linalg.norm(np.diff(log.truth["robot"].poses[:, :3], axis=0), axis=1).sum() == pytest.approx(
        44.3, abs=0.1
    )


def test_starry_night_reprojects_as_its_variances_say(data: Data) -> None:
    log = opened(data("starry_night"))
    sensor = log.describes["robots"]["robot"]["sensors"]["stereo"]
    errors = []
    for scan in (scan for scan in scans(log) if len(scan.y)):
        points = np.array([log.landmarks[i] for i in scan.ids])
        pose = log.truth["robot"].at(scan.t_ns)
        errors.append(scan.y - stereo(in_sensor(points, pose, sensor["mount"]), sensor))
    error = np.concatenate(errors)
    np.testing.assert_allclose(error.mean(axis=0), (1.07, 0.36, 1.16, 0.31), atol=0.006)
    np.testing.assert_allclose(error.std(axis=0), (6.16, 11.39, 6.48, 11.51), atol=0.006)
    np.testing.assert_allclose(
        [sensor[f"sigma_{n}_px"] for n in ("ul", "vl", "ur", "vr")], error.std(axis=0), rtol=1e-3
    )


def test_starry_night_s_rates_lead_along_the_truth(data: Data) -> None:
    log = opened(data("starry_night"))
    truth = log.truth["robot"]
    away = np.linalg.norm(held_rates(truth.poses[0], controls(log)) - truth.poses[:, :3], axis=1)
    assert away[truth.t_ns < 10_000_000_000].max() < 0.05
    assert np.median(away[abs(truth.t_ns * 1e-9 - 10) < 1]) == pytest.approx(0.012, abs=0.002)
    assert away[-1] == pytest.approx(3.93, abs=0.01)


def test_starry_night_s_noise_of_the_rates_is_that_of_a_held_rate(data: Data) -> None:
    log = opened(data("starry_night"))
    truth, motion = log.truth["robot"], log.describes["robots"]["robot"]["motion"]
    turns, dt = Rotation.from_quat(truth.poses[:, 3:]), np.diff(truth.t_ns)[:, None] * 1e-9
    w = (turns[:-1].inv() * turns[1:]).as_rotvec() / dt
    v = turns[:-1].inv().apply(np.diff(truth.poses[:, :3], axis=0)) / dt
    rates = np.array([control.u for control in controls(log)])[:-1]
    spread = np.sqrt(np.mean((rates - np.hstack([v, w])) ** 2, axis=0))
    given = [motion[n] for n in motion if n.startswith("sigma")]
    assert list(motion)[1:] == [f"sigma_{name}" for name in log.control_columns["robot"]]
    np.testing.assert_allclose(given, spread, rtol=0.02)


def test_starry_night_with_an_array_of_another_size_is_refused(data: Data, tmp_path: Path) -> None:
    content = scipy.io.loadmat(data("starry_night/vincentive_dataset3.mat"))
    kept = {name: value for name, value in content.items() if not name.startswith("__")}
    scipy.io.savemat(tmp_path / "short.mat", kept | {"y_k_j": kept["y_k_j"][:, :-1]})
    with pytest.raises(LogError, match=r"short\.mat: y_k_j has shape \(4, 1899, 20\), expected \(4, 1900, 20\)"):
        open_log(tmp_path / "short.mat")


def test_a_log_describes_only_the_robots_that_were_asked_for(data: Data) -> None:
    assert list(open_log(data("starry_night"), robots="robot", to_s=1).describes["robots"]) == ["robot"]


RECORDINGS = {  # frames, position RMSE m, mean NEES and its median: those of the toolbox itself
    "a_idpPnt_odo": (150, 0.0365, 6.5, 6.5),
    "a_idpPnt_odo_small": (150, 0.0405, 7.8, 7.5),
    "a3_hmgPnt_odo": (60, 0.0217, 25.7, 23.1),
    "b2_idpPnt_constVel_small": (100, 0.0950, 5.3, 4.4),
    "c_idpLin_small": (50, 0.0113, 7.6, 5.4),
    "c_plkLin_small": (50, 0.0117, 7.6, 5.4),
    "c_hmgLin_small": (50, 0.0117, 7.9, 5.4),
    "e_omni_ahmPnt": (60, 0.0371, 7.6, 7.1),
    "g_outliers_small": (80, 0.0411, 6.7, 6.5),
}


def recording(oracle: Data, name: str) -> Log:
    return opened(oracle(f"{name}.json.gz"))


def pixels(p: np.ndarray, s: dict[str, Any]) -> np.ndarray:
    """Return the pixels (K, 2) of points (K, 3) in the frame of a camera that a log describes."""
    if s["type"] == "omnidirectional":
        k = np.array([s["cx_px"], s["cy_px"], s["c"], s["d"], s["e"]])
        return project(OMNI, p, lens_parameters("omnidirectional", k, s["projection"], ()))[0]
    k = np.array([s["fx_px"], s["fy_px"], s["cx_px"], s["cy_px"]])
    return project_pinhole(p, k, np.array(s.get("distortion", [])))[0]


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_has_the_toolbox_s_own_figures(name: str, oracle: Data) -> None:
    frames, rmse, nees, median = RECORDINGS[name]
    log = recording(oracle, name)
    assert (log.name, log.format, log.robots) == (name, "slamtb", ("robot1",))
    assert [scan.t_ns for scan in scans(log, "camera1")] == [k * 100_000_000 for k in range(1, frames + 1)]
    assert len(controls(log)) == frames + (
        log.describes["robots"]["robot1"]["motion"]["type"] == "constant_velocity_3d"
    )
    figures = log.reference["slamtb"]
    assert figures["ate_raw_m"] == pytest.approx(rmse, abs=5e-5)
    assert (figures["pose_nees"], figures["pose_nees_median"]) == pytest.approx((nees, median), abs=0.051)
    assert len(log.truth["robot1"]) == frames + 1 and log.skipped == []


@pytest.mark.parametrize("name", [name for name in RECORDINGS if "outliers" not in name and "Lin" not in name])
def test_a_recording_s_points_are_seen_where_the_truth_puts_them(name: str, oracle: Data) -> None:
    log = recording(oracle, name)
    sensor = log.describes["robots"]["robot1"]["sensors"]["camera1"]
    errors = []
    for scan in scans(log):
        points = np.array([log.landmarks[i] for i in scan.ids])
        errors.append(scan.y - pixels(in_sensor(points, log.truth["robot1"].at(scan.t_ns), sensor["mount"]), sensor))
    error = np.concatenate(errors)
    assert abs(error.mean(axis=0)).max() < 0.1
    np.testing.assert_allclose(error.std(axis=0), sensor["sigma_px"], rtol=0.06)


@pytest.mark.parametrize("name", [name for name in RECORDINGS if "Lin" in name])
def test_a_recording_s_segments_lie_on_the_true_lines(name: str, oracle: Data) -> None:
    log = recording(oracle, name)
    sensor = log.describes["robots"]["robot1"]["sensors"]["camera1"]
    errors = []
    for scan in scans(log):
        pose = log.truth["robot1"].at(scan.t_ns)
        for id_, y in zip(scan.ids, scan.y, strict=True):
            a, b = in_sensor(log.landmarks[id_].reshape(2, 3), pose, sensor["mount"])
            k = np.array([[sensor["fx_px"], 0, sensor["cx_px"]], [0, sensor["fy_px"], sensor["cy_px"]], [0, 0, 1]])
            line = np.cross(k @ a, k @ b)
            errors += [(line @ [*end, 1]) / np.linalg.norm(line[:2]) for end in (y[:2], y[2:])]
    assert abs(np.mean(errors)) < 0.1
    assert np.std(errors) == pytest.approx(sensor["sigma_px"], rel=0.06)
    assert all(len(ends) == 6 for ends in log.landmarks.values())


def test_a_recording_s_controls_lead_along_the_truth(oracle: Data) -> None:
    log = recording(oracle, "a_idpPnt_odo")
    path, motion = log.truth["robot1"].poses, log.describes["robots"]["robot1"]["motion"]
    turns = Rotation.from_quat(path[:, 3:])
    moved = turns[:-1].inv().apply(np.diff(path[:, :3], axis=0))
    turned = (turns[:-1].inv() * turns[1:]).as_rotvec()
    error = np.array([control.u for control in controls(log)]) - np.hstack([moved, turned])
    given = [motion[f"sigma_{axis}_m"] for axis in "xyz"] + 3 * [motion["sigma_rotation_rad"]]
    np.testing.assert_allclose(error.std(axis=0), given, rtol=0.25)
    assert abs(error.mean(axis=0) / given).max() < 0.3


def test_a_constant_velocity_starts_at_0_with_a_control_that_does_nothing(oracle: Data) -> None:
    log = recording(oracle, "b2_idpPnt_constVel_small")
    first, start = controls(log)[0], log.describes["robots"]["robot1"]["start"]
    assert first.t_ns == 0 and not first.u.any() and not first.cov.any()
    assert start["vx_mps"] == 0.8 and start["wz_radps"] == pytest.approx(np.radians(9))
    after = log.truth["robot1"].at(100_000_000)
    np.testing.assert_allclose(after[:3], [0.08, -5, 0], atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(after[3:]).as_rotvec(), [0, 0, np.radians(0.9)], atol=1e-12)


def test_a_recording_follows_the_toolbox_s_landmarks_gate_and_attention(oracle: Data) -> None:
    rig = recording(oracle, "a_idpPnt_odo").describes
    camera = rig["robots"]["robot1"]["sensors"]["camera1"]
    assert rig["landmarks"] == {"type": "inverse_depth", "prior_rho_per_m": 0.01, "sigma_rho_per_m": 0.5}
    assert rig["association"]["gate"] == pytest.approx(0.98889, abs=1e-5) and rig["map"] == {"reparametrize": 0.1}
    assert camera["distortion"] == [-0.3, 0.1] and camera["mount"]["roll_deg"] == -90 == camera["mount"]["yaw_deg"]
    attention = camera["attention"]
    assert (attention["updates"], attention["first_starts"], attention["starts"]) == (10, 5, 1)
    assert attention["margin_px"] == 25.6 and attention["delete"]
    lines = recording(oracle, "c_plkLin_small").describes["landmarks"]
    assert [lines[f"{name}_beta_{i}"] for name in ("prior", "sigma") for i in (1, 2)] == [0.1, 0, 0.25, 1]
    kinds = {name: recording(oracle, name).describes["landmarks"]["type"] for name in RECORDINGS}
    assert kinds["a3_hmgPnt_odo"] == "homogeneous" and kinds["e_omni_ahmPnt"] == "anchored_homogeneous"
    assert [kinds[f"c_{k}Lin_small"] for k in ("idp", "plk", "hmg")] == [
        "inverse_depth_line", "pluecker_line", "homogeneous_line"
    ]  # fmt: skip


def test_a_recording_that_is_cut_or_lacks_something_is_refused(oracle: Data, tmp_path: Path) -> None:
    whole = oracle("c_plkLin_small.json.gz").read_bytes()
    cut = tmp_path / "cut.json.gz"
    cut.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(LogError, match=r"cut\.json\.gz: cannot be unpacked .*, expected a complete file"):
        open_log(cut)
    cut.write_bytes(gzip.compress(b'{"cfg":{"Robot":[],"Sensor":[]},"frames":[]}'))
    with pytest.raises(LogError, match=r"cut\.json\.gz: no 'Opt' in it"):
        open_log(cut)
    with pytest.raises(LogError, match="no known log format"):
        open_log(oracle("functions.json.gz"))


def test_a_recording_without_its_numbers_has_no_truth(oracle: Data, tmp_path: Path) -> None:
    shutil.copy(oracle("c_plkLin_small.json.gz"), tmp_path)
    log = open_log(tmp_path / "c_plkLin_small.json.gz")
    assert log.truth == {} and log.reference == {} and len(scans(log)) == 50


def frame_to_frame(log: Log) -> np.ndarray:
    """Return how far (u, v) of the left image is off (K, 2) when a point moves from one frame to the next."""
    sensor = log.describes["robots"]["car"]["sensors"]["stereo"]
    (turn, place), errors = pose_of(sensor["mount"]), []
    for control, before, after in zip(controls(log), scans(log), scans(log)[1:], strict=False):
        shared = sorted(set(before.ids) & set(after.ids))
        a = before.y[[before.ids.index(i) for i in shared]]
        b = after.y[[after.ids.index(i) for i in shared]]
        z = sensor["fx_px"] * sensor["baseline_m"] / (a[:, 0] - a[:, 2])
        x, y = (a[:, 0] - sensor["cx_px"]) * z / sensor["fx_px"], (a[:, 1] - sensor["cy_px"]) * z / sensor["fy_px"]
        points, dt = turn.apply(np.column_stack([x, y, z])) + place, after.t_s - before.t_s
        moved = Rotation.from_rotvec(control.u[3:] * dt).inv().apply(points - control.u[:3] * dt)
        errors.append(b[:, :2] - stereo(turn.inv().apply(moved - place), sensor)[:, :2])
    return np.concatenate(errors)


def test_kitti_has_its_counts_and_leaves_out_points_behind_infinity(data: Data) -> None:
    log = opened(data("kitti_stereo_features"))
    assert (log.format, log.robots, log.truth) == ("kitti_stereo_features", ("car",), {})
    assert len(controls(log)) == len(scans(log)) == 800
    assert sum(len(scan.y) for scan in scans(log)) == 58418 - 107
    assert log.skipped == [f"{log.path}: 107 observations with a disparity below 1 px"]
    assert min((scan.y[:, 0] - scan.y[:, 2]).min() for scan in scans(log)) >= 1
    all_of_it = opened(data("kitti_stereo_features/0022.npz"), min_disparity_px=-100)
    assert sum(len(scan.y) for scan in scans(all_of_it)) == 58418 and all_of_it.skipped == []
    assert np.median(np.concatenate([abs(s.y[:, 1] - s.y[:, 3]) for s in scans(log)])) == pytest.approx(0.26, abs=0.01)
    path = sum(np.linalg.norm(c.u[:3]) * (d.t_s - c.t_s) for c, d in pairwise(controls(log)))
    assert path == pytest.approx(511, abs=2)


def test_kitti_s_features_move_as_its_rates_say(data: Data) -> None:
    mean = np.median(abs(frame_to_frame(opened(data("kitti_stereo_features")))), axis=0)
    held = np.median(abs(frame_to_frame(opened(data("kitti_stereo_features"), rates="held"))), axis=0)
    np.testing.assert_allclose(mean, (2.37, 2.28), atol=0.02)
    assert (mean < 0.75 * held).all()


def test_kitti_s_camera_is_ahead_of_and_above_the_inertial_unit(data: Data) -> None:
    mount = opened(data("kitti_stereo_features")).describes["robots"]["car"]["sensors"]["stereo"]["mount"]
    assert [round(mount[f"{axis}_m"], 3) for axis in "xyz"] == [1.083, -0.310, 0.730]
    assert [mount[f"{angle}_deg"] for angle in ("roll", "pitch", "yaw")] == pytest.approx([-90, 0, -90], abs=1)


REAL = ["starry_night", "kitti_stereo_features", "tagslam_test/test_13", "tagslam_test/test_22"]


@pytest.mark.parametrize("name", [*REAL, "b2_idpPnt_constVel_small.json.gz", "c_hmgLin_small.json.gz"])
def test_a_log_of_space_is_the_same_when_converted(name: str, data: Data, oracle: Data, tmp_path: Path) -> None:
    log = opened((oracle if name.endswith(".gz") else data)(name))
    again = open_log(write_native(log, tmp_path))
    assert again.describes == log.describes == json.loads(json.dumps(log.describes))
    assert (again.control_columns, again.sensor_columns) == (log.control_columns, log.sensor_columns)
    assert len(again) == len(log) and [event.t_ns for event in again] == [event.t_ns for event in log]
    for a, b in zip(scans(log), scans(again), strict=True):
        assert (a.sensor, a.ids or ()) == (b.sensor, b.ids or ()) and np.array_equal(a.y, b.y)
    for c, d in zip(controls(log), controls(again), strict=True):
        assert np.array_equal(c.u, d.u) and (c.cov is d.cov is None or np.array_equal(c.cov, d.cov))
    assert all(np.array_equal(log.landmarks[i], again.landmarks[i]) for i in log.landmarks)
    assert all(np.array_equal(path.poses, again.truth[robot].poses) for robot, path in log.truth.items())
