"""Textbook filters in plain NumPy, to read, to print and to change: dense matrices, full-size Jacobians.

`KalmanFilter` is Algorithm 11.3 of [F], `ExtendedKalmanFilter` the same for functions, `TextbookSlam` is EKF-SLAM as
[S] 2 and C.3 print it.  Each prints the result of every equation with `show=True`.  With the estimator `Textbook`, a
`Slam` runs on the last one, or on that of a copy of this file in which an equation is changed.  The other estimators
are faster forms, which are tested against these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, ClassVar

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.declare import class_of, declared, registered_name
from kalmark.errors import ModelError
from kalmark.filter.estimator_protocols import Correction, Movement, Update
from kalmark.filter.kernels import submatrix
from kalmark.filter.map import NO_SLOTS, Map, StochasticMap
from kalmark.filter.prediction import noise_in_world
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import inv_observe, move, observe
from kalmark.geometry.spaces import POINT2, Space
from kalmark.models.observe import linearize, step

__all__ = ["ExtendedKalmanFilter", "KalmanFilter", "Textbook", "TextbookSlam"]
COLUMNS = ("range_m", "bearing_rad")


class KalmanFilter:
    """The linear Kalman filter: x_i ~ N(D x_(i-1), Sigma_d) and y_i ~ N(M x_i, Sigma_m).  [F] Algorithm 11.3.

    D (n, n), M (m, n), Sigma_d (n, n), Sigma_m (m, m), the start x (n,) and Sigma (n, n) are attributes and may be
    changed between two steps.  Raises ModelError where the shapes do not fit.

    >>> kf = km.textbook.KalmanFilter(D=[[1.0]], M=[[1.0]], Sigma_d=[[1.0]], Sigma_m=[[2.0]], x=[0.0], Sigma=[[1.0]])
    >>> kf.predict()
    >>> kf.correct([3.0])
    >>> kf.x, kf.Sigma
    (array([1.5]), array([[1.]]))
    """

    def __init__(self, D: Any, M: Any, Sigma_d: Any, Sigma_m: Any, x: Any, Sigma: Any, show: bool = False) -> None:
        n, m = np.size(x), max(np.shape(Sigma_m), default=1)
        self.D, self.Sigma_d = _shaped("D", D, (n, n)), _shaped("Sigma_d", Sigma_d, (n, n))
        self.M, self.Sigma_m = _shaped("M", M, (m, n)), _shaped("Sigma_m", Sigma_m, (m, m))
        self.x, self.Sigma, self.show = _shaped("x", x, (n,)), _shaped("Sigma", Sigma, (n, n)), show

    def predict(self) -> None:
        """Predict the next state."""
        self.x = self.D @ self.x
        self.Sigma = self.Sigma_d + self.D @ self.Sigma @ self.D.T
        _print(self.show, {"x-": self.x, "Sigma-": self.Sigma})

    def correct(self, y: Any) -> None:
        """Correct the state by the measurement y (m,)."""
        z = _shaped("y", y, (len(self.M),)) - self.M @ self.x  # predicted from observed measurement
        K = self.Sigma @ self.M.T @ np.linalg.inv(self.M @ self.Sigma @ self.M.T + self.Sigma_m)
        self.x = self.x + K @ z
        self.Sigma = (np.eye(len(self.x)) - K @ self.M) @ self.Sigma
        _print(self.show, {"y - M x-": z, "K": K, "x+": self.x, "Sigma+": self.Sigma})


class ExtendedKalmanFilter:
    """The extended Kalman filter of any state, x_i = f(x_(i-1), n, ...) and y_i = g(x_i, n, ...).  [F]; [S] 2.3.

    x (n,) has covariance Sigma (n, n).  The noise n in f has covariance Sigma_n (p, p), that in g Sigma_m (q, q); what
    follows n is given to `predict` and `correct`.  A function returns its value, and its Jacobians are found by
    differences; or it returns (value, Jacobian of x, Jacobian of n).  `angles` are the indices of the angles in x,
    `angles_y` of those in y.  Raises ModelError where the shapes do not fit.

    >>> ekf = km.textbook.ExtendedKalmanFilter(
    ...     f=lambda x, n, u: x + u + n, g=lambda x, n: np.hypot(*x)[None] + n,
    ...     Sigma_n=0.01 * np.eye(2), Sigma_m=[[0.01]], x=[3.0, 4.0], Sigma=np.zeros((2, 2)))
    >>> ekf.predict([3.0, 4.0])
    >>> ekf.correct([10.1])
    >>> ekf.x.round(4)
    array([6.03, 8.04])
    """

    def __init__(
        self, f: Callable[..., Any], g: Callable[..., Any], Sigma_n: Any, Sigma_m: Any, x: Any, Sigma: Any,
        angles: Sequence[int] = (), angles_y: Sequence[int] = (), show: bool = False,
    ) -> None:  # fmt: skip
        self.f, self.g, self.angles, self.angles_y, self.show = f, g, list(angles), list(angles_y), show
        self.Sigma_n = _shaped("Sigma_n", Sigma_n, (max(np.shape(Sigma_n), default=1),) * 2)
        self.Sigma_m = _shaped("Sigma_m", Sigma_m, (max(np.shape(Sigma_m), default=1),) * 2)
        self.x, self.Sigma = _shaped("x", x, (np.size(x),)), _shaped("Sigma", Sigma, (np.size(x),) * 2)

    def predict(self, *given: Any) -> None:
        """Move the state by f(x, n, *given)."""
        self.x, F_x, F_n = _with_jacobians(self.f, self.x, len(self.Sigma_n), given, self.angles)  # [S] (9)
        self.x[self.angles] = wrap(self.x[self.angles])
        self.Sigma = F_x @ self.Sigma @ F_x.T + F_n @ self.Sigma_n @ F_n.T  # [S] (10)
        _print(self.show, {"x-": self.x, "F_x": F_x, "F_n": F_n, "Sigma-": self.Sigma})

    def correct(self, y: Any, *given: Any) -> None:
        """Correct by one measurement y (m,) = g(x, n, *given)."""
        self.correct_stacked([y], [given])

    def correct_stacked(self, ys: Any, given: Sequence[Any]) -> None:
        """Correct by K measurements (K, m) in one step; given[k] is the tuple that g takes for y_k.

        All are linearized at one estimate.  `correct` one after the other is the sequential form.
        """
        of_each = [_with_jacobians(self.g, self.x, len(self.Sigma_m), each, self.angles_y) for each in given]
        es = np.array([e for e, _, _ in of_each])
        zs = _shaped("y", ys, es.shape) - es  # [S] (19)
        zs[:, self.angles_y] = wrap(zs[:, self.angles_y])
        z, G_x = zs.ravel(), np.concatenate([each_x for _, each_x, _ in of_each])
        noise, m = np.zeros((len(z), len(z))), zs.shape[1]  # G_n Sigma_m G_n': block diagonal
        for k, (_, _, G_n) in enumerate(of_each):
            noise[m * k : m * (k + 1), m * k : m * (k + 1)] = G_n @ self.Sigma_m @ G_n.T
        Z = G_x @ self.Sigma @ G_x.T + noise  # [S] (20)
        K = self.Sigma @ G_x.T @ np.linalg.inv(Z)  # [S] (21)
        self.x = self.x + K @ z  # [S] (22)
        self.x[self.angles] = wrap(self.x[self.angles])
        self.Sigma = (np.eye(len(self.x)) - K @ G_x) @ self.Sigma  # [S] (23)
        _print(self.show, {"z": z, "G_x": G_x, "Z": Z, "K": K, "x+": self.x, "Sigma+": self.Sigma})

    def augment(self, h: Callable[..., Any], Sigma: Any, *given: Any) -> None:
        """Add what h(x, n, *given) returns (p,) to the state, with n ~ N(0, Sigma).  [S] (32)-(38)."""
        l, H_x, H_n = _with_jacobians(h, self.x, len(Sigma), given)
        cross = H_x @ self.Sigma  # [S] (36)
        own = cross @ H_x.T + H_n @ np.asarray(Sigma) @ H_n.T  # [S] (35)
        self.x, self.Sigma = np.concatenate([self.x, l]), np.block([[self.Sigma, cross.T], [cross, own]])
        _print(self.show, {"H_x": H_x, "H_n": H_n, "x": self.x, "Sigma": self.Sigma})


class TextbookSlam:
    """One robot with a range-bearing sensor and points: x = (robot, landmarks), P their covariance.  [S] 2, C.3.

    `move`, `observe` and `inv_observe` are the models of a robot (x, y, heading) with the sensor at its centre, those
    of `kalmark.geometry`, and may be replaced.  The last correction has left e, z, Z and K.

    >>> slam = km.textbook.TextbookSlam(start=[0, 0, 0], Q=np.diag([0.1, 0.05]) ** 2, R=np.diag([0.1, 0.02]) ** 2)
    >>> slam.initialize([2.0, 0.5])
    0
    >>> slam.predict([1.0, 0.0])
    >>> slam.correct(0, [1.2, 0.9])
    True
    >>> slam.x.round(3)
    array([0.999, 0.   , 0.003, 1.75 , 0.953])
    """

    def __init__(self, start: Any, Q: Any, R: Any, P: Any = None, show: bool = False) -> None:
        """Start at the pose `start` with covariance P; Q (2, 2) is the noise of (forward, turn), R (2, 2) of (r, b)."""
        self.x = np.array(start, dtype=np.float64)  # (5): x = [R; M], no landmarks yet
        self.m = m = len(self.x)  # numbers of R
        self.P = np.zeros((m, m)) if P is None else np.array(P, dtype=np.float64)
        self.Q, self.R, self.show = np.asarray(Q, dtype=np.float64), np.asarray(R, dtype=np.float64), show
        self.move: Callable[..., Any] = move
        self.observe: Callable[..., Any] = observe
        self.inv_observe: Callable[..., Any] = inv_observe
        self.e = self.z = np.full(2, np.nan)
        self.Z, self.K = np.full((2, 2), np.nan), np.zeros((m, 2))

    def predict(self, u: Any) -> None:
        """Move the robot by u = (forward, turn)."""
        m, n, q = self.m, len(self.x), len(self.Q)
        r, F_r, F_n = self.move(self.x[:m], u, np.zeros(q))
        F = np.eye(n)  # (13)
        F[:m, :m] = F_r
        G = np.zeros((n, q))
        G[:m] = F_n
        self.x[:m] = r  # (9)
        self.P = F @ self.P @ F.T + G @ self.Q @ G.T  # (10)
        _print(self.show, {"x (9)": self.x, "F_r (12)": F_r, "F_n (12)": F_n, "P (10)": self.P})

    def expect(self, i: int) -> tuple[Array, Array]:
        """Return the expectation e (2,) of landmark i and its full-size Jacobian H (2, n)."""
        at = self.m + 2 * i
        e, E_r, E_l = self.observe(self.x[: self.m], self.x[at : at + 2])
        H = np.zeros((2, len(self.x)))  # (25)
        H[:, : E_r.shape[1]], H[:, at : at + 2] = E_r, E_l
        return e, H

    def correct(self, i: int, y: Any, gate: float = 9.0) -> bool:
        """Correct with the observation y = (range, bearing) of landmark i; return whether it passed the gate."""
        e, H = self.expect(i)
        z = np.asarray(y) - e  # (19)
        z[1] = wrap(z[1])
        Z = H @ self.P @ H.T + self.R  # (20)
        self.e, self.z, self.Z = e, z, Z
        if not z @ np.linalg.inv(Z) @ z < gate:  # (83)
            return False
        K = self.K = self.P @ H.T @ np.linalg.inv(Z)  # (21)
        self.x = self.x + K @ z  # (22)
        self.x[2] = wrap(self.x[2])
        self.P = self.P - K @ Z @ K.T  # (23)
        _print(self.show, {"z (19)": z, "H (25)": H, "Z (20)": Z, "K (21)": K, "x (22)": self.x, "P (23)": self.P})
        return True

    def initialize(self, y: Any) -> int:
        """Add the landmark observed at y = (range, bearing); return its number."""
        m, n = self.m, len(self.x)
        l, L_r, L_y = self.inv_observe(self.x[:m], np.asarray(y, dtype=np.float64))  # (32)-(34)
        G = np.zeros((2, n))
        G[:, : L_r.shape[1]] = L_r
        P_Lx = G @ self.P  # (36)
        P_LL = P_Lx @ G.T + L_y @ self.R @ L_y.T  # (35)
        self.x = np.concatenate([self.x, l])  # (37)
        self.P = np.block([[self.P, P_Lx.T], [P_Lx, P_LL]])  # (38)
        _print(self.show, {"P_LL (35)": P_LL, "P_Lx (36)": P_Lx, "x (37)": self.x, "P (38)": self.P})
        return (n - m) // 2


@declared
class Textbook:
    """EKF-SLAM as the guide prints it, in dense NumPy: to step through, and to change in a copy of its file.

    Each step is done by `TextbookSlam` with the configured motion and sensor: range and bearing to points of the plane
    with known ids, by one robot.  Fixes, and landmarks known exactly, are fused by `Ekf`.

    >>> rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    >>> scan = km.Scan(0.1, "rover", "lidar", [[4.0, 0.3], [2.0, -1.0]], ids=[7, 8])
    >>> events = [km.Control(0.0, "rover", (0.5, 0.1)), scan]
    >>> slam = km.Slam(rover, estimator=Textbook())
    >>> reports = [slam.process(event) for event in events]
    >>> slam.mean("rover").round(3), slam.mean(7).round(2)
    (array([0.05, 0.  , 0.01]), array([3.86, 1.22]))
    """

    show: Annotated[bool, "Print the result of each equation."] = False

    coordinates: ClassVar[str] = "world"
    default_gate: ClassVar[float] = 9.0

    def refuse_misfits(
        self, robots: Mapping[str, Any], channels: Mapping[Any, Any], policies: Mapping[Any, Any]
    ) -> None:
        """Raise ModelError if robots, sensors or landmarks are others than those of the guide."""
        for misfit in _misfits(robots, channels, policies):
            raise ModelError(f"estimator {registered_name(type(self)) or type(self).__name__}: {misfit}")

    def predict(self, map_: Map, movement: Movement) -> bool:
        """Move a robot; return whether all of it is finite: if not, nothing has changed.  [S] (9)-(10)."""
        model, robot, added, shared, begins, B, u, N, D, dt_s = movement
        m, robot, _, slots = map_.movable(robot, added)
        size, c, d = len(m.index(robot)), len(u), len(D)
        book, order = self._opened(m, [robot, *slots.tolist()])  # what changes the control is behind the robot's own
        error = np.arange(size, size + c if begins else size)  # what was there before has no effect
        book.x[error] = 0.0
        r, R_r, R_u = step(model, book.x[:size], u + B @ book.x[size : book.m], dt_s)
        F_r, F_n, Q = np.eye(book.m), np.zeros((book.m, c + d)), np.zeros((c + d, c + d))
        F_r[:size, :size], F_r[:size, size:] = R_r, R_u @ B
        F_n[:size, :c], F_n[:d, c:] = R_u, np.eye(d)
        F_r[:, error], F_n[error, : len(error)] = 0.0, np.eye(len(error))
        Q[:c, :c] = 0.0 if shared and not begins else N
        Q[c:, c:] = noise_in_world(r, D) if d else D
        book.Q, book.move = Q, lambda x, _u, _n: (np.concatenate([r, x[size:]]), F_r, F_n)
        book.predict(u)
        if not (np.isfinite(book.x).all() and np.isfinite(book.P).all()):
            return False
        _write(m, book, order)
        m.set_predicted(robot, book.x[:size])
        return True

    def correct(self, map_: Map, update: Update) -> Correction:
        """Fuse a scan, one landmark after the other.  [S] (19)-(25)."""
        y, R = update.y, update.R
        m, robot, _, slots = map_.opened(update.robot, -1, update.slots, False)
        number = {slot: i for i, slot in enumerate(dict.fromkeys(slots.tolist()))}
        book, order = self._opened(m, [robot], [*number])
        e, z, Z, d2 = np.full_like(y, np.nan), np.full_like(y, np.nan), R.copy(), np.full(len(y), np.nan)
        fused = np.zeros(len(y), dtype=np.bool_)
        for k, slot in enumerate(slots.tolist()):
            book.R, book.observe = R[k], partial(_observed, update.model, y[k])
            try:
                fused[k] = book.correct(number[slot], y[k], update.gate)
            except np.linalg.LinAlgError:  # Z is singular: d2 stays NaN
                continue
            e[k], z[k], Z[k] = book.e, book.z, book.Z
            d2[k] = z[k] @ np.linalg.solve(Z[k], z[k])
        _write(m, book, order)
        map_.finish_correction(update.robot, False)
        return Correction(e, z, Z, d2, fused, bool((d2 >= 0.0).all()))

    def initialize(self, map_: Map, robot: int, space: Space, l: Array, L_r: Array, Q: Array) -> int:
        """Add a landmark l (2,) with L_r (2, 3) by the robot's pose and noise Q (2, 2); return its slot.  [S] (37)."""
        slot = map_.add(space, l)
        m, robot_here, _, new = map_.opened(robot, -1, np.array([slot]), False)
        book, order = self._opened(m, [robot_here], new=new.tolist())
        book.R, book.inv_observe = Q, lambda _r, _y: (l, L_r, np.eye(2))
        book.initialize(l)
        _write(m, book, order)
        map_.finish_correction(robot, False)
        return slot

    def _opened(
        self, m: StochasticMap, robot: list[int], landmarks: Sequence[int] = (), new: Sequence[int] = ()
    ) -> tuple[TextbookSlam, Index]:  # fmt: skip
        """Return the filter that has the map's x and P but for `new` blocks, and the order of their rows in it.

        First come the blocks of the robot, then those landmarks, then all others; those that are `new` are the last.
        """
        own, seen, added = (np.concatenate([NO_SLOTS, *map(m.index, slots)]) for slots in (robot, landmarks, new))
        rest = np.setdiff1d(np.arange(m.n), np.concatenate([own, seen, added]))
        order = np.concatenate([own, seen, rest])
        book = TextbookSlam(m.x[own], np.eye(2), np.eye(2), show=self.show)
        book.x, book.P = m.x[order], submatrix(m.P, order)
        return book, np.concatenate([order, added])

    def for_fixes(self) -> Any:
        """Return the estimator that fuses absolute positions."""
        return class_of("estimator", "ekf")()

    def pose_jacobian(self, map_: Map, robot: int, J: Array) -> Array:
        """Return J as it is: everything is linearised at the estimate."""
        return J


def _with_jacobians(
    function: Callable[..., Any], x: Array, q: int, given: Sequence[Any], angles: Sequence[int] = ()
) -> tuple[Array, Array, Array]:
    """Return function(x, 0, *given) (k,), its Jacobian of x (k, n) and that of the noise (k, q)."""
    zero, step = np.zeros(q), 1e-6
    value = function(x, zero, *given)
    if isinstance(value, tuple):
        k = len(value[0])
        V_x, V_n = _shaped("Jacobian of x", value[1], (k, len(x))), _shaped("Jacobian of n", value[2], (k, q))
        return np.array(value[0], dtype=np.float64), V_x, V_n

    def differences(at: Callable[[Array], Any], size: int) -> Array:
        rises = np.array([np.subtract(at(d), at(-d)) for d in step * np.eye(size)]).T
        rises[list(angles)] = wrap(rises[list(angles)])
        return rises / (2 * step)

    V_x = differences(lambda d: function(x + d, zero, *given), len(x))
    return np.array(value, dtype=np.float64), V_x, differences(lambda d: function(x, d, *given), q)


def _shaped(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """Return a copy of an array.  Raises ModelError if it has another shape."""
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise ModelError(f"{name}: an array {array.shape}, expected {shape}")
    return array


def _print(show: bool, results: dict[str, Array]) -> None:
    """Print arrays with their names, if this is to be shown."""
    for name, value in results.items() if show else ():
        print(f"{name} =\n{np.round(value, 4)}")


# ---------------------------------------------------------------------- the map of a Slam
def _misfits(
    robots: Mapping[str, Any], channels: Mapping[Any, Any], policies: Mapping[Any, Any]
) -> Iterator[str]:  # fmt: skip
    """Yield what the guide's filter is not made for, and what is expected."""
    if len(robots) > 1:
        yield f"robots are {', '.join(robots)}, expected one"
    for name, robot in robots.items():
        if robot.motion.space.world != "plane":
            yield f"robots.{name}.motion is a {type(robot.motion).__name__} of space, expected one of the plane"
        for key, mount in robot.sensors.items():
            if tuple(mount.sensor.columns) != COLUMNS:
                what = f"robots.{name}.sensors.{key} is a {type(mount.sensor).__name__}"
                yield f"{what} of {', '.join(mount.sensor.columns)}, expected one of {', '.join(COLUMNS)}"
    for (name, key), channel in channels.items():
        policy, what = policies[name, key], f"robots.{name}.sensors.{key}"
        if registered_name(type(policy.association)) != "identity":
            yield f"association of {what} is {type(policy.association).__name__}, expected identity: known ids"
        if channel.landmark.space != POINT2:
            yield f"landmarks of {what} are {channel.landmark.kind}, expected point"
        if channel.mount >= 0:
            yield f"mount of {what} is estimated with the map, expected no sigmas of it and its parameters"
        if policy.delayed is not None or policy.deferred is not None:
            yield f"initialization of {what} is late, expected immediate"


def _observed(model: Any, y: Array, x: Array, l: Array) -> tuple[Array, Array, Array]:
    """Return the expectation e (2,) of a landmark l (2,), and E_r (2, 3), E_l (2, 2), by a model of observations."""
    e, _, E_r, E_l = linearize(model, x[:3].copy(), l[None].copy(), y[None].copy())
    return e[0], E_r[0], E_l[0]


def _write(m: StochasticMap, book: TextbookSlam, order: Index) -> None:
    """Write x and P of a filter, whose rows are those of a map in this order, into the map."""
    P = np.zeros((m.n, m.n))
    P[np.ix_(order, order)] = book.P
    m.x[order], m.P[: m.n, : m.n] = book.x, np.tril(P)
