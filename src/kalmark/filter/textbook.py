"""Textbook filters in plain NumPy, to read, to print and to change: dense matrices, full-size Jacobians.

`KalmanFilter` is Algorithm 11.3 of [F], `ExtendedKalmanFilter` the same for functions, `TextbookSlam` is EKF-SLAM as
[S] 2 and C.3 print it.  Each prints the result of every equation with `show=True`.  `Slam` does not run on these: its
faster forms are tested against them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import ModelError
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import inv_observe, move, observe

__all__ = ["ExtendedKalmanFilter", "KalmanFilter", "TextbookSlam"]


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
    """One robot with a range-bearing sensor at its centre and points: x = (robot, landmarks), P their covariance.

    >>> slam = TextbookSlam(start=[0, 0, 0], Q=np.diag([0.1, 0.05]) ** 2, R=np.diag([0.1, 0.02]) ** 2)
    """

    def __init__(self, start: Any, Q: Any, R: Any, P: Any = None, show: bool = False) -> None:
        """Start at the pose `start` with covariance P; Q (2, 2) is the noise of (forward, turn), R (2, 2) of (r, b)."""
        self.x = np.array(start, dtype=np.float64)  # (5): x = [R; M], no landmarks yet
        self.P = np.zeros((3, 3)) if P is None else np.array(P, dtype=np.float64)
        self.Q, self.R, self.show = np.asarray(Q, dtype=np.float64), np.asarray(R, dtype=np.float64), show

    def predict(self, u: Any) -> None:
        """Move the robot by u = (forward, turn)."""
        n = len(self.x)
        r, F_r, F_n = move(self.x[:3], u, np.zeros(2))
        F = np.eye(n)  # (13)
        F[:3, :3] = F_r
        G = np.zeros((n, 2))
        G[:3] = F_n
        self.x[:3] = r  # (9)
        self.P = F @ self.P @ F.T + G @ self.Q @ G.T  # (10)
        _print(self.show, {"x (9)": self.x, "F_r (12)": F_r, "F_n (12)": F_n, "P (10)": self.P})

    def expect(self, i: int) -> tuple[Array, Array]:
        """Return the expectation e (2,) of landmark i and its full-size Jacobian H (2, n)."""
        at = 3 + 2 * i
        e, E_r, E_l = observe(self.x[:3], self.x[at : at + 2])
        H = np.zeros((2, len(self.x)))  # (25)
        H[:, :3], H[:, at : at + 2] = E_r, E_l
        return e, H

    def correct(self, i: int, y: Any, gate: float = 9.0) -> bool:
        """Correct with the sighting y = (range, bearing) of landmark i; return whether it passed the gate."""
        e, H = self.expect(i)
        z = np.asarray(y) - e  # (19)
        z[1] = wrap(z[1])
        Z = H @ self.P @ H.T + self.R  # (20)
        if z @ np.linalg.inv(Z) @ z >= gate:  # (83)
            return False
        K = self.P @ H.T @ np.linalg.inv(Z)  # (21)
        self.x = self.x + K @ z  # (22)
        self.x[2] = wrap(self.x[2])
        self.P = self.P - K @ Z @ K.T  # (23)
        _print(self.show, {"z (19)": z, "H (25)": H, "Z (20)": Z, "K (21)": K, "x (22)": self.x, "P (23)": self.P})
        return True

    def initialize(self, y: Any) -> int:
        """Add the landmark sighted at y = (range, bearing); return its number."""
        n = len(self.x)
        l, L_r, L_y = inv_observe(self.x[:3], np.asarray(y, dtype=np.float64))  # (32)-(34)
        G = np.zeros((2, n))
        G[:, :3] = L_r
        P_Lx = G @ self.P  # (36)
        P_LL = P_Lx @ G.T + L_y @ self.R @ L_y.T  # (35)
        self.x = np.concatenate([self.x, l])  # (37)
        self.P = np.block([[self.P, P_Lx.T], [P_Lx, P_LL]])  # (38)
        _print(self.show, {"P_LL (35)": P_LL, "P_Lx (36)": P_Lx, "x (37)": self.x, "P (38)": self.P})
        return (n - 3) // 2


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
