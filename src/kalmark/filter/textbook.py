"""EKF-SLAM as the guide prints it: dense matrices, full-size Jacobians, nothing clever.  [S] 2 and C.3, [F] 11.3.

This is the reference that every fast path is tested against.  It is not what `Slam` runs on.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import inv_observe, move, observe

__all__ = ["TextbookSlam"]


class TextbookSlam:
    """One robot with a range-bearing sensor at its centre and points: x = (robot, landmarks), P their covariance.

    >>> slam = TextbookSlam(start=[0, 0, 0], Q=np.diag([0.1, 0.05]) ** 2, R=np.diag([0.1, 0.02]) ** 2)
    """

    def __init__(self, start: Any, Q: Any, R: Any, P: Any = None) -> None:
        """Start at the pose `start` with covariance P; Q (2, 2) is the noise of (forward, turn), R (2, 2) of (r, b)."""
        self.x = np.array(start, dtype=np.float64)  # (5): x = [R; M], no landmarks yet
        self.P = np.zeros((3, 3)) if P is None else np.array(P, dtype=np.float64)
        self.Q, self.R = np.asarray(Q, dtype=np.float64), np.asarray(R, dtype=np.float64)

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
        return (n - 3) // 2
