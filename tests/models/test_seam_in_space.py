"""Every sensor of space with every landmark it sees: Jacobians of the composition, starts, gauges."""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.geometry import SE3
from kalmark.geometry.frames3d import compose
from kalmark.geometry.rotations import exp
from kalmark.geometry.spaces import MOUNTS
from kalmark.models import landmarks
from kalmark.models.landmark_views import Spatial
from kalmark.models.observe import expectation, inverse_expectation, linearize, linearize_chain, view_of
from kalmark.tracks.channel import ObservationModel
from placed_landmarks import placed

IN_SPACE = [kind for kind in landmarks.BUILT_IN if kind().space.world == "space"]
BY_KIND: dict[str, Any] = {kind.kind: kind for kind in landmarks.BUILT_IN}
SENSORS: list[Any] = [
    km.sensors.RangeBearing3D(),
    km.sensors.Position3D(),
    km.sensors.PinHole(distortion=(-0.3, 0.1)),
    km.sensors.PinHole(lens="radtan", distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.0)),
    km.sensors.PinHole(lens="equidistant", distortion=(-0.01, 0.003, 0.0, 0.0)),
    km.sensors.Omnidirectional(),
    km.sensors.PixelDepth(lens="radtan", distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.0)),
    km.sensors.Stereo(),
    km.sensors.Segments(),
    km.sensors.TagPose(),
    km.sensors.TagCorners(),
]
PAIRS = [(sensor, BY_KIND[kind]()) for sensor in SENSORS for kind in sensor.sees_kinds]
STARTS = [(s, l) for s, l in PAIRS if getattr(s, "finds_depth", True) or l.kind != "point3"]


def name(pair: Any) -> str:
    lens = getattr(pair[0], "lens", "")
    return f"{type(pair[0]).__name__}{lens and '-' + lens}-{pair[1].kind}"


def slope(function: Any, d: np.ndarray, h: float = 1e-5) -> np.ndarray:
    """Return the derivative of a function of errors along d, to the fourth order: near poles the second is rough."""
    near, far = function(h * d) - function(-h * d), function(2 * h * d) - function(-2 * h * d)
    return (8 * near - far) / (12 * h)  # type: ignore[no-any-return]


def drawn(rng: np.random.Generator, sensor: Any, landmark: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a head (pose and mount), a landmark in view and a measurement of it."""
    r = np.concatenate([rng.normal(size=3) * 5, exp(rng.normal(size=3))])
    mount = np.concatenate([rng.normal(size=3) * 0.3, exp(rng.normal(size=3))])
    T = compose(r, mount)[0]
    forward = "range_m" in sensor.columns or "x_m" in sensor.columns
    axis = np.array([1.0, 0, 0]) if forward else np.array([0, 0, 1.0])
    depth = 10.0 ** rng.uniform(-0.3, 1.5)
    p, q = (depth * (axis + rng.uniform(-0.5, 0.5, 3) * (1 - axis)) for _ in range(2))
    l = placed(landmark, T, p, q, rng)
    size = np.array([depth / 5])
    y = np.zeros((1, len(sensor.columns)))
    if landmark.kind == "tag":
        y[0, -1] = size[0]
        v = landmark.seen_from(T, l[None])[0]
        y = sensor.expect(v, y)[0] if len(y[0]) == 9 else SE3.plus(v[0], rng.normal(size=6) * 0.05)[None]
    elif "line" in landmark.kind:
        k = sensor.parameters
        y = np.array([[k[0] * v[0] / v[2] + k[2], k[1] * v[1] / v[2] + k[3]] for v in (p, q)]).reshape(1, 4)
    else:
        y = sensor.expect(landmark.seen_from(T, l[None])[0])[0]
    noise = rng.normal(size=y.shape)
    if landmark.kind == "tag":
        noise[:, 8 if y.shape[1] == 9 else 0 :] = 0.0
    if "rho_per_m" in sensor.columns:
        noise[:, 2] *= 0.001
    return np.concatenate([r, mount]), l, y + noise * (1.0 if "u_px" in str(sensor.columns) or y.shape[1] > 7 else 0.01)


@pytest.mark.parametrize("pair", PAIRS, ids=name)
def test_the_jacobians_of_every_composition_are_those_of_differences(pair: Any) -> None:
    sensor, landmark = pair
    rng = np.random.default_rng(3)
    for _ in range(200):
        head, l, y = drawn(rng, sensor, landmark)
        view = view_of(sensor, landmark, head[7:].copy())
        _, z, E_h, E_l = linearize(view, head, l[None], y)
        assert np.isfinite(z).all()

        def innovation(d: np.ndarray, head: Any = head, l: Any = l, y: Any = y, view: Any = view) -> np.ndarray:
            moved = np.concatenate([SE3.plus(head[:7], d[:6]), MOUNTS[7].plus(head[7:], d[6:12])])
            return linearize(view, moved, landmark.space.plus(l, d[12:])[None], y)[1][0]  # type: ignore[no-any-return]

        J = np.concatenate([E_h[0], E_l[0]], axis=1)
        numeric = np.stack([-slope(innovation, d) for d in np.eye(J.shape[1])], axis=1)
        np.testing.assert_allclose(J, numeric, rtol=1e-6, atol=2e-6 * (1 + np.abs(numeric).max()))
        _, _, E_r, same = linearize(view, head[:7].copy(), l[None], y)  # a mount that is not in the map
        np.testing.assert_allclose(E_r, E_h[:, :, :6], atol=1e-9 * (1 + np.abs(E_h).max()))
        np.testing.assert_allclose(same, E_l)


@pytest.mark.parametrize("pair", PAIRS, ids=name)
def test_the_compiled_models_called_by_address_equal_the_written_out_composition(pair: Any) -> None:
    sensor, landmark = pair
    rng = np.random.default_rng(6)
    for _ in range(20):
        head, l, y = drawn(rng, sensor, landmark)
        r, mount, l = head[:7].copy(), head[7:].copy(), l[None]
        more = (y,) if isinstance(sensor, Spatial) else ()  # sizes of tags and ends of segments
        told = SimpleNamespace(expect=lambda v, more=more: sensor.expect(v, *more))
        e, E_r, E_s, E_l = expectation(r, mount, told, landmark, l)  # type: ignore[arg-type]
        view = view_of(sensor, landmark, mount)
        assert isinstance(view, tuple), "built-in models take the compiled way"
        ours = linearize(view, head, l, y)
        for mine, written in zip((ours[0], *ours[2:]), (e, np.concatenate([E_r, E_s], axis=2), E_l), strict=True):
            np.testing.assert_allclose(mine, written, rtol=1e-12, atol=1e-12 * (1 + np.abs(written).max()))
        for mine, plain in zip(ours, linearize_chain.py_func(view, head, l, y), strict=True):  # type: ignore[attr-defined]
            np.testing.assert_allclose(mine, plain, rtol=1e-12, atol=1e-12 * (1 + np.abs(plain).max()))


def test_the_filter_is_compiled_from_no_model_but_observe_that_its_folder_is_named_after() -> None:
    sources = [path.read_text() for path in (Path(km.__file__).parent / "filter").glob("*.py")]
    assert {m for text in sources for m in re.findall(r"kalmark\.models[.\w]*", text)} == {"kalmark.models.observe"}


def test_an_observation_model_that_is_copied_to_another_process_leaves_the_addresses_behind() -> None:
    model = ObservationModel(km.landmarks.Homogeneous(), km.sensors.PinHole(), np.array([0.0, 0, 0, 0, 0, 0, 1]))
    assert model.model[0] and "model" in vars(model)
    copy = pickle.loads(pickle.dumps(model))
    assert "model" not in vars(copy)
    assert copy.model[:4] == model.model[:4]  # in this process they are found again


@pytest.mark.parametrize("pair", STARTS, ids=name)
def test_a_landmark_started_from_a_measurement_explains_it(pair: Any) -> None:
    sensor, landmark = pair
    rng = np.random.default_rng(4)
    for _ in range(20):
        head, _, y = drawn(rng, sensor, landmark)
        if type(sensor).__name__ == "Stereo":  # the height is the mean of both images'
            y[0, 3] = y[0, 1]
        r, mount = head[:7].copy(), head[7:].copy()
        l, L_r, L_s, L_y, prior = inverse_expectation(r, mount, sensor, landmark, y)
        if np.isnan(l).any():
            assert type(sensor).__name__ == "TagCorners"  # a tag that looks like its mirror image is not started
            continue
        _, z, _, _ = linearize(view_of(sensor, landmark, mount), r, l, y)
        limit = 5.0 if type(sensor).__name__ == "TagCorners" else 0.02 if getattr(sensor, "distortion", ()) else 1e-6
        assert np.abs(z).max() < limit  # corners moved by noise are of no tag exactly; corrections are fitted
        dof = landmark.space.dof
        assert L_r.shape == (1, dof, 6) and L_s.shape == (1, dof, 6) and L_y.shape[1] == dof
        assert np.linalg.eigvalsh(prior[0]).min() > -1e-9
        for analytic, space, x, index in ((L_r, SE3, r, 0), (L_s, MOUNTS[7], mount, 1)):
            for j in range(6):
                d = np.eye(6)[j] * 1e-6
                args: list[Any] = [r, mount]
                sides = []
                for sign in (1, -1):
                    args[index] = space.plus(x, sign * d)
                    sides.append(inverse_expectation(args[0], args[1], sensor, landmark, y)[0][0])
                rate = landmark.space.minus(*sides) / 2e-6
                np.testing.assert_allclose(analytic[0, :, j], rate, rtol=1e-5, atol=1e-5 * (1 + np.abs(rate).max()))


@pytest.mark.parametrize("kind", IN_SPACE, ids=lambda k: k.kind)
def test_the_generators_of_every_kind_are_those_of_moving_the_world(kind: Any) -> None:
    rng = np.random.default_rng(5)
    space = kind.space
    T = np.array([0.0, 0, 0, 0, 0, 0, 1])
    for _ in range(50):
        p, q = rng.normal(size=3) * 3, rng.normal(size=3) * 3
        x = placed(kind(), T, p, q, rng)
        for axis, e in enumerate(np.eye(3) * 1e-6):
            rate = space.minus(space.rotated(x, e), space.rotated(x, -e)) / 2e-6
            np.testing.assert_allclose(space.generator(x)[:, axis], rate, rtol=1e-6, atol=1e-7)
        d = rng.normal(size=space.dof) * 0.1
        np.testing.assert_allclose(space.minus(space.plus(x, d), x), d, atol=1e-9)
