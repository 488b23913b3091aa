"""Check a model of one's own: its shapes, and its Jacobians against central differences.

Differences are taken in the error coordinates of the spaces: of a robot's state, a landmark, a pose.  Those of angles
are wrapped: a difference near a multiple of 2 pi over so small a step is a wrap.
"""

from __future__ import annotations

import inspect
import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from kalmark.declare import classes
from kalmark.errors import ModelError
from kalmark.geometry.spaces import HOMOGENEOUS, RHO, ROTATION, SE2, SE3, TURNED, Rn, Space
from kalmark.models.protocols import (
    Calibrated,
    Completing,
    Landmark,
    Motion,
    Placed,
    Reparametrizable,
    Segmented,
    SegmentVisible,
    Sensor,
    UnknownDepth,
    bias_covariance,
    finds_depth,
    sees_kinds,
)
from kalmark.models.sensors3d import Spatial

Array = npt.NDArray[np.float64]
Rng = np.random.Generator

TOLERANCE = 1e-5
DRAWS = 200
BATCH = 10
LARGEST = 13  # numbers of an argument of a plain function


@dataclass(frozen=True)
class Finding:
    """What one check found: the largest difference, relative to 1 + the value, and where it was."""

    what: str
    error: float
    where: str

    @property
    def ok(self) -> bool:
        """Whether the difference is small enough."""
        return self.error <= TOLERANCE


@runtime_checkable
class _Moves(Protocol):
    def move(self, r: Array, u: Array, dt_s: float) -> Any: ...


@runtime_checkable
class _Expects(Protocol):
    def expect(self, v: Array) -> Any: ...


@runtime_checkable
class _Seen(Protocol):
    def seen_from(self, T: Array, l: Array) -> Any: ...


@runtime_checkable
class _Inverts(Protocol):
    def invert(self, y: Array) -> Any: ...


@runtime_checkable
class _Starts(Protocol):
    def from_view(self, T: Array, v: Array) -> Any: ...


def check_model(model: Any, rng: Rng) -> list[Finding]:
    """Return one finding for each thing that a motion, sensor or landmark model, or a function, promises.

    A function f(x, ...) returns a value and its Jacobians in its arguments, in their order.  Raises ModelError if it is
    none of these, or returns the wrong shapes.
    """
    roles: Any = ((_Moves, Motion, _motion), (_Expects, Sensor, _sensor), (_Seen, Landmark, _landmark))
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for method, protocol, check in roles:
            if isinstance(model, method):
                missing = sorted(name for name in _required(protocol, check) if name not in dir(model))
                if missing:
                    raise ModelError(f"{type(model).__name__} has no {', '.join(missing)}")
                return check(model, rng)
        if callable(model):
            return _function(model, rng)
    name = type(model).__name__
    raise ModelError(f"{name}: expected a function, or a model with one of the methods move, expect and seen_from")


def _required(protocol: Any, check: Any) -> list[str]:
    """Return what a model must have to be looked at; a landmark need not start."""
    return [name for name in vars(protocol) if not name.startswith("_") and (check, name) != (_landmark, "from_view")]


# ------------------------------------------------------------------ motions
def _motion(model: Any, rng: Rng) -> list[Finding]:
    k, space, worst = len(model.columns), model.space, _Worst()
    for draw in range(DRAWS):
        r = _drawn(space, rng)
        u = rng.normal(0, 1, k) * 10.0 ** rng.uniform(-6, 0.3) * (draw > 0)
        u[rng.uniform(size=k) < 0.2] = 0.0
        dt_s = float(rng.uniform(0.01, 2))
        where = f"r = {_show(r)}, u = {_show(u)}, dt_s = {dt_s:.3g}"
        moved, R_r, R_u = model.move(r, u, dt_s)
        _shape("move", "state", moved, (space.size,))
        _shape("move", "R_r", R_r, (space.dof, space.dof))
        _shape("move", "R_u", R_u, (space.dof, k))
        worst.add("R_r", R_r, _differences(lambda x: model.move(x, u, dt_s)[0], r, space, space), where)  # noqa: B023
        worst.add("R_u", R_u, _differences(lambda x: model.move(r, x, dt_s)[0], u, Rn(k), space), where)  # noqa: B023
        worst.covariance("control_noise", model.control_noise(u), k, where)
        diffusion = model.diffusion(u, dt_s)
        if diffusion is not None:
            worst.covariance("diffusion", diffusion, space.dof, where)
    bias = bias_covariance(model)
    if bias is not None:
        worst.covariance("bias_cov", bias, k, "the model")
    return worst.findings()


# ------------------------------------------------------------------ sensors
def _sensor(model: Any, rng: Rng) -> list[Finding]:
    m = len(model.columns)
    if len(model.angular) != m:
        raise ModelError(f"angular has {len(model.angular)} entries for {m} columns, expected one each")
    v, view = _views(model, rng)
    worst, p = _Worst(), m
    if isinstance(model, Spatial):  # its innovation is not always y - e
        y, p = _innovations(model, v, view, rng, worst)
    else:
        y, E_v = model.expect(v)
        _shape("expect", "e", y, (len(v), m))
        _shape("expect", "E_v", E_v, (len(v), m, view.dof))
        for one, at in zip(E_v, v, strict=True):
            worst.add("E_v", one, _differences(lambda x: model.expect(x[None])[0][0], at, view, Rn(m)), _at("v", at))
    if isinstance(model, _Inverts):
        y = _inverse(model, y, view, p, worst)
    R = model.noise(y)
    _shape("noise", "R", R, (len(y), p, p))
    for one, at in zip(R, y, strict=True):
        worst.covariance("noise", one, p, _at("y", at))
    if isinstance(model, Calibrated):
        E_p = model.parameters_jacobian(v)
        for one, at in zip(E_p, v, strict=True):
            changed = _differences(
                lambda x: model.with_parameters(x).expect(at[None])[0][0],  # noqa: B023
                model.parameters, Rn(len(model.parameters)), Rn(m),
            )  # fmt: skip
            worst.add("E_p", one, changed, _at("v", at))
    return worst.findings()


def _innovations(model: Any, v: Array, view: Space, rng: Rng, worst: _Worst) -> tuple[Array, int]:
    """Check how the innovations of kalmark's own sensors of space change with the views; return measurements."""
    y = np.zeros((len(v), len(model.columns)))
    if model.columns[-1] == "size_m":
        y[:, -1] = 0.3
    lines = isinstance(model, SegmentVisible)  # what is measured of a line lies anywhere on it
    y = rng.uniform(0, [*model.image, *model.image], (DRAWS, 4)) if lines else model.expect(v, y)[0]
    E_v = model.expect(v, y)[1]
    angular, par = np.array(model.angular, dtype=np.bool_), np.array(model.parameters)
    for one, at, given in zip(E_v, v, y, strict=True):

        def innovation(x: Array, given: Array = given) -> Array:
            z = type(model).expected(model.code, par, angular, np.ascontiguousarray(x)[None], given[None])[1]
            return np.asarray(z[0])

        worst.add("E_v", one, -_differences(innovation, at, view, Rn(E_v.shape[1])), _at("v", at))
    return y, E_v.shape[1]


def _inverse(model: Any, y: Array, view: Space, p: int, worst: _Worst) -> Array:
    """Check what a sensor starts landmarks by; return the measurements that can be inverted."""
    measured = SE3 if "qw" in model.columns else Rn(y.shape[1])
    y = _inside(model.invert, y[:BATCH] if model.columns[-1] == "size_m" else y, measured)  # tags are iterated
    back, V_y = model.invert(y)
    d, k = view.size, back.shape[1]
    if k not in ((d,) if finds_depth(model) else (d, d - 1, 2 * d)):
        raise ModelError(f"invert: v has shape {back.shape}, expected {(len(y), d)}")
    started, errors = view if k == d else Rn(k), p if model.columns[-1] == "size_m" else measured.dof
    _shape("invert", "V_y", V_y, (len(y), started.dof, errors))
    for one, at in zip(V_y, y, strict=True):
        differences = _differences(lambda x: model.invert(x[None])[0][0], at, measured, started)
        worst.add("V_y", one, differences[:, :errors], _at("y", at))
    if k == 2 * d:
        return y
    if k == d - 1:  # a ray, at any distance
        back = np.column_stack([back, np.ones(len(back))])
    again = model.expect(back, y)[0] if isinstance(model, Spatial) else model.expect(back)[0]
    error = np.array([measured.minus(one, other) for one, other in zip(again, y, strict=True)])
    worst.add("expect(invert(y)) = y", _unwrapped(error), np.zeros_like(error), "all draws")
    return y


def _inside(invert: Callable[[Array], tuple[Array, Array]], y: Array, space: Space) -> Array:
    """Return the measurements that can be inverted all around, too; all of them if there are none.

    On the border of what a sensor can measure (a sine of 1) the differences would leave it.
    """
    steps = 1e-4 * np.vstack([np.eye(space.dof), -np.eye(space.dof)])
    around = [np.array([space.plus(one, step * (1 + np.abs(one[: space.dof]))) for step in steps]) for one in y]
    kept = [one for one, near in zip(y, around, strict=True) if _finite(invert, np.vstack([one[None], near]))]
    return np.array(kept) if kept else y


def _finite(invert: Callable[[Array], tuple[Array, Array]], y: Array) -> bool:
    try:
        return bool(np.isfinite(invert(y)[0]).all())
    except (ValueError, ArithmeticError):
        return False


def _views(model: Any, rng: Rng) -> tuple[Array, Space]:
    """Return views (DRAWS, d) that a sensor can have, and their space."""
    d, in_image = _size_of_view(model, rng), model.columns[0].endswith("_px")
    v = rng.normal(0, 1, (DRAWS, d)) * 10.0 ** rng.uniform(-1, 1, (DRAWS, 1))
    if d == SE3.size:
        v = np.array([SE3.plus(FACING, rng.normal(0, 0.1, 6)) for _ in range(DRAWS)])
        v[:, 2] += 1.0  # a tag that faces a camera
    elif in_image and not isinstance(model, SegmentVisible):
        depth = 10.0 ** rng.uniform(-0.5, 1, (DRAWS, 1))
        rho = rng.uniform(0.01, 1, (DRAWS, d - 3))
        v = np.column_stack([depth * rng.uniform(-0.4, 0.4, (DRAWS, 2)), depth, rho])
    return v, SE3 if d == SE3.size else Rn(d)


def _size_of_view(model: Any, rng: Rng) -> int:
    """Return how many numbers a view has: those of a landmark the sensor names, else what it takes and gives back."""
    kinds = sees_kinds(model) or ()
    seen = [own() for models in classes("landmark").values() for own in models if own().kind in kinds]
    if seen:
        T = SE3_ORIGIN if seen[-1].space.world == "space" else np.zeros(3)
        return int(seen[-1].seen_from(T, _drawn(seen[-1].space, rng)[None])[0].shape[1])
    taken = []
    for d in (3, 2, 4):
        try:
            e, E_v = model.expect(rng.uniform(0.5, 1, (BATCH, d)))
            if np.shape(E_v) == (BATCH, len(model.columns), d):
                taken.append(d)
                if not isinstance(model, _Inverts) or np.shape(model.invert(e)[0]) == (BATCH, d):
                    return d
        except Exception:  # this only tries; what is wrong shows when the model is called in earnest
            continue
    return taken[0] if taken else 2


# ------------------------------------------------------------------ landmarks
def _landmark(model: Any, rng: Rng) -> list[Finding]:
    space, worst = model.space, _Worst()
    pose = SE3 if space.world == "space" else SE2
    for _ in range(DRAWS // BATCH):
        T, l = _drawn(pose, rng), np.array([_drawn(space, rng) for _ in range(BATCH)])
        where = f"T = {_show(T)}"
        v, V_T, V_l = model.seen_from(T, l)
        if np.ndim(v) != 2:
            raise ModelError(f"seen_from: v has shape {np.shape(v)}, expected ({BATCH}, d)")
        view = SE3 if v.shape[1] == SE3.size and np.shape(V_l)[1] == SE3.dof else Rn(v.shape[1])
        _shape("seen_from", "V_T", V_T, (BATCH, view.dof, pose.dof))
        _shape("seen_from", "V_l", V_l, (BATCH, view.dof, space.dof))
        for i, at in enumerate(l):
            one = at[None]
            worst.add("V_T", V_T[i], _differences(lambda x: model.seen_from(x, one)[0][0], T, pose, view), where)  # noqa: B023
            worst.add("V_l", V_l[i], _differences(lambda x: model.seen_from(T, x[None])[0][0], at, space, view), where)  # noqa: B023
        for name, points in _points(model).items():
            p, P_l = points(l)
            _shape(name, "P_l", P_l, (BATCH, p.shape[1], space.dof))
            for one, at in zip(P_l, l, strict=True):
                differences = _differences(lambda x: points(x[None])[0][0], at, space, Rn(p.shape[1]))  # noqa: B023
                worst.add(f"P_l of {name}", one, differences, _at("l", at))
        if isinstance(model, _Starts):
            _started(model, T, pose, _startable(model, space.world, v, view, rng), view, worst)
    return worst.findings()


def _points(model: Any) -> dict[str, Callable[[Array], tuple[Array, Array]]]:
    """Return what gives points of landmarks, by name."""
    named: dict[str, Callable[[Array], tuple[Array, Array]]] = {}
    if isinstance(model, Reparametrizable):
        named["to_point"] = model.to_point
    if isinstance(model, Placed):
        named["place"] = model.place
    return named


def _startable(model: Any, world: str, v: Array, view: Space, rng: Rng) -> tuple[Array, Space]:
    """Return what `from_view` takes, and its space: a view, or a view completed by a prior."""
    if not isinstance(model, Completing):
        return v, view
    d = 6 if isinstance(model, Segmented) else 2 if world == "plane" else 3
    if isinstance(model, UnknownDepth) or d == 6:  # rays of length 1
        v = rng.normal(0, 1, (BATCH, d)).reshape(BATCH, -1, d if d == 2 else 3)
        v = (v / np.linalg.norm(v, axis=2, keepdims=True)).reshape(BATCH, d)
        v = model.complete(v, np.tile(np.eye(d), (BATCH, 1, 1)), False)[0]
    return v, Rn(v.shape[1]) if view.size != SE3.size else view


def _started(model: Any, T: Array, pose: Space, given: tuple[Array, Space], view: Space, worst: _Worst) -> None:
    """Check the landmarks that start from what is seen of them."""
    w, of = given
    l, L_T, L_w = model.from_view(T, w)
    space, where = model.space, f"T = {_show(T)}"
    _shape("from_view", "l", l, (BATCH, space.size))
    _shape("from_view", "L_T", L_T, (BATCH, space.dof, pose.dof))
    _shape("from_view", "L_v", L_w, (BATCH, space.dof, of.dof))
    for i, at in enumerate(w):
        one = at[None]
        worst.add("L_T", L_T[i], _differences(lambda x: model.from_view(x, one)[0][0], T, pose, space), where)  # noqa: B023
        worst.add("L_v", L_w[i], _differences(lambda x: model.from_view(T, x[None])[0][0], at, of, space), where)
    again = model.seen_from(T, l)[0]
    if isinstance(model, Segmented):  # the plane through both rays
        normal = np.cross(w[:, :3], w[:, 3:6])
        again, w = (n / np.linalg.norm(n, axis=1, keepdims=True) for n in (again, normal))
        view = Rn(3)
    error = np.array([view.minus(a, b[: view.size]) for a, b in zip(again, w, strict=True)])
    worst.add("seen_from(from_view(v)) = v", _unwrapped(error), np.zeros_like(error), where)


# ------------------------------------------------------------------ functions
def _function(f: Callable[..., Any], rng: Rng) -> list[Finding]:
    """Check a function f(x, ...) -> value, Jacobians in its arguments, in their order."""
    sizes, count = _sizes(f, rng)
    worst = _Worst()
    for _ in range(DRAWS):
        x = [float(rng.uniform(0.1, 2)) if size == 0 else rng.normal(0, 1, size) for size in sizes]
        where = ", ".join(f"{_show(np.array(one))}" for one in x)
        _, *jacobians = f(*x)
        for i, J in enumerate(jacobians[:count]):

            def value(one: Array, i: int = i, x: list[Any] = x) -> Array:
                return np.atleast_1d(f(*x[:i], one if sizes[i] else float(one[0]), *x[i + 1 :])[0])

            at = np.atleast_1d(x[i])
            expected = _differences(value, at, Rn(len(at)), Rn(len(value(at))))
            worst.add(f"Jacobian {i + 1}", np.reshape(J, expected.shape), expected, where)
    return worst.findings()


def _sizes(f: Callable[..., Any], rng: Rng) -> tuple[tuple[int, ...], int]:
    """Return the sizes of a function's arguments, 0 for a number, and how many have Jacobians."""
    try:
        own = inspect.signature(f).parameters.values()
    except (TypeError, ValueError):
        raise ModelError("got no Python function, expected f(x, ...) -> value, Jacobians") from None
    choices = [_choices(one) for one in own if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]
    for sizes in sorted(itertools.product(*choices), key=sum) if 1 <= len(choices) <= 3 else ():
        try:
            value, *jacobians = f(*(1.0 if n == 0 else rng.normal(0, 1, n) for n in sizes))
            shapes = [(np.size(value), max(n, 1)) for n in sizes[: len(jacobians)]]
            fits = np.ndim(value) < 2 and np.isfinite(value).all()
            if jacobians and fits and all(_fits(J, at) for J, at in zip(jacobians, shapes, strict=True)):
                return sizes, len(jacobians)
        except Exception:  # this only tries
            continue
    raise ModelError(
        "no sizes of up to three arguments give a value (m,) and Jacobians (m, n), expected such a function"
    )


def _choices(parameter: inspect.Parameter) -> Any:
    """Return the sizes that an argument may have: that of its default, a number's 0, or any."""
    if parameter.default is not parameter.empty:
        return (np.size(parameter.default) if np.ndim(parameter.default) else 0,)
    return (0,) if parameter.annotation in (float, "float") else range(1, LARGEST + 1)


def _fits(J: Any, shape: tuple[int, int]) -> bool:
    return np.shape(J) == shape or (1 in shape and np.shape(J) == (max(shape),) and np.ndim(J) == 1)


# ------------------------------------------------------------------ differences
SE3_ORIGIN = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
FACING = np.array([0.0, 0.0, 0.0, np.cos(0.3), 0.0, 0.0, -np.sin(0.3)])  # tilted: no tag like its mirror image


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


def _differences(f: Callable[[Array], Any], x: Array, of: Space, to: Space) -> Array:
    """Return d f / d x (to.dof, of.dof) by central differences in the errors of both spaces."""
    columns = []
    for i in range(of.dof):
        step = np.zeros(of.dof)
        step[i] = np.cbrt(np.finfo(float).eps) * max(1.0, abs(x[i]) if of.dof == of.size else 1.0)
        rise = to.minus(np.asarray(f(of.plus(x, step))), np.asarray(f(of.plus(x, -step))))
        columns.append(_unwrapped(rise) / (2 * step[i]))
    return np.stack(columns, axis=-1)


def _unwrapped(rise: Array) -> Array:
    return np.asarray(rise - 2 * np.pi * np.round(rise / (2 * np.pi)))


class _Worst:
    """The worst difference of each kind so far."""

    def __init__(self) -> None:
        self._found: dict[str, Finding] = {}

    def add(self, what: str, value: Array, expected: Array, where: str) -> None:
        """Compare a value with what was expected."""
        error = np.max(np.abs(value - expected) / (1.0 + np.abs(expected)), initial=0.0)
        self._keep(what, float("inf") if np.isnan(error) else float(error), where)

    def covariance(self, what: str, P: Any, size: int, where: str) -> None:
        """Check shape, symmetry and sign of a covariance."""
        P = np.asarray(P, dtype=np.float64)
        _shape(what, "covariance", P, (size, size))
        asymmetry = float(np.max(np.abs(P - P.T), initial=0.0))
        negative = max(0.0, -float(np.linalg.eigvalsh(P).min())) if np.isfinite(P).all() else float("inf")
        self._keep(f"{what} is a covariance", max(asymmetry, negative), where)

    def findings(self) -> list[Finding]:
        """Return one finding for each kind."""
        return list(self._found.values())

    def _keep(self, what: str, error: float, where: str) -> None:
        if what not in self._found or error > self._found[what].error:
            self._found[what] = Finding(what, error, where)


def _shape(method: str, what: str, value: Any, expected: tuple[int, ...]) -> None:
    if np.shape(value) != expected:
        raise ModelError(f"{method}: {what} has shape {np.shape(value)}, expected {expected}")


def _at(name: str, x: Array) -> str:
    return f"{name} = {_show(x)}"


def _show(x: Array) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in np.ravel(x)) + ")"
