"""Alignment of paths, against evo and against constructed cases."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kalmark.results.evaluate import free_scale_figures, scale_figures, scale_is_free, scale_notes
from kalmark.results.measures import identity_alignment, rigid, rigid_robust, rmse, similarity


def rotation_2d(a: float) -> np.ndarray:
    return np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])


def test_an_exact_motion_is_recovered_in_2d_and_3d() -> None:
    rng = np.random.default_rng(1)
    for d in (2, 3):
        q, _ = np.linalg.qr(rng.normal(size=(d, d)))
        q *= np.sign(np.linalg.det(q))  # d = 3: a rotation
        if np.linalg.det(q) < 0:
            q[:, 0] *= -1
        shift = rng.normal(size=d)
        points = rng.normal(size=(30, d))
        fit = rigid(points, points @ q.T + shift)
        assert np.allclose(fit.rotation, q, atol=1e-12)
        assert np.allclose(fit.shift, shift, atol=1e-12)
        assert np.allclose(fit.inverse()(fit(points)), points, atol=1e-12)


def test_a_similarity_is_recovered_and_is_the_best_one() -> None:
    rng = np.random.default_rng(3)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    points, shift = rng.normal(size=(40, 3)), rng.normal(size=3)
    fit, scale = similarity(points, 2.5 * points @ q.T + shift)
    assert scale == pytest.approx(2.5)
    assert np.allclose(fit.rotation, q)
    assert np.allclose(fit.shift, shift)
    target = points + 0.1 * rng.normal(size=points.shape)
    fit, scale = similarity(points, target)
    best = rmse(fit(scale * points) - target)
    assert all(rmse(fit(s * points) - target) > best for s in (0.99 * scale, 1.01 * scale))
    assert similarity(np.ones((3, 3)), np.zeros((3, 3)))[1] == 1.0


def test_the_drift_of_the_scale_is_that_of_the_second_half_against_the_first() -> None:
    t = np.linspace(0, 1, 100)
    truth = np.column_stack([np.cos(9 * t), np.sin(9 * t), t])
    path = np.concatenate([truth[:50] / 2, truth[50:] / 2.2])
    figures = scale_figures(path, truth)
    assert figures["scale_drift"] == pytest.approx(0.1)
    assert 2 < figures["scale"] < 2.2


def test_a_mirror_image_is_never_aligned_by_a_reflection() -> None:
    points = np.random.default_rng(2).normal(size=(20, 2))
    fit = rigid(points, points * [1.0, -1.0])
    assert np.linalg.det(fit.rotation) == pytest.approx(1.0)


def test_no_point_gives_the_identity_and_one_point_a_shift() -> None:
    assert np.array_equal(rigid(np.empty((0, 2)), np.empty((0, 2))).rotation, identity_alignment().rotation)
    fit = rigid(np.array([[1.0, 2.0]]), np.array([[4.0, 6.0]]))
    assert np.allclose(fit.rotation, np.eye(2))
    assert np.allclose(fit.shift, [3.0, 4.0])


def test_gross_outliers_barely_move_the_robust_alignment() -> None:
    rng = np.random.default_rng(3)
    path = np.cumsum(rng.normal(size=(400, 2)), axis=0)
    fixes = path @ rotation_2d(0.6).T + [-67.0, -41.0] + 0.3 * rng.normal(size=path.shape)
    bad = rng.random(400) < 0.1
    fixes[bad] += [40.0, 25.0]
    least, robust = rigid(path, fixes), rigid_robust(path, fixes)
    truth = path @ rotation_2d(0.6).T + [-67.0, -41.0]
    assert rmse(robust(path) - truth) < 0.3
    assert rmse(least(path) - truth) > 3.0
    assert np.arctan2(robust.rotation[1, 0], robust.rotation[0, 0]) == pytest.approx(0.6, abs=0.02)


def test_alignment_and_error_agree_with_evo() -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory = pytest.importorskip("evo.core.trajectory")
    rng = np.random.default_rng(4)
    for d in (2, 3):
        truth = np.cumsum(rng.normal(size=(500, d)), axis=0)
        spin = rotation_2d(0.4) if d == 2 else np.linalg.qr(rng.normal(size=(3, 3)))[0]
        spin = spin * (np.sign(np.linalg.det(spin)) if d == 3 else 1.0)
        estimate = truth @ spin.T + 3.0 + 0.5 * rng.normal(size=truth.shape)

        def evo_path(xyz: np.ndarray) -> object:
            return trajectory.PoseTrajectory3D(
                positions_xyz=np.pad(xyz, ((0, 0), (0, 3 - xyz.shape[1]))),
                orientations_quat_wxyz=np.tile([1.0, 0, 0, 0], (len(xyz), 1)),
                timestamps=np.arange(float(len(xyz))),
            )

        reference, path = evo_path(truth), evo_path(estimate)
        raw, aligned = (metrics.APE(metrics.PoseRelation.translation_part) for _ in range(2))
        raw.process_data((reference, path))
        rotation, shift, _ = path.align(reference)  # type: ignore[attr-defined]
        aligned.process_data((reference, path))

        fit = rigid(estimate, truth)
        assert np.allclose(fit.rotation, rotation[:d, :d], atol=1e-9)
        assert np.allclose(fit.shift, shift[:d], atol=1e-9)
        assert rmse(estimate - truth) == pytest.approx(raw.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)
        assert rmse(fit(estimate) - truth) == pytest.approx(
            aligned.get_statistic(metrics.StatisticsType.rmse), abs=1e-9
        )


def test_a_path_whose_scale_nothing_tells_has_no_nees_and_diverges_by_its_shape_alone() -> None:
    rng = np.random.default_rng(4)
    truth = np.column_stack([np.cumsum(rng.normal(size=(60, 3)), axis=0), np.tile([0.0, 0.0, 0.0, 1.0], (60, 1))])
    P = np.tile(1e-4 * np.eye(6), (60, 1, 1))
    small = np.column_stack([0.3 * truth[:, :3], truth[:, 3:]])
    assert free_scale_figures(small, P, truth) == {
        "pose_nees": None, "pose_nees_most": None, "pose_nees_world": None, "diverged": False,
    }  # fmt: skip
    lost = small + np.r_[np.zeros(40), np.full(20, 15.0)][:, None] * np.r_[1.0, np.zeros(6)]
    assert free_scale_figures(lost, P, truth)["diverged"]


def test_one_camera_alone_has_a_free_scale() -> None:
    camera = SimpleNamespace(robot="r", sensor="camera", columns=("u_px", "v_px"))
    history: dict[str, Any] = {"cameras": [camera], "robots": ["r"], "fixes": (), "priors": (), "controls": {}}

    def free(sensors: Any = ("camera",), **other: Any) -> bool:
        stub: Any = SimpleNamespace(
            history=SimpleNamespace(**history | other), sections=lambda _: dict.fromkeys(sensors)
        )
        return scale_is_free(stub, "r")

    assert free()
    assert not free(sensors=("camera", "laser"))
    assert not free(controls={"r": object()})
    assert not free(fixes=(object(),))
    assert not free(cameras=[SimpleNamespace(robot="r", sensor="camera", columns=("u_px", "v_px", "depth_m"))])


def test_one_camera_on_a_velocity_that_drifts_is_said_to_be_too_sure() -> None:
    camera = SimpleNamespace(robot="r", sensor="camera", columns=("u_px", "v_px"))
    history = SimpleNamespace(cameras=[camera], robots=["r"], fixes=(), priors=(), controls={"r": object()})

    def notes(motion: str, sensors: Any = ("camera",)) -> list[str]:
        stub: Any = SimpleNamespace(
            history=history, sections=lambda _: dict.fromkeys(sensors), motion=lambda _: {"type": motion}
        )
        return [*scale_notes(stub, {"r": {}})]

    (note,) = notes("constant_velocity_3d")
    assert note.startswith("r sees no scale, and its velocity drifts")
    assert notes("odometry_3d") == notes("constant_velocity_3d", ("camera", "laser")) == []
