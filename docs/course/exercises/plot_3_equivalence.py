r"""
[T] 3: a start with a huge covariance is the start of [S]
=========================================================

Thrun's EKF-SLAM begins with all landmarks in the state, with the covariance :math:`C\,I` and :math:`C` huge. [T] proves
that the first observation of a landmark then gives, as :math:`C \to \infty`, what an augmentation gives, [S] (32)-(38):

.. math::

   K \to \begin{bmatrix} 0 \\ B^{-1} \end{bmatrix}, \qquad
   \Sigma_{kk} \to B^{-1} (A\,\Sigma_X A^\top + Q_t) B^{-\top}, \qquad \Sigma_{kX} \to -B^{-1} A\,\Sigma_X

with the Jacobians :math:`A` of the robot and :math:`B` of the landmark. :math:`F_{x,j}` puts both in their columns:
:math:`H = [A\; B]\,F_{x,j}`.
"""

# %%
# F_x,j and the table of C
# ------------------------
#
# A landmark is (x, y, s), with a signature s that is measured. The pose is uncertain; landmark 2 of 3 is observed.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km


def F(j, N):
    """Return F_x,j (6, 3N + 3): the columns of the robot and of landmark j = 1, ..., N."""
    return np.vstack([np.eye(3, 3 * N + 3), np.eye(3, 3 * N + 3, 3 * j)])


r, y, Q = np.array([1.0, 2.0, 0.3]), np.array([4.0, 0.5, 7.0]), np.diag([0.1, 0.02, 0.5]) ** 2
S, N, j = np.diag([0.3, 0.2, 0.1]) ** 2, 3, 2
l, A, B = km.geometry.inv_observe(r, y[:2])[0], np.zeros((3, 3)), np.eye(3)
_, A[:2], B[:2, :2] = km.geometry.observe(r, l)
H, B_inv = np.hstack([A, B]) @ F(j, N), np.linalg.inv(B)
exact, cross = B_inv @ (A @ S @ A.T + Q) @ B_inv.T, -B_inv @ A @ S
at, rows = slice(3 * j, 3 * j + 3), []
for C in 10.0 ** np.arange(0, 19):
    P = np.diag([*np.zeros(3), *np.full(3 * N, C)])
    P[:3, :3] = S
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + Q)
    P = P - K @ H @ P
    off = K[at] - B_inv, P[at, at] - exact, P[at, :3] - cross
    rows.append((C, *(abs(each).max() for each in off)))
    print("C = {:.0e}: gain {:.1e}, covariance {:.1e}, cross {:.1e}".format(*rows[-1]))

# %%
# Too small and too large
# -----------------------
#
# Left: :math:`F_{x,2}` of three landmarks, black is 1. Right: the difference falls as 1/C, as [T] proves. The
# covariance is the difference of two numbers as large as C, so beyond C = 10^7 rounding destroys it. The augmentation
# has no C.
figure, (shown, ax) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
shown.imshow(F(j, N), cmap="Greys")
shown.set(title="$F_{x,2}$", xlabel="column", ylabel="row")
C, gain, own, crosses = np.transpose(rows)
for values, name in ((gain, "gain"), (own, "covariance"), (crosses, "cross-covariance")):
    ax.loglog(C, values, "o-", ms=4, label=name)
ax.set(xlabel="C", ylabel="largest difference")
ax.legend()
plt.show()

# %%
# Try changing
# ------------
#
# * The symmetric form of the correction: ``L = np.eye(12) - K @ H`` and ``P = L @ P @ L.T + K @ Q @ K.T``. The
#   covariance is then exact to 1e-14 for all large C.
# * A pose that is known a hundred times better: ``S = np.diag([0.003, 0.002, 0.001]) ** 2``. The best C is the same; it
#   depends on the digits of the numbers.
