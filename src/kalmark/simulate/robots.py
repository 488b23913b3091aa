"""Move robots through a world and let them measure, with the models the filter uses.  [S] 4.1; [TB] SimRob, SimSen.

The guide and the toolbox disturb the *estimator's* control and let the robot move exactly (`noise_on: control`); with
`noise_on: robot` the robot is disturbed and the log holds the command.  Either way the log holds the control
the estimator is given.  A diffusion always disturbs the robot.  A mount with sigmas truly sits elsewhere: the log's
rig is the one configured, and where the sensor sits is drawn around it.  So are the constants of a motion with sigmas:
biases, scales, radii; and the lag of a sensor, which is never negative.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.random import Generator, SeedSequence

from kalmark.arrays import Array, Index
from kalmark.compiled import python_form
from kalmark.config.building import build_robot
from kalmark.detect.laser_scan import RAW, Laser
from kalmark.errors import KalmarkError
from kalmark.events import Control, Event, Id, Raw, Scan, list_names, seconds_text, sort_key
from kalmark.geometry.angles import wrap
from kalmark.geometry.spaces import SE3, mount_space
from kalmark.logs.log import Log, Trajectory
from kalmark.logs.source import landmark_id
from kalmark.models.observe import sensor_pose
from kalmark.models.protocols import (
    PLACES,
    POSE,
    Drifting,
    OfState,
    Ranging,
    SeesVelocity,
    TimedNoise,
    coasts,
    has_velocity_state,
    measures_blocks,
    parameter_covariance,
    poses_kept,
    range_limit,
    self_calibrating,
    true_control,
    with_jacobians,
)
from kalmark.models.state_sensors import ZeroVelocity2D, ZeroVelocity3D
from kalmark.models.state_view import sees_state, velocity_of, view_of_state
from kalmark.simulate import laser, sights
from kalmark.simulate.layouts import Scenery
from kalmark.simulate.routes import Course, Ways, aim, disturb_state, drive_leg, python_ways
from kalmark.simulate.sights import POINTS, Sighted, SimulatedSensing, Things, gaussian, things_in_frame
from kalmark.simulate.worlds import World
from kalmark.slam.robot import Mount, Robot
from kalmark.tracks.classes import Classes

Key = tuple[int, str, str]
# step, sensor, y, ids, or names of blocks, and origins
Found = tuple[int, str, Array, list[Any] | None, tuple[Id | None, ...]]
AT_ONCE = 2**14  # observations of landmarks, seen or not, that are made at once
ROUNDS = 10  # of a fixed point: a constant changes a control by some percent
WILD = 30.0  # by so many of its own errors an outlier of a sensor of the state is off


@dataclass
class SimSensor:
    """A sensor, where it truly sits, and what is wrong with it; `laser` is the detector of one whose scans are raw.

    `raw` makes the raw data of one that gives no measurements, `classes` are those that it reports, its stamps
    are `late_s` later than what its scans show.
    """

    sensor: Any
    at: Array
    sensing: SimulatedSensing
    laser: Laser | None = None
    raw: Callable[..., Raw] | None = None
    classes: Classes | None = None
    late_s: float = 0.0
    frames: Array = field(default_factory=lambda: np.zeros((0, 3)))  # its true poses (steps + 1, 3 or 7)
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
    """A robot: its model, and what it carries.

    `states` (steps + 1, n) are the true ones, `poses` (steps + 1, 3 or 7) a view of them, `given` (steps, m) the
    controls that its estimator is given, `done` those that moved it; by `constants` (c,) all controls are wrong.
    """

    name: str
    motion: Any
    sensors: dict[str, SimSensor]
    states: Array
    poses: Array
    given: Array
    done: Array
    course: Course
    target: Array
    constants: Array


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
        streams = np.random.default_rng(seed).spawn(7)
        self.layout, self.route, self.control, self.sight, self.faults, self.mounts, self.classes = streams


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
    chance, times = Chance(seed), [0, *world.times()]
    robots, things = drive_all(world, [build_robot(world.models(), name) for name in world.robots], chance)
    events: list[Event] = []
    origins: dict[Key, tuple[Id | None, ...]] = {}
    for robot in robots:
        if coasts(robot.motion) and robot.sensors:  # it moves from the first event on: the start
            name = next(iter(robot.sensors))
            scan = Scan(t_ns=0, robot=robot.name, sensor=name)
            events.append(scan if robot.sensors[name].raw is None else raw_of(robot, name, 0, 0, chance))
    for robot in robots:
        at = times[:-1] if robot.motion.held else times[1:]
        events += [Control(t_ns=t_ns, robot=robot.name, u=u) for t_ns, u in zip(at, robot.given, strict=True)]
    for steps in spans(world, robots, things):
        for robot in robots:
            for k, name, y, ids, real in sensor_scans(robot, robots, things, world, steps, chance):
                t_ns = times[k] + round(robot.sensors[name].late_s * 1e9)
                classes = reported_classes(robot.sensors[name], things[POINTS], real, chance)
                told: Any = {"of" if measures_blocks(robot.sensors[name].sensor) else "ids": ids}
                events.append(Scan(t_ns=t_ns, robot=robot.name, sensor=name, y=y, classes=classes, **told))
                origins[t_ns, robot.name, name] = real
            for name, carried in robot.sensors.items():
                if carried.raw is not None:
                    at_k = steps[carried.sensing.scans_at(steps)].tolist()
                    events += [raw_of(robot, name, k, times[k], chance) for k in at_k]
    log = Log(
        world.name, tuple(world.robots), sorted(events, key=sort_key), "simulated",
        truth={r.name: Trajectory(np.array(times), r.poses) for r in robots},
        landmarks=true_landmarks(things),
        control_columns={r.name: r.motion.columns for r in robots},
        sensor_columns={(r.name, name): s.columns for r in robots for name, s in r.sensors.items()},
    )  # fmt: skip
    mounts = {(r.name, name): s.at for r in robots for name, s in r.sensors.items()}
    true_sensors = {(r.name, name): s.sensor for r in robots for name, s in r.sensors.items()}
    constants = {r.name: r.constants for r in robots}
    return Simulation(log, {r.name: r.states for r in robots}, mounts, origins, constants, true_sensors)


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
    points, count = things[POINTS], max(map(len, world.class_names()), default=0)
    drawn = rng.integers(count, size=len(points.values)) if count and scenery.classes is None else scenery.classes
    points.classes = drawn
    return things


def reported_classes(
    carried: SimSensor, points: Things, real: Sequence[Id | None], chance: Chance
) -> list[str | None] | None:
    """Return the classes that a sensor reports of what is `real` (K,), some of them wrong; None if it reports none."""
    if carried.classes is None or points.classes is None:
        return None
    out, names, M = list[str | None](), carried.classes.names, carried.classes.confusion_matrix
    for name in real:
        at = name - points.first if isinstance(name, int) else -1
        of = int(points.classes[at]) if 0 <= at < len(points.classes) else len(names)
        out.append(names[int(chance.classes.choice(len(names), p=M[of]))] if of < len(names) else None)
    return out


def true_landmarks(things: dict[str, Things]) -> dict[Id, Array]:
    """Return by id the points (2|3,), segments (4|6,) from end to end and tags (7,)."""
    points = things[POINTS]
    rows = {POINTS: points.centres()} | {s: t.values for s, t in things.items() if s != POINTS}
    return {i: row.copy() for s, t in things.items() for i, row in enumerate(rows[s], t.first)}


def sim_robot(world: World, robot: Robot, area: Array, chance: Chance, scenery: Scenery) -> SimRobot:
    """Put a robot at its start and its sensors on their mounts, drawn around configured values with sigmas.

    `area` (2, D) has the lower and the upper corner of the world, `scenery` may have raw data for them.
    """
    simulated, motion = world.robots[robot.name], robot.motion
    states = np.empty((world.steps + 1, motion.space.size))
    states[0] = draw_start(robot, chance.route)
    sensors = {}
    for key, mount in robot.sensors.items():
        sensing = simulated.sensing.get(key, SimulatedSensing()).of(simulated.sensors[key], world.dt_s)
        laser = mount.detector if isinstance(mount.detector, Laser) else None
        true, at = draw_mount(mount, chance.mounts)
        raw = scenery.raw_of(true, sensing) if scenery.raw_of is not None and sensing.images else None
        lag_s = mount.lag_s + (chance.mounts.normal(0.0, mount.sigma_lag_s) if mount.sigma_lag_s else 0.0)
        sensors[key] = SimSensor(true, at, sensing, laser, raw, mount.classes, max(lag_s + sensing.late_s, 0.0))
    course = simulated.route.course(world.steps, world.dt_s, area, chance.route)
    constants = draw_constants(motion, chance.mounts)
    given, done = np.empty((2, world.steps, len(motion.columns)))
    poses = states[:, : 3 if world.dimensions == 2 else 7]
    return SimRobot(robot.name, motion, sensors, states, poses, given, done, course, next(course[1]), constants)


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
        at = mount_space(len(at)).plus(at, gaussian(mount.cov, rng))
    cov = parameter_covariance(sensor)
    if cov is None:
        return sensor, at
    if not isinstance(mount.sensor, Ranging):
        return sensor.with_parameters(sensor.parameters + gaussian(cov, rng)), at
    scale, bias_m = rng.normal([sensor.scale, sensor.bias_m], [sensor.sigma_scale, sensor.sigma_bias_m]).tolist()
    return replace(sensor, scale=scale, bias_m=bias_m, sigma_scale=0.0, sigma_bias_m=0.0), at


def draw_constants(motion: Any, rng: Generator) -> Array:
    """Return the true constants (c,) by which all controls are wrong; none of a motion that has none."""
    model = self_calibrating(motion)
    return np.zeros(0) if model is None else gaussian(model.calibration_cov, rng)


def given_control(motion: Any, u: Array, constants: Array, dt_s: float) -> Array:
    """Return the control (m,) that is u (m,) in truth, with the constants (c,) by which all of a robot's are wrong."""
    out = u
    for _ in range(ROUNDS if len(constants) else 0):
        out = out + u - true_control(motion, out, constants, dt_s)[0]
    return out


def add_diffusion(motion: Any, state: Array, u: Array, dt_s: float, rng: Generator) -> Array:
    """Return a state (size,) disturbed by the diffusion of the motion, if any, in `dt_s` of the control u (m,)."""
    D = motion.diffusion(u, dt_s)
    return state if D is None else disturb_state(motion, state, gaussian(D, rng))


def sensor_poses(poses: Array, at: Array) -> Array:
    """Return the poses (K, 3 or 7) of a sensor that sits at (3,) or (7,) of a robot's poses."""
    if len(at) == 7:
        return np.array([sensor_pose(r, at)[0] for r in poses])
    heading = poses[:, 2]
    place = poses[:, 0] + 1j * poses[:, 1] + (at[0] + 1j * at[1]) * np.exp(1j * heading)
    return np.column_stack([place.real, place.imag, heading + at[2]])


def drive_all(
    world: World, robots: Sequence[Robot], chance: Chance, ways: Ways | None = None
) -> tuple[list[SimRobot], dict[str, Things]]:
    """Drive robots through all steps, compiled in `ways`, or in Python; return also what there is to see."""
    scenery, dt_s = world.world.scenery(chance.layout), world.dt_s
    things = things_in(world, scenery, chance.layout)
    places = [sort.centres() for sort in things.values() if len(sort.values)]
    places += [scenery.corners] if len(scenery.corners) else []
    centres = np.concatenate(places or [np.zeros((1, things[POINTS].dimensions))])
    area = np.array([centres.min(axis=0), centres.max(axis=0)])
    driven = [sim_robot(world, robot, area, chance, scenery) for robot in robots]
    z = chance.control.standard_normal(sum(r.given.size + world.steps * r.motion.space.dof for r in driven))
    all_ways = [ways or python_ways(robot.motion, dt_s) for robot in robots]
    leg, at = drive_leg if ways else python_form(drive_leg), 0
    stride = world.steps if len(driven) == 1 else 1  # robots share their chance
    for first in range(0, world.steps, stride):
        for r, by in zip(driven, all_ways, strict=True):
            (controls, ahead, limits), k, last = r.course, first, first + stride
            while k < last:
                r.target = aim(r.target, ahead, 2 * limits[1], r.states[k])
                course, rules = (controls, r.target, limits), (dt_s, world.noise_on == "robot")
                k, at = leg(by, course, (z, at), (k, last), rules, (r.states, r.given, r.done))
    for r in driven:
        for carried in r.sensors.values():
            carried.frames = sensor_poses(r.poses, carried.at)
        if len(r.constants):
            r.given = np.array([given_control(r.motion, u, r.constants, dt_s) for u in r.given])
    return driven, things


def spans(world: World, robots: list[SimRobot], things: dict[str, Things]) -> list[Index]:
    """Return the steps of which the scans are made at once.

    One by one where sensors share chance, false measurements draw more, or what is seen depends on earlier scans.
    """
    steps, size = np.arange(1, world.steps + 1), 1
    carried = [sensor for robot in robots for sensor in robot.sensors.values()]
    alone = carried if len(robots) == len(carried) == 1 and world.dimensions == 2 else []
    for s in alone:
        steady = not (s.laser or s.sensing.outliers or isinstance(s.sensor, OfState | SeesVelocity))
        if steady and sights.looks_for(s.sensor) == POINTS:
            size = max(1, AT_ONCE // max(1, len(things[POINTS].values)))
    return [steps[k : k + size] for k in range(0, len(steps), size)]


def sensor_scans(
    robot: SimRobot, robots: list[SimRobot], things: dict[str, Things], world: World, steps: Index, chance: Chance
) -> Iterator[Found]:
    """Yield the scans of a robot's sensors at some steps; empty ones are left out."""
    names: dict[int, Id | None] = {-1 - i: r.name for i, r in enumerate(robots)} | {0: None}
    for name, carried in robot.sensors.items():
        at = steps[carried.sensing.scans_at(steps)]
        if carried.raw is not None or not len(at) or isinstance(carried.sensor, ZeroVelocity2D | ZeroVelocity3D):
            continue
        k = int(at[0])
        if carried.laser is not None:
            y = laser.beams(carried.laser, carried.sensing, carried.frames[k], things, chance.sight)
            if len(y):
                yield k, name, y, None, (None,) * len(y)
        elif isinstance(carried.sensor, OfState):
            yield from own_readings(robot, name, k, robots, things, world.dt_s, chance)
        else:
            for seen in sight(carried, robot, robots, things, world, at, chance):
                told, real = ([names.get(i, i) for i in part.tolist()] for part in (seen.ids, seen.real))
                for k in np.unique(seen.steps).tolist():
                    rows = slice(*np.searchsorted(seen.steps, (k, k + 1)))
                    carried.last = k, robot.poses[k].copy()
                    yield k, name, seen.e[rows], told[rows] if world.ids else None, tuple(real[rows])


def sight(
    carried: SimSensor, robot: SimRobot, robots: list[SimRobot], things: dict[str, Things], world: World,
    steps: Index, chance: Chance,
) -> Iterator[Sighted]:  # fmt: skip
    """Yield what a sensor of landmarks reports at some steps, with noise and faults, all of a step at once."""
    sensor, there = carried.sensor, things[sights.looks_for(carried.sensor)]
    seen = visible(carried, robot, robots, there, world, steps)
    parts: tuple[Any, ...] = seen
    landmarks = np.count_nonzero(seen.real > 0)
    groups: Iterable[Index] = sights.reported_rows(
        there, Sighted(*(part[:landmarks] for part in parts)), world.new_per_step, world.max_per_scan, chance.sight
    )
    if landmarks < len(seen.real):
        groups = [np.concatenate([*groups, np.arange(landmarks, len(seen.real))])]
    for rows in groups:
        part = sights.report_with_faults(sensor, seen.rows(rows), carried.sensing, there, chance.faults)
        part = part._replace(e=sights.noisy_measurements(sensor, part.e, chance.sight))
        yield part.rows(sights.is_reportable(sensor, part.e))


def visible(
    carried: SimSensor, robot: SimRobot, robots: list[SimRobot], there: Things, world: World, steps: Index
) -> Sighted:
    """Return what a sensor can observe at some steps, or at one: there other robots, too, which are last."""
    sensor, T, d, others = carried.sensor, carried.frames[steps], world.dimensions, np.zeros(0, dtype=np.int64)
    if len(steps) != 1:
        of, near, v = sights.points_in_reach(T, there.values, range_limit(sensor))
    else:
        near, k, moving = there.near(T[0, :d], range_limit(sensor)), int(steps[0]), isinstance(sensor, SeesVelocity)
        if world.sight_robots and there.sort == POINTS and not moving:
            others = np.array([i for i, r in enumerate(robots) if r is not robot], dtype=np.int64)
        places = [robots[i].poses[k, :d] for i in others]
        v = things_in_frame(there.sort, T[0], np.vstack([there.values[near], *places]))
        of = np.zeros(len(v), dtype=np.int64)
        if moving:  # it sees what stands still
            k_before, before = carried.last or (0, robot.poses[0])
            state = robot.states[k] if has_velocity_state(robot.motion) else np.array(before)
            since = np.array([(k - k_before) * world.dt_s, *robot.done[k - 1]])
            t = velocity_of(robot.motion, carried.at, robot.poses[k], state, since)[0]
            v = np.column_stack([v, np.tile(t, (len(v), 1))])
    sizes, ids = np.append(there.sizes[near], 0.0 * others), np.append(near + there.first, -1 - others)
    inside, e = sights.exact_measurements(sensor, v, sizes)
    return Sighted(steps[of], ids, ids, v, e, sizes).rows(np.flatnonzero(inside))


def raw_of(robot: SimRobot, name: str, k: int, t_ns: int, chance: Chance) -> Raw:
    """Return the raw data of a sensor, as its scene makes them, from its robot's true pose at step k."""
    carried, seed = robot.sensors[name], int(chance.sight.integers(2**62))
    assert carried.raw is not None
    return carried.raw(carried.frames[k], t_ns, robot.name, name, seed)


def reading(robot: SimRobot, carried: SimSensor, k: int, dt_s: float, chance: Chance) -> Array | None:
    """Return what a sensor of the state reads at step k (1, m); None of the first one that counts from the last.

    Its constants walk at random.  A twist that is not in the robot's state is the mean since the last reading.
    """
    of, at = carried.sensor, carried.at
    last, walked_s = carried.last, (k - carried.walked) * dt_s
    before, k_before = (robot.poses[0], 0) if last is None else last[::-1]
    since_s, carried.last, carried.walked = (k - k_before) * dt_s, (k, robot.poses[k].copy()), k
    if isinstance(of, Drifting) and (Q := of.drift(walked_s)).any():
        of = carried.sensor = of.with_parameters(of.parameters + chance.sight.normal(0.0, np.sqrt(Q)))  # type: ignore[attr-defined]
    counts = of.views != POSE and not sees_state(of, robot.motion)
    v = view_of_state(of, robot.motion, at, robot.states[k], np.array(before), np.array([since_s, *robot.done[k - 1]]))
    y, wild = measure_state(carried, v, since_s if counts else 0.0, chance)
    if wild < (carried.sensing.dropouts or 0.0):
        carried.last = last if counts else carried.last
        return None
    return None if counts and last is None else y


def own_readings(
    robot: SimRobot, name: str, k: int, robots: list[SimRobot], things: dict[str, Things], dt_s: float, chance: Chance
) -> Iterator[Found]:
    """Yield what a sensor of the state, or of blocks, measures at step k, if all of it is not left out."""
    carried = robot.sensors[name]
    if measures_blocks(carried.sensor):
        yield from readings_between(robot, name, k, robots, things, chance)
        return
    read, ids = reading(robot, carried, k, dt_s, chance), None
    if carried.sensing.loop_reach_m is not None:
        read, ids = with_loop(robot, carried, k, dt_s, read, chance)
    if read is not None:
        yield k, name, read, ids, (robot.name,) * len(read)


def readings_between(
    robot: SimRobot, name: str, k: int, robots: list[SimRobot], things: dict[str, Things], chance: Chance
) -> Iterator[Found]:
    """Yield what a sensor of blocks measures at step k, if all of it is not left out."""
    carried, y, of = robot.sensors[name], list[Array](), list[Any]()
    sensor, d, there = carried.sensor, things[POINTS].dimensions, true_landmarks(things)
    there |= {other.name: other.states[k, : d if sensor.views == PLACES else None] for other in robots}
    for names in carried.sensing.between or ((robot.name,),):
        if missing := {*names} - there.keys():
            raise KalmarkError(f"simulation: the world has no {list_names(missing)}, expected names in it")
        e = np.ravel(with_jacobians(sensor.expect(*(there[name] for name in names)))[0])
        wild, told = chance.faults.uniform(size=2)
        error = gaussian(sensor.noise(e[None])[0], chance.sight) * (WILD if wild < carried.sensing.outliers else 1.0)
        if told >= (carried.sensing.dropouts or 0.0):
            y.append(np.where(sensor.angular, wrap(e + error), e + error))
            of.append(names)
    if y:
        yield k, name, np.array(y), of, (robot.name,) * len(y)


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
    of, reach_m, here = carried.sensor, carried.sensing.loop_reach_m or 0.0, robot.poses[k]
    d = len(here) // 3 + 1
    rows, ids = ([], []) if read is None else ([*read], list[Id | None]([None]))
    far = {j: float(np.linalg.norm(here[:d] - pose[:d])) for j, pose in carried.kept.items()}
    carried.left |= {j for j, far_m in far.items() if far_m > reach_m}
    near = [j for j in far if j in carried.left and far[j] <= reach_m]
    if near:
        j = min(near, key=far.__getitem__)
        since = np.array([(k - j) * dt_s])
        v = view_of_state(of, robot.motion, carried.at, robot.states[k], carried.kept[j], since)
        rows, ids = (
            [*rows, *measure_state(carried, v, 0.0, chance)[0]],
            [*ids, landmark_id(seconds_text(round(j * dt_s * 1e9)))],
        )
    carried.kept[k], carried.last = here.copy(), (k, here.copy())
    for j in [*carried.kept][: -poses_kept(of)]:
        del carried.kept[j]
    return np.array(rows).reshape(len(rows), len(of.columns)), ids
