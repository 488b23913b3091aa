"""The logs of space on the real data: their counts, and residuals that only right frames and signs can give."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from scipy.spatial.transform import Rotation

from kalmark.errors import LogError
from kalmark.logs import Log, open_log
from kalmark.slam.events import Control, Scan

Data = Callable[[str], Path]


@cache
def opened(path: Path, **options: object) -> Log:
    """Open a log once for all tests here, which only read it."""
    return open_log(path, **options)


def controls(log: Log) -> list[Control]:
    return [event for event in log if isinstance(event, Control)]


def scans(log: Log, sensor: str | None = None) -> list[Scan]:
    return [event for event in log if isinstance(event, Scan) and sensor in (None, event.sensor)]


def pose_of(section: dict[str, Any]) -> tuple[Rotation, np.ndarray]:
    """Return rotation and position of a mount or start as configurations give them."""
    angles = [section[name] for name in ("yaw_deg", "pitch_deg", "roll_deg")]
    return Rotation.from_euler("ZYX", angles, degrees=True), np.array([section[n] for n in ("x_m", "y_m", "z_m")])


def in_sensor(points: np.ndarray, pose: np.ndarray, mount: dict[str, Any]) -> np.ndarray:
    """Return world points (K, 3) in the frame of a sensor mounted on a robot at this pose (7,)."""
    turn, place = pose_of(mount)
    return turn.inv().apply(Rotation.from_quat(pose[3:]).inv().apply(points - pose[:3]) - place)


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
