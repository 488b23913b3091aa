"""How a map of one camera begins: the first frames together choose between what is near and what is far."""

from __future__ import annotations

import numpy as np
import pytest

import kalmark as km
from kalmark.codec import Reader, Writer, kind_of
from kalmark.errors import KalmarkError
from kalmark.geometry.frames3d import from_euler_pose, to_frame_many
from kalmark.slam.sources import BufferedScans
from kalmark.vision.beginning import LEAST_RHO, Beginning, residuals

cv2 = pytest.importorskip("cv2", reason="needs OpenCV: pip install 'kalmark[opencv]'")

CAMERA = km.sensors.PinHole(fx_px=500, fy_px=500, cx_px=320, cy_px=240, width_px=640, height_px=480)
PRIOR = 0.5


def sideways(frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return poses (F, 7) of a camera that moves to the left and turns a little, and points (N, 3) before it."""
    s = np.linspace(0.0, 1.0, frames)
    poses = [np.array([-0.2 * a, 0.01 * np.sin(3 * a), 0.02 * a, *np.radians([0.5 * a, 2.0 * a, -a])]) for a in s]
    depth = 1.0 / rng.uniform(0.2, 0.8, 50)
    points = np.column_stack([rng.uniform(-0.5, 0.5, 50), rng.uniform(-0.4, 0.4, 50), np.ones(50)]) * depth[:, None]
    return np.array([from_euler_pose(pose)[0] for pose in poses]), points


def tried(
    poses: np.ndarray, points: np.ndarray, estimated: np.ndarray, rng: np.random.Generator
) -> BufferedScans | None:
    """Return how a map begins whose filter has `estimated` (F, 7), of pixels with a noise of a fifth."""
    beginning = Beginning()
    for k, (T, wrong) in enumerate(zip(poses, estimated, strict=True)):
        e = CAMERA.expect(to_frame_many(T, points)[0])[0]
        y = e + rng.normal(0.0, 0.2, e.shape)
        ids = list(range(len(points)))
        beginning.add(km.Scan(k / 30, "camera", "eye", y, ids), [], dict(zip(ids, y, strict=True)), wrong)
        begun = beginning.tried(CAMERA, PRIOR)
        if begun is not None:
            return begun
    return None


def test_the_jacobian_of_the_first_frames_agrees_with_differences() -> None:
    rng = np.random.default_rng(0)
    rays = np.column_stack([rng.uniform(-0.4, 0.4, (7, 2)), np.ones(7)])
    y = rng.uniform(0, 400, (3, 7, 2))
    seen = rng.random((3, 7)) < 0.8
    x = np.concatenate([rng.normal(0, 0.2, 18), rng.uniform(0.1, 1.0, 7)])
    _, J = residuals(CAMERA, rays, y, seen, x)
    h = 1e-6
    for i in range(len(x)):
        step = h * (np.arange(len(x)) == i)
        high, low = (residuals(CAMERA, rays, y, seen, x + sign * step)[0] for sign in (1, -1))
        assert np.allclose(J[:, i], (high - low) / (2 * h), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_near_and_far_are_right_although_the_filter_moves_the_other_way(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses, points = sideways(40, rng)
    reversed_poses = poses.copy()
    reversed_poses[:, :3] *= -1.0
    begun = tried(poses, points, reversed_poses, rng)
    assert begun is not None
    true = 1.0 / np.linalg.norm(points, axis=1)
    found = np.array([begun.rho[k] for k in range(len(points))])
    assert np.corrcoef(true, found)[0, 1] > 0.95
    assert np.isclose(np.median(found), PRIOR)
    assert found.min() >= LEAST_RHO * PRIOR


def test_a_camera_that_only_turns_says_nothing_of_depths() -> None:
    rng = np.random.default_rng(1)
    poses, points = sideways(40, rng)
    poses[:, :3] = 0.0
    assert tried(poses, points, poses, rng) is None


def test_what_is_saved_of_first_frames_goes_on_as_it_was() -> None:
    rng = np.random.default_rng(2)
    poses, points = sideways(6, rng)
    one = Beginning()
    for k, T in enumerate(poses):
        y = CAMERA.expect(to_frame_many(T, points)[0])[0]
        one.add(km.Scan(k / 30, "camera", "eye", y, [str(i) for i in range(50)]), ["a"] * (k == 3), {"4": y[4]}, T)
    writer = Writer({})
    says = kind_of(Beginning).write(writer, one)
    again = kind_of(Beginning).read(Reader(writer.numbers(), {}), says, None)
    assert [(scan.t_ns, scan.ids, gone) for scan, gone in again.scans] == [(s.t_ns, s.ids, g) for s, g in one.scans]
    np.testing.assert_array_equal(again.poses, one.poses)
    assert [fitted["4"].tolist() for fitted in again.matched] == [fitted["4"].tolist() for fitted in one.matched]


def test_anything_but_a_frame_ends_the_beginning() -> None:
    detector = km.vision.ActiveSearch(in_view=20)
    mount = km.Mount(CAMERA, at=(0, 0, 0, 0, 0, 0, 1), landmark=km.landmarks.Homogeneous(0.5, 0.5), detector=detector)
    slam = km.Slam(km.Robot("camera", km.motion.ConstantVelocity3D(), sensors={"eye": mount}))
    front_end = slam.state.sources["camera", "eye"]
    for refused in (
        lambda: slam.process(km.Control(t_s=0.0, robot="camera", u=np.zeros(5))),
        lambda: slam.add_landmark("a", (1.0, 2.0)),
        lambda: slam.remove("a"),
    ):
        with pytest.raises(KalmarkError):
            refused()
    assert front_end.beginning is not None, "what is refused changes nothing"  # type: ignore[attr-defined]
    slam.process(km.Control(t_s=0.0, robot="camera", u=np.zeros(6)))
    assert front_end.beginning is None  # type: ignore[attr-defined]
