"""Move robots through a world and let them measure, with the models the filter uses.  [S] 4.1; [TB] SimRob, SimSen.

The guide and the toolbox disturb the *estimator's* control and let the robot move exactly (`noise_on: control`); with
`noise_on: robot` the robot is disturbed and the log holds the command.  Either way the log holds the control
the estimator is given.  A diffusion always disturbs the robot.  A mount with sigmas truly sits elsewhere: the log's
rig is the one configured, and where the sensor sits is drawn around it.  So are the constants of a motion with sigmas:
biases, scales, radii.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.random import Generator, SeedSequence

from kalmark.arrays import Array
from kalmark.config.building import build_robot
from kalmark.detect.laser_scan import RAW, Laser
from kalmark.events import Control, Event, Id, Raw, Scan, seconds_text, sort_key
from kalmark.geometry.angles import rotation
from kalmark.geometry.rotations import matrix
from kalmark.geometry.spaces import SE2, SE3
from kalmark.logs.log import Log, Trajectory
from kalmark.logs.source import landmark_id
from kalmark.models.observe import sensor_pose
from kalmark.models.protocols import (
    POSE,
    Drifting,
    OfState,
    Ranging,
    SeesVelocity,
    TimedNoise,
    coasts,
    diffusion_of,
    parameter_covariance,
    poses_kept,
    range_limit,
    self_calibrating,
    tells_velocity,
    true_control,
)
from kalmark.models.state_sensors import ZeroVelocity2D, ZeroVelocity3D
from kalmark.models.state_view import sees_state, velocity_of, view_of_state
from kalmark.simulate import laser, sights
from kalmark.simulate.layouts import Scenery
from kalmark.simulate.routes import Driver
from kalmark.simulate.sights import POINTS, Sighted, SimulatedSensing, Things, gaussian, things_in_frame
from kalmark.simulate.worlds import World
from kalmark.slam.robot import Mount, Robot

Key = tuple[int, str, str]
ROUNDS = 10  # of a fixed point: a constant changes a control by some percent
WILD = 30.0  # by so many of its own errors an outlier of a sensor of the state is off


@dataclass
class SimSensor:
    """A sensor, where it truly sits, and what is wrong with it; `laser` is the detector of one whose scans are raw.

    `raw` makes the raw data of one that gives no measurements.
    """

    sensor: Any
    at: Array
    sensing: SimulatedSensing
    laser: Laser | None = None
    raw: Callable[..., Raw] | None = None
    walked: int = 0  # the step up to which its constants have walked
    last: tuple[int, Array] | None = None  # step and robot's pose of the last reading or scan
    kept: dict[int, Array] = field(default_factory=dict)  # of an odometer that closes loops: poses by steps,
    left: set[int] = field(default_factory=set)  # and those of them that the robot has left since

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of its scans."""
        return tuple(self.sensor.columns) if self.laser is None else RAW[:2]


@dataclass
class SimRobot:
    """A robot under way: its model, its true state, what steers it, and what it carries."""

    name: str
    motion: Any
    state: Array
    driver: Driver
    sensors: dict[str, SimSensor]
    states: list[Array] = field(default_factory=list)
    constants: Array = field(default_factory=lambda: np.zeros(0))
    u: Array = field(default_factory=lambda: np.zeros(0))  # the control of the last step, as it was done

    @property
    def pose(self) -> Array:
        """The true pose (3,) or (7,)."""
        return self.state[: 3 if self.motion.space.world == "plane" else 7]


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated log and its truth.

    `states` are the true states (steps + 1, n) of each robot, `mounts` where its sensors truly sit, `origins` (by time,
    robot and sensor) what each observation of a scan is really of: an id, or None for a false one; `constants` (c,)
    those by which each robot's controls are wrong; `sensors` are the true ones at the end, by robot and name.
    """

    log: Log
    states: dict[str, Array]
    mounts: dict[tuple[str, str], Array]
    origins: dict[Key, tuple[Id | None, ...]]
    constants: dict[str, Array] = field(default_factory=dict)
    sensors: dict[tuple[str, str], Any] = field(default_factory=dict)


class Chance:
    """The sources of chance, each a random stream of its own, all from one seed."""

    def __init__(self, seed: int | SeedSequence | Generator) -> None:
        streams = np.random.default_rng(seed).spawn(6)
        self.layout, self.route, self.control, self.sight, self.faults, self.mounts = streams


def simulate(world: World, seed: int | SeedSequence | Generator = 0) -> Log:
    """Return the log of one simulated run, with truth; the same seed gives the same log.

    Landmark ids are 1, 2, ... in the world's order.  A scan in which nothing is seen is left out.

    >>> from kalmark.simulate import load_world, simulate
    >>> simulate(load_world("cloister", ["steps=100"]), seed=3)
    <Log 'cloister' of 'robot': 200 events in 9.9 s, with truth>
    """
    return simulation(world, seed).log


def simulation(world: World, seed: int | SeedSequence | Generator = 0) -> Simulation:
    """Return one simulated run: its log and its truth."""
    chance = Chance(seed)
    scenery = world.world.scenery(chance.layout)
    things = things_in(world, scenery, chance.layout)
    area = area_of(scenery, things)
    robots = [sim_robot(world, name, area, chance, scenery) for name in world.robots]
    times = [round(k * world.dt_s * 1e9) for k in range(world.steps + 1)]
    events: list[Event] = []
    origins: dict[Key, tuple[Id | None, ...]] = {}
    for robot in robots:
        if coasts(robot.motion) and robot.sensors:  # it moves from the first event on: the start
            events.append(first_event(robot, next(iter(robot.sensors)), chance))
    for k, (before, now) in enumerate(pairwise(times), 1):
        for robot in robots:
            u = step_robot(robot, world, chance.control)
            events.append(Control(t_ns=before if robot.motion.held else now, robot=robot.name, u=u))
        for robot in robots:
            for scan, real in sensor_scans(robot, robots, things, world, k, now, chance):
                events.append(scan)
                origins[now, scan.robot, scan.sensor] = real
            events += raw_data(robot, k, now, chance)
    states = {r.name: np.array([*r.states, r.state]) for r in robots}
    log = Log(
        world.name, tuple(world.robots), sorted(events, key=sort_key), "simulated",
        truth={r.name: Trajectory(np.array(times), states[r.name][:, : len(r.pose)]) for r in robots},
        landmarks=true_landmarks(things),
        control_columns={r.name: r.motion.columns for r in robots},
        sensor_columns={(r.name, name): s.columns for r in robots for name, s in r.sensors.items()},
    )  # fmt: skip
    mounts = {(r.name, name): s.at for r in robots for name, s in r.sensors.items()}
    carried = {(r.name, name): s.sensor for r in robots for name, s in r.sensors.items()}
    return Simulation(log, states, mounts, origins, {r.name: r.constants for r in robots}, carried)


def scenery_of(world: World, rng: Generator) -> dict[str, Things]:
    """Place what there is to see, points with a signature each if a sensor measures signatures."""
    return things_in(world, world.world.scenery(rng), rng)


def things_in(world: World, scenery: Scenery, rng: Generator) -> dict[str, Things]:
    """Return what there is to see of a scenery, points with a signature each if a sensor measures signatures."""
    things = sights.things_of(scenery, world.dimensions)
    if world.has_signatures:
        points = things[POINTS]
        signatures = rng.uniform(0.0, world.signature_max, len(points.values))
        points.values = np.column_stack([points.values, signatures])
    return things


def area_of(scenery: Scenery, things: dict[str, Things]) -> Array:
    """Return the lower and the upper corner of all there is (2, D)."""
    places = [sort.centres() for sort in things.values() if len(sort.values)]
    places += [scenery.corners] if len(scenery.corners) else []
    centres = np.concatenate(places or [np.zeros((1, things[POINTS].values.shape[1]))])
    return np.array([centres.min(axis=0), centres.max(axis=0)])


def true_landmarks(things: dict[str, Things]) -> dict[Id, Array]:
    """Return by id the points (2|3,), segments (4|6,) from end to end and tags (7,)."""
    points = things[POINTS]
    rows = {POINTS: points.centres()} | {s: t.values for s, t in things.items() if s != POINTS}
    return {i: row.copy() for s, t in things.items() for i, row in enumerate(rows[s], t.first)}


def sim_robot(world: World, name: str, area: Array, chance: Chance, scenery: Scenery) -> SimRobot:
    """Put a robot at its start and its sensors on their mounts, drawn around configured values with sigmas.

    `area` (2, D) has the lower and the upper corner of the world, `scenery` may have raw data for them.
    """
    simulated = world.robots[name]
    robot = build_robot(world.models(), name)
    state = draw_start(robot, chance.route)
    sensors = {}
    for key, mount in robot.sensors.items():
        sensing = simulated.sensing.get(key, SimulatedSensing()).of(simulated.sensors[key], world.dt_s)
        laser = mount.detector if isinstance(mount.detector, Laser) else None
        true, at = draw_mount(mount, chance.mounts)
        raw = scenery.raw_of(true, sensing) if scenery.raw_of is not None and sensing.images else None
        sensors[key] = SimSensor(true, at, sensing, laser, raw)
    driver = simulated.route.driver(robot.motion, world.dt_s, area, chance.route)
    model = self_calibrating(robot.motion)
    constants = np.zeros(0) if model is None else gaussian(model.calibration_cov, chance.mounts)
    return SimRobot(name, robot.motion, state, driver, sensors, constants=constants)


def draw_start(robot: Robot, rng: Generator) -> Array:
    """Return the true start (3,) or (7 or more,) of a robot, drawn around the given one if that has sigmas."""
    space = robot.motion.space
    cov = np.zeros((space.dof, space.dof)) if robot.cov is None else robot.cov
    return space.plus(np.array(robot.start), gaussian(cov, rng))


def draw_mount(mount: Mount, rng: Generator) -> tuple[Any, Array]:
    """Return the true sensor and its true mount (3,) or (7,), drawn around the given ones if these have sigmas."""
    sensor: Any = mount.sensor
    at = np.array(mount.at)
    if mount.cov is not None:
        at = (SE2 if len(at) == 3 else SE3).plus(at, gaussian(mount.cov, rng))
    cov = parameter_covariance(sensor)
    if cov is None:
        return sensor, at
    if not isinstance(mount.sensor, Ranging):
        return sensor.with_parameters(sensor.parameters + gaussian(cov, rng)), at
    scale, bias_m = rng.normal([sensor.scale, sensor.bias_m], [sensor.sigma_scale, sensor.sigma_bias_m]).tolist()
    return replace(sensor, scale=scale, bias_m=bias_m, sigma_scale=0.0, sigma_bias_m=0.0), at


def step_robot(robot: SimRobot, world: World, rng: Generator) -> Array:
    """Move a robot by one step and return the control (m,) that its estimator is given."""
    motion, dt_s, u = robot.motion, world.dt_s, robot.driver(robot.state)
    error = gaussian(motion.control_noise(u), rng)
    noisy, done = (u + error, u) if world.noise_on == "control" else (u, u + error)
    robot.states.append(robot.state)
    robot.u = done
    D = diffusion_of(motion, robot.state, done, dt_s)
    robot.state = disturb_state(motion, motion.move(robot.state, done, dt_s)[0], D, rng)
    return given_control(motion, noisy, robot.constants, dt_s)


def given_control(motion: Any, u: Array, constants: Array, dt_s: float) -> Array:
    """Return the control (m,) that is u (m,) in truth, with the constants (c,) by which all of a robot's are wrong."""
    out = u
    for _ in range(ROUNDS if len(constants) else 0):
        out = out + u - true_control(motion, out, constants, dt_s)[0]
    return out


def add_diffusion(motion: Any, state: Array, u: Array, dt_s: float, rng: Generator) -> Array:
    """Return a state (size,) disturbed by the diffusion of the motion, if any, in `dt_s` of the control u (m,)."""
    return disturb_state(motion, state, motion.diffusion(u, dt_s), rng)


def disturb_state(motion: Any, state: Array, D: Array | None, rng: Generator) -> Array:
    """Return a state (size,) disturbed by a diffusion D (k, k) in the robot's frame."""
    if D is None:
        return state
    d = np.zeros(motion.space.dof)
    d[: len(D)] = body_axes(state, len(D)) @ gaussian(D, rng)
    return motion.space.plus(state, d)


def body_axes(state: Array, size: int) -> Array:
    """Return the matrix (size, size) from errors in the robot's frame to the world's; rates stay in the body's."""
    G = np.eye(size)
    if len(state) < 7:  # a velocity behind a pose of the plane is in the robot's frame anyway
        G[:2, :2] = rotation(state[2])
        return G
    Q = matrix(state[3:7].copy())
    for at in range(0, min(size, 9), 3):
        G[at : at + 3, at : at + 3] = Q
    return G


def sensor_scans(
    robot: SimRobot, robots: list[SimRobot], things: dict[str, Things], world: World, k: int, t_ns: int, chance: Chance
) -> list[tuple[Scan, tuple[Id | None, ...]]]:
    """Return the scans of a robot's sensors from its true pose at step k, and what each observation is really of."""
    found: list[tuple[Scan, tuple[Id | None, ...]]] = []
    for name, carried in robot.sensors.items():
        if carried.raw is not None or not carried.sensing.scans_at(k):
            continue
        if isinstance(carried.sensor, ZeroVelocity2D | ZeroVelocity3D):
            continue
        if carried.laser is not None:
            y = laser.beams(
                carried.laser, carried.sensing, sensor_pose(robot.pose, carried.at)[0], things, chance.sight
            )
            if len(y):
                scan = Scan(t_ns=t_ns, robot=robot.name, sensor=name, y=y)
                found.append((scan, (None,) * len(y)))
            continue
        if isinstance(carried.sensor, OfState):
            read, ids = reading(robot, carried, k, world.dt_s, chance), None
            if carried.sensing.loop_reach_m is not None:
                read, ids = with_loop(robot, carried, k, world.dt_s, read, chance)
            if read is not None:
                scan = Scan(t_ns=t_ns, robot=robot.name, sensor=name, y=read, ids=ids)
                found.append((scan, (robot.name,) * len(read)))
            continue
        sensor, there = carried.sensor, things[sights.looks_for(carried.sensor)]
        others = {r.name: r.pose for r in robots if r is not robot} if world.sight_robots else {}
        t = np.zeros(0)
        if isinstance(sensor, SeesVelocity):  # of what stands still
            t, others = sensor_velocity(robot, carried, k, world.dt_s), {}
        sighted = observe_things(sensor, sensor_pose(robot.pose, carried.at)[0], there, others, world, chance.sight, t)
        sighted, real = sights.report_with_faults(sensor, sighted, carried.sensing, k, there, chance.faults)
        y = sights.noisy_measurements(sensor, sighted.e, chance.sight)
        kept = sights.is_reportable(sensor, y)
        if len(kept):
            ids = [sighted.ids[i] for i in kept] if world.ids else None
            scan = Scan(t_ns=t_ns, robot=robot.name, sensor=name, y=y[kept], ids=ids)
            carried.last = k, robot.pose.copy()
            found.append((scan, tuple(real[i] for i in kept)))
    return found


def raw_data(robot: SimRobot, k: int, t_ns: int, chance: Chance) -> list[Raw]:
    """Return the raw data of a robot's sensors that give them, from its true pose at step k."""
    return [
        raw_of(robot, name, carried.raw, t_ns, chance)
        for name, carried in robot.sensors.items()
        if carried.raw is not None and carried.sensing.scans_at(k)
    ]


def raw_of(robot: SimRobot, name: str, make: Callable[..., Raw], t_ns: int, chance: Chance) -> Raw:
    """Return the raw data of a sensor, as its scene makes them, from its robot's true pose."""
    T, seed = sensor_pose(robot.pose, robot.sensors[name].at)[0], int(chance.sight.integers(2**62))
    return make(T, t_ns, robot.name, name, seed)


def first_event(robot: SimRobot, name: str, chance: Chance) -> Event:
    """Return the first event of a robot that moves without controls: an empty scan of a sensor, or raw data."""
    make = robot.sensors[name].raw
    if make is None:
        return Scan(t_ns=0, robot=robot.name, sensor=name)
    return raw_of(robot, name, make, 0, chance)


def sensor_velocity(robot: SimRobot, carried: SimSensor, k: int, dt_s: float) -> Array:
    """Return the velocity (2 or 3,) of a sensor at step k in its frame, or the mean since its last scan."""
    k_before, before = carried.last or (0, robot.states[0][: len(robot.pose)])
    state = robot.state if tells_velocity(robot.motion) else np.array(before)
    return velocity_of(robot.motion, carried.at, robot.pose, state, np.array([(k - k_before) * dt_s, *robot.u]))[0]


def reading(robot: SimRobot, carried: SimSensor, k: int, dt_s: float, chance: Chance) -> Array | None:
    """Return what a sensor of the state reads at step k (1, m); None of the first one that counts from the last.

    Its constants walk at random.  A twist that is not in the robot's state is the mean since the last reading.
    """
    of, at = carried.sensor, carried.at
    last, walked_s = carried.last, (k - carried.walked) * dt_s
    before, k_before = (robot.states[0][: len(robot.pose)], 0) if last is None else last[::-1]
    since_s, carried.last, carried.walked = (k - k_before) * dt_s, (k, robot.pose.copy()), k
    if isinstance(of, Drifting) and (Q := of.drift(walked_s)).any():
        of = carried.sensor = of.with_parameters(of.parameters + chance.sight.normal(0.0, np.sqrt(Q)))  # type: ignore[attr-defined]
    counts = of.views != POSE and not sees_state(of, robot.motion)
    v = view_of_state(of, robot.motion, at, robot.state, np.array(before), np.array([since_s, *robot.u]))
    y, wild = measure_state(carried, v, since_s if counts else 0.0, chance)
    if wild < (carried.sensing.dropouts or 0.0):
        carried.last = last if counts else carried.last
        return None
    return None if counts and last is None else y


def measure_state(carried: SimSensor, v: Array, since_s: float, chance: Chance) -> tuple[Array, float]:
    """Return what a sensor of the state measures of its view v (1, m), and a random number that may drop it."""
    of: Any = carried.sensor
    e, wild = of.expect(v[None])[0], chance.faults.uniform(size=2)
    R = of.noise_since(since_s)[0] if since_s and isinstance(of, TimedNoise) else of.noise(e)[0]
    error = gaussian(R, chance.sight) * (WILD if wild[0] < carried.sensing.outliers else 1.0)
    if len(error) == len(e[0]):
        return np.asarray(e + error), wild[1]
    return SE3.plus(e[0], error)[None], wild[1]  # a pose of space has more numbers than errors


def with_loop(
    robot: SimRobot, carried: SimSensor, k: int, dt_s: float, read: Array | None, chance: Chance
) -> tuple[Array, list[Id | None]]:
    """Return what an odometer reads at step k (n, m): since its last scan, and since one near which it is again.

    That is the nearest of those that are kept, of which the robot has been farther since.  An id is its time.
    """
    of, reach_m, d = carried.sensor, carried.sensing.loop_reach_m or 0.0, len(robot.pose) // 3 + 1
    rows, ids = ([], []) if read is None else ([*read], list[Id | None]([None]))
    far = {j: float(np.linalg.norm(robot.pose[:d] - pose[:d])) for j, pose in carried.kept.items()}
    carried.left |= {j for j, far_m in far.items() if far_m > reach_m}
    near = [j for j in far if j in carried.left and far[j] <= reach_m]
    if near:
        j = min(near, key=far.__getitem__)
        since = np.array([(k - j) * dt_s])
        v = view_of_state(of, robot.motion, carried.at, robot.state, carried.kept[j], since)
        rows, ids = (
            [*rows, *measure_state(carried, v, 0.0, chance)[0]],
            [*ids, landmark_id(seconds_text(round(j * dt_s * 1e9)))],
        )
    carried.kept[k], carried.last = robot.pose.copy(), (k, robot.pose.copy())
    for j in [*carried.kept][: -poses_kept(of)]:
        del carried.kept[j]
    return np.array(rows).reshape(len(rows), len(of.columns)), ids


def observe_things(
    sensor: Any, T: Array, things: Things, others: dict[str, Array], world: World, rng: Generator, velocity: Array
) -> Sighted:  # fmt: skip
    """Return the observations y (K, m) of a sensor at T (3,) or (7,), those of other robots last.

    `velocity` is that of a sensor that measures it, in its frame, of others empty.
    """
    near = things.near(T[: world.dimensions], range_limit(sensor))
    v = things_in_frame(things.sort, T, things.values[near])
    v = np.column_stack([v, np.tile(velocity, (len(v), 1))])
    inside, e = sights.exact_measurements(sensor, v, things.sizes[near])
    near, v, e = near[inside], v[inside], e[inside]
    distance = np.linalg.norm(sights.centre(things.sort, v, world.dimensions), axis=1)
    rows = sights.select_reported(things, near, distance, world.new_per_step, world.max_per_scan, rng)
    ids: list[Id] = [int(i) + things.first for i in near[rows]]
    v, e, sizes = v[rows], e[rows], things.sizes[near[rows]]
    if others and things.sort == POINTS:
        w = things_in_frame(POINTS, T, np.array([pose[: world.dimensions] for pose in others.values()]))
        inside, f = sights.exact_measurements(sensor, w, np.zeros(len(w)))
        v, e, sizes = np.concatenate([v, w[inside]]), np.concatenate([e, f[inside]]), np.append(sizes, 0 * f[inside, 0])
        ids += [name for name, seen in zip(others, inside, strict=True) if seen]
    return Sighted(v, e, sizes, ids)
