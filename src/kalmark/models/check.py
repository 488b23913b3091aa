"""Check a model of one's own: its shapes, and its Jacobians against central differences."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import ModelError
from kalmark.models.pointwise import jacobian

Array = npt.NDArray[np.float64]

TOLERANCE = 1e-5
DRAWS = 200


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


def check_model(model: Any, rng: np.random.Generator) -> list[Finding]:
    """Return one finding for each thing that a motion, sensor or landmark model promises.

    Raises ModelError if it is none of the three, or returns the wrong shapes.
    """
    for method, check in (("move", _motion), ("expect", _sensor), ("seen_from", _landmark)):
        if hasattr(model, method):
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)
                return check(model, rng)
    raise ModelError(f"{type(model).__name__}: expected a model with one of the methods move, expect and seen_from")


def _motion(model: Any, rng: np.random.Generator) -> list[Finding]:
    k = len(model.columns)
    worst = _Worst()
    for draw in range(DRAWS):
        r = rng.normal(0, [5.0, 5.0, 1.5])
        u = rng.normal(0, 1, k) * 10.0 ** rng.uniform(-6, 0.3) * (draw > 0)
        u[rng.uniform(size=k) < 0.2] = 0.0
        dt_s = float(rng.uniform(0.01, 2))
        where = f"r = {_show(r)}, u = {_show(u)}, dt_s = {dt_s:.3g}"
        moved, R_r, R_u = model.move(r, u, dt_s)
        _shape("move", "state", moved, (3,))
        _shape("move", "R_r", R_r, (3, 3))
        _shape("move", "R_u", R_u, (3, k))
        angular = (False, False, True)
        worst.add("R_r", R_r, jacobian(lambda x: model.move(x, u, dt_s)[0], r, angular), where)  # noqa: B023
        worst.add("R_u", R_u, jacobian(lambda x: model.move(r, x, dt_s)[0], u, angular), where)  # noqa: B023
        worst.covariance("control_noise", model.control_noise(u), k, where)
        diffusion = model.diffusion(u, dt_s)
        if diffusion is not None:
            worst.covariance("diffusion", diffusion, 3, where)
    return worst.findings()


def _sensor(model: Any, rng: np.random.Generator) -> list[Finding]:
    m = len(model.columns)
    angular = np.array(model.angular, dtype=bool)
    if len(angular) != m:
        raise ModelError(f"angular has {len(angular)} entries for {m} columns, expected one each")
    worst = _Worst()
    d = _size_of_view(model, rng)
    v = _views(rng, d)
    e, E_v = model.expect(v)
    _shape("expect", "e", e, (DRAWS, m))
    _shape("expect", "E_v", E_v, (DRAWS, m, d))
    _batch(worst, "E_v", lambda x: model.expect(x)[0], E_v, v, "v", tuple(angular.tolist()))
    y = e
    if hasattr(model, "invert"):
        y = _inside(model.invert, e)
        back, V_y = model.invert(y)
        _shape("invert", "v", back, (len(y), d))
        _shape("invert", "V_y", V_y, (len(y), d, m))
        _batch(worst, "V_y", lambda x: model.invert(x)[0], V_y, y, "y")
        again = _wrapped(model.expect(back)[0] - y, angular)
        worst.add("expect(invert(y)) = y", again, np.zeros_like(y), "all draws")
    R = model.noise(y)
    _shape("noise", "R", R, (len(y), m, m))
    for one, at in zip(R, y, strict=True):
        worst.covariance("noise", one, m, f"y = {_show(at)}")
    return worst.findings()


def _views(rng: np.random.Generator, d: int) -> Array:
    return rng.normal(0, 1, (DRAWS, d)) * 10.0 ** rng.uniform(-1, 1, (DRAWS, 1))


def _size_of_view(model: Any, rng: np.random.Generator) -> int:
    """Return how many numbers a view has, 2 or 3: what the sensor takes and, if it can, gives back."""
    taken = []
    for d in (2, 3):
        try:
            e, E_v = model.expect(_views(rng, d))
            if np.shape(E_v) == (*np.shape(e), d) and np.shape(e)[1] == len(model.columns):
                taken.append(d)
                if not hasattr(model, "invert") or np.shape(model.invert(e)[0]) == (DRAWS, d):
                    return d
        except Exception:  # this only tries; what is wrong shows when the model is called in earnest
            continue
    return taken[0] if taken else 2


def _inside(invert: Callable[[Array], tuple[Array, Array]], y: Array) -> Array:
    """Return the measurements that can be inverted all around, too; all of them if there are none.

    On the border of what a sensor can measure (a sine of 1) the differences would leave it.
    """
    around = 1e-3 * np.vstack([np.eye(y.shape[1]), -np.eye(y.shape[1])])
    kept = [one for one in y if not _finite(invert, one[None]) or _finite(invert, one + around * (1 + np.abs(one)))]
    return np.array(kept) if kept else y


def _finite(invert: Callable[[Array], tuple[Array, Array]], y: Array) -> bool:
    try:
        return bool(np.isfinite(invert(y)[0]).all())
    except (ValueError, ArithmeticError):
        return False


def _landmark(model: Any, rng: np.random.Generator) -> list[Finding]:
    n = model.space.size
    worst = _Worst()
    for _ in range(DRAWS // 10):
        T = rng.normal(0, [5.0, 5.0, 1.5])
        l = rng.normal(0, 5, (10, n))
        v, V_T, V_l = model.seen_from(T, l)
        d = v.shape[1] if v.ndim == 2 else n
        _shape("seen_from", "v", v, (10, d))
        _shape("seen_from", "V_T", V_T, (10, d, 3))
        _shape("seen_from", "V_l", V_l, (10, d, n))
        where = f"T = {_show(T)}"
        worst.add("V_T", V_T, jacobian(lambda x: model.seen_from(x, l)[0].ravel(), T).reshape(V_T.shape), where)  # noqa: B023
        _batch(worst, "V_l", lambda x: model.seen_from(T, x)[0], V_l, l, "l")  # noqa: B023
        if hasattr(model, "from_view"):
            back, L_T, L_v = model.from_view(T, v)
            _shape("from_view", "L_T", L_T, (10, n, 3))
            _shape("from_view", "L_v", L_v, (10, n, d))
            worst.add("from_view(seen_from(l)) = l", back, l, where)
            worst.add("L_T", L_T, jacobian(lambda x: model.from_view(x, v)[0].ravel(), T).reshape(L_T.shape), where)  # noqa: B023
            _batch(worst, "L_v", lambda x: model.from_view(T, x)[0], L_v, v, "v")  # noqa: B023
    return worst.findings()


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


def _batch(
    worst: _Worst,
    what: str,
    function: Callable[[Array], Array],
    J: Array,
    x: Array,
    name: str,
    angular: tuple[bool, ...] = (),
) -> None:
    """Compare the Jacobians J (K, m, d) of a batched function with differences, one row of x (K, d) at a time."""
    for one, at in zip(J, x, strict=True):
        worst.add(what, one, jacobian(lambda p: function(p[None])[0], at, angular), f"{name} = {_show(at)}")


def _wrapped(difference: Array, angular: npt.NDArray[np.bool_]) -> Array:
    turned = np.mod(difference + np.pi, 2 * np.pi) - np.pi
    return np.where(angular, turned, difference)


def _shape(method: str, what: str, value: Any, expected: tuple[int, ...]) -> None:
    if np.shape(value) != expected:
        raise ModelError(f"{method}: {what} has shape {np.shape(value)}, expected {expected}")


def _show(x: Array) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in np.ravel(x)) + ")"
