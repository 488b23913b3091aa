"""Faults planted in simulated logs: does the diagnosis name them, and is it silent where nothing is wrong?

    python benchmarks/diagnosis.py                       # 5 logs a fault, and 200 clean ones
    python benchmarks/diagnosis.py --runs 1 --clean 5 --only range
    KALMARK_DATA=... python benchmarks/diagnosis.py --real     # every shipped real log

A robot wanders between 40 landmarks whose ids it knows; a car does for the steering, and the hall of benchmarks/hall.py
is for the recorder that stops.  A line a log: what was planted, what is named, best first.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kalmark.config import build_slam, config_dict, open_run
from kalmark.diagnosis.verdict import diagnose
from kalmark.events import Control, Fix, Scan, sort_key
from kalmark.geometry import observe
from kalmark.geometry.frames import compose, inverse
from kalmark.logs.log import Log
from kalmark.results.record import record
from kalmark.results.run import Run
from kalmark.simulate import load_world, simulate

FIELD = ("world.count=40", "world.size_m=24", "steps=700", "robots.rover.start={x_m: 12, y_m: 12, theta_rad: 0}")
MOUNT = np.array([0.3, 0.0, 0.0])
Plant = Callable[[Log, np.random.Generator], Log]


def seen(scan: Scan, y: np.ndarray | None = None, ids: list | None = None, t_ns: int | None = None) -> Scan:
    """Return a scan with other measurements, ids or another time."""
    return Scan(
        t_ns=scan.t_ns if t_ns is None else t_ns,
        robot=scan.robot,
        sensor=scan.sensor,
        y=scan.y if y is None else y,
        ids=scan.ids if ids is None else ids,
    )


def measured(change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    """Return what changes the measurements y (K, 2) of all scans."""

    def plant(log: Log, rng: np.random.Generator) -> Log:
        return replace(log, events=[seen(e, y=change(e.y.copy())) if isinstance(e, Scan) else e for e in log.events])

    return plant


def controlled(change: Callable[[np.ndarray], np.ndarray]) -> Plant:
    """Return what changes the controls u (2,)."""

    def plant(log: Log, rng: np.random.Generator) -> Log:
        return replace(
            log,
            events=[
                Control(t_ns=e.t_ns, robot=e.robot, u=change(e.u.copy())) if isinstance(e, Control) else e
                for e in log.events
            ],
        )

    return plant


def late(log: Log, rng: np.random.Generator) -> Log:
    """Stamp the scans .1 s late."""
    moved = [seen(e, t_ns=e.t_ns + 100_000_000) if isinstance(e, Scan) else e for e in log.events]
    return replace(log, events=sorted(moved, key=sort_key))


def moving(log: Log, rng: np.random.Generator) -> Log:
    """Move the landmark that is seen most by 2 cm/s."""
    ids = [i for e in log.events if isinstance(e, Scan) for i in e.ids or ()]
    name = max(set(ids), key=ids.count)
    truth, place, direction = log.truth["rover"], np.array(log.landmarks[name]), rng.normal(size=2)
    direction *= 0.02 / np.linalg.norm(direction)
    events = []
    for e in log.events:
        event = e
        if isinstance(event, Scan) and event.ids is not None and name in event.ids:
            y, k = event.y.copy(), list(event.ids).index(name)
            pose = truth.poses[np.searchsorted(truth.t_ns, event.t_ns)]
            at = compose(pose, MOUNT)[0]
            there = place + direction * event.t_ns * 1e-9
            y[k] += observe(at, there[None])[0][0] - observe(at, place[None])[0][0]
            event = seen(event, y=y)
        events.append(event)
    return replace(log, events=events)


def wrong_ids(log: Log, rng: np.random.Generator) -> Log:
    """Give 3 % of the observations the id of another landmark in view."""
    events = []
    for e in log.events:
        event = e
        if isinstance(event, Scan) and event.ids is not None and len(event.ids) > 1:
            ids = list(event.ids)
            for k in np.flatnonzero(rng.random(len(ids)) < 0.015).tolist():
                other = int(rng.integers(len(ids) - 1))
                other += other >= k
                ids[k], ids[other] = ids[other], ids[k]
            event = seen(event, ids=ids)
        events.append(event)
    return replace(log, events=events)


def exchanged(log: Log, rng: np.random.Generator) -> Log:
    """Exchange the ids of two landmarks that are seen often, from the middle of the log on."""
    ids = [i for e in log.events if isinstance(e, Scan) for i in e.ids or ()]
    often = sorted(set(ids), key=lambda i: (-ids.count(i), i))[:10]
    a, b = (often[k] for k in rng.choice(len(often), 2, replace=False))
    begin, other = log.events[len(log.events) // 2].t_ns, {a: b, b: a}
    events = []
    for e in log.events:
        event = e
        if isinstance(event, Scan) and event.ids is not None and event.t_ns >= begin:
            event = seen(event, ids=[other.get(i, i) for i in event.ids])
        events.append(event)
    return replace(log, events=events)


def scaled(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda y: y * [factor, 1.0]


def wheel(u: np.ndarray) -> np.ndarray:
    """Return the control of a differential drive that takes its right wheel 1 % too small.

    The wheels are .5 m apart.
    """
    left, right = u[0] - u[1] * 0.25, (u[0] + u[1] * 0.25) / 1.01
    return np.array([(left + right) / 2, (right - left) / 0.5])


def turned(y: np.ndarray) -> np.ndarray:
    """Return what a sensor that looks back measures."""
    return np.stack([y[:, 0], (y[:, 1] + 2 * np.pi) % (2 * np.pi) - np.pi], axis=1)


def kidnapped(log: Log, rng: np.random.Generator) -> Log:
    """Leave out the controls and scans of the middle fifth of the log: the robot is elsewhere when they come again."""
    begin, end = (log.events[k * len(log.events) // 5].t_ns for k in (2, 3))
    events = []
    for e in log.events:
        if e.t_ns < begin:
            events.append(e)
        elif e.t_ns >= end:
            t_ns = e.t_ns - end + begin
            events.append(seen(e, t_ns=t_ns) if isinstance(e, Scan) else Control(t_ns=t_ns, robot=e.robot, u=e.u))
    return replace(log, events=events)


def bumped(log: Log, rng: np.random.Generator) -> Log:
    """Move the robot by .3 m and turn it by 15 deg, at once, in the middle of the log: it sees all from there on."""
    t_ns, truth = log.events[len(log.events) // 2].t_ns, log.truth["rover"]
    before, angle = truth.poses[np.searchsorted(truth.t_ns, t_ns)], rng.uniform(-np.pi, np.pi)
    by = np.array([0.3 * np.cos(angle), 0.3 * np.sin(angle), np.radians(15.0) * rng.choice([-1, 1])])
    moved = compose(compose(before, by)[0], inverse(before)[0])[0]
    names, places = [*log.landmarks], np.array([*log.landmarks.values()])
    events = []
    for e in log.events:
        event = e
        if isinstance(event, Scan) and event.t_ns > t_ns:
            pose = compose(moved, truth.poses[np.searchsorted(truth.t_ns, event.t_ns)])[0]
            y = observe(compose(pose, MOUNT)[0], places)[0]
            near = np.flatnonzero((y[:, 0] > 0.5) & (y[:, 0] < 12.0) & (np.abs(y[:, 1]) < np.pi / 2))
            event = seen(event, y=y[near] + rng.normal(size=(len(near), 2)) * (0.1, 0.02), ids=[names[k] for k in near])
        events.append(event)
    return replace(log, events=events, truth={})


def spiked(log: Log, rng: np.random.Generator) -> Log:
    """Let one control in the middle of the log be 20 m/s."""
    t_ns = [e.t_ns for e in log.events if isinstance(e, Control)][len(log.events) // 4]
    spike = Control(t_ns=t_ns, robot="rover", u=np.array([20.0, 0.0]))
    return replace(log, events=[spike if isinstance(e, Control) and e.t_ns == t_ns else e for e in log.events])


def misplaced(log: Log, rng: np.random.Generator) -> Log:
    """Survey the landmark that is seen most 1 m from where it is."""
    ids = [i for e in log.events if isinstance(e, Scan) for i in e.ids or ()]
    name, angle = max(set(ids), key=ids.count), rng.uniform(-np.pi, np.pi)
    off = np.array([np.cos(angle), np.sin(angle)])
    return replace(log, landmarks=log.landmarks | {name: np.array(log.landmarks[name]) + off})


def fixed(log: Log, rng: np.random.Generator) -> Log:
    """Add a fix of .3 m every two seconds."""
    truth = log.truth["rover"]
    fixes = [
        Fix(t_ns=int(t), robot="rover", y=pose[:2] + rng.normal(size=2) * 0.3, cov=0.09 * np.eye(2))
        for t, pose in [*zip(truth.t_ns, truth.poses, strict=True)][::10]
    ]
    return replace(log, events=sorted([*log.events, *fixes], key=sort_key))


def stopped(log: Log, rng: np.random.Generator) -> Log:
    """Leave out 4 s of controls and scans in the middle, as a recorder that stops does."""
    begin = log.events[len(log.events) // 2].t_ns
    return replace(log, events=[e for e in log.events if not begin <= e.t_ns < begin + 4_000_000_000])


def none(log: Log, rng: np.random.Generator) -> Log:
    """Change nothing."""
    return log


CAR = (
    "robots.rover.motion={type: ackermann, wheelbase_m: 1.0, encoder_offset_m: 0.0,"
    " sigma_v_mps: 0.05, sigma_steering_rad: 0.02}",
)
SIGMA = "robots.rover.sensors.lidar.sigma_range_m"
CONTROLS = ("robots.rover.motion.sigma_v_mps=0.01667", "robots.rover.motion.sigma_w_radps=0.01667")
# fault: the names that are right, what it does to the log, settings of the world and of the filter
FAULTS: dict[str, tuple[tuple[str, ...], Plant, tuple[str, ...], tuple[str, ...]]] = {
    "none": ((), none, (), ()),
    "range sigma half": (("range_sigma",), none, (), (f"{SIGMA}=0.2",)),
    "range sigma double": (("range_sigma",), none, (), (f"{SIGMA}=0.05",)),
    "bearing bias 1 deg": (("bearing_offset",), measured(lambda y: np.add(y, [0.0, np.radians(1.0)])), (), ()),
    "range scale 5 %": (("range_scale",), measured(scaled(1.05)), (), ()),
    "time offset .1 s": (("time_offset",), late, (), ()),
    "control noise threefold": (("control_sigma",), none, (), CONTROLS),
    "moving landmark": (("moving_landmark",), moving, (), ()),
    "wrong ids 3 %": (("wrong_ids",), wrong_ids, (), ()),
    "ids exchanged": (("wrong_ids",), exchanged, (), ()),
    "steering bias 1 deg": (("steering_offset",), controlled(lambda u: np.add(u, [0.0, np.radians(1.0)])), CAR, ()),
    "recorder gap 4 s": (("gap",), stopped, (), ()),
    "kidnapped": (("kidnapped",), kidnapped, (), ()),
    "bumped": (("odometry_jump",), bumped, (), ()),
    "speed of 20 m/s once": (("odometry_jump",), spiked, (), ()),
    "survey 1 m off": (("landmark_prior",), misplaced, (), ("filter.map.known=truth",)),
    "survey 1 m off, no gate": (
        ("landmark_prior",),
        misplaced,
        (),
        ("filter.map.known=truth", "filter.association={type: identity, gate: off}"),
    ),
    "first heading 1 rad off": (
        ("start",),
        fixed,
        (),
        ("robots.rover.start={x_m: 12, y_m: 12, theta_rad: 1}",),
    ),
    "bearing clockwise": (("bearing_sign",), measured(lambda y: y * [1.0, -1.0]), (), ()),
    "bearing in degrees": (("units",), measured(lambda y: y * [1.0, 180 / np.pi]), (), ()),
    "turn rate in degrees": (("units",), controlled(lambda u: u * [1.0, 180 / np.pi]), (), ()),
    "range and bearing swapped": (
        ("swapped_columns",),
        measured(lambda y: np.stack([y[:, 1] % (2 * np.pi), y[:, 0]], axis=1)),
        (),
        (),
    ),
    "mount 180 deg": (("mount",), measured(turned), (), ()),
    "wheel 1 %": (("odometry_turn",), controlled(wheel), (), ()),
}


# of each real log: configuration and overrides, and the causes that are known of it; all these maps are right
REAL: dict[str, tuple[tuple[str, ...], set[str]]] = {
    "lost_in_the_woods": (("lost_in_the_woods",), {"correlated_noise", "bearing_offset"}),
    "lost_in_the_woods_bearing": (("lost_in_the_woods_bearing",), set()),
    "plaza": (("plaza",), {"odometry_jump"}),  # it estimates the scale of its ranges
    "plaza_uncalibrated": (("plaza", "robots.each.sensors.radio.sigma_scale=0"), {"range_scale"}),
    # the robots move .18 to .20 s after their controls, and the bearings are .04 to .05 s older than their stamps
    **{f"mrclam_{k}": (("mrclam", f"log.robots=[{k}]"), {"time_offset"}) for k in (1, 3, 5)},
    "mrclam_3_unshifted": (("mrclam", "log.robots=[3]", "log.bearing_shift_s=0"), {"time_offset"}),
    "mrclam_all": (("mrclam", "log.robots=[1, 2, 3, 4, 5]"), {"time_offset"}),
    "victoria_park_known": (("victoria_park_known",), {"steering_offset"}),
    "dlr": (("dlr",), {"wrong_ids"}),  # two of 576 landmarks at the end
    **{name: ((name,), set()) for name in ("victoria_park", "dlr_unknown", "freiburg_course", "starry_night")},
}


def planted(fault: str, seed: int) -> tuple[Log, Run]:
    """Return the log with a fault, and the run of it."""
    _, plant, of_world, of_filter = FAULTS[fault]
    world = load_world("random_field", [*FIELD, *of_world])
    log = plant(simulate(world, seed), np.random.default_rng(seed))
    config = load_world("random_field", [*FIELD, *of_world, *of_filter]).config()
    seen = replace(log.without_truth(), landmarks=log.landmarks)  # which are the survey where there is one
    return log, record(build_slam(config, seen), seen, progress=False)


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--clean", type=int, default=200)
    parser.add_argument("--only", default="")
    parser.add_argument("--real", action="store_true", help="every shipped real log instead")
    options = parser.parse_args()
    if options.real:
        real(options.only)
        return
    first = third = count = accused = alarmed = 0
    for fault, (names, *_) in FAULTS.items():
        if options.only not in fault:
            continue
        for seed in range(options.runs if names else options.clean):
            _, run = planted(fault, seed)
            verdict = diagnose(run)
            told = [cause.name for cause in verdict.causes]
            causes = "; ".join(f"{cause.name} ({cause.score:.0f})" for cause in verdict.causes)
            print(f"{fault:24s} {seed:4d}  {verdict.map:9s} {causes}", flush=True)
            if names:
                count, first, third = count + 1, first + (told[:1] == [names[0]]), third + bool({*told[:3]} & {*names})
            else:
                accused, alarmed = accused + bool(told), alarmed + (verdict.map != "ok")
    print(f"planted: {first} of {count} named first, {third} among the first three")
    print(f"clean: {accused} of {options.clean} accused, the map of {alarmed}")


def real(only: str) -> None:
    """Print the verdict on each real log beside its true state: all these maps are right."""
    agree = count = 0
    print("log | true state | verdict | sigma factor | causes that do harm | checked")
    for name, (config, known) in REAL.items():
        if only not in name:
            continue
        config_, log = open_run(config[0], None, config[1:])
        slam, log = build_slam(config_, log), log.without_truth()  # several robots have the starts that the truth has
        verdict = diagnose(record(slam, log, progress=False, config=config_dict(config_)))
        told = [f"{cause.name} ({cause.score:.0f})" for cause in verdict.causes if not cause.harmless]
        missing = known - {cause.name for cause in verdict.causes}
        factor = "-" if verdict.sigma_factor is None else f"{verdict.sigma_factor:.2f}"
        count, agree = count + 1, agree + (verdict.map == "ok" and not missing)
        state = f"right; {', '.join(sorted(known))}" if known else "right"
        print(f"{name} | {state} | {verdict.map} | {factor} | {'; '.join(told)} | {verdict.checked}", flush=True)
    print(f"real: {agree} of {count} as they are known to be")


if __name__ == "__main__":
    main()
