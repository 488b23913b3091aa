"""How well a match is known, by what its template leaves of the image."""

from __future__ import annotations

import numpy as np
import pytest

import kalmark as km
from kalmark.vision.template_matching import shift_covariances

cv2 = pytest.importorskip("cv2", reason="needs OpenCV: pip install 'kalmark[opencv]'")

ONE = np.zeros(1, dtype=np.int64)
SIGMA = 4.0  # grey values


def picture(sharp_px: float, rng: np.random.Generator) -> np.ndarray:
    """Return a smooth random picture (41, 41)."""
    grey = cv2.GaussianBlur(rng.uniform(0, 255, (41, 41)), (0, 0), sharp_px)
    return np.asarray(128.0 + 60.0 * (grey - grey.mean()) / grey.std())


def grey(image: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def test_the_covariance_of_a_shift_is_the_scatter_of_least_squares_in_white_noise() -> None:
    rng = np.random.default_rng(0)
    clean = picture(2.0, rng)
    template = grey(clean[14:27, 14:27])
    T_v, T_u = (one[1:-1, 1:-1].ravel() for one in np.gradient(template.astype(float)))
    A = np.column_stack([template[1:-1, 1:-1].ravel(), np.ones(121), -T_u, -T_v])
    t, C = [], []
    for _ in range(400):
        image = grey(0.8 * clean + 20.0 + SIGMA * rng.standard_normal(clean.shape))
        x = np.linalg.lstsq(A, image[15:26, 15:26].ravel().astype(float), rcond=None)[0]
        t.append(x[2:] / x[0])
        C.append(shift_covariances(image, template[None], ONE, np.array([[20.0, 20.0]]))[0])
    whitened = np.linalg.eigvalsh(np.linalg.solve(np.mean(C, axis=0), np.cov(np.array(t).T)))
    assert (whitened > 0.8).all() and (whitened < 1.25).all()


def test_a_match_along_an_edge_is_known_across_it_only() -> None:
    rng = np.random.default_rng(1)
    image = grey(np.where(np.arange(41) < 20, 60.0, 190.0) + SIGMA * rng.standard_normal((41, 41)))
    template = cv2.GaussianBlur(image, (0, 0), 1.0)[None, 14:27, 14:27].copy()
    C = shift_covariances(image, template, ONE, np.array([[20.0, 20.0]]))[0]
    assert C[1, 1] > 20 * C[0, 0] > 0


def test_where_a_template_shows_nothing_nothing_is_added() -> None:
    image = np.full((41, 41), 90, dtype=np.uint8)
    flat = np.full((1, 13, 13), 90, dtype=np.uint8)
    assert not shift_covariances(image, np.zeros_like(flat), ONE, np.array([[20.0, 20.0]])).any()
    assert not shift_covariances(image, flat, ONE, np.array([[3.0, 20.0]])).any(), "beyond the border"


def noise_of_matches(slam: km.Slam, pictures: list[np.ndarray], **beside: np.ndarray) -> list[np.ndarray]:
    """Return the noise (n, m, m) of the measurements of each picture."""
    R = []
    for k, image in enumerate(pictures):
        more = {name: image if name == "right" else one for name, one in beside.items()}
        slam.process(km.Frame(0.1 * k, "camera", "eye", image, **more))
        observation = slam.state.sources["camera", "eye"].observation  # type: ignore[attr-defined]
        R.append(np.asarray(observation.scan.cov))
    return R


def with_camera(sensor: object) -> km.Slam:
    mount = km.Mount(sensor, at=(0, 0, 0, 0, 0, 0, 1), landmark=km.landmarks.Homogeneous(0.5, 0.5),
                     detector=km.vision.ActiveSearch(in_view=20))  # fmt: skip
    return km.Slam(km.Robot("camera", km.motion.ConstantVelocity3D(0.1, 0.1), sensors={"eye": mount}))


def pictures(sigmas: tuple[float, ...]) -> list[np.ndarray]:
    """Return one smooth picture (240, 320) with white noise of each sigma."""
    rng = np.random.default_rng(2)
    big = cv2.GaussianBlur(rng.uniform(0, 255, (240, 320)), (0, 0), 2.0)
    clean = 128.0 + 50.0 * (big - big.mean()) / big.std()
    return [grey(clean + sigma * rng.standard_normal(clean.shape)) for sigma in sigmas]


INTRINSICS = {"fx_px": 250, "fy_px": 250, "cx_px": 159.5, "cy_px": 119.5, "width_px": 320, "height_px": 240}


def test_matches_with_depths_have_the_noise_of_their_images_and_new_landmarks_that_of_the_sensor() -> None:
    sensor = km.sensors.PixelDepth(**INTRINSICS, sigma_px=1.0, sigma_rho_per_m=0.01)
    R = noise_of_matches(with_camera(sensor), pictures((0.0, 1.0, 8.0)), depth=np.full((240, 320), 2.0))
    variance = [np.trace(one[:, :2, :2], axis1=1, axis2=2) / 2 for one in R]
    assert np.allclose(variance[0], 1.0), "all are new"
    assert len(variance[2]) and 0.0 < 4 * (np.median(variance[1]) - 1) < np.median(variance[2]) - 1


def test_both_images_of_a_pair_err_by_the_same_shift() -> None:
    sensor = km.sensors.Stereo(**INTRINSICS, baseline_m=0.1, sigma_ul_px=1, sigma_vl_px=1, sigma_ur_px=1, sigma_vr_px=1)
    R = noise_of_matches(with_camera(sensor), pictures((0.0, 8.0)), right=np.zeros(0))[1]
    seen = R[R[:, 2, 2] < 1e4]
    more = seen - np.eye(4)
    assert len(seen) and np.median(more[:, 0, 0]) > 0.0
    assert np.allclose(more[:, :2, 2:], more[:, :2, :2]) and np.allclose(more[:, 2:, 2:], more[:, :2, :2])
