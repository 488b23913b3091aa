"""The batched engine: runs of one world, filtered and scored in compiled code without Python in a step.

A run has the numbers of the ordinary path (`simulation`, `score`) up to rounding.  The simulator is the same, its robot
driven in compiled code.  The filter calls the compiled prediction and correction that `Slam.process` calls, by their
addresses.  `refusal` has the reasons why the engine does not run a world; a run that it cannot finish, such as one
whose filter diverges, is left to the ordinary path, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.random import SeedSequence

from kalmark.arrays import Array, Index
from kalmark.association import ByIdentity
from kalmark.campaign.scoring import SERIES, Scores, scores_of
from kalmark.compiled import address_of, by_address, compiled, signature_of
from kalmark.config.building import build_robot, build_slam
from kalmark.config.schema import Config
from kalmark.filter import corrections, kernels, prediction
from kalmark.filter.estimators import Ekf, Invariant
from kalmark.filter.maps import DENSE
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose, from_frame_many, inv_scan_many
from kalmark.geometry.spaces import HEADING, VECTOR, Table
from kalmark.management.attention import EVERYTHING
from kalmark.models.landmarks import Point2D
from kalmark.models.observe import step_of
from kalmark.models.protocols import parameter_covariance, self_calibrating
from kalmark.models.sensors import RangeBearing
from kalmark.results.measures import MAP_NEES, log_translation, map_nees
from kalmark.simulate.robots import Chance, drive_all, scenery_of, sight, spans
from kalmark.simulate.routes import MOTIONS, compiled_ways
from kalmark.simulate.sights import POINTS, Sighted
from kalmark.simulate.worlds import World
from kalmark.slam.robot import Mount
from kalmark.slam.slam import Slam

PREDICT = signature_of(
    "b1(Tuple((f8[::1], f8[::1], f8[:, ::1], i8, i8[:, ::1], i8[:, ::1], i8)), "
    "Tuple((Tuple((i8, f8[::1])), i8, i8[::1], b1, b1, f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8)), b1, b1)"
)
CORRECT = signature_of(
    f"Tuple((f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[::1], b1[::1], b1))({corrections.TO_CORRECT}, Tuple((i8, f8)))"
)
call_predict, call_correct = by_address(PREDICT), by_address(CORRECT)


# of ranges and bearings: sigma_range_m, sigma_range_rel, sigma_bearing_rad, scale and bias_m
Noise = tuple[float, float, float, float, float]
Observations = tuple[Index, Index, Index, Array, Array]  # as `by_landmark` returns


# ---------------------------------------------------------------------- what the engine runs
def refusal(world: Any, configs: Mapping[str, Config]) -> str:
    """Return the reasons why the engine does not run a scene with these filters; empty if it does."""
    if not isinstance(world, World):
        return "the batched engine does not replay logs"
    if world.dimensions != 2 or len(world.robots) != 1:
        return "the batched engine runs one robot of the plane"
    ((name, simulated),) = world.robots.items()
    if len(simulated.sensors) != 1:
        return "the batched engine runs one sensor"
    robot = build_robot(world.models(), name)
    (mount,) = robot.sensors.values()
    why = _odd_models(robot.motion, mount)
    if not why and any(sensing.outliers or sensing.swapped for sensing in simulated.sensing.values()):
        why = "the batched engine has no outliers and no swapped ids: it rejects nothing"
    if not why and not world.ids:
        why = "the batched engine needs known ids"
    things = scenery_of(world, np.random.default_rng(0))
    if not why and sum(len(sort.values) for sort in things.values()) > len(things[POINTS].values):
        why = "the batched engine has no landmarks but points"
    return why or next(filter(None, (_odd_filter(c, name, len(things[POINTS].values)) for c in configs.values())), "")


def _odd_models(motion: Any, mount: Mount) -> str:
    """Return what of a motion and a mounted sensor the engine does not run."""
    if type(motion) not in MOTIONS or self_calibrating(motion) is not None:
        return "the batched engine has velocities and increments of the plane that do not calibrate themselves"
    if (
        type(mount.sensor) is not RangeBearing
        or parameter_covariance(mount.sensor) is not None
        or mount.cov is not None
        or mount.lags
        or mount.detector is not None
    ):
        return "the batched engine has ranges and bearings, of a sensor whose calibration is known"
    return ""


def _odd_filter(config: Config, name: str, landmarks: int) -> str:
    """Return what of a filter the engine does not run."""
    if config.map.known is not None:
        return "the batched engine has no known maps"
    slam = build_slam(config)
    robot = slam.robots[name]
    ((key, mount),) = robot.sensors.items()
    policy, channel = slam.state.policies[name, key], slam.state.channels[name, key]
    if why := _odd_models(robot.motion, mount):
        return why
    if type(slam.estimator) not in (Ekf, Invariant):
        return f"the batched engine has no estimator {config.estimator.type}"
    if type(policy.association) is not ByIdentity or type(channel.landmark) is not Point2D:
        return "the batched engine has points with known ids"
    is_gated = policy.association.threshold(channel.dof, math.inf) < math.inf
    if channel.robust is not None or is_gated or (robot.max_speed_mps, robot.max_turn_radps) != (None, None):
        return "the batched engine has no robust weights, no gate that is set, and no limits of its robot"
    plain = mount.attention == EVERYTHING and mount.initialization is None
    if not plain or policy.upkeep.p_detect is not None:
        return "the batched engine uses all that is seen, and keeps it"
    kind = slam.state.settings.map
    if kind == "postponed" or (kind == "auto" and landmarks > DENSE):
        return f"the batched engine has dense maps, of up to {DENSE} landmarks"
    return ""


# ---------------------------------------------------------------------- observations
def by_landmark(count: int, steps: Index, numbers: Index, places: Array, y: Array) -> Observations:
    """Return measurements y (N, 2) of points at `places` (N, 2) in `count` steps, in each those of new landmarks last.

    That is where each step begins (count + 1,), where its new ones do (count,), the places of landmarks in the state
    (N,), y (N, 2) and where the landmarks are (L, 2), in the order in which they are seen first.
    """
    first, place = np.zeros((2, numbers.max(initial=0) + 1), np.int64)
    first[numbers[::-1]] = np.arange(len(numbers))[::-1]  # the last one that is written
    new = first[numbers] == np.arange(len(numbers))
    place[numbers[new]] = np.arange(np.count_nonzero(new)) + 1
    rows = np.lexsort((new, steps))
    begins = np.searchsorted(steps, np.arange(count + 1))
    middle = begins[1:] - np.bincount(steps[new], minlength=count)
    return begins, middle, place[numbers[rows]], y[rows], places[new]


# ---------------------------------------------------------------------- filter
@compiled
def textbook(view: Any, map_: Any, scan: Any, limits: tuple[int, float]) -> Any:
    """Correct as `Ekf` does, with the arguments of `invariant`."""
    return corrections.textbook(view, map_, scan, None)


@compiled
def range_variance(noise: Noise, x: float, y: float) -> float:
    """Return the variance of the range of a point at x, y in the sensor's frame, as `RangeBearing.noise_at`."""
    return noise[0] ** 2 + (noise[1] * (noise[3] * math.sqrt(x * x + y * y) + noise[4])) ** 2


@compiled
def noises(
    x: Array, slots: Index, at: Array, noise: Noise
) -> Array:  # fmt: skip
    """Return the noise R (K, 2, 2) of observing the landmarks on `slots` (K,), at their expected ranges."""
    R = np.zeros((len(slots), 2, 2))
    T = compose(x[:3], at)[0]
    c, s = math.cos(T[2]), math.sin(T[2])
    for i in range(len(slots)):
        j = 1 + 2 * slots[i]
        d_x, d_y = x[j] - T[0], x[j + 1] - T[1]
        R[i, 0, 0] = range_variance(noise, c * d_x + s * d_y, c * d_y - s * d_x)
        R[i, 1, 1] = noise[2] ** 2
    return R


@compiled
def start_landmark(
    x: Array, x_first: Array, P: Array, n: int, at: Array, y: Array,
    noise: Noise,
) -> None:  # fmt: skip
    """Add the landmark that explains y (1, 2) from a mount `at` (3,) to the n rows of a map.  [S] (32)-(38)."""
    T, T_r, _ = compose(x[:3], at)
    seen = y.copy()
    seen[0, 0] = (y[0, 0] - noise[4]) / noise[3]
    v, V_y = inv_scan_many(seen)
    l, L_T, L_v = from_frame_many(T, v)
    for i in range(2):
        V_y[0, i, 0] /= noise[3]
        x[n + i] = x_first[n + i] = l[0, i]
    L_r, L_y, R = kernels.product(L_T[0], T_r), kernels.product(L_v[0], V_y[0]), np.zeros((2, 2))
    R[0, 0], R[1, 1] = range_variance(noise, v[0, 0], v[0, 1]), noise[2] ** 2
    kernels.augment(P, n + 2, np.arange(n, n + 2), np.arange(3), L_r, kernels.quadratic(L_y, R))


@compiled
def filter_run(
    ways: tuple[int, int, int], routines: corrections.Routines, view: Any, motion: tuple[int, Array],
    tables: tuple[Table, Table, int], started: tuple[Array, Array], controls: tuple[Array, Array, Array, Array, bool],
    observations: Observations, sensed: tuple[Array, Noise],
    rules: tuple[float, int, float], scored: tuple[int, bool, Array],
) -> tuple[bool, Array, Array, Array, Array, float, int]:  # fmt: skip
    """Filter a run: predict, correct and start landmarks step by step, as `Slam.process` does with known ids.

    `ways` are the addresses of the prediction, the correction and the generator, `tables` the blocks and the atoms of a
    robot and all landmarks and the capacity of a covariance, `controls` u (steps, m), seconds (steps,), the covariance
    N of a control's error, the diffusion (3 or 0, .) a second and whether controls are held, `sensed` the mount and
    its noise, `rules` the gate and the limits of the iterations, `scored` how often `score_map` scores, its `turns` and
    the true states (steps + 1, 3).

    Returns whether all went well, the pose (steps, 3) after each scan and its covariance, the scores of the map
    (steps, 6), the mean in the end, the sum of d2 and how many were fused.
    """
    blocks, atoms, capacity = tables
    u, dt_s, N, density, held = controls
    first, new, slots, y, places = observations
    at, noise = sensed
    steps, axes, robot, mount, d, never = len(u), 1, 0, -1, 2, False
    no_effect = np.empty((u.shape[1], 0))
    x, x_first, P = np.zeros(capacity), np.zeros(capacity), np.zeros((capacity, capacity))
    x[:3] = x_first[:3] = started[0]
    P[:3, :3] = started[1]
    mean, cov, scores = np.full((steps, 3), np.nan), np.full((steps, 3, 3), np.nan), np.full((steps, 6), np.nan)
    none, nothing, count, nis, fused, ok = np.empty(0, np.int64), np.zeros((0, 0)), 0, 0.0, 0, True
    for k in range(steps):
        low, middle, high = first[k], new[k], first[k + 1]
        if held and k == steps - 1 and high == low:
            break  # no later event asks where the robot is
        n = 3 + 2 * count
        D = density * dt_s[k] if len(density) and u[k].any() else nothing
        map_ = x, x_first, P, n, blocks[: count + 1], atoms[: count + 2], ways[2]
        part = motion, robot, none, never, never, no_effect, u[k], N, D, dt_s[k]
        ok = call_predict(ways[0], (map_, part, never, never))
        if ok and middle > low:
            whole = x, P, n, blocks[: count + 1], atoms[: count + 2], axes, routines
            known = slots[low:middle]
            scan = robot, mount, known, d, y[low:middle], noises(x, known, at, noise), rules[0]
            _e, _z, _Z, d2, near, ok = call_correct(ways[1], (view, whole, scan, (rules[1], rules[2])))
            for i in range(len(known)):
                nis += d2[i] if near[i] else 0.0
                fused += near[i]
        if not ok:
            break
        for i in range(middle, high):
            start_landmark(x, x_first, P, 3 + 2 * count, at, y[i : i + 1], noise)
            count += 1
        if high > low:
            keep_pose(x, P, mean[k], cov[k])
            if (k + 1) % scored[0] == 0 or k == steps - 1:
                scores[k] = score_map(x, P, places[:count], scored[1], scored[2][k + 1])
    return ok, mean, cov, scores, x, nis, fused


# ---------------------------------------------------------------------- scores
@compiled
def keep_pose(x: Array, P: Array, mean: Array, cov: Array) -> None:
    """Write the mean (3,) and the covariance (3, 3) of the robot's pose."""
    for i in range(3):
        mean[i] = x[i]
        for j in range(3):
            cov[i, j] = P[max(i, j), min(i, j)]


@compiled
def score_map(x: Array, P: Array, places: Array, turns: bool, truth: Array) -> Array:
    """Return the NEES of the map (6,), as `map_nees`.

    `turns`: errors are in the invariant filter's coordinates.  `truth` is the true state (3,) of the robot, `places`
    (B, 2) where the landmarks truly are.
    """
    a, d = wrap(truth[2] - x[2]), np.empty((2, 3 + 2 * len(places)))
    d[0, 2] = d[1, 2] = a
    for i in range(len(places) + 1):
        j, true = (2 * i + 1, places[i - 1]) if i else (0, truth[:2])
        d[1, j], d[1, j + 1] = true[0] - x[j], true[1] - x[j + 1]
        d[0, j], d[0, j + 1] = log_translation(a if turns else 0.0, d[1, j], d[1, j + 1])
    return map_nees(d, P, 3 + 2 * np.arange(len(places)), np.full(len(places), 2))


# ---------------------------------------------------------------------- runs
class _Filter:
    """An estimator of the engine: the arguments of `filter_run` that are the same in all runs."""

    def __init__(self, slam: Slam, name: str, landmarks: int) -> None:
        robot, estimator = slam.robots[name], slam.estimator
        ((key, mount),) = robot.sensors.items()
        channel, motion = slam.state.channels[name, key], robot.motion
        assert isinstance(motion, MOTIONS) and isinstance(mount.sensor, RangeBearing)
        correct = corrections.invariant if isinstance(estimator, Invariant) else textbook
        self.ways = (
            address_of(prediction.predict, PREDICT), address_of(correct, CORRECT),
            corrections.generator_address(1),
        )  # fmt: skip
        self.routines = corrections.routines(1, False, False)
        self.view, self.motion = channel.models["point"].model, step_of(robot.motion)
        rows = 3 + 2 * np.arange(landmarks)
        columns = (rows, 2, rows, 2, np.arange(landmarks) + 2, 1)
        blocks = np.column_stack(np.broadcast_arrays(*columns))
        atoms = np.column_stack(np.broadcast_arrays(VECTOR, rows, rows))
        self.blocks = np.concatenate([[[0, 3, 0, 3, 0, 2]], blocks])
        self.atoms = np.concatenate([[[VECTOR, 0, 0], [HEADING, 2, 2]], atoms])
        self.capacity = capacity_for(3 + 2 * landmarks)
        cov = np.zeros((3, 3)) if robot.cov is None else np.asarray(robot.cov)
        self.start = np.array(robot.start), np.array(cov)
        u = np.ones(len(motion.columns))
        D = motion.diffusion(u, 1.0)
        self.control = motion.control_noise(u), np.zeros((0, 0)) if D is None else D, motion.held
        s = mount.sensor
        self.sensed = np.array(mount.at), (s.sigma_range_m, s.sigma_range_rel, s.sigma_bearing_rad, s.scale, s.bias_m)
        limits = (estimator.iterations, float(estimator.tolerance)) if isinstance(estimator, Invariant) else (1, 0.0)
        self.rules = (float(channel.gate), *limits)
        self.coordinates = estimator.coordinates


def capacity_for(rows: int) -> int:
    """Return a width of a covariance of so many rows: an odd number of cache lines, see `layout.CAPACITY`."""
    return 16 * (rows // 16) + 8 if rows % 16 <= 8 else 16 * (rows // 16) + 24


class Engine:
    """Runs of a world under several filters.  Made once for many runs: it compiles, or loads, what they call."""

    def __init__(self, world: World, configs: Mapping[str, Config]) -> None:
        self.world = world
        (name,) = world.robots
        self.robot = build_robot(world.models(), name)
        self.landmarks = len(scenery_of(world, np.random.default_rng(0))[POINTS].values)
        self.filters = {label: _Filter(build_slam(c), name, self.landmarks) for label, c in configs.items()}
        self.ways = compiled_ways(self.robot.motion, world.dt_s)
        self.seconds = np.diff([0, *world.times()]) * 1e-9  # of each control: an increment's first has none before it
        self.seconds[0] *= self.robot.motion.held

    def run(self, seed: SeedSequence, map_every: int) -> dict[str, Scores] | None:
        """Simulate and score one run under every filter; None if that is left to the ordinary path."""
        world, chance = self.world, Chance(seed)
        (robot,), things = drive_all(world, [self.robot], chance, self.ways)
        (carried,), points = robot.sensors.values(), things[POINTS].values
        parts = [
            part
            for steps in spans(world, [robot], things)
            for part in sight(carried, robot, [robot], things, world, steps[carried.sensing.scans_at(steps)], chance)
        ]
        if len(points) != self.landmarks or not parts:
            return None
        seen = Sighted(*map(np.concatenate, zip(*parts, strict=True)))
        observations = by_landmark(world.steps, seen.steps - 1, seen.ids, points[seen.ids - 1], seen.e)
        scores = {}
        for label, one in self.filters.items():
            score = self._filter(one, robot.states, robot.given, observations, map_every)
            if score is None:
                return None
            scores[label] = score
        return scores

    def _filter(self, f: _Filter, states: Array, u: Array, observations: Observations, map_every: int) -> Scores | None:
        """Filter and score a run; None if the filter diverges."""
        N, density, held = f.control
        scored = map_every, f.coordinates == "log", states
        ok, mean, P, of_map, x, nis, fused = filter_run(
            f.ways, f.routines, f.view, f.motion, (f.blocks, f.atoms, f.capacity), f.start,
            (u, self.seconds, N, density, held), observations, f.sensed, f.rules, scored,
        )  # fmt: skip
        if not ok:
            return None
        series = {key: np.full((1, len(u)), np.nan) for key in SERIES}
        for i, key in enumerate(MAP_NEES):
            series[key][0] = of_map[:, i]
        places = observations[-1]
        found = x[3 : 3 + places.size].reshape(-1, 2), places, len(places), len(places)
        return scores_of(series, mean[None], P[None], states[None, 1:], f.coordinates, found, nis, 2 * fused, "")
