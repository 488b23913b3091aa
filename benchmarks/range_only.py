"""Ranges alone: how often beacons are started honestly, and Plaza1 with beacons and range scale unknown.

    python benchmarks/range_only.py [TRIALS] [SEEDS]

Trials: 60 steps of 0.5 m along an arc (radius 10 m) or a line, one beacon or four, range sigma .1 m; 250 steps with
strengths of 2 dB, whose value at 1 m is known to 5 dB and whose exponent to .4.  "started" is the share of beacons that
became landmarks, "honest" the share of those whose squared error in their own sigmas is below 9.21 (99 % of a
consistent filter's), "mean" the mean of it (2 for a consistent filter's), "lost" the runs in which the pose is more
than 5 sigmas off.  Plaza1: each seed leaves out a tenth of the ranges.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

import kalmark as km
from kalmark.config import build_slam, load_config, open_config_log
from kalmark.errors import LogError
from kalmark.geometry import V_inverse
from kalmark.results.measures import rigid

AT, STEP = np.array([0.2, 0.1, 0.0]), np.array([0.5, 0.0, 0.05])
STRENGTHS = "eight around a circle of 10 m, strengths, path loss unknown"
ROWS: dict[str, dict[str, Any]] = {
    "5 to 20 m": {},
    "20 to 80 m": {"near": 20.0, "far": 80.0},
    "5 to 20 m, odometry three times as noisy": {"noise": 3.0},
    "5 to 20 m, straight line": {"turn": 0.0},
    "four at 10 to 40 m, scale 7 % and bias .2 m unknown": {
        "near": 10.0,
        "far": 40.0,
        "count": 4,
        "unknown": (0.07, 0.2),
    },
    STRENGTHS: {"count": 8, "strengths": True, "steps": 250},
}
WAYS = {"trilateration": km.initialization.Trilateration(), "hypotheses": km.initialization.Hypotheses()}


def trial(
    seed: int, way: Any, near: float = 5.0, far: float = 20.0, noise: float = 1.0, turn: float = 0.05, count: int = 1,
    unknown: tuple[float, float] = (0.0, 0.0), strengths: bool = False, steps: int = 60,
) -> tuple[list[float], float]:  # fmt: skip
    """Return the squared errors of the beacons found, and that of the pose."""
    rng = np.random.default_rng(seed)
    sigmas = noise * np.array([0.01, 0.003, 0.005])
    sensor: Any = km.sensors.Range(sigma_range_m=0.1, sigma_scale=unknown[0], sigma_bias_m=unknown[1])
    truth: Any = km.sensors.Range(scale=1 + unknown[0] * rng.normal(), bias_m=unknown[1] * rng.normal())
    if strengths:
        sensor = km.sensors.SignalStrength2D(2.0, sigma_strength_db=5.0, sigma_exponent=0.4)
        truth = km.sensors.SignalStrength2D(strength_dbm=rng.normal(-40, 5), exponent=rng.normal(2, 0.4))
    sigma = float(np.sqrt(sensor.noise(np.ones((1, 1)))[0, 0, 0]))
    motion, mount = km.motion.Odometry2D(*sigmas), km.Mount(sensor, at=AT, initialization=way)
    slam = km.Slam([km.Robot("r", motion, sensors={"radio": mount})])
    away, around = rng.uniform(near, far, count), rng.uniform(-np.pi, np.pi, count)
    beacons = np.column_stack([away * np.cos(around), away * np.sin(around)])
    beacons = rng.uniform((-12.0, -2.0), (12.0, 22.0), (count, 2)) if strengths else beacons
    r, u = np.zeros(3), np.array([*STEP[:2], turn])
    for t in range(steps):
        slam.process(km.Control(t_s=float(t), robot="r", u=u + rng.normal(size=3) * sigmas))
        r, _, _ = motion.move(r, u, 1.0)
        T, _, _ = km.geometry.compose(r, AT)
        y = truth.expect(beacons - T[:2])[0] + sigma * rng.normal(size=(count, 1))
        y = y if strengths else np.abs(y)
        slam.process(km.Scan(t_s=float(t), robot="r", sensor="radio", y=y, ids=list(range(count))))
    turned = V_inverse(r[2] - slam.mean("r")[2])
    pose = np.array([*(turned @ (r[:2] - slam.mean("r")[:2])), r[2] - slam.mean("r")[2]])
    errors = [(slam.covariance(i), turned @ (beacons[i] - slam.mean(i))) for i in slam.landmarks().ids]
    return [float(d @ np.linalg.solve(P, d)) for P, d in errors], float(
        pose @ np.linalg.solve(slam.covariance("r"), pose)
    )


def trials(count: int) -> None:
    """Print the table of trials."""
    print(f"{count} trials          way            started   honest    mean   lost")
    for name, keys in ROWS.items():
        for label, way in WAYS.items():
            if keys.get("strengths") and label == "hypotheses":
                continue
            runs = [trial(seed, way, **keys) for seed in range(count)]
            d2, poses = np.array([e for found, _ in runs for e in found]), np.array([pose for _, pose in runs])
            share = len(d2) / (count * keys.get("count", 1))
            told = f"{np.mean(d2 < 9.21):8.1%} {np.mean(d2):7.2f}" if len(d2) else f"{'-':>8} {'-':>7}"
            print(f"{name:52} {label:13} {share:8.1%} {told} {np.mean(poses > 25):6.1%}", flush=True)


def plaza(*sets: str, seed: int | None = None) -> tuple[float, float, float, bool]:
    """Return the RMSE of path and beacons after rigid alignments, the scale found, and whether all beacons were."""
    config = load_config("plaza", list(sets))
    log = open_config_log(config)
    slam, rng, t_ns, path = build_slam(config, log), np.random.default_rng(seed), [], []
    for event in log:
        if isinstance(event, km.Scan) and seed is not None and rng.random() < 0.1:
            continue
        slam.process(event)
        if isinstance(event, km.Scan):
            t_ns.append(event.t_ns)
            path.append(slam.mean("robot")[:2])
    names = [name for name in log.landmarks if name in slam.tracks.slots]
    truth = log.truth["robot"].at(np.array(t_ns))[:, :2]
    there, found = (np.array([f(name) for name in names]) for f in (log.landmarks.__getitem__, slam.mean))
    gain = slam.mean("robot.radio")[3] if "robot.radio" in slam.tracks.slots else 1 / 1.069
    return rmse(np.array(path), truth), rmse(found, there), float(1 / gain), len(names) == len(log.landmarks)


def rmse(a: np.ndarray, b: np.ndarray) -> float:
    """Return the root mean square distance of points (N, 2) from others after a rigid alignment."""
    return float(np.sqrt(np.mean(np.sum((rigid(a, b)(a) - b) ** 2, axis=1))))


def main() -> None:
    """Print both tables."""
    count, seeds = (int(text) for text in (sys.argv[1:] + ["100", "10"][len(sys.argv) - 1 :])[:2])
    if count:
        trials(count)
    radio = "robots.each.sensors.radio."
    given = (f"{radio}scale=1.069", f"{radio}sigma_scale=0", f"{radio}sigma_bias_m=0")
    rows: list[tuple[str, tuple[str, ...], int | None]] = [
        ("all unknown", (), None),
        ("scale given", given, None),
        ("no bias", (f"{radio}sigma_bias_m=0",), None),
        ("hypotheses", (f"{radio}initialization.type=hypotheses",), None),
        *((f"all unknown, seed {seed}", (), seed) for seed in range(seeds)),
    ]
    print("Plaza1                     path m   beacons m   scale   all beacons")
    for name, sets, seed in rows:
        try:
            path, beacons, scale, whole = plaza(*sets, seed=seed)
        except LogError as error:
            print(error)
            return
        print(f"{name:25} {path:7.3f} {beacons:10.3f} {scale:9.4f}   {whole}", flush=True)


if __name__ == "__main__":
    main()
