r"""
Choosing the noise
==================

A filter is as good as its noise. The normalised innovation squared, :math:`z^\top Z^{-1} z`, is 1 per degree of
freedom where the stated noise is that of the data, and it needs no truth.
"""

# %%
# Three noises for one log
# ------------------------
#
# The simulated ranges have a standard deviation of 0.1 m. The filter states a third of it, itself and the triple. The
# errors and the pose NEES (3 on average where consistent) need the truth; a real log has only the NIS.
import matplotlib.pyplot as plt
import numpy as np

import kalmark as km
from kalmark.config import build_slam
from kalmark.simulate import load_world, simulate

world = load_world("random_field", ["steps=300"])
log = simulate(world, seed=4)
figure, ax = plt.subplots(figsize=(8, 3.2), layout="constrained")
for sigma in (0.033, 0.1, 0.3):
    key = "filter.robots.rover.sensors.lidar"
    said = [f"{key}.sigma_range_m={sigma}", f"{key}.sigma_bearing_rad={sigma / 5}", "steps=300"]
    run = km.record(build_slam(load_world("random_field", said).config(), log), log, progress=False)
    told = run.evaluate()
    nis = run.history.d2[np.isfinite(run.history.d2)] / 2
    ax.plot(np.convolve(nis, np.ones(200) / 200, "valid"), label=f"{sigma} m")
    nees = told["robots"]["rover"]["pose_nees"]
    print(f"sigma {sigma:5} m: NIS {told['nis_per_dof']:.2f}, pose NEES {nees:.1f}")
ax.axhline(1, color="0.5")
ax.set(yscale="log", xlabel="observation", ylabel="NIS per degree of freedom")
figure.legend(title="stated noise\nof the range", loc="outside right center")

# %%
# Move both noises
# ----------------
#
# The page below has the beginning of that log, filtered with 81 noises. Move the sliders, or click the picture of the
# likelihood. ``kalmark tune mine.yaml --log my_log --page sliders.html`` makes such a page of your own log.
from kalmark.diagnosis.sliders import sliders

sliders(world.config(), log, seconds=12.0)
plt.show()

# %%
# Which part is wrong
# -------------------
#
# A NIS above 1 does not show which noise is too small. ``km.diagnose(run)`` names it, with the key of the
# configuration; ``kalmark diagnose RUN`` prints it with its evidence, and ``kalmark tune CONFIG`` estimates all
# noises and calibrations at once (:doc:`/diagnosis`, :doc:`/tuning`).
#
# Of a control
# ------------
#
# ``sigma_v_mps`` is the error of a speed held over its interval, so its effect depends on the rate of the controls.
# Noise stated as ``..._per_sqrt_s`` is a random walk and does not: use it where controls come at any rate.
# :doc:`/presets` has the noise of common sensors with its sources.

# %%
# Try changing
# ------------
#
# Only the noise of the range is wrong: ``sigma_bearing_rad=0.02`` in place of ``{sigma / 5}``. The three NIS are 4.69,
# 0.97 and 0.54, the NEES 6.6, 3.1 and 2.8.
