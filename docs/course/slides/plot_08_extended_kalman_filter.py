r"""
[F] The extended Kalman filter with your own f and g
====================================================

If the update of the state or the measurement is not linear, :math:`x_i = f(x_{i-1}, n)` and :math:`y_i = g(x_i, n)`,
the slides linearize both. Each line of Algorithm 11.3 then has a Jacobian in place of :math:`D` and :math:`M`:

.. math::

   \bar x_i^- &= f(\bar x_{i-1}^+, 0) & \Sigma_i^- &= F_x \Sigma_{i-1}^+ F_x^\top + F_n \Sigma_n F_n^\top \\
   K_i &= \Sigma_i^- G_x^\top (G_x \Sigma_i^- G_x^\top + G_n \Sigma_m G_n^\top)^{-1} \\
   \bar x_i^+ &= \bar x_i^- + K_i (y_i - g(\bar x_i^-, 0)) & \Sigma_i^+ &= (I - K_i G_x) \Sigma_i^-

*Misprints:* the last slide still has :math:`M_i^\top` in the gain; the mean of :math:`y_i` is printed as
:math:`f(x_i, 0)`.
"""

# %%
# A pendulum
# ----------
#
# The state is angle and angular rate. The noise :math:`n` is an acceleration; what is measured is the height of the
# weight, which does not determine the side. ``f`` returns its value, and its Jacobians are found by differences; ``g``
# returns them itself.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km

rng, dt = np.random.default_rng(1), 0.05


def f(x, n):
    rate = x[1] + dt * (-9.81 * np.sin(x[0]) + n[0])
    return np.array([x[0] + dt * rate, rate])


def g(x, n):
    return np.array([1 - np.cos(x[0]) + n[0]]), np.array([[np.sin(x[0]), 0]]), np.eye(1)


noise = {"Sigma_n": [[0.5**2]], "Sigma_m": [[0.2**2]]}
start = {"x": [0.8, 0], "Sigma": np.diag([0.3, 0.3]) ** 2}
ekf = km.textbook.ExtendedKalmanFilter(f, g, **noise, **start)
true, rows = np.array([1.1, 0.0]), []
for i in range(120):
    true = f(true, 0.5 * rng.normal(size=1))
    ekf.show = i == 0  # prints each equation of the first step
    ekf.predict()
    ekf.correct(g(true, 0.2 * rng.normal(size=1))[0])
    rows.append((i * dt, *ekf.x, *np.sqrt(np.diag(ekf.Sigma)), *true))

# %%
# Angle and rate
# --------------
#
# The band is 2 sigma. The rate is never measured. At the lowest point :math:`G_x` is zero, and the measurement has
# no information; it is the motion that carries the estimate through.
t, angle, rate, s_angle, s_rate, true_angle, true_rate = np.array(rows).T
print(f"last sigmas: {s_angle[-1]:.3f} rad, {s_rate[-1]:.3f} rad/s")
figure, axes = plt.subplots(2, 1, figsize=(8, 5), layout="constrained", sharex=True)
shown = (angle, s_angle, true_angle), (rate, s_rate, true_rate)
for ax, (x, s, truth) in zip(axes, shown, strict=True):
    ax.fill_between(t, x - 2 * s, x + 2 * s, alpha=0.25, lw=0)
    ax.plot(t, x, label="estimate")
    ax.plot(t, truth, "k--", lw=1, label="truth")
axes[0].set(ylabel="angle [rad]")
axes[1].set(xlabel="t [s]", ylabel="rate [rad/s]")
figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=2)
plt.show()

# %%
# Try changing
# ------------
#
# * A start on the wrong side: ``"x": [-0.8, 0]``. The whole estimate is the mirror image of the right one, with the
#   same sigmas. The measurement fits both sides; a filter has one mean, and it stays on its side.
# * A better sensor: ``[[0.02**2]]`` and ``0.02 * rng``. The last sigma of the angle falls from 0.070 to 0.020 rad.
# * A single number for the height: ``1 - np.cos(x[0]) + n[0]`` in brackets is an array of one. ``g`` may return two
#   numbers as well; ``Sigma_m`` then has two rows.
