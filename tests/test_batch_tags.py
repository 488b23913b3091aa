"""The batch solution of cameras and tags: it finds what made the corners, and knows how well."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import kalmark as km
from kalmark.errors import KalmarkError
from kalmark.geometry import frames3d, rotations
from kalmark.models import lenses, tags
from kalmark.results import batch_tags
from kalmark.results.batch_tags import Sightings, Tags, adjust
from kalmark.results.batch_tags_input import adjust_run

Array = np.ndarray[Any, np.dtype[np.float64]]

LENSES = [
    (lenses.EQUIDISTANT, lenses.parameters("equidistant", (470, 471, 640, 512), (-0.018, -0.003, 0.007, -0.003))),
    (lenses.RADTAN, lenses.parameters("radtan", (600, 600, 640, 512), (-0.16, 0.09, -2e-4, -2e-4))),
]
IMAGE = np.array([1280.0, 1024.0])
MOUNTS = np.array(
    [[0, 0, 0, 0, 0, 0, 1.0], [0.1, 0.01, -0.02, *rotations.exp(np.array([0.02, 0.3, -0.01]))]],
)
SIGMA = 0.4


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(38)


def scene(rng: np.random.Generator, poses: int = 40, count: int = 8) -> tuple[Sightings, Tags]:
    """Return perfect sightings of tags about the plane z = 0, from a rig that passes them, and the truth."""
    l = np.array([frames3d.plus(np.eye(7)[6], d) for d in rng.normal(size=(count, 6)) * [0.7, 0.5, 0.2, 0.3, 0.3, 1]])
    x = np.linspace(-0.7, 0.7, poses)
    r = np.stack([x, 0.4 * np.sin(4 * x), -1.5 + 0 * x, *(0 * x,) * 3, 1 + 0 * x], axis=1)
    r = np.array([frames3d.plus(a, d) for a, d in zip(r, 0.2 * rng.normal(size=(poses, 6)), strict=True)])
    size = rng.uniform(0.1, 0.3, count)
    rows = []
    for i, j, k in np.ndindex(poses, 2, count):
        v = tags.tag_seen_from(frames3d.compose(r[i], MOUNTS[j])[0], l[k : k + 1])[0]
        y = tags.project_corners(LENSES[j][0], v, size[k : k + 1], LENSES[j][1])[0][0].reshape(4, 2)
        if np.isfinite(y).all() and (abs(y / IMAGE - 0.5) < 0.5).all():
            rows.append((i, j, k, y.ravel()))
    pose, camera, tag = (np.array([row[a] for row in rows]) for a in range(3))
    seen = Sightings(pose, camera, tag, np.array([row[3] for row in rows]), size[tag], LENSES)
    return seen, Tags(r, l, MOUNTS, np.zeros_like(seen.y), np.zeros((count, 6, 6)))


def shaken(x: Array, rng: np.random.Generator, sigma: float, held: Any = ()) -> Array:
    d = sigma * rng.normal(size=(len(x), 6))
    d[held,] = 0
    return np.array([frames3d.plus(a, b) for a, b in zip(x, d, strict=True)])


def off(a: Array, b: Array) -> Array:
    return np.array([frames3d.minus(x, y) for x, y in zip(a, b, strict=True)])


def test_perfect_corners_give_path_tags_and_the_second_camera_s_mount(rng: np.random.Generator) -> None:
    seen, truth = scene(rng)
    start = shaken(truth.poses, rng, 0.03, [0]), shaken(truth.tags, rng, 0.03), shaken(MOUNTS, rng, 0.03, [0])
    found = adjust(seen, *start, free_mounts=[1])
    for x, y in ((found.poses, truth.poses), (found.tags, truth.tags), (found.mounts, MOUNTS)):
        np.testing.assert_allclose(off(x, y), 0, atol=1e-8)
    assert found.rms_px < 1e-7 and found.iterations < 15
    np.testing.assert_array_equal(found.poses[0], truth.poses[0])


def test_the_covariances_of_the_tags_are_those_of_all_unknowns_together(rng: np.random.Generator) -> None:
    seen, truth = scene(rng, poses=6, count=4)
    found = adjust(seen, truth.poses, truth.tags, MOUNTS, hold_pose=None, hold_tag=2, free_mounts=[1], sigma_px=SIGMA)
    _, E = batch_tags.look(seen, found.poses, found.tags, found.mounts)
    H = np.zeros((len(seen.y), 8, 12, 6))
    for k, (i, j, l) in enumerate(zip(seen.pose, seen.camera, seen.tag, strict=True)):
        H[k, :, i], H[k, :, 6 + l], H[k, :, 10 + j] = E[:, k]
    free = np.isin(np.arange(12), [8, 10], invert=True)
    J = H[:, :, free].reshape(8 * len(seen.y), -1)
    P = SIGMA**2 * np.linalg.inv(J.T @ J).reshape(10, 6, 10, 6)
    for tag, block in ((0, 6), (1, 7), (3, 8)):
        np.testing.assert_allclose(found.covariances[tag], P[block, :, block], rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(found.covariances[2], 0)


def test_what_is_left_and_the_tags_errors_are_as_large_as_expected(rng: np.random.Generator) -> None:
    nees, left, dof = [], 0.0, 0
    for _ in range(10):
        seen, truth = scene(rng)
        seen = replace(seen, y=seen.y + SIGMA * rng.normal(size=seen.y.shape))
        found = adjust(seen, truth.poses, shaken(truth.tags, rng, 0.01), MOUNTS, sigma_px=SIGMA)
        errors = off(truth.tags, found.tags)
        nees += [e @ np.linalg.solve(P, e) for e, P in zip(errors, found.covariances, strict=True)]
        left += np.sum(found.residuals**2) / SIGMA**2
        dof += seen.y.size - 6 * (len(truth.poses) - 1 + len(truth.tags))
        assert found.rms_px == pytest.approx(np.sqrt(np.mean(found.errors_px**2)))
    assert chi2.ppf(0.001, dof) < left < chi2.ppf(0.999, dof)
    assert 4 < np.mean(nees) < 8.5  # tags of one scene share the error of the pose that is held


def test_a_wrong_tag_hardly_matters_when_outliers_count_less(rng: np.random.Generator) -> None:
    seen, truth = scene(rng)
    y = seen.y + SIGMA * rng.normal(size=seen.y.shape)
    clean = adjust(replace(seen, y=y), truth.poses, truth.tags, MOUNTS)
    y[3] += 200.0
    hurt, robust = (adjust(replace(seen, y=y), truth.poses, truth.tags, MOUNTS, huber_px=h) for h in (np.inf, 2.0))
    assert abs(off(robust.tags, clean.tags)).max() < 0.1 * abs(off(hurt.tags, clean.tags)).max()
    assert np.sqrt(np.mean(robust.errors_px[3] ** 2)) > 150


def test_moving_the_world_moves_the_solution_with_it(rng: np.random.Generator) -> None:
    seen, truth = scene(rng)
    seen = replace(seen, y=seen.y + SIGMA * rng.normal(size=seen.y.shape))
    g = np.array([3.0, -2, 1, *rotations.exp(np.array([0.4, -1.0, 2.0]))])
    there = [np.array([frames3d.compose(g, x)[0] for x in rows]) for rows in (truth.poses, truth.tags)]
    one, other = adjust(seen, truth.poses, truth.tags, MOUNTS), adjust(seen, *there, MOUNTS)
    np.testing.assert_allclose(off(np.array([frames3d.compose(g, x)[0] for x in one.tags]), other.tags), 0, atol=1e-7)


def test_what_is_not_determined_or_not_in_view_is_refused(rng: np.random.Generator) -> None:
    seen, truth = scene(rng)
    with pytest.raises(KalmarkError, match="do not determine all poses and tags"):
        adjust(seen, truth.poses, truth.tags, MOUNTS, hold_pose=None)
    behind = truth.tags.copy()
    behind[:, 2] -= 5
    with pytest.raises(KalmarkError, match=r"the start does not show tag \d to camera 0 at pose \d+, which saw it"):
        adjust(seen, truth.poses, behind, MOUNTS)
    with pytest.raises(KalmarkError, match=r"the last of 1 steps is .* expected 1e-09"):
        adjust(seen, truth.poses, shaken(truth.tags, rng, 0.03), MOUNTS, iterations=1)


def test_a_filter_of_corners_ends_near_the_optimum_of_its_own_sightings(rng: np.random.Generator) -> None:
    seen, truth = scene(rng, poses=60)
    y = np.hstack([seen.y + SIGMA * rng.normal(size=seen.y.shape), seen.size[:, None]])
    fisheye = km.sensors.TagCorners(
        470, 471, 640, 512, 1280, 1024, "equidistant", (-0.018, -0.003, 0.007, -0.003), SIGMA
    )
    radtan = km.sensors.TagCorners(600, 600, 640, 512, 1280, 1024, "radtan", (-0.16, 0.09, -2e-4, -2e-4, 0), SIGMA)
    sensors = {"left": km.Mount(fisheye, at=MOUNTS[0]), "right": km.Mount(radtan, at=MOUNTS[1])}
    motion = km.motion.Odometry3D(sigma_x_m=0.02, sigma_y_m=0.02, sigma_z_m=0.02, sigma_rotation_rad=0.02)
    rig = km.Robot("rig", motion=motion, start=truth.poses[0], sensors=sensors)
    slam = km.Slam([rig], landmarks=km.landmarks.Tag(), association=km.association.ByIdentity())
    events: list[km.Event] = []
    for i, pose in enumerate(truth.poses):
        if i:
            step = frames3d.compose(frames3d.inverse(truth.poses[i - 1])[0], pose)[0]
            u = np.concatenate([step[:3], rotations.log(step[3:])]) + 0.02 * rng.normal(size=6)
            events.append(km.Control(t_s=0.1 * i, robot="rig", u=u))
        for j, name in enumerate(sensors):
            mine = (seen.pose == i) & (seen.camera == j)
            events.append(km.Scan(t_s=0.1 * i, robot="rig", sensor=name, y=y[mine], ids=seen.tag[mine].tolist()))
    batch = adjust_run(km.record(slam, events, progress=False))
    figures = batch.compare()
    assert figures["rms_px"] < figures["filter_rms_px"] < 1.05 * figures["rms_px"]
    assert figures["map_difference_m"] < 0.003 and figures["tags"] == len(truth.tags)
    assert 0.9 < figures["sigma_ratio"] < 1.1
    np.testing.assert_allclose(off(batch.optimum.tags, truth.tags[np.array(batch.ids)]), 0, atol=0.02)
