"""The linear Kalman filter is the special case of linear models: a robot of known heading that measures positions.

With the heading known exactly, moving is an addition and so is measuring a position in the robot's frame.  Forsyth's
Algorithm 11.3, written out below, and kalmark then give the same numbers.

python examples/04_linear_kalman.py
"""

import numpy as np

import kalmark as km

rng = np.random.default_rng(0)
D, M = np.eye(4), np.array([[-1.0, 0, 1, 0], [0, -1, 0, 1]])  # x = (robot, landmark); y = landmark - robot
S_d, S_m = np.diag([0.01, 0.01, 0, 0]), 0.04 * np.eye(2)

odometry = km.motion.Odometry2D(sigma_x_m=0.1, sigma_y_m=0.1, sigma_theta_rad=0.0)
position = km.Mount(km.sensors.Position2D(sigma_x_m=0.2, sigma_y_m=0.2))
robot = km.Robot("robot", odometry, sensors={"camera": position}, cov=np.diag([0.04, 0.04, 0.0]))
slam = km.Slam([robot], km.association.ByIdentity(gate="off"))  # these numbers are at random: no gate for the post
slam.add_landmark("post", mean=(3.0, 1.0), cov=np.eye(2))
x, S = np.array([0.0, 0, 3, 1]), np.diag([0.04, 0.04, 1, 1])

for t in range(20):
    u, y = rng.normal(size=2), np.array([3.0, 1.0]) + rng.normal(size=2)

    x = D @ x + [*u, 0, 0]  # Algorithm 11.3: prediction ...
    S = S_d + D @ S @ D.T
    K = S @ M.T @ np.linalg.inv(M @ S @ M.T + S_m)  # ... and correction
    x = x + K @ (y - M @ x)
    S = (np.eye(4) - K @ M) @ S

    slam.process(km.Control(t_s=t, robot="robot", u=(*u, 0.0)))
    slam.process(km.Scan(t_s=t, robot="robot", sensor="camera", y=[y], ids=["post"]))

ours = np.concatenate([slam.mean("robot")[:2], slam.mean("post")])
P = np.delete(np.delete(slam.covariance("robot", "post"), 2, 0), 2, 1)
print(f"difference of the means {np.abs(ours - x).max():.1e}, of the covariances {np.abs(P - S).max():.1e}")
assert np.allclose(ours, x, atol=1e-12)
assert np.allclose(P, S, atol=1e-12)
