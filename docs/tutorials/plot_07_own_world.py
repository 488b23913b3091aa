"""
Your own simulated world
========================

A world describes the truth: landmarks, the motion and sensors of each robot, its route. It makes logs with truth, and
the configuration of the filter that fits it.
"""

# %%
# The file
# --------
#
# A yard with five posts and a robot that drives round. All keys: :doc:`/worlds`.
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt

import kalmark as km
from kalmark.config import build_slam
from kalmark.simulate import load_world, simulate

file = Path(mkdtemp()) / "yard.yaml"
file.write_text("""
world: {type: list, points_m: [[0, 0], [8, 0], [8, 6], [0, 6], [4, 3]]}
robots:
  mower:
    start: {x_m: 1.0, y_m: 1.0, theta_rad: 0.0}
    route: {type: waypoints, points_m: [[7, 1], [7, 5], [1, 5], [1, 1]], speed_mps: 0.8}
    motion: {type: unicycle, sigma_v_mps: 0.05, sigma_w_radps: 0.05}
    sensors:
      lidar: {type: range_bearing, sigma_range_m: 0.1, sigma_bearing_rad: 0.02, range_max_m: 6}
steps: 300
dt_s: 0.1
""")

# %%
# A log and its map
# -----------------
#
# On the command line: ``kalmark simulate yard.yaml --out log``, then ``kalmark run log/config.yaml``; ``kalmark
# campaign yard.yaml --runs 50`` for the average NEES of many runs.
world = load_world(file)
log = simulate(world, seed=1)
run = km.record(build_slam(world.config(), log), log, progress=False)
print(run)

# %%
# Truth and estimate
# ------------------
figure, ax = plt.subplots(figsize=(6, 4.5), layout="constrained")
truth = log.truth["mower"].poses
ax.plot(truth[:, 0], truth[:, 1], "0.7", label="true path")
ax.plot(run.history.mean[:, 0], run.history.mean[:, 1], label="estimate")
for row in run.final_slam().landmarks():
    ax.plot(*km.geometry.ellipse(row.mean, row.covariance, sigmas=3, points=40).T, "C1")
ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
ax.legend()
plt.show()

# %%
# Try changing
# ------------
#
# A sensor that sees less far: ``range_max_m: 2``. It makes 82 observations in place of 1034, and the map has two of
# the five posts.
