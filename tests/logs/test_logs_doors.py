"""Graphs of g2o, poses of TUM and KITTI, logs of CARMEN: read, written, and one line for what is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import write_log
from differences import derivative
from kalmark.datasets.g2o import increment_of_edge
from kalmark.errors import LogError
from kalmark.events import Control, Fix, Scan
from kalmark.geometry import frames3d, rotations
from kalmark.logs import open_log
from kalmark.logs.log import poses_of_size
from kalmark.logs.poses import read_path, tum_text, write_path
from kalmark.logs.source import Request, raise_refusal

REQUEST = Request(None, raise_refusal, [])


def random_poses(seed: int = 0, n: int = 5) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    q = random.normal(size=(n, 4))
    poses = np.column_stack([random.normal(size=(n, 3)), q / np.linalg.norm(q, axis=1)[:, None]])
    return np.cumsum(random.integers(1, 10**9, n)), poses


def close(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether poses are the same, up to the signs of their quaternions."""
    signs = np.sign(np.sum(a[:, 3:] * b[:, 3:], axis=1))[:, None]
    return bool(np.allclose(a, np.column_stack([b[:, :3], signs * b[:, 3:]]), atol=1e-8))


# ------------------------------------------------------------------ TUM, KITTI
@pytest.mark.parametrize("name", ["a.tum", "a.kitti"])
def test_poses_come_back(name: str, tmp_path: Path) -> None:
    t_ns, poses = random_poses()
    write_path(tmp_path / name, t_ns, poses)
    back = read_path(tmp_path / name, REQUEST)
    assert back.t_ns.tolist() == t_ns.tolist() and close(back.poses, poses)


def test_another_library_reads_the_poses(tmp_path: Path) -> None:
    evo = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")
    t_ns, poses = random_poses(1)
    for name, reader in (("a.tum", evo.read_tum_trajectory_file), ("a.kitti", evo.read_kitti_poses_file)):
        write_path(tmp_path / name, t_ns, poses)
        found = reader(str(tmp_path / name))
        np.testing.assert_allclose(found.positions_xyz, poses[:, :3], atol=1e-8)
        turned = np.roll(found.orientations_quat_wxyz, -1, axis=1)
        assert close(np.column_stack([found.positions_xyz, turned]), poses)


def test_poses_of_the_plane_are_at_height_0() -> None:
    np.testing.assert_allclose(poses_of_size(np.array([[1, 2, np.pi]]), 7), [[1, 2, 0, 0, 0, 1, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "t_ns"),
    [
        ("a.tum", "timestamp tx ty tz qx qy qz qw\n1.5 1 2 3 0 0 0.7071 0.7071\n", 1_500_000_000),
        ("a.csv", "time,x,y,z,q_w,q_x,q_y,q_z\n1.5, 1, 2, 3, 0.7071, 0, 0, 0.7071\n", 1_500_000_000),
        ("a.txt", "# t x y z qx qy qz qw\n1 nan nan nan nan nan nan nan\n1.5;1;2;3;0;0;0.7071;0.7071\n", 1_500_000_000),
        ("a.tum", "1500000000000000001 1 2 3 0 0 0.7071 0.7071\n", 1_500_000_000_000_000_001),
        ("a.tum", "1500000000000000 1 2 3 0 0 0.7071 0.7071\n", 1_500_000_000 * 10**9),
    ],
)
def test_poses_of_tum_are_read_as_programs_write_them(name: str, text: str, t_ns: int, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    skipped: list[str] = []
    path = read_path(tmp_path / name, Request(None, raise_refusal, skipped))
    assert path.t_ns.tolist() == [t_ns]
    np.testing.assert_allclose(path.poses, [[1, 2, 3, 0, 0, 0.5**0.5, 0.5**0.5]], atol=1e-12)
    assert skipped == ([f"{tmp_path / name}: 1 positions of NaN, which are none"] if "nan" in text else [])


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.tum", "1 0 0 0 0 0 0 2\n", "a.tum:1: quaternion has length 2, expected 1"),
        ("a.csv", "t,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n2,0,0,0,0,0,0,1.1\n", "a.csv:3: quaternion has length 1.1"),
        ("a.tum", "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "a.tum:2: time 1 s after 1 s, expected increasing"),
        ("a.tum", "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "a.tum:2: time 1 s after 2 s"),
        ("a.tum", "1 0 0 0 0 0 0 1\n2 0 0 nan 0 0 0 1\n", "a.tum:2: z_m is 'nan'"),
        ("a.tum", "1 0 0\n", "no file of poses, expected poses as TUM has them"),
        ("a.kitti", "1 0 0 0 0 1 0 0 0 0 1 0\n", "KITTI's poses have no times, expected them in a_times.txt"),
        ("times.txt", "", "no file of poses"),
    ],
)
def test_poses_that_cannot_be_get_one_line(name: str, text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(LogError, match=said):
        read_path(tmp_path / name, REQUEST)


@pytest.mark.parametrize(
    ("times", "poses", "said"),
    [
        ("0\n1\n", "1 0 0 0 0 1 0 0 0 0 1 0\n", "1 poses and 2 times, expected as many"),
        ("0\n", "2 0 0 0 0 1 0 0 0 0 1 0\n", "a.kitti:1: the first three columns are no rotation"),
        ("0\n", "1 0 0 0 0 1 0 0 0 0 -1 0\n", "a.kitti:1: the first three columns are no rotation"),
        ("x\n", "1 0 0 0 0 1 0 0 0 0 1 0\n", "times.txt:1: 'x', expected a time in s"),
        ("0\n0\n", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "a.kitti:2: its time is not after the one before"),
    ],
)
def test_times_and_rotations_of_kitti_are_checked(times: str, poses: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "times.txt").write_text(times)
    (tmp_path / "a.kitti").write_text(poses)
    with pytest.raises(LogError, match=said):
        read_path(tmp_path / "a.kitti", REQUEST)


def test_a_file_of_poses_is_truth_or_fixes_of_another_log(tmp_path: Path) -> None:
    write_log(tmp_path / "log")
    (tmp_path / "log" / "truth.csv").unlink(missing_ok=True)
    t_ns = np.array([event.t_ns for event in open_log(tmp_path / "log")][:3])
    t_ns = np.unique(t_ns)
    write_path(tmp_path / "path.tum", t_ns, np.tile([1.0, 2, 3, 0, 0, 0, 1], (len(t_ns), 1)))
    log = open_log(tmp_path / "log", truth=tmp_path / "path.tum", fixes=tmp_path / "path.tum", sigma_fixes_m=0.5)
    fixes = [event for event in log if isinstance(event, Fix)]
    assert [fix.t_ns for fix in fixes] == t_ns.tolist()
    assert fixes[0].y.tolist() == [1, 2] and fixes[0].cov.tolist() == [[0.25, 0], [0, 0.25]]
    assert log.truth["rover"].poses[0].tolist() == [1, 2, 3, 0, 0, 0, 1]
    for options, said in (
        ({"fixes": tmp_path / "path.tum"}, "expected both: a file of positions and their noise"),
        ({"truth": {"other": tmp_path / "path.tum"}}, "expected a file, or one for each of the robots rover"),
        ({"truth": tmp_path / "none.tum"}, "not found"),
        ({"fixes": tmp_path / "path.tum", "sigma_fixes_m": -1.0}, "sigma_fixes_m is -1.0, expected"),
        ({"sigma_fixes_z_m": 1.0}, "expected both: a file of positions and their noise"),
    ):
        with pytest.raises(LogError, match=said):
            open_log(tmp_path / "log", **options)


def test_heights_of_fixes_may_have_a_noise_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "controls.csv").write_text("t_s,robot,dx_m,dy_m,dz_m,rx_rad,ry_rad,rz_rad\n1,r,0,0,0,0,0,0\n")
    write_path(tmp_path / "path.tum", np.array([10**9]), np.array([[1.0, 2, 3, 0, 0, 0, 1]]))
    log = open_log(tmp_path, "native", fixes=tmp_path / "path.tum", sigma_fixes_m=0.5, sigma_fixes_z_m=2.0)
    assert log.events[-1].cov.tolist() == np.diag([0.25, 0.25, 4.0]).tolist()


# ------------------------------------------------------------------ g2o
PLANE = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 3 1 0 0.5
VERTEX_SE2 7 2 0.5 1
VERTEX_XY 9 3 3
FIX 0
EDGE_SE2 0 3 1 0 0.5 100 0 0 400 0 10000
EDGE_SE2 3 7 1 0 0.5 100 0 0 400 0 10000
EDGE_SE2 0 7 2 0.5 1 1 0 0 1 0 1
EDGE_SE2_XY 0 9 3 3 25 0 100
EDGE_SE2_XY 3 9 2 2 25 0 100
EDGE_SE2_XY 3 9 2 2 25 0 100
EDGE_OTHER 1 2 3
"""


def test_a_graph_of_the_plane_is_a_chain_of_increments_and_observations(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(PLANE)
    log = open_log(path, vertices="truth")
    controls = [event for event in log if isinstance(event, Control)]
    assert [c.t_ns for c in controls] == [10**9, 2 * 10**9] and controls[0].u.tolist() == [1, 0, 0.5]
    c, s = np.cos(0.5), np.sin(0.5)
    R = np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(controls[0].cov[:2, :2], R @ np.diag([0.01, 0.0025]) @ R.T, atol=1e-15)
    scans = [event for event in log if isinstance(event, Scan)]
    seen, loops = ([scan for scan in scans if scan.sensor == sensor] for sensor in ("sensor", "loops"))
    assert [(scan.t_ns, scan.ids) for scan in seen] == [(0, (9,)), (10**9, (9,))]
    np.testing.assert_allclose(seen[0].cov, [[[0.04, 0], [0, 0.01]]], atol=1e-15)
    assert [(scan.t_ns, scan.ids) for scan in loops] == [(0, ()), (10**9, ()), (2 * 10**9, (0,))]
    np.testing.assert_allclose(loops[2].y, [[2, 0.5, 1]], atol=1e-15)
    np.testing.assert_allclose(loops[2].cov, [np.eye(3)], atol=1e-15)
    assert log.truth["robot"].poses[-1].tolist() == [2, 0.5, 1] and log.landmarks[9].tolist() == [3, 3]
    assert [line.split(": ", 1)[1] for line in log.skipped] == [
        "1 EDGE_OTHER lines, which are not read",
        "1 observations of a landmark that pose 3 has already",
    ]
    assert open_log(path).truth == {}


def test_the_errors_of_an_edge_are_those_of_g2o() -> None:
    """Its error is (Z^-1 X), the vector part of its quaternion: here of X = Z with a small error behind it."""
    random = np.random.default_rng(4)
    q = random.normal(size=4)
    Z = np.append(random.normal(size=3), q / np.linalg.norm(q))

    def increment(e: np.ndarray) -> np.ndarray:
        turn = np.append(e[3:], np.sqrt(1 - e[3:] @ e[3:]))
        X = frames3d.compose(Z, np.append(e[:3], turn))[0]
        return np.append(X[:3], rotations.log(X[3:]))

    J = derivative(increment, np.zeros(6))
    u, C = increment_of_edge(Z, np.eye(6))
    np.testing.assert_allclose(u, increment(np.zeros(6)), atol=1e-12)
    np.testing.assert_allclose(C, J @ J.T, atol=1e-6)


EYE = " ".join("1" if i == j else "0" for i in range(6) for j in range(i, 6))
SPACE = f"""PARAMS_SE3OFFSET 0 0.1 0 0 0 0 0 1
VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
EDGE_SE3:QUAT 0 1 1 0 0 0 0 0.1 0.99498743710662 {EYE}
EDGE_SE3_TRACKXYZ 1 5 0 1 2 3 4 0 0 4 0 4
"""


def test_a_graph_of_space_has_a_mount_and_positions(tmp_path: Path) -> None:
    (tmp_path / "a.g2o").write_text(SPACE)
    log = open_log(tmp_path / "a.g2o")
    moved, seen = log.events
    np.testing.assert_allclose(moved.u, [1, 0, 0, 0, 0, 2 * np.arcsin(0.1)], atol=1e-12)
    assert seen.y.tolist() == [[1, 2, 3]] and seen.cov[0].tolist() == (0.25 * np.eye(3)).tolist()
    assert log.describes["robots"]["robot"]["sensors"]["sensor"]["mount"]["x_m"] == 0.1


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("EDGE_SE2 7 8 1 0 0.5 100 0 0 400 0", "a.g2o:13: EDGE_SE2: 5 numbers of information, expected 6"),
        ("EDGE_SE2 7 8 1 0 0.5 -1 0 0 400 0 1", "a.g2o:13: EDGE_SE2: Matrix is not positive definite"),
        ("EDGE_SE2 7 8 1 0 nan 1 0 0 400 0 1", "a.g2o:13: EDGE_SE2: nan"),
        ("EDGE_SE2", "a.g2o:13: EDGE_SE2: "),
        ("VERTEX_SE2 a 1 2 3", "a.g2o:13: VERTEX_SE2: id 'a' of a pose, expected a whole number"),
        ("PARAMS_SE3OFFSET 0 1", "a.g2o:13: PARAMS_SE3OFFSET: 1 numbers of a pose, expected 7"),
        ("VERTEX_SE2 8 1 2 3", "no edge from pose 7 to pose 8"),
        ("VERTEX_SE3:QUAT 8 1 2 3 0 0 0 2", "quaternion has length 2, expected 1"),
        ("EDGE_SE2 7 7 1 0 0.5 1 0 0 1 0 1", "a.g2o:13: EDGE_SE2: an edge from pose 7 to itself"),
        (f"EDGE_SE2 7 {'9' * 5000} 1 0 0 1 0 0 1 0 1", "expected at most 200"),
    ],
)
def test_a_bad_line_of_a_graph_is_named(line: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.g2o").write_text(f"{PLANE}{line}\n")
    with pytest.raises(LogError, match=said) as error:
        open_log(tmp_path / "a.g2o")
    assert "\n" not in str(error.value) and len(str(error.value)) < 700


def test_a_graph_of_toro_has_its_information_in_another_order(tmp_path: Path) -> None:
    """As xx, xy, yy, tt, xt, yt."""
    lines = "VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0 10 1 20 30 2 3\n"
    (tmp_path / "a.graph").write_text(lines)
    log = open_log(tmp_path / "a.graph", vertices="truth")
    np.testing.assert_allclose(np.linalg.inv(log.events[0].cov), [[10, 1, 2], [1, 20, 3], [2, 3, 30]], atol=1e-9)
    assert log.truth["robot"].poses.tolist() == [[0, 0, 0], [1, 0, 0]]


def test_a_graph_with_bearings_has_a_sensor_of_bearings(tmp_path: Path) -> None:
    lines = "EDGE_BEARING_SE2_XY 0 7 0.5 100\nEDGE_SE2_XY 0 7 1 2 4 0 4\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
    (tmp_path / "a.g2o").write_text(lines)
    log = open_log(tmp_path / "a.g2o")
    seen = {event.sensor: event for event in log if isinstance(event, Scan)}
    assert seen["bearings"].y.tolist() == [[0.5]] and seen["bearings"].ids == (7,)
    assert seen["bearings"].cov.tolist() == [[[0.01]]] and seen["sensor"].y.tolist() == [[1, 2]]
    assert log.describes["robots"]["robot"]["sensors"]["bearings"]["type"] == "bearing"


# ------------------------------------------------------------------ CARMEN
LASER = "FLASER 3 1.0 2.0 81.9 0.3 0 0 0.2 0 0 10.5 host 0.5\n"
CARMEN = f"""# a comment
PARAM robot_frontlaser_offset 0.3
ODOM 0 0 0 0.1 0 0 10.0 host 0.0
{LASER}ODOM 0.4 0 1.5707963267948966 0.1 0 0 11.0 host 1.0
SYNC tag 1 host 1
ROBOTLASER1 0 -0.5 1.0 0.5 80 0.01 0 3 1 2 90 0 0 0 0 0.4 0.2 1.5707963267948966 0 0 0 0 0 12.0 host 2.0
"""


def test_a_log_of_carmen_has_increments_and_beams(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text(CARMEN)
    log = open_log(tmp_path / "a.log")
    controls = [event for event in log if isinstance(event, Control)]
    np.testing.assert_allclose([c.u for c in controls], [[0.2, 0, 0], [0.2, 0, np.pi / 2], [0.2, 0, 0]], atol=1e-12)
    assert [c.t_ns for c in controls] == [10_500_000_000, 11 * 10**9, 12 * 10**9]
    first, second = (event for event in log if isinstance(event, Scan))
    np.testing.assert_allclose(first.y, [[1, -np.pi / 2], [2, 0]], atol=1e-12)
    np.testing.assert_allclose(second.y, [[1, -0.5], [2, 0]], atol=1e-12)
    assert log.describes["robots"]["robot"]["sensors"]["front_laser"]["mount"] == {"x_m": 0.3}
    assert [line.split(": ", 1)[1] for line in log.skipped] == ["1 SYNC messages, which are not read"]


def test_messages_of_carmen_without_times_are_a_second_apart(tmp_path: Path) -> None:
    lines = "ODOM 0 0 0 0.1 0 0\nFLASER 2 1 2 0 0 0 1 0 0\nODOM 3 0 0 0.1 0 0\n"
    (tmp_path / "a.log").write_text(lines)
    log = open_log(tmp_path / "a.log")
    assert [(type(e).__name__, e.t_ns // 10**9) for e in log] == [("Control", 2), ("Scan", 2), ("Control", 3)]
    (tmp_path / "a.log").write_text(lines + "ODOM 4 0 0 0.1 0 0 17.0 host 1\n")
    with pytest.raises(LogError, match=r"a\.log:4: ODOM: a message with a time, expected all or none to have one"):
        open_log(tmp_path / "a.log")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("FLASER 5 1.0 2.0", "a.log:9: FLASER: .* cells and 5 ranges"),
        ("FLASER x 1.0 2.0", "a.log:9: FLASER: invalid literal"),
        ("ODOM 0 0", "a.log:9: ODOM: too few cells"),
        ("ODOM 0 0 0 0.1 0 0", "a.log:9: ODOM: a message without a time"),
        ("ODOM 0 0 inf 0.1 0 0 14.0 host 0.0", "a.log:9: ODOM: inf"),
        ("FLASER 2 -1.0 1.0 0.3 0 0 0.2 0 0 13 host 0.5", "range -1.0, expected ranges of at least 0"),
        (LASER.strip(), "a second scan at this time"),
        ("ROBOTLASER1 0 -0.5 1.0 0.5 80 0.01 0 9 1 2", "a.log:9: ROBOTLASER1: too few cells"),
        (f"FLASER {'9' * 5000} 1", "a.log:9: FLASER"),
    ],
)
def test_a_bad_message_of_carmen_is_named(line: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text(f"{CARMEN}\n{line}\n")
    with pytest.raises(LogError, match=said) as error:
        open_log(tmp_path / "a.log")
    assert "\n" not in str(error.value) and len(str(error.value)) < 700
    assert len(open_log(tmp_path / "a.log", on_error="skip").events) == 5


def test_what_is_no_log_of_these_formats_is_not_taken_for_one(tmp_path: Path) -> None:
    files: dict[str, Any] = {"a.log": "nothing\n", "a.txt": "1 2 3\n", "a.g2o": "", "a.tum": "x\n"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(LogError, match=r"no known log format|is empty"):
            open_log(tmp_path / name)
    assert tum_text(np.array([1]), np.zeros((1, 3))).startswith("# t_s x_m")
