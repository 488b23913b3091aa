r"""
[F] The Kalman filter with your own D and M
===========================================

Algorithm 11.3 for a linear model :math:`x_i \sim N(D x_{i-1}, \Sigma_d)`, :math:`y_i \sim N(M x_i, \Sigma_m)`:

.. math::

   \bar x_i^- &= D \bar x_{i-1}^+ & \Sigma_i^- &= \Sigma_d + D \Sigma_{i-1}^+ D^\top \\
   K_i &= \Sigma_i^- M^\top (M \Sigma_i^- M^\top + \Sigma_m)^{-1} \\
   \bar x_i^+ &= \bar x_i^- + K_i (y_i - M \bar x_i^-) & \Sigma_i^+ &= (I - K_i M) \Sigma_i^-

*Misprint:* the slides write :math:`D_i \Sigma_{i-1}^+ D_i`, without the transpose.
"""

# %%
# A cart on a rail
# ----------------
#
# The state is position and speed; the position is measured every fourth step. ``show=True`` prints every equation.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

rng, dt = np.random.default_rng(0), 0.25
D, M = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[1.0, 0.0]])
Sigma_d, Sigma_m = 0.1 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.array([[0.25]])
kf = km.textbook.KalmanFilter(D, M, Sigma_d, Sigma_m, x=[0, 0], Sigma=np.diag([1.0, 1.0]))
true, rows, measured = np.array([0.5, 0.8]), [], []
for i in range(80):
    kf.show = i == 3
    true = D @ true + rng.multivariate_normal([0, 0], Sigma_d)
    kf.predict()
    rows.append((i * dt, *kf.x, *np.sqrt(np.diag(kf.Sigma)), *true))
    if i % 4 == 3:
        measured.append((i * dt, *(M @ true + rng.multivariate_normal([0], Sigma_m))))
        kf.correct(measured[-1][1:])
        rows.append((i * dt, *kf.x, *np.sqrt(np.diag(kf.Sigma)), *true))

# %%
# Prediction widens, correction narrows
# -------------------------------------
#
# The band is 2 sigma. The speed is never measured; it is found through its correlation with the position.
t, position, speed, s_x, s_v, p_true, v_true = np.array(rows).T
figure, axes = plt.subplots(2, 1, figsize=(8, 5.5), layout="constrained", sharex=True)
for ax, x, s, truth in zip(axes, (position, speed), (s_x, s_v), (p_true, v_true), strict=True):
    ax.fill_between(t, x - 2 * s, x + 2 * s, alpha=0.25, lw=0)
    ax.plot(t, x, label="estimate")
    ax.plot(t, truth, "k--", lw=1, label="truth")
axes[0].plot(*np.transpose(measured), "r.", label="measurements")
print("last sigmas:", s_x[-1].round(2), "m,", s_v[-1].round(2), "m/s; largest:", s_x.max().round(1), "m")
axes[0].legend()
axes[0].set_ylabel("position [m]")
axes[1].set(xlabel="t [s]", ylabel="speed [m/s]")
plt.show()

# %%
# Try changing
# ------------
#
# * A better sensor: ``Sigma_m = np.array([[0.01]])``. The last sigma of the position falls from 0.41 m to 0.10 m,
#   that of the speed only from 0.37 m/s to 0.23 m/s: between two measurements the speed changes.
# * A measurement of the speed: ``M = np.array([[0.0, 1.0]])``. The sigma of the position grows without bound.
# * A measurement every 20th step: ``i % 20 == 19``. The sigma of the position reaches 5.5 m.
