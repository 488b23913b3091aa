"""The batch solution of cameras and tags: it finds what made the corners, and knows how well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from kalmark.batch.batch_state import FIRST_MOUNT
from kalmark.batch.data import Associations, BatchInput, replay_events
from kalmark.batch.solver import optimum
from kalmark.errors import KalmarkError
from kalmark.geometry import frames3d, rotations
from kalmark.models import tags
from kalmark.results.batch import compare_tags, tag_problem

Array = np.ndarray[Any, np.dtype[np.float64]]

IMAGE = np.array([1280.0, 1024.0])
MOUNTS = np.array(
    [[0, 0, 0, 0, 0, 0, 1.0], [0.1, 0.01, -0.02, *rotations.exp(np.array([0.02, 0.3, -0.01]))]],
)
SIGMA = 0.4
MOTION = km.motion.Odometry3D(sigma_x_m=0.02, sigma_y_m=0.02, sigma_z_m=0.02, sigma_rotation_rad=0.02)


def cameras(sigma_px: float = 1.0) -> list[km.sensors.TagCorners]:
    fisheye = (470, 471, 640, 512, *IMAGE, "equidistant", (-0.018, -0.003, 0.007, -0.003))
    radtan = (600, 600, 640, 512, *IMAGE, "radtan", (-0.16, 0.09, -2e-4, -2e-4, 0))
    return [km.sensors.TagCorners(*[*lens, sigma_px]) for lens in (fisheye, radtan)]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(38)


@dataclass
class Seen:
    """K tags seen by cameras: whose, and their corners and sizes y (K, 9)."""

    pose: Array
    camera: Array
    tag: Array
    y: Array


@dataclass
class Tags:
    """Where everything is, what is left of the corners (K, 8), and the covariances of the tags."""

    poses: Array
    tags: Array
    mounts: Array
    residuals: Array
    covariances: Array
    iterations: int

    @property
    def errors_px(self) -> Array:
        return np.hypot(self.residuals[:, ::2], self.residuals[:, 1::2])

    @property
    def rms_px(self) -> float:
        return float(np.sqrt(np.mean(self.errors_px**2)))


def scene(rng: np.random.Generator, poses: int = 40, count: int = 8) -> tuple[Seen, Array, Array]:
    """Return perfect observations of tags about the plane z = 0, from a rig that passes them, its poses, the tags."""
    l = np.array([frames3d.plus(np.eye(7)[6], d) for d in rng.normal(size=(count, 6)) * [0.7, 0.5, 0.2, 0.3, 0.3, 1]])
    x = np.linspace(-0.7, 0.7, poses)
    r = np.stack([x, 0.4 * np.sin(4 * x), -1.5 + 0 * x, *(0 * x,) * 3, 1 + 0 * x], axis=1)
    r = np.array([frames3d.plus(a, d) for a, d in zip(r, 0.2 * rng.normal(size=(poses, 6)), strict=True)])
    size = rng.uniform(0.1, 0.3, count)
    rows = []
    for i, j, k in np.ndindex(poses, 2, count):
        y = project(cameras()[j], frames3d.compose(r[i], MOUNTS[j])[0], l[k], size[k])[0].reshape(4, 2)
        if np.isfinite(y).all() and (abs(y / IMAGE - 0.5) < 0.5).all():
            rows.append((i, j, k, [*y.ravel(), size[k]]))
    pose, camera, tag, y = (np.array([row[a] for row in rows]) for a in range(4))
    return Seen(pose, camera, tag, y), r, l


def project(camera: km.sensors.TagCorners, T: Array, l: Array, size: float) -> tuple[Array, Array, Array]:
    """Return the corners of one tag seen from T, E_T and E_l."""
    v, V_T, V_l = tags.tag_seen_from(T, l[None])
    e, E_v = tags.project_corners(camera.code, v, np.array([size]), np.array(camera.parameters))
    return e[0], E_v[0] @ V_T[0], E_v[0] @ V_l[0]


def adjust(
    seen: Seen,
    poses: Array,
    l: Array,
    mounts: Array = MOUNTS,
    *,
    hold_pose: bool = True,
    hold_tag: int | None = None,
    free_mounts: Sequence[int] = (),
    sigma_px: float = 1.0,
    huber_px: float = np.inf,
    iterations: int = 100,
) -> Tags:
    sensors = {
        f"camera {j}": km.Mount(camera, at=mounts[j], cov=1e-4 * np.eye(6) if j in free_mounts else None)
        for j, camera in enumerate(cameras(sigma_px))
    }
    scan_of = seen.pose * 2 + seen.camera
    scans, first, scan = np.unique(scan_of, return_index=True, return_inverse=True)
    names = np.array([f"camera {j}" for j in seen.camera])
    ids = seen.tag.tolist()
    index = np.arange(len(ids)) - first[scan]
    given = BatchInput(
        robots={"rig": km.Robot("rig", MOTION, sensors=sensors)},
        landmark=km.landmarks.Tag(),
        t_ns=scans // 2,
        robot=np.full(len(scans), "rig"),
        poses=poses[scans // 2],
        associations=Associations(scan, names, index, ids, seen.y),
        landmarks={k: (l[k], np.eye(6)) for k in range(len(l))},
        known={} if hold_tag is None else {hold_tag: (l[hold_tag], None)},
        motion=False,
        mounts={("rig", f"camera {j}"): mounts[j] for j in free_mounts},
        huber=2 * huber_px / sigma_px,
    )
    rows = np.split(np.arange(len(ids)), first[1:])
    problem = replay_events(
        given,
        (
            km.Scan(t_ns=t, robot="rig", sensor=names[k[0]], y=seen.y[k])
            for t, k in zip(given.t_ns.tolist(), rows, strict=True)
        ),
    )
    if not hold_pose and hold_tag is None:
        problem.free[:] = True
    found = optimum(problem, iterations=range(1, iterations + 1))
    order, moved = np.argsort(found.ids), mounts.copy()
    for j, group in zip(free_mounts, found.state.groups[FIRST_MOUNT:], strict=True):
        moved[j] = group[0]
    residuals = np.empty((len(ids), 8))
    for sensor, left in problem.left(found.state):
        residuals[names == sensor] = left
    return Tags(found.state.groups[0], found.means[order], moved, residuals, found.covariances[order], found.iterations)


def shaken(x: Array, rng: np.random.Generator, sigma: float, held: Any = ()) -> Array:
    d = sigma * rng.normal(size=(len(x), 6))
    d[held,] = 0
    return np.array([frames3d.plus(a, b) for a, b in zip(x, d, strict=True)])


def noisy(seen: Seen, rng: np.random.Generator) -> Seen:
    corners = seen.y[:, :8] + SIGMA * rng.normal(size=(len(seen.y), 8))
    return replace(seen, y=np.column_stack([corners, seen.y[:, 8]]))


def off(a: Array, b: Array) -> Array:
    return np.array([frames3d.minus(x, y) for x, y in zip(a, b, strict=True)])


def test_perfect_corners_give_path_tags_and_the_second_camera_s_mount(rng: np.random.Generator) -> None:
    seen, r, l = scene(rng)
    start = shaken(r, rng, 0.03, [0]), shaken(l, rng, 0.03), shaken(MOUNTS, rng, 0.03, [0])
    found = adjust(seen, *start, free_mounts=[1])
    for x, y in ((found.poses, r), (found.tags, l), (found.mounts, MOUNTS)):
        np.testing.assert_allclose(off(x, y), 0, atol=1e-8)
    assert found.rms_px < 1e-7 and found.iterations < 15
    np.testing.assert_array_equal(found.poses[0], r[0])


def test_the_covariances_of_the_tags_are_those_of_all_unknowns_together(rng: np.random.Generator) -> None:
    seen, r, l = scene(rng, poses=6, count=4)
    found = adjust(seen, r, l, hold_tag=2, free_mounts=[1], sigma_px=SIGMA)
    H = np.zeros((len(seen.y), 8, 12, 6))
    for k, (i, j, tag) in enumerate(zip(seen.pose, seen.camera, seen.tag, strict=True)):
        T, T_r, T_s = frames3d.compose(found.poses[i], found.mounts[j])
        _, E_T, H[k, :, 6 + tag] = project(cameras()[j], T, found.tags[tag], seen.y[k, 8])
        H[k, :, i], H[k, :, 10 + j] = E_T @ T_r, E_T @ T_s
    free = np.isin(np.arange(12), [8, 10], invert=True)
    J = H[:, :, free].reshape(8 * len(seen.y), -1)
    P = SIGMA**2 * np.linalg.inv(J.T @ J).reshape(10, 6, 10, 6)
    for tag, block in ((0, 6), (1, 7), (3, 8)):
        np.testing.assert_allclose(found.covariances[tag], P[block, :, block], rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(found.covariances[2], 0)


def test_what_is_left_and_the_tags_errors_are_as_large_as_expected(rng: np.random.Generator) -> None:
    nees, left, dof = [], 0.0, 0
    for _ in range(10):
        seen, r, l = scene(rng)
        found = adjust(noisy(seen, rng), r, shaken(l, rng, 0.01), sigma_px=SIGMA)
        errors = off(l, found.tags)
        nees += [e @ np.linalg.solve(P, e) for e, P in zip(errors, found.covariances, strict=True)]
        left += np.sum(found.residuals**2) / SIGMA**2
        dof += 8 * len(seen.y) - 6 * (len(r) - 1 + len(l))
        assert found.rms_px == pytest.approx(np.sqrt(np.mean(found.errors_px**2)))
    assert chi2.ppf(0.001, dof) < left < chi2.ppf(0.999, dof)
    assert 4 < np.mean(nees) < 8.5  # tags of one scene share the error of the pose that is held


def test_a_wrong_tag_hardly_matters_when_outliers_count_less(rng: np.random.Generator) -> None:
    seen, r, l = scene(rng)
    seen = noisy(seen, rng)
    clean = adjust(seen, r, l)
    seen.y[3, :8] += 200.0
    hurt, robust = (adjust(seen, r, l, huber_px=h) for h in (np.inf, 2.0))
    assert abs(off(robust.tags, clean.tags)).max() < 0.1 * abs(off(hurt.tags, clean.tags)).max()
    assert np.sqrt(np.mean(robust.errors_px[3] ** 2)) > 150


def test_moving_the_world_moves_the_solution_with_it(rng: np.random.Generator) -> None:
    seen, r, l = scene(rng)
    seen = noisy(seen, rng)
    g = np.array([3.0, -2, 1, *rotations.exp(np.array([0.4, -1.0, 2.0]))])
    there = [np.array([frames3d.compose(g, x)[0] for x in rows]) for rows in (r, l)]
    one, other = adjust(seen, r, l), adjust(seen, *there)
    np.testing.assert_allclose(off(np.array([frames3d.compose(g, x)[0] for x in one.tags]), other.tags), 0, atol=1e-7)


def test_what_is_not_determined_or_not_in_view_is_refused(rng: np.random.Generator) -> None:
    seen, r, l = scene(rng)
    with pytest.raises(KalmarkError, match="do not determine all poses and tags"):
        adjust(seen, r, l, hold_pose=False)
    behind = l.copy()
    behind[:, 2] -= 5
    with pytest.raises(KalmarkError, match=r"the start does not show tag \d to camera 0 at pose \d+, which saw it"):
        adjust(seen, r, behind)
    with pytest.raises(KalmarkError, match=r"the last of 1 steps is .* expected 1e-09"):
        adjust(seen, r, shaken(l, rng, 0.03), iterations=1)


def test_a_filter_of_corners_ends_near_the_optimum_of_its_own_observations(rng: np.random.Generator) -> None:
    seen, r, l = scene(rng, poses=60)
    y = noisy(seen, rng).y
    sensors = {name: km.Mount(c, at=at) for name, c, at in zip(("left", "right"), cameras(SIGMA), MOUNTS, strict=True)}
    rig = km.Robot("rig", motion=MOTION, start=r[0], sensors=sensors)
    slam = km.Slam([rig], landmarks=km.landmarks.Tag(), association=km.association.ByIdentity())
    events: list[km.Event] = []
    for i, pose in enumerate(r):
        if i:
            step = frames3d.compose(frames3d.inverse(r[i - 1])[0], pose)[0]
            u = np.concatenate([step[:3], rotations.log(step[3:])]) + 0.02 * rng.normal(size=6)
            events.append(km.Control(t_s=0.1 * i, robot="rig", u=u))
        for j, name in enumerate(sensors):
            mine = (seen.pose == i) & (seen.camera == j)
            events.append(km.Scan(t_s=0.1 * i, robot="rig", sensor=name, y=y[mine], ids=seen.tag[mine].tolist()))
    run = km.record(slam, events, progress=False, pictures=False)
    problem = tag_problem(run)
    batch = optimum(problem)
    figures = compare_tags(run, problem, batch)
    assert figures["rms_px"] < figures["filter_rms_px"] < 1.05 * figures["rms_px"]
    assert figures["map_difference_m"] < 0.003 and figures["tags"] == len(l)
    assert 0.9 < figures["sigma_ratio"] < 1.1
    np.testing.assert_allclose(off(batch.means, l[np.array(batch.ids)]), 0, atol=0.02)
