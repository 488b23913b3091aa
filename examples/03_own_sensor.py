"""Your own sensor in about fifteen lines: what it measures of a point at v = (x, y) in its own frame.

python examples/03_own_sensor.py; then check its Jacobians: kalmark check examples/03_own_sensor.py:sonar
"""

import numpy as np

import kalmark as km


def echo(v: np.ndarray) -> np.ndarray:
    """A sonar that gives the time of flight (ms) and the sine of the bearing."""
    distance = np.hypot(v[0], v[1])
    return np.array([2 * distance / 343.0 * 1e3, v[1] / distance])


def place(y: np.ndarray) -> np.ndarray:
    """Where the echo came from: what starts a landmark."""
    distance, bearing = y[0] * 343.0 / 2e3, np.arcsin(y[1])
    return distance * np.array([np.cos(bearing), np.sin(bearing)])


sonar = km.pointwise(echo, noise=np.diag([0.1, 0.02]) ** 2, inverse=place, columns=("flight_ms", "sine"))

if __name__ == "__main__":
    rover = km.Robot("rover", motion=km.motion.Unicycle(), sensors={"sonar": km.Mount(sonar, at=(0.2, 0, 0))})
    slam = km.Slam([rover])
    slam.process(km.Control(t_s=0.0, robot="rover", u=(0.4, 0.0)))
    for t in np.arange(0.0, 5.0, 0.5):
        v = np.array([[3.0, 1.0], [4.0, -1.0]]) - [0.2 + 0.4 * t, 0.0]
        slam.process(km.Scan(t_s=t, robot="rover", sensor="sonar", y=[echo(one) for one in v], ids=[1, 2]))
    for row in slam.landmarks():
        print(f"landmark {row.id} at {row.mean.round(3)} m, sigmas {np.sqrt(np.diag(row.covariance)).round(3)}")
