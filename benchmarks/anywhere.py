"""A robot that may be anywhere in a known map, or is carried away in it or in its own: how soon is it placed?

    python benchmarks/anywhere.py                      # every case, 20 seeds
    python benchmarks/anywhere.py --cases rays "corners of tags" --runs 5

`start`: the log begins at a random time of a simulated one; of its start is known that it is in the world, turned in
any way.  `known` and `own`: a piece is cut out of the log (benchmarks/carried.py).  A line a case: the runs of which
every pose after the placement is within .3 m of the true one, the time until then, median and most, and the runs that
end farther off than that with a sigma that excludes it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from carried import cut

from kalmark.config import build_slam
from kalmark.events import Event
from kalmark.results.landmark_table import places
from kalmark.results.measures import rigid
from kalmark.simulate import load_world, simulate

RIGHT_M, SURE = 0.3, 5.0
KNOWN, NEW = "filter.map={known: truth}", "filter.map={known: null}"
HALL = "{x_m: 15, y_m: 10, theta_rad: 0, sigma_xy_m: 10, sigma_theta_rad: 3}"
SEA = "{x_m: 0, y_m: -5, z_m: 0, sigma_position_m: 8, sigma_rotation_deg: 120, sigma_v_mps: 1, sigma_w_radps: 0.3}"
ROOM = "{x_m: 4, y_m: 1.5, z_m: 1.2, sigma_position_m: 4, sigma_rotation_deg: 120}"
LASER, SONAR = "robots.robot.sensors.laser", "robots.robot.sensors.sonar"
RANGES = "{type: range, sigma_range_m: 0.1}"
DIRECTIONS = "{type: bearing, sigma_azimuth_rad: 0.01, sigma_elevation_rad: 0.01}"
RAYS = f"{LASER}={{type: bearing, sigma_bearing_rad: 0.01, range_max_m: 10}}"
POSES = "robots.rig.sensors.camera={type: tag_pose, sigma_position_m: 0.02, sigma_rotation_rad: 0.02}"
CASES: dict[str, tuple[str, str, list[str]]] = {  # the world, its robot's start anywhere, and its keys
    "points": ("localization", f"robots.robot.start={HALL}", []),
    "points, no ids": ("localization", f"robots.robot.start={HALL}", ["ids=false"]),
    "rays": ("localization", f"robots.robot.start={HALL}", [RAYS]),
    "four ranges": ("localization", f"robots.robot.start={HALL}", ["world.count=4", f"{LASER}={RANGES}"]),
    "points of space": ("diver", f"robots.robot.start={SEA}", [f"{SONAR}.range_max_m=6"]),
    "rays of space": ("diver", f"robots.robot.start={SEA}", [f"{SONAR}={DIRECTIONS}"]),
    "ranges of space": ("diver", f"robots.robot.start={SEA}", [f"{SONAR}={RANGES}"]),
    "corners of tags": ("tags_room", f"robots.rig.start={ROOM}", []),
    "poses of tags": ("tags_room", f"robots.rig.start={ROOM}", [POSES]),
}  # fmt: skip
WAYS = ("start", "known", "own")


def placed(case: str, way: str, seed: int) -> tuple[float, bool]:
    """Return how many seconds a robot was not where it is, inf at the end, too, and whether it was sure of that."""
    name, start, keys = CASES[case]
    keys = [*keys, NEW if way == "own" else KNOWN]
    log = simulate(load_world(name, keys), seed=seed)
    robot, times = next(iter(log.truth)), np.array([event.t_ns for event in log.events])
    events: Sequence[Event]
    if way == "start":
        at = first = last = int(times[int(len(times) * np.random.default_rng([seed, 1]).uniform(0.1, 0.6))])
        events = [event for event in log.events if event.t_ns > first]
    else:
        events, first, last = cut(log)
        at = first
    slam = build_slam(load_world(name, [*keys, start] if way == "start" else keys).config(), log)
    own, t_ns = list[np.ndarray](), list[int]()
    for event in events:
        slam.process(event)
        own.append(slam.mean(robot))
        t_ns.append(event.t_ns)
    d = 2 if len(own[0]) == 3 else 3
    was = np.array(t_ns)
    path, true = np.array(own)[:, :d], log.truth[robot].at(was + np.where(was > first, last - first, 0))[:, :d]
    if way == "own":
        table, tracks = slam.landmarks(), slam.state.tracks.confirmed
        mapped = [places(tracks[i].model, l[None], P[None], [None]) for i, _, l, P, _ in table]
        onto = rigid(
            np.array([p[0][0][:d] for p in mapped if p]), np.array([log.landmarks[i] for i in table.ids])[:, :d]
        )
        path = onto(path)
    off = np.linalg.norm(path - true, axis=1)
    wrong = was[(off > RIGHT_M) & (was >= at)]
    is_sure = off[-1] > max(RIGHT_M, SURE * float(np.sqrt(np.trace(slam.covariance(robot)[:d, :d]))))
    after = np.inf if off[-1] > RIGHT_M else (wrong[-1] - at) * 1e-9 if len(wrong) else 0.0
    return float(after), bool(is_sure)


def main() -> None:
    """Print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--cases", nargs="+", default=[*CASES], choices=[*CASES])
    parser.add_argument("--ways", nargs="+", default=[*WAYS], choices=WAYS)
    options = parser.parse_args()
    for case in options.cases:
        for way in options.ways:
            if way == "own" and case in ("points, no ids", "four ranges", "ranges of space"):
                continue  # benchmarks/carried.py, or no whole map of such measurements
            runs = [placed(case, way, seed) for seed in range(options.runs)]
            after = np.array([t_s for t_s, _ in runs])
            found = np.isfinite(after)
            when = f"after {np.median(after[found]):.1f} s, at most {after[found].max():.1f} s" if found.any() else ""
            sure, name = sum(is_sure for _, is_sure in runs), case.replace(",", "").replace(" ", "_")
            print(f"{way} {name} {found.sum()} of {len(runs)} {when}; sure elsewhere {sure}", flush=True)


if __name__ == "__main__":
    main()
