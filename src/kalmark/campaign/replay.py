"""`Replay`: a parametric bootstrap of a log.  The same route, the same sightings, all noise drawn anew from the models.

The map that the filter makes of the log is the truth now.  A robot follows the log's path *by its own motion*: it
takes, for each control of the log, one near it that leads to where the robot was at the end of the interval; its filter
is told that one with noise.  Each scan sees the landmarks that it saw in the log, from the true pose.

The true control depends on where the robot truly is, its error does not: that is all that a filter assumes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.random import Generator, SeedSequence

from kalmark.campaign.recorded import Look, Recorded, Steer, recorded
from kalmark.config.building import build_robot, config_dict
from kalmark.config.opening import described
from kalmark.config.schema import Config, StartConfig
from kalmark.config.tree import name_on
from kalmark.events import Control, Event, Fix, Id
from kalmark.geometry.angles import wrap
from kalmark.logs.log import Log, Trajectory
from kalmark.models.observe import composed
from kalmark.models.protocols import bias_covariance
from kalmark.results.files import config_yaml
from kalmark.simulate.robots import Chance, Key, Simulation, body_axes, diffused, drawn_mount, drawn_start
from kalmark.simulate.sights import POINTS, exact, gaussian, in_frame, noisy, possible
from kalmark.slam.motion import HeldInput, Part
from kalmark.slam.robot import Robot

Array = npt.NDArray[np.float64]

BACK_S, BACK_M, BACK_RAD = 2.0, 0.5, 0.3  # the path is met again in so long a time, or on so long a way; not steeper


@dataclass(frozen=True, eq=False)
class Replay:
    """A configuration and its log, to be simulated again and again."""

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
        return tuple(sorted({e.event.t_ns for e in self.recorded.events if isinstance(e, Look)}))

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
    config = described(config, log)
    robots = {name: build_robot(config, name, log) for name in log.robots}
    sections: dict[str, Any] = {}
    for name, robot in robots.items():
        refuse_other(config, name, robot)
        section, (x_m, y_m, theta_rad) = config.robots.get(name) or config.robots["each"], robot.start
        start = section.start or StartConfig(x_m=float(x_m), y_m=float(y_m), theta_rad=float(theta_rad))
        sections[name] = section.model_copy(update={"start": start})
    settings = config.model_copy(update={"robots": sections})
    written = config_yaml(config_dict(config))
    return Replay(name_on(config.name, log.name), settings, log.robots, recorded(settings, log, progress), written)


def refuse_other(config: Config, name: str, robot: Robot) -> None:
    """Refuse robots of space, and sensors whose scans a detector searches for landmarks."""
    path = ("robots", name if name in config.robots else "each")
    if robot.motion.space.world != "plane":
        what = f"got {config.robots[path[1]].motion.type}, a motion of space, expected one of the plane to replay a log"
        raise config.error((*path, "motion"), what)
    for key, mount in robot.sensors.items():
        if mount.detector is not None:
            what = "got a detector, expected scans of landmarks, not raw ones (victoria_park_known has such)"
            raise config.error((*path, "sensors", key, "detector"), what)


@dataclass
class _Driven:
    """A robot on its way: its true state, the control it holds, the one it was told, and what it carries."""

    motion: Any
    state: Array
    bias: Array | float
    sensors: dict[str, tuple[Any, Array]]
    drive: HeldInput
    told: Array = field(default_factory=lambda: np.zeros(0))

    def advance(self, t_ns: int, rng: Generator, last: bool = False) -> None:
        """Move by the control in force."""
        part = self.drive.advance(t_ns, last)
        if part is not None:
            self.move(part, rng)

    def move(self, part: Part, rng: Generator) -> None:
        """Move by a part of a control; what it diffuses is that of the control that the filter knows."""
        self.state, *_ = self.motion.move(self.state, part.u, part.dt_s)
        self.state = diffused(self.motion, self.state, self.told, part.dt_s, rng)


class _Replaying:
    """One run of a replay, event by event."""

    def __init__(self, replay: Replay, chance: Chance) -> None:
        self.replay, self.chance = replay, chance
        self.robots = {name: self._driven(build_robot(replay.settings, name)) for name in replay.robots}
        self.events: list[Event] = []
        self.origins: dict[Key, tuple[Id | None, ...]] = {}

    def _driven(self, robot: Robot) -> _Driven:
        motion, cov = robot.motion, bias_covariance(robot.motion)
        start = drawn_start(robot, self.chance.route)
        sensors = {key: drawn_mount(mount, self.chance.mounts) for key, mount in robot.sensors.items()}
        return _Driven(
            motion, start, 0.0 if cov is None else gaussian(cov, self.chance.route), sensors, HeldInput(motion)
        )

    def simulation(self) -> Simulation:
        """Return the log of all events, and what it does not tell: states as they are after each scan."""
        start = {name: robot.state for name, robot in self.robots.items()}
        after: dict[int, dict[str, Array]] = {}
        for event in self.replay.recorded.events:
            if isinstance(event, Steer):
                self._steer(event)
            elif isinstance(event, Look):
                self._look(event)
                after[event.event.t_ns] = {name: robot.state for name, robot in self.robots.items()}
            else:
                robot = self.robots[event.robot]
                robot.advance(event.t_ns, self.chance.control)
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
        """Take the control that leads back to the path, and tell it with noise."""
        event, robot, rng = steer.event, self.robots[steer.event.robot], self.chance.control
        robot.advance(event.t_ns, rng, last=True)
        N = robot.motion.control_noise(event.u) if event.cov is None else event.cov
        u = steered(robot.motion, robot.state, steer, N)
        robot.told = u - robot.bias + gaussian(N, rng)
        self.events.append(Control(t_ns=event.t_ns, robot=event.robot, u=robot.told, cov=event.cov))
        for part in robot.drive.accept(Control(t_ns=event.t_ns, robot=event.robot, u=u)):
            robot.move(part, rng)

    def _look(self, look: Look) -> None:
        """Look at the same landmarks; what cannot be seen from where the robot truly is is left out."""
        event, robot = look.event, self.robots[look.event.robot]
        for name in (event.robot, *(name for name in look.real if name in self.robots)):
            self.robots[str(name)].advance(event.t_ns, self.chance.control)
        places = {name: other.state[:2] for name, other in self.robots.items()} | self.replay.recorded.landmarks
        sensor, at = robot.sensors[event.sensor]
        v = in_frame(POINTS, composed(robot.state, at)[0], np.array([places[name] for name in look.real]))
        inside, e = exact(sensor, v, np.zeros(len(v)))
        y = noisy(sensor, e[inside], self.chance.sight, None if look.cov is None else look.cov[inside])
        seen = possible(sensor, y)
        rows = np.flatnonzero(inside)[seen].tolist()
        told = None if event.ids is None else [event.ids[look.rows[i]] for i in rows]
        self.events.append(look.scan(y[seen], told, rows))
        self.origins[event.t_ns, event.robot, event.sensor] = tuple(look.real[i] for i in rows)


def steered(motion: Any, r: Array, steer: Steer, N: Array) -> Array:
    """Return the control (m,) between the log's and the one from r (size,) to the path at the end of the interval.

    Least squares: the control differs from the log's by its noise N (m, m), bias and diffusion, the end from the path
    by the covariance of the path.  Two steps of Gauss-Newton.
    """
    u, dt_s = steer.event.u, steer.dt_s
    if motion.held and not dt_s:
        return u
    end, _, R_u = motion.move(r, u, dt_s)
    M, D, bias = N, motion.diffusion(u, dt_s), bias_covariance(motion)
    if bias is not None:
        M = M + bias
    if D is not None:  # as a control; one that hardly moves the robot, like the steering at rest, is left alone
        A = np.linalg.solve(R_u.T @ R_u + (0.1 * dt_s) ** 2 * np.eye(len(u)), R_u.T) @ body_axes(r, len(D))
        M = M + A @ D @ A.T
    if not M.any():
        return u
    goal, v = facing_path(r, end, steer.goal, dt_s), u
    for _ in range(2):
        end, _, R_u = motion.move(r, v, dt_s)
        z = goal - end
        z[2] = wrap(z[2])
        B = M @ R_u.T
        v = u + B @ np.linalg.solve(R_u @ B + steer.cov, z + R_u @ (v - u))
    return v


def facing_path(r: Array, end: Array, goal: Array, dt_s: float) -> Array:
    """Return the pose `goal` (3,), rotated towards the path by the lateral distance of `end`: cars do not slip."""
    c, s = np.cos(goal[2]), np.sin(goal[2])
    beside = c * (end[1] - goal[1]) - s * (end[0] - goal[0])
    along = c * (end[0] - r[0]) + s * (end[1] - r[1])
    way = max(BACK_M, abs(along) / max(dt_s, 1e-3) * BACK_S)
    turn = min(max(beside / way, -BACK_RAD), BACK_RAD) * along / (abs(along) + 0.01 * dt_s + 1e-9)  # none at rest
    return np.array([goal[0], goal[1], goal[2] - turn])
