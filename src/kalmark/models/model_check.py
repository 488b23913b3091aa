"""Check a model of one's own: its shapes, and its Jacobians against central differences.

Differences are in the error coordinates of the spaces: of a robot's state, a landmark, a pose, a measurement.  Two
steps must agree on one; where they do not (the border of a domain, a wrap, a pole), it is not compared.
"""

from __future__ import annotations

import inspect
import itertools
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import kalmark.models.landmarks  # noqa: F401 - registers the kinds that sensors see
from kalmark.arrays import Array
from kalmark.declare import classes
from kalmark.errors import ModelError
from kalmark.geometry.spaces import ANGLE, HOMOGENEOUS, RHO, ROTATION, SCALAR, SE2, SE3, TURNED, Rn, Space
from kalmark.models import protocols
from kalmark.models.landmark_views import Spatial

Rng = np.random.Generator
Batch = Callable[[Array], Any]  # of K arguments: their values and Jacobians

TOLERANCE = 1e-5
STEP = np.cbrt(np.finfo(float).eps)
DRAWS = 200
BATCH = 10
LARGEST = 13  # numbers of an argument of a plain function
FACING = np.array([0.0, 0.0, 1.0, np.cos(0.3), 0.0, 0.0, -np.sin(0.3)])  # tilted: no tag like its mirror image


@dataclass(frozen=True)
class CheckResult:
    """The result of one check: the largest difference, relative to 1 + the value, and where it was."""

    what: str
    error: float
    where: str

    @property
    def ok(self) -> bool:
        """True if the difference is small enough."""
        return self.error <= TOLERANCE


def check_model(model: Any, rng: Rng) -> list[CheckResult]:
    """Return one finding for each requirement on a motion, sensor or landmark model, or of a function.

    A function f(x, ...) returns a value and its Jacobians in its arguments, in their order.  Raises ModelError if it is
    none of these, or returns the wrong shapes.
    """
    found, offered, name = _Findings(), dir(model), type(model).__name__
    roles: Any = (
        ("move", protocols.Motion, _motion),
        ("expect", protocols.Sensor, _sensor),
        ("seen_from", protocols.Landmark, _landmark),
    )
    protocol, check = next((rest for method, *rest in roles if method in offered), (None, _function))
    if protocol is None and not callable(model):
        raise ModelError(f"{name}: expected a function, or a model with one of the methods move, expect and seen_from")
    needed = {each for each in vars(protocol or object) if not each.startswith("_")} - {"from_view"}
    if missing := sorted(needed - {*offered}):
        raise ModelError(f"{name} has no {', '.join(missing)}")
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        (_of_blocks if protocols.measures_blocks(model) else check)(model, rng, found)
    return [*found.worst.values()]


# ------------------------------------------------------------------ motions
def _motion(model: Any, rng: Rng, found: _Findings) -> None:
    k, space = len(model.columns), model.space
    r = np.array([_drawn(space, rng) for _ in range(DRAWS)])
    u = rng.normal(0, 1, (DRAWS, k)) * 10.0 ** rng.uniform(-6, 0.3, (DRAWS, 1))
    u[rng.uniform(size=u.shape) < 0.2] = 0.0
    u[0] = 0.0
    dt_s = rng.uniform(0.01, 2, DRAWS).tolist()
    at = {"r": r, "u": u, "dt_s": dt_s}

    def move(r: Array, u: Array) -> list[Array]:
        state, R_r, R_u = _arrays(map(model.move, r, u, dt_s))
        R_r[~np.isfinite(state).all(axis=1)] = np.nan
        return [state, R_r, R_u]

    _shape("state of move", move(r, u)[0], (DRAWS, space.size))
    found.jacobian("R_r", lambda x: move(x, u)[:2], r, space, space, at)
    if k:
        found.jacobian("R_u", lambda x: move(r, x)[::2], u, Rn(k), space, at)
        found.covariance("control_noise", [*map(model.control_noise, u)], k, at)
    of_state = isinstance(model, protocols.StateDiffusion)
    gathered = map(model.diffusion_at, r, u, dt_s) if of_state else map(model.diffusion, u, dt_s)
    diffusion = [D for D in gathered if D is not None]
    if diffusion:
        pose_alone = space.world == "plane" and np.shape(diffusion[0]) == (SE2.dof, SE2.dof)
        found.covariance("diffusion", diffusion, SE2.dof if pose_alone else space.dof, at)
    if (calibrating := protocols.self_calibrating(model)) is not None:
        c = len(calibrating.calibration)
        found.covariance("calibration_cov", [calibrating.calibration_cov], c, {})
        _shape("calibration_effect", np.array(calibrating.calibration_effect(u[0], dt_s[0])), (k, c))
        if isinstance(calibrating, protocols.NonlinearCalibration):
            of, a = calibrating, rng.normal(0, 1, (DRAWS, c)) * np.sqrt(np.diag(calibrating.calibration_cov))
            found.jacobian("U_a", lambda x: _arrays(map(of.calibrated, u, x, dt_s)), a, Rn(c), Rn(k), at | {"a": a})
    if protocols.has_velocity_state(model):
        size = 6 if space.world == "space" else 3

        def velocity(r: Array) -> list[Array]:
            return _arrays(protocols.velocity_in(model, one, u[0]) for one in r)

        _shape("b of the velocity", velocity(r)[0], (DRAWS, size))
        found.jacobian("B_r", velocity, r, space, Rn(size), {"r": r})


# ------------------------------------------------------------------ sensors
def _sensor(model: Any, rng: Rng, found: _Findings) -> None:
    m, spatial = len(model.columns), isinstance(model, Spatial)
    protocols.refuse_other_views(model, "sensor")
    if len(model.angular) != m:
        raise ModelError(f"angular has {len(model.angular)} entries for {m} columns, expected one each")
    plain = Space("y", tuple(ANGLE if angle else SCALAR for angle in model.angular))
    measured = SE3 if "qw" in model.columns else plain
    v, view = views(model, rng)
    y = np.tile([0.3 * (name == "size_m") for name in model.columns], (len(v), 1))
    e, E_v = _expect(model, v, y)
    _shape("e of expect", e, (len(v), m))
    lines = (
        isinstance(model, protocols.SegmentVisible) and protocols.image_size(model) is not None
    )  # anywhere on a line
    y = rng.uniform(0, [*model.image, *model.image], (len(v), m)) if lines else e
    E_v = _expect(model, v, y)[1] if spatial else E_v
    kept = _finite("e of expect", y, v)
    v, y, E_v = v[kept], y[kept], E_v[kept]
    p = E_v.shape[1]
    to = Rn(p) if spatial else measured
    found.jacobian("E_v", lambda x: (_changing(model, x, y), E_v), v, view, to, {"v": v})
    found.covariance("noise", model.noise(y), p, {"y": y})
    if isinstance(model, protocols.NonAdditiveSensor) and not model.additive:
        found.covariance("noise_at", model.noise_at(v), p, {"v": v})
    if "invert" in dir(model):
        _inverse(model, y, view, measured, found, v if isinstance(model, protocols.SeesVelocity) else None)
    if isinstance(model, protocols.Calibrated) and len(model.parameters):
        a = np.tile(model.parameters, (len(v), 1))
        E_p = model.parameters_jacobian(v)

        def by_parameters(x: Array) -> tuple[Array, Array]:
            return _expect(model.with_parameters(x[0]), v, y)[0], E_p

        found.jacobian("E_p", by_parameters, a, Rn(a.shape[1]), measured, {"v": v})


def _of_blocks(model: Any, rng: Rng, found: _Findings) -> None:
    """Check what a sensor of blocks expects, of as many places or means as `expect` takes, and its own Jacobians."""
    m, count = len(model.columns), len(inspect.signature(model.expect).parameters)
    parts: list[Any] = []
    for n in (2, 3) if model.views == protocols.PLACES else range(1, LARGEST + 1):
        draws = rng.normal(0, 2, (DRAWS, count, n))
        with suppress(Exception):  # this only tries
            parts = [protocols.with_jacobians(model.expect(*x)) for x in draws]
            e = np.array([np.ravel(part[0]) for part in parts])
            if e.shape == (DRAWS, m) and (len(parts[0]) == 1 or np.shape(parts[0][1]) == (m, n)):
                break
    else:
        raise ModelError(f"expect returns no expectation ({m},) of {count} blocks of 1 to {LARGEST} numbers")
    for i in range(len(parts[0]) - 1):
        E = np.array([part[1 + i] for part in parts])

        def value(x: Array, i: int = i, E: Array = E) -> tuple[Array, Array]:
            rows = [model.expect(*old[:i], one, *old[i + 1 :]) for old, one in zip(draws, x, strict=True)]
            return np.array([np.ravel(protocols.with_jacobians(row)[0]) for row in rows]), E

        found.jacobian(f"E_{i + 1}", value, draws[:, i], Rn(n), Rn(m), {"x": draws.reshape(DRAWS, -1)})
    found.covariance("noise", model.noise(e), m, {"y": e})


def _expect(model: Any, v: Array, y: Array) -> tuple[Array, Array]:
    e, E_v = model.expect(v, y) if isinstance(model, Spatial) else model.expect(v)
    return np.asarray(e, dtype=np.float64), np.asarray(E_v, dtype=np.float64)


def _changing(model: Any, v: Array, y: Array) -> Any:
    """Return what E_v is the Jacobian of: e, or -z of kalmark's sensors of space, whose z is not always y - e."""
    if not isinstance(model, Spatial):
        return model.expect(v)[0]
    angular = np.array(model.angular, dtype=np.bool_)
    return -type(model).expected(model.code, model.constants, angular, np.ascontiguousarray(v), y)[1]


def _inverse(
    model: Any, y: Array, view: Space, measured: Space, found: _Findings, moving: Array | None
) -> None:  # fmt: skip
    """Check what a sensor starts landmarks from: a view, a ray or the two rays of a line.

    Of a sensor that measures its velocity, that is the first half of the views `moving` (K, 2 d).
    """
    sized = model.columns[-1] == "size_m"  # a tag, found by iterations; its size has no error,
    exact = sized + sum(name in ("right_m", "left_m") for name in model.columns)  # nor have the ends of a wall
    back, V_y = model.invert(y)
    view = view if moving is None else Rn(view.size // 2)
    d, k, n = view.size, np.shape(back)[1], y.shape[1] - exact
    segment = exact and not sized
    if k not in ((d,) if protocols.finds_depth(model) and not segment else (d, d - 1, 2 * d)):
        raise ModelError(f"v of invert has shape {np.shape(back)}, expected {(len(y), d)}")
    kept = np.flatnonzero(_finite("v of invert", back, y))[: BATCH if sized else None]
    y, back, V_y = y[kept], back[kept], V_y[kept]

    def inverted(x: Array) -> tuple[Array, Array]:
        rows = np.full((len(x), k), np.nan)
        for row, one, whole in zip(rows, x, y, strict=True):
            with suppress(ValueError, ArithmeticError):  # refused, beyond the border of what can be measured
                row[:] = model.invert(np.append(one, whole[n:])[None])[0][0]
        return rows, V_y

    found.jacobian("V_y", inverted, y[:, :n], Rn(n) if exact else measured, view if k == d else Rn(k), {"y": y})
    if k != 2 * d:
        whole = np.column_stack([back, np.ones(len(back))]) if k == d - 1 else back  # a ray, at any distance
        whole = whole if moving is None else np.column_stack([whole, moving[kept][:, d:]])
        found.same("expect(invert(y)) = y", _expect(model, whole, y)[0], y, measured, {"y": y})


def views(model: Any, rng: Rng) -> tuple[Array, Space]:
    """Return views (K, d) that a sensor can have, and their space."""
    if isinstance(model, protocols.OfState):
        return _views_of_state(model, rng)
    d = _size_of_view(model, rng)
    if d == SE3.size:
        return np.array([SE3.plus(FACING, rng.normal(0, 0.1, 6)) for _ in range(DRAWS)]), SE3
    v = rng.normal(0, 1, (20 * DRAWS, d)) * 10.0 ** rng.uniform(-1, 1, (20 * DRAWS, 1))
    if protocols.image_size(model) is not None or model.columns[0].endswith("_px"):  # about the middle of the image
        v[:, :2], v[:, 2] = rng.uniform(-0.4, 0.4, (len(v), 2)), 1.0
        v[:, :3] *= 10.0 ** rng.uniform(-0.5, 1, (len(v), 1))
    if d == 4:
        v[:, 3] = rng.uniform(0.01, 1, len(v))  # an inverse distance
    seen = v[model.sees(v)] if isinstance(model, protocols.Visible) and "sees_segments" not in dir(model) else v
    seen = (seen if len(seen) else v)[:DRAWS]
    if isinstance(model, protocols.SeesVelocity):
        seen, d = np.column_stack([seen, rng.normal(0, 1, seen.shape)]), 2 * d
    return seen, Rn(d)


def _views_of_state(model: Any, rng: Rng) -> tuple[Array, Space]:
    """Return twists or poses (K, d) of a robot, in the plane if the sensor may be there."""
    plane = protocols.world_of(model) != "space"
    if model.views == protocols.TWIST:
        return rng.normal(0, 1, (DRAWS, 3 if plane else 6)), Rn(3 if plane else 6)
    if plane:
        return rng.normal(0, 1, (DRAWS, 3)), SE2
    return np.array([SE3.plus(FACING, rng.normal(0, 0.1, 6)) for _ in range(DRAWS)]), SE3


def _size_of_view(model: Any, rng: Rng) -> int:
    """Return how many numbers a view has: those of a landmark the sensor names, else what it takes and gives back."""
    kinds = protocols.sees_kinds(model) or ()
    named = [own for models in classes("landmark").values() for own in models if vars(own).get("kind") in kinds]
    if named:
        landmark: Any = named[-1]()
        T = _drawn(SE3 if landmark.space.world == "space" else SE2, rng)
        return int(landmark.seen_from(T, _drawn(landmark.space, rng)[None])[0].shape[1])
    taken = []
    for d in (3, 2, 4):
        with suppress(Exception):  # this only tries; a mistake shows when the model is called in earnest
            e, E_v = model.expect(rng.uniform(0.5, 1, (BATCH, d)))
            if np.shape(E_v) == (BATCH, len(model.columns), d):
                taken.append(d)
                if "invert" not in dir(model) or np.shape(model.invert(e)[0]) == (BATCH, d):
                    return d
    return taken[0] if taken else 2


# ------------------------------------------------------------------ landmarks
def _landmark(model: Any, rng: Rng, found: _Findings) -> None:
    for _ in range(DRAWS // BATCH):
        _from_pose(model, rng, found)


def _from_pose(model: Any, rng: Rng, found: _Findings) -> None:
    """Check landmarks seen from one pose."""
    space, pose = model.space, SE3 if model.space.world == "space" else SE2
    T, l = _drawn(pose, rng), np.array([_drawn(space, rng) for _ in range(BATCH)])
    Ts, where = np.tile(T, (BATCH, 1)), Rn(3 if space.world == "space" else 2)
    v, _, V_l = model.seen_from(T, l)
    if np.ndim(v) != 2 or len(v) != BATCH:
        raise ModelError(f"v of seen_from has shape {np.shape(v)}, expected ({BATCH}, d)")
    view = SE3 if v.shape[1] == SE3.size and np.shape(V_l)[1] == SE3.dof else Rn(v.shape[1])
    at: dict[str, Any] = {"T": Ts, "l": l}
    found.jacobian("V_T", lambda x: model.seen_from(x[0], l)[:2], Ts, pose, view, at)
    found.jacobian("V_l", lambda x: model.seen_from(T, x)[::2], l, space, view, at)
    if isinstance(model, protocols.Reparametrizable):
        found.jacobian("P_l of to_point", model.to_point, l, space, where, at)
    if isinstance(model, protocols.HasPlace):
        found.jacobian("P_l of place", model.place, l, space, where, at)
    if "from_view" not in dir(model):
        return
    if isinstance(model, protocols.Joining):  # a distance, a direction and two ends
        v = rng.normal(0, 1.5, (BATCH, 4))
    elif isinstance(model, protocols.UnknownDepth | protocols.Segmented):  # rays of length 1, completed by a prior
        rays, d = 1 + isinstance(model, protocols.Segmented), 2 if space.world == "plane" else 3
        v = rng.normal(0, 1, (BATCH, rays, d))
        v = (v / np.linalg.norm(v, axis=2, keepdims=True)).reshape(BATCH, -1)
        if isinstance(model, protocols.Completing):
            v = model.complete(v, np.tile(np.eye(rays * d), (BATCH, 1, 1)), False)[0]
    given = view if v.shape[1] == view.size else Rn(v.shape[1])
    l = model.from_view(T, v)[0]
    _shape("l of from_view", l, (BATCH, space.size))
    at = {"T": Ts, "v": v}
    found.jacobian("L_T", lambda x: model.from_view(x[0], v)[:2], Ts, pose, space, at)
    found.jacobian("L_v", lambda x: model.from_view(T, x)[::2], v, given, space, at)
    again, looked = model.seen_from(T, l)[0], v[:, : view.size]
    if isinstance(model, protocols.Segmented) and space.world == "space":  # the plane through both rays
        again, looked = (n / np.linalg.norm(n, axis=1)[:, None] for n in (again, np.cross(v[:, :3], v[:, 3:6])))
    found.same("seen_from(from_view(v)) = v", again, looked, view, at)


# ------------------------------------------------------------------ functions
def _function(f: Callable[..., Any], rng: Rng, found: _Findings) -> None:
    """Check a function f(x, ...) -> value, Jacobians in its arguments, in their order."""
    sizes, count = _sizes(f, rng)
    draws = [[float(rng.uniform(0.1, 2)) if n == 0 else rng.normal(0, 1, n) for n in sizes] for _ in range(DRAWS)]
    results = [f(*x) for x in draws]
    m = np.size(results[0][0])
    for i, n in enumerate(sizes[:count]):
        J = np.array([np.reshape(each[1 + i], (m, max(n, 1))) for each in results])

        def value(x: Array, i: int = i, n: int = n, J: Array = J) -> tuple[Array, Array]:
            given = [(*old[:i], one if n else float(one[0]), *old[i + 1 :]) for old, one in zip(draws, x, strict=True)]
            return np.array([np.ravel(f(*each)[0]) for each in given]), J

        x = np.array([np.atleast_1d(each[i]) for each in draws])
        at = {f"argument {j + 1}": [each[j] for each in draws] for j in range(len(sizes))}
        found.jacobian(f"Jacobian {i + 1}", value, x, Rn(max(n, 1)), Rn(m), at)


def _sizes(f: Callable[..., Any], rng: Rng) -> tuple[tuple[int, ...], int]:
    """Return the sizes of a function's arguments, 0 for a number, and how many have Jacobians."""
    try:
        own = [one for one in inspect.signature(f).parameters.values() if one.kind < inspect.Parameter.VAR_POSITIONAL]
    except (TypeError, ValueError):
        raise ModelError("got no Python function, expected f(x, ...) -> value, Jacobians") from None
    choices: list[Any] = [(0,) if one.annotation in (float, "float") else range(1, LARGEST + 1) for one in own]
    for i, one in enumerate(own):
        if one.default is not one.empty:
            choices[i] = (np.size(one.default) if np.ndim(one.default) else 0,)
    for sizes in sorted(itertools.product(*choices), key=sum) if 1 <= len(own) <= 3 else ():
        with suppress(Exception):  # this only tries
            value, *jacobians = f(*(1.0 if n == 0 else rng.normal(0, 1, n) for n in sizes))
            shapes = [(np.size(value), max(n, 1)) for n in sizes[: len(jacobians)]]
            allowed = [{at, (max(at),)} if 1 in at else {at} for at in shapes]
            fit = [np.shape(J) in at for J, at in zip(jacobians, allowed, strict=True)]
            if np.ndim(value) < 2 and np.isfinite(value).all() and fit and all(fit):
                return sizes, len(jacobians)
    raise ModelError("no sizes of 1 to 3 arguments give a value (m,) and Jacobians (m, n), expected such a function")


# ------------------------------------------------------------------ differences
def _drawn(space: Space, rng: Rng) -> Array:
    """Return a random value of a space: some metres, any direction, no inverse distance near 0."""
    x = np.zeros(space.size)
    for kind, at, _ in space.atoms:
        if kind in (ROTATION, TURNED):
            x[at + 3] = 1.0
    x = space.plus(x, rng.normal(0, 1.5, space.dof))
    for kind, at, _ in space.atoms:
        if kind in (RHO, HOMOGENEOUS):
            last = at + (3 if kind == HOMOGENEOUS else 0)
            x[last] = 0.3 + abs(x[last])
    return x


def _differences(f: Batch, x: Array, of: Space, to: Space, h: float) -> Array:
    """Return d f / d x (K, to.dof, of.dof) by central differences in the errors of both spaces."""
    columns = []
    for i in range(of.dof):
        step = np.zeros((len(x), of.dof))
        step[:, i] = h * np.maximum(1.0, np.abs(x[:, i]) if of.dof == of.size else 1.0)
        ends = [f(np.array([of.plus(*each) for each in zip(x, d, strict=True)]))[0] for d in (step, -step)]
        rise = np.array([to.minus(*each) for each in zip(*ends, strict=True)])
        columns.append(rise / (2 * step[:, i, None]))
    return np.stack(columns, axis=-1)


@dataclass
class _Findings:
    """The worst finding of each kind so far."""

    worst: dict[str, CheckResult] = field(default_factory=dict)

    def jacobian(self, what: str, f: Batch, x: Array, of: Space, to: Space, at: dict[str, Any]) -> None:
        """Compare the Jacobian (K, to.dof, of.dof) of f at x (K, of.size) with the differences of its values."""
        J = np.asarray(f(x)[1], dtype=np.float64)
        _shape(what, J, (len(x), to.dof, of.dof))
        fine, coarse = (_differences(f, x, of, to, h) for h in (STEP, 2 * STEP))
        smooth = np.abs(coarse - fine) <= TOLERANCE / 2 * (1 + np.abs(fine))
        error = np.where(smooth, np.abs(J - fine) / (1 + np.abs(fine)), 0.0)
        error[~np.isfinite(J) | ~smooth.any()] = np.inf
        self._keep(what, error, at)

    def same(self, what: str, x: Array, expected: Array, space: Space, at: dict[str, Any]) -> None:
        """Compare values (K, space.size); what differs by turns is the same."""
        d = np.array([space.minus(*each) for each in zip(x, expected, strict=True)])
        d -= 2 * np.pi * np.round(d / (2 * np.pi))
        self._keep(what, np.abs(d) / (1 + np.abs(expected).max(axis=1, keepdims=True)), at)

    def covariance(self, what: str, P: Any, size: int, at: dict[str, Any]) -> None:
        """Check shape, symmetry and sign of covariances (K, size, size)."""
        P = np.array(P, dtype=np.float64)
        _shape(what, P, (len(P), size, size))
        finite = np.isfinite(P).all(axis=(1, 2))
        negative = -np.linalg.eigvalsh(np.where(finite[:, None, None], P, 0.0))[:, :1]
        error = np.maximum(np.abs(P - P.swapaxes(1, 2)).max(axis=2), np.maximum(negative, 0.0))
        self._keep(f"{what} is a covariance", error, at)

    def _keep(self, what: str, error: Array, at: dict[str, Any]) -> None:
        error = np.where(np.isnan(error), np.inf, error).reshape(len(error), -1).max(axis=1)
        i = int(np.argmax(error))
        if what not in self.worst or error[i] > self.worst[what].error:
            where = ", ".join(f"{name} = {_show(x[i])}" for name, x in at.items())
            self.worst[what] = CheckResult(what, float(error[i]), where or "the model")


def _arrays(results: Iterable[Any]) -> list[Array]:
    """Return results, tuples one a draw, as an array (K, ...) for each of their parts."""
    return [np.array(each) for each in zip(*results, strict=True)]


def _finite(what: str, y: Array, x: Array) -> Any:
    """Return which rows of y (K, m), found at x (K, n), are finite.  Raises ModelError if none is."""
    kept = np.isfinite(y).all(axis=1)
    if not kept.any():
        raise ModelError(f"{what} is {_show(y[0])} at {_show(x[0])}, expected finite numbers")
    return kept


def _shape(what: str, value: Any, expected: tuple[int, ...]) -> None:
    if np.shape(value) != expected:
        raise ModelError(f"{what} has shape {np.shape(value)}, expected {expected}")


def _show(x: Any) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in np.ravel(x)) + ")"
