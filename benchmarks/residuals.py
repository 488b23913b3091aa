"""Where the shipped noise comes from: what odometry and sensors of the real logs err by.

    KALMARK_DATA=... python benchmarks/residuals.py

MRCLAM 6 against its truth: the odometry's error over windows of T seconds, divided by sqrt(T), which is constant for a
diffusion; range and bearing residuals by range.  Victoria Park against the batch optimum of the log, as its GPS is no
truth: 1.48 times the median absolute residual of range and bearing, and of the speed and steering that the optimal path
asks for.  Of MRCLAM 6 and Lost in the Woods also the shifts of bearings and odometry in time that fit the truth best.
"""

from __future__ import annotations

import numpy as np

import kalmark as km
from kalmark.config import build_slam, load_config, open_config_log
from kalmark.events import Control, Scan
from kalmark.geometry import compose, inverse, wrap
from kalmark.results.batch import solve_batch
from kalmark.results.record import record

SECOND = 1_000_000_000
WHEELBASE_M = 2.83


def spread(values: np.ndarray) -> float:
    """Return 1.48 times the median absolute value."""
    return float(1.4826 * np.median(np.abs(values)))


def mrclam() -> None:
    """Print the odometry's diffusion and the camera's residuals, all five robots together."""
    config = load_config("mrclam", ["log.robots=[1, 2, 3, 4, 5]"])
    log = open_config_log(config)
    unicycle = km.motion.Unicycle()
    windows: dict[int, list[np.ndarray]] = {1: [], 4: [], 16: []}
    ranges: list[tuple[float, float, float]] = []
    for robot in log.robots:
        mine = [e for e in log.events if e.robot == robot]
        controls = [e for e in mine if isinstance(e, Control)]
        t = np.array([e.t_ns for e in controls])
        u = np.array([e.u for e in controls])
        path = [np.zeros(3)]
        for k in range(len(t) - 1):
            path.append(unicycle.move(path[-1], u[k], (t[k + 1] - t[k]) * 1e-9)[0])
        track, truth = np.array(path), log.truth[robot]
        for length, errors in windows.items():
            for start in range(t[0], t[-1] - length * SECOND, length * SECOND):
                i, j = np.searchsorted(t, [start, start + length * SECOND])
                if not u[i:j].any(axis=1).all():
                    continue  # standing some of the time
                poses = truth.at(t[[i, j]])
                if np.isnan(poses).any():
                    continue
                said, was = (compose(inverse(a)[0], b)[0] for a, b in ((track[i], track[j]), (poses[0], poses[1])))
                errors.append(compose(inverse(said)[0], was)[0] / np.sqrt(length))
        for scan in (e for e in mine if isinstance(e, Scan)):
            pose = truth.at(scan.t_ns)
            for y, i in zip(scan.y, scan.ids or (), strict=True):
                if i in log.landmarks and not np.isnan(pose).any():
                    e = km.geometry.observe(pose, log.landmarks[i])[0]
                    ranges.append((e[0], y[0] - e[0], wrap(y[1] - e[1])))
    print("MRCLAM 6, moving: odometry's error over T seconds / sqrt(T): RMS (1.48 MAD)")
    print(f"{'T s':>6}{'windows':>9}{'along m':>20}{'across m':>20}{'heading rad':>20}")
    for length, errors in windows.items():
        all_ = np.array(errors)
        cells = [f"{np.sqrt(np.mean(c**2)):.4f} ({spread(c):.4f})" for c in all_.T]
        print(f"{length:>6}{len(all_):>9}" + "".join(f"{c:>20}" for c in cells))
    table = np.array(ranges)
    print(f"{'range m':>10}{'observations':>11}{'range RMS m':>14}{'bearing RMS rad':>18}")
    for low in (0, 2, 4, 6):
        near = table[(table[:, 0] >= low) & (table[:, 0] < low + 2) & (np.abs(table[:, 1]) < 1)]
        print(f"{low:>5} to {low + 2}{len(near):>9}{np.std(near[:, 1]):>14.3f}{np.std(near[:, 2]):>18.4f}")


def shifts(config: str, *overrides: str) -> None:
    """Print by how much the stamps of scans and of controls are late, and what the turns of the controls are times.

    The bearings, and the turns in half a second, fit the truth best when they are taken as so much older.
    """
    loaded = load_config(config, [*overrides])
    log = open_config_log(loaded)
    for name, robot in build_slam(loaded, log).robots.items():
        truth, mine = log.truth[name], [e for e in log.events if e.robot == name]
        t, heading = truth.t_ns * 1e-9, np.unwrap(truth.poses[:, 2])
        mount = next(iter(robot.sensors.values())).at
        seen = [(e.t_s, y[-1], log.landmarks[i]) for e in mine if isinstance(e, Scan)
                for y, i in zip(e.y, e.ids or (), strict=True) if i in log.landmarks]  # fmt: skip
        stamps, bearings, places = (np.array(column) for column in zip(*seen, strict=True))
        places = places[:, :2]
        controls_ = [e for e in mine if isinstance(e, Control)]
        at, w = np.array([e.t_s for e in controls_]), np.array([e.u[1] for e in controls_])
        turned = np.concatenate([[0.0], np.cumsum(w[:-1] * np.diff(at))])
        grid = np.arange(max(t[0], at[0]) + 1, min(t[-1], at[-1]) - 1, 0.5)
        true = np.diff(np.interp(grid, t, heading))
        of_scans, of_controls = [], []
        for late in np.arange(-0.3, 0.31, 0.01):
            theta = np.interp(stamps - late, t, heading)
            ahead = np.column_stack([np.cos(theta), np.sin(theta)]) * mount[0]
            away = places - ahead - np.column_stack([np.interp(stamps - late, t, c) for c in truth.poses[:, :2].T])
            e = wrap(bearings - np.arctan2(away[:, 1], away[:, 0]) + theta)
            of_scans.append((np.std(e[np.abs(e) < 0.2]), late))
            said = np.diff(np.interp(grid + late, at, turned))
            good = np.abs(said - true) < 0.5
            scale = said[good] @ true[good] / (said[good] @ said[good])
            of_controls.append((np.std(true[good] - scale * said[good]), late, scale))
        (_, scans), (_, odometry, scale) = min(of_scans), min(of_controls)
        print(f"{config} {name}: stamps late: scans {scans:+.2f} s, controls {odometry:+.2f} s; true turns {scale:.3f}")


def victoria_park() -> None:
    """Print the laser's residuals about the batch optimum."""
    config = load_config("victoria_park_known")
    log = open_config_log(config)
    run = record(build_slam(config, log), log, progress=False)
    batch = solve_batch(run, log)
    where = dict(zip(batch.ids, batch.means, strict=True))
    mount = next(iter(build_slam(config, log).robots.values())).sensors["laser"].at
    scans = [e for e in log.events if isinstance(e, Scan)]
    residuals = []
    for scan, pose, report_step in zip(scans, batch.poses, range(len(scans)), strict=True):
        sensor = compose(pose, mount)[0]
        kept = run.history.outcome[run.history.step == report_step]
        for y, i, outcome in zip(scan.y, scan.ids or (), kept, strict=True):
            if outcome in ("associated", "new"):
                e = km.geometry.observe(sensor, where[i])[0]
                residuals.append((y[0] - e[0], wrap(y[1] - e[1])))
    r, b = np.array(residuals).T
    print("Victoria Park, known trees, residuals about the batch optimum")
    print(f"  range   RMS {np.sqrt(np.mean(r**2)):.3f} m, 1.48 MAD {spread(r):.3f} m")
    print(f"  bearing RMS {np.sqrt(np.mean(b**2)):.4f} rad, 1.48 MAD {spread(b):.4f} rad")


def steering() -> None:
    """Print how the two calibrations of Victoria Park's steering, and the headings driven by them, part."""
    one, other = (controls(name) for name in ("ascii", "mat"))
    mat = np.interp(one[:, 0], other[:, 0], other[:, 2])
    moving = one[:, 1] > 0.1
    v, ascii_, mat = one[moving, 1], one[moving, 2], mat[moving]
    slope, offset = np.polyfit(mat, ascii_, 1)
    left = np.std(ascii_ - slope * mat - offset)
    print(f"Victoria Park, steering: ascii = {slope:.4f} mat + {offset:.4f} rad, residual {left:.1e} rad")
    dt = 0.025
    turned = v * (np.tan(ascii_) - np.tan(mat)) / WHEELBASE_M * dt
    for t_s in (1, 2, 5, 10, 20, 40):
        steps = round(t_s / dt)
        parted = np.add.reduceat(turned, np.arange(0, len(turned) - steps, steps))
        print(f"  {t_s:3d} s: headings part by {np.sqrt(np.mean(parted**2) / t_s):.4f} rad/sqrt(s)")


def controls(calibration: str) -> np.ndarray:
    """Return time, speed and steering (N, 3) by one of the calibrations."""
    log = open_config_log(load_config("victoria_park_known", [f"log.steering={calibration}"]))
    return np.array([[e.t_s, *e.u] for e in log if isinstance(e, Control)])


if __name__ == "__main__":
    mrclam()
    shifts("mrclam", "log.robots=[1, 2, 3, 4, 5]", "log.bearing_shift_s=0")
    shifts("lost_in_the_woods")
    victoria_park()
    steering()
