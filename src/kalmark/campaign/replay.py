"""`Replay`: a parametric bootstrap of a log: the same route and observations, all noise drawn again from the models.

The log goes through its filter twice: once as it is, for the map and the association; then on that map, known, so that
the path fits the map at every time and does not jump where a loop closes.  That map is the truth now.  A robot follows
the path *by its own motion*: it takes, for each control of the log, one near it that leads to where the robot was at
the end of the interval; its filter is given that one with noise.  Each scan sees the landmarks that it saw in the log,
from the true pose.

The true control depends on where the robot truly is, its error does not: that is all that a filter assumes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.random import Generator, SeedSequence

from kalmark.arrays import Array
from kalmark.config.building import build_robot, build_slam, config_dict
from kalmark.config.opening import with_log_description
from kalmark.config.schema import Config, StartConfig
from kalmark.config.sections import section_of
from kalmark.config.tree import name_on
from kalmark.errors import DivergedError, EventError, KalmarkError
from kalmark.events import Control, Event, Fix, Id, Scan
from kalmark.geometry.angles import wrap
from kalmark.geometry.pose_frames import body_axes
from kalmark.geometry.spaces import SE2
from kalmark.logs.log import Log, Trajectory
from kalmark.logs.progress import track
from kalmark.models.observe import sensor_pose
from kalmark.models.protocols import self_calibrating
from kalmark.report import Report
from kalmark.results.landmark_table import MapLandmarks, refuse_other_than_points
from kalmark.results.recording import config_yaml
from kalmark.results.warnings import NO_ID
from kalmark.simulate.robots import (
    Chance,
    Key,
    Simulation,
    add_diffusion,
    draw_constants,
    draw_mount,
    draw_start,
    given_control,
)
from kalmark.simulate.sights import (
    POINTS,
    exact_measurements,
    gaussian,
    is_reportable,
    noisy_measurements,
    things_in_frame,
)
from kalmark.slam.held_control import HeldInput, MotionPart, control_covariance
from kalmark.slam.robot import Robot
from kalmark.slam.slam import Slam

BACK_S, BACK_M, BACK_RAD = 2.0, 0.5, 0.3  # the path is met again in so long a time, or on so long a way; not steeper
LEAST = np.diag(np.square([1e-3, 1e-3, 1e-3]))  # m, m, rad: no path is followed nearer than that


class Steer(NamedTuple):
    """A control of the log, the pose of the robot `dt_s` later, (3,), and its covariance (3, 3)."""

    event: Control
    dt_s: float = 0.0
    goal: Array = np.zeros(3)
    cov: Array = LEAST


class ReplayedScan(NamedTuple):
    """A scan of the log: rows of it, and the landmark of the map or the robot that each of these was of."""

    event: Scan
    rows: tuple[int, ...]
    real: tuple[Id, ...]

    @property
    def cov(self) -> Array | None:
        """The covariances (K, m, m) that came with the log, if any did."""
        cov = self.event.cov
        return cov if cov is None else np.broadcast_to(cov, (len(self.event.y), *cov.shape[-2:]))[list(self.rows)]

    def scan(self, y: Array, ids: Any, keep: Any = slice(None)) -> Scan:
        """Return a scan at the same time with other measurements y (K, m) and ids of the rows `keep`."""
        e, cov = self.event, self.cov
        return replace(e, y=y, ids=ids, cov=None if cov is None else cov[keep])


class Recorded(NamedTuple):
    """Events to replay, in the order of the log, and the landmarks: (2,) m, or (3,) with a signature."""

    events: list[Steer | ReplayedScan | Fix]
    landmarks: dict[Id, Array]


def record_for_replay(config: Config, log: Log, progress: bool = True) -> Recorded:
    """Return the events of a log for a replay.  Raises KalmarkError where the filter gives up, or nothing was seen."""
    slam = build_slam(config, log)
    bar = track(log.events, f"{log.name}, the map", len(log.events), show=progress)
    reports = [report for event in bar if (report := _processed(slam, event, config)) is not None]
    refuse_other_than_points(slam, f"{log.name}, to be replayed")
    found = MapLandmarks.of(slam)
    landmarks = {i: p for i, p in zip(found.ids, found.means, strict=True) if np.isfinite(p).all()}
    sizes = {len(p) for p in landmarks.values()}
    if len(sizes) > 1:
        raise KalmarkError(f"{log.name}: got points with and without a signature, expected one kind to replay")
    events = _recognised(reports, landmarks, (*slam.robots,) if sizes == {2} else ())
    if not any(isinstance(event, ReplayedScan) for event in events):
        nameless = any(o.reason == NO_ID for report in reports for o in report.observations)
        hint = "; without ids try --set association.type=auto" if nameless else ""
        raise KalmarkError(f"{log.name}: no observation is of a landmark of the map, expected some to replay{hint}")
    slam = build_slam(_on_known_map(config), log)
    for name, mean in landmarks.items():
        slam.add_landmark(name, mean)
    again = track(events, f"{log.name}, the path", len(events), show=progress)
    return Recorded(_followed(slam, again, config), landmarks)


def _processed(slam: Slam, event: Event, config: Config) -> Report | None:
    """Process an event; None for a bad one that the configuration leaves out."""
    try:
        return slam.process(event)
    except EventError:
        if config.log.on_error == "raise":
            raise
        return None
    except DivergedError as error:
        raise KalmarkError(f"campaign: {error}, expected a filter that gets through its own log") from None


def _recognised(
    reports: list[Report], landmarks: dict[Id, Array], robots: tuple[str, ...]
) -> list[Event | ReplayedScan]:
    """Return the events with scans as looks at the landmarks of the final map; each is looked at once in a scan."""
    merged: dict[Id, Id] = {}
    for report in reversed(reports):
        for gone, into, _ in report.merged:
            merged[gone] = merged.get(into, into)
    events: list[Event | ReplayedScan] = []
    for report in reports:
        if not isinstance(report.event, Scan):
            events.append(report.event)
            continue
        rows: dict[Id, int] = {}
        for o in report.observations:
            name: Any = o.id if o.landmark is None else merged.get(o.landmark, o.landmark)
            if o.outcome != "rejected" and name != report.robot and (name in landmarks or name in robots):
                rows.setdefault(name, o.index)
        if rows:
            events.append(ReplayedScan(report.event, tuple(rows.values()), tuple(rows)))
    return events


def _on_known_map(config: Config) -> Config:
    """Return the configuration with the association given, and every landmark kept as it is."""
    own = {"association": None, "upkeep": None, "attention": None}
    robots = {
        name: robot.model_copy(
            update={"sensors": {key: sensor.model_copy(update=own) for key, sensor in robot.sensors.items()}}
        )
        for name, robot in config.robots.items()
    }
    trusted = section_of("association", "identity").model_validate({"gate": "off"})
    given = {"association": trusted, "upkeep": section_of("upkeep", "upkeep")()}
    given["map"] = config.map.model_copy(update={"known": None, "landmarks": ()})  # all of the map is given
    return config.model_copy(update={"robots": robots, **given})


def _followed(slam: Slam, events: Iterable[Event | ReplayedScan], config: Config) -> list[Steer | ReplayedScan | Fix]:
    """Return the events, each control with the pose at the end of its interval."""
    followed: list[Steer | ReplayedScan | Fix] = []
    acting: dict[str, tuple[int, Steer]] = {}  # by robot: which control is in force, or was the last increment
    for event in events:
        raw = event.scan(event.event.y[list(event.rows)], event.real) if isinstance(event, ReplayedScan) else event
        if _processed(slam, raw, config) is None:
            continue
        if not isinstance(event, Control):
            followed.append(cast("ReplayedScan | Fix", event))
            continue
        name = event.robot
        at, before = acting.get(name, (0, None))
        P = slam.covariance(name)
        xy = 0.5 * (P[0, 0] + P[1, 1])  # alike in all directions: a robot beside its path may turn towards it
        end = slam.mean(name), np.diag([xy, xy, P[2, 2]]) + LEAST
        dt_s = 0.0 if before is None else (event.t_ns - before.event.t_ns) * 1e-9
        held = slam.robots[name].motion.held
        if held and before is not None:
            followed[at] = Steer(before.event, dt_s, *end)
        steer = Steer(event) if held else Steer(event, dt_s, *end)
        acting[name] = len(followed), steer
        followed.append(steer)
    return followed


@dataclass(frozen=True, eq=False)
class Replay:
    """A configuration and its log, to be simulated again and again.

    >>> from kalmark.campaign.replay import replay_of
    >>> from kalmark.simulate import load_world, simulate
    >>> world = load_world("cloister", ["steps=10"])
    >>> replay = replay_of(world.config(), simulate(world), progress=False)
    >>> replay.robots, len(replay.times())
    (('robot',), 10)
    """

    name: str
    settings: Config
    robots: tuple[str, ...]
    recorded: Recorded
    description: str

    def config(self) -> Config:
        """Return the filter's configuration, with the start of every robot in it."""
        return self.settings

    def times(self) -> tuple[int, ...]:
        """Return the times (ns) at which any robot scans."""
        return tuple(sorted({e.event.t_ns for e in self.recorded.events if isinstance(e, ReplayedScan)}))

    def to_yaml(self) -> str:
        """Return the text of the configuration as the user has it, defaults written out."""
        return self.description

    def simulation(self, seed: int | SeedSequence | Generator) -> Simulation:
        """Return one simulated run."""
        return _Replaying(self, Chance(seed)).simulation()


def replay_of(config: Config, log: Log, progress: bool = True) -> Replay:
    """Return the replay of a configuration over its log, which goes through the filter for that, twice.

    Raises ConfigError on what cannot be replayed, KalmarkError where the filter gives up or nothing was seen.
    """
    config = with_log_description(config, log)
    robots = {name: build_robot(config, name, log) for name in log.robots}
    sections: dict[str, Any] = {}
    for name, robot in robots.items():
        refuse_unsupported(config, name, robot)
        section, (x_m, y_m, theta_rad) = config.robots.get(name) or config.robots["each"], robot.start
        start = section.start or StartConfig(x_m=float(x_m), y_m=float(y_m), theta_rad=float(theta_rad))
        sections[name] = section.model_copy(update={"start": start})
    settings = config.model_copy(update={"robots": sections})
    written = config_yaml(config_dict(config))
    return Replay(
        name_on(config.name, log.name), settings, log.robots, record_for_replay(settings, log, progress), written
    )


def refuse_unsupported(config: Config, name: str, robot: Robot) -> None:
    """Refuse robots of space, states of more than a pose, and sensors whose scans a detector searches for landmarks."""
    path = ("robots", name if name in config.robots else "each")
    got = f"got {config.robots[path[1]].motion.type}"
    if robot.motion.space.world != "plane":
        what = f"{got}, a motion of space, expected one of the plane to replay a log"
        raise config.error((*path, "motion"), what)
    if robot.motion.space.size > SE2.size:
        raise config.error((*path, "motion"), f"{got}, expected a motion of which the state is a pose to replay a log")
    for key, mount in robot.sensors.items():
        if mount.detector is not None:
            what = "got a detector, expected scans of landmarks, not raw ones (victoria_park_known has such)"
            raise config.error((*path, "sensors", key, "detector"), what)


@dataclass
class _Driven:
    """A robot on its way: its true state, its held control, the control given to the filter, and its sensors."""

    motion: Any
    state: Array
    constants: Array  # of its controls
    sensors: dict[str, tuple[Any, Array]]
    drive: HeldInput
    given: Array = field(default_factory=lambda: np.zeros(0))

    def move(self, rng: Generator, *parts: MotionPart | None) -> None:
        """Move by parts of a control, with the diffusion of the control that the filter has."""
        for part in filter(None, parts):
            self.state, *_ = self.motion.move(self.state, part.u, part.dt_s)
            self.state = add_diffusion(self.motion, self.state, self.given, part.dt_s, rng)


class _Replaying:
    """One run of a replay, event by event."""

    def __init__(self, replay: Replay, chance: Chance) -> None:
        self.replay, self.chance = replay, chance
        self.robots: dict[str, _Driven] = {}
        for name in replay.robots:
            robot = build_robot(replay.settings, name)
            motion, start = robot.motion, draw_start(robot, chance.route)
            constants = draw_constants(motion, chance.route)
            sensors = {key: draw_mount(mount, chance.mounts) for key, mount in robot.sensors.items()}
            self.robots[name] = _Driven(motion, start, constants, sensors, HeldInput(motion))
        self.events: list[Event] = []
        self.origins: dict[Key, tuple[Id | None, ...]] = {}

    def simulation(self) -> Simulation:
        """Return the log of all events, and the true states after each scan."""
        start = {name: robot.state for name, robot in self.robots.items()}
        after: dict[int, dict[str, Array]] = {}
        for event in self.replay.recorded.events:
            if isinstance(event, Steer):
                self._steer(event)
            elif isinstance(event, ReplayedScan):
                self._look(event)
                after[event.event.t_ns] = {name: robot.state for name, robot in self.robots.items()}
            else:
                robot = self.robots[event.robot]
                robot.move(self.chance.control, robot.drive.advance(event.t_ns))
                y = robot.state[:2] + gaussian(event.cov, self.chance.sight)
                self.events.append(Fix(t_ns=event.t_ns, robot=event.robot, y=y, cov=event.cov))
        times = np.array([*after], dtype=np.int64)
        states = {name: np.array([start[name], *(poses[name] for poses in after.values())]) for name in self.robots}
        landmarks = {i: p[:2] for i, p in self.replay.recorded.landmarks.items()}
        truth = {name: Trajectory(times, poses[1:]) for name, poses in states.items()}
        mounts = {(n, key): at for n, robot in self.robots.items() for key, (_, at) in robot.sensors.items()}
        log = Log(self.replay.name, self.replay.robots, self.events, "simulated", truth=truth, landmarks=landmarks)
        return Simulation(log, states, mounts, self.origins)

    def _steer(self, steer: Steer) -> None:
        """Take the control that leads back to the path, and give it to the filter with noise."""
        event, robot, rng = steer.event, self.robots[steer.event.robot], self.chance.control
        robot.move(rng, robot.drive.advance(event.t_ns, last=True))
        N = control_covariance(robot.motion, event)
        u = steer_to_path(robot.motion, robot.state, steer, N)
        robot.given = given_control(robot.motion, u, robot.constants, steer.dt_s) + gaussian(N, rng)
        self.events.append(replace(event, u=robot.given))
        robot.move(rng, *robot.drive.accept(replace(event, u=u, cov=None)))

    def _look(self, look: ReplayedScan) -> None:
        """Look at the same landmarks; what cannot be seen from where the robot truly is is left out."""
        event, robot = look.event, self.robots[look.event.robot]
        for name in (event.robot, *(name for name in look.real if name in self.robots)):
            other = self.robots[str(name)]
            other.move(self.chance.control, other.drive.advance(event.t_ns))
        places = {name: other.state[:2] for name, other in self.robots.items()} | self.replay.recorded.landmarks
        sensor, at = robot.sensors[event.sensor]
        v = things_in_frame(POINTS, sensor_pose(robot.state, at)[0], np.array([places[name] for name in look.real]))
        inside, e = exact_measurements(sensor, v, np.zeros(len(v)))
        y = noisy_measurements(sensor, e[inside], self.chance.sight, None if look.cov is None else look.cov[inside])
        seen = is_reportable(sensor, y)
        rows = np.flatnonzero(inside)[seen].tolist()
        told = None if event.ids is None else [event.ids[look.rows[i]] for i in rows]
        self.events.append(look.scan(y[seen], told, rows))
        self.origins[event.t_ns, event.robot, event.sensor] = tuple(look.real[i] for i in rows)


def steer_to_path(motion: Any, r: Array, steer: Steer, N: Array) -> Array:
    """Return the control (m,) between the log's and the one from r (size,) to the path at the end of the interval.

    Least squares: the control differs from the log's by its noise N (m, m), bias and diffusion, the end from the path
    by the covariance of the path.  Two steps of Gauss-Newton.
    """
    u, dt_s = steer.event.u, steer.dt_s
    if motion.held and not dt_s:
        return u
    end, _, R_u = motion.move(r, u, dt_s)
    M, D, model = N, motion.diffusion(u, dt_s), self_calibrating(motion)
    if model is not None:
        B = model.calibration_effect(u, dt_s)
        M = M + B @ model.calibration_cov @ B.T
    if D is not None:  # as a control; one that hardly moves the robot, like the steering at rest, is left alone
        A = np.linalg.solve(R_u.T @ R_u + (0.1 * dt_s) ** 2 * np.eye(len(u)), R_u.T) @ body_axes(r, len(D))
        M = M + A @ D @ A.T
    if not M.any():
        return u
    goal, v = turn_to_path(r, end, steer.goal, dt_s), u
    for _ in range(2):
        end, _, R_u = motion.move(r, v, dt_s)
        z = goal - end
        z[2] = wrap(z[2])
        B = M @ R_u.T
        v = u + B @ np.linalg.solve(R_u @ B + steer.cov, z + R_u @ (v - u))
    return v


def turn_to_path(r: Array, end: Array, goal: Array, dt_s: float) -> Array:
    """Return the pose `goal` (3,), rotated towards the path by the lateral distance of `end`: cars do not slip."""
    c, s = np.cos(goal[2]), np.sin(goal[2])
    beside = c * (end[1] - goal[1]) - s * (end[0] - goal[0])
    along = c * (end[0] - r[0]) + s * (end[1] - r[1])
    way = max(BACK_M, abs(along) / max(dt_s, 1e-3) * BACK_S)
    turn = min(max(beside / way, -BACK_RAD), BACK_RAD) * along / (abs(along) + 0.01 * dt_s + 1e-9)  # none at rest
    return np.array([goal[0], goal[1], goal[2] - turn])
