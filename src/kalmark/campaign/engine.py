"""The batched engine: runs of one world, filtered and scored in compiled code without Python in a step.

A run has the numbers of the ordinary path (`simulation`, `score`) up to rounding.  The simulator is the same, its robot
driven in compiled code.  The filter calls the compiled prediction and correction that `Slam.process` calls, by their
addresses.  `refusal` has the reasons why the engine does not run a world; a run that it cannot finish, such as one
whose filter diverges, is left to the ordinary path, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.random import SeedSequence

from kalmark.arrays import Array, Index
from kalmark.campaign.scoring import SERIES, Scores, scores_of
from kalmark.compiled import address_of, by_address, compiled, signature_of
from kalmark.config.building import build_robot, build_slam
from kalmark.config.schema import Config
from kalmark.filter import corrections, kernels, prediction
from kalmark.filter.estimators import Ekf, Invariant
from kalmark.filter.map import StochasticMap
from kalmark.filter.maps import DENSE
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import compose, product
from kalmark.geometry.spaces import Table
from kalmark.models.landmark_views import LOOK, NOISE, look, noise_of
from kalmark.models.landmarks import Point2D
from kalmark.models.observe import MOUNT, call_linearize, step_of
from kalmark.models.protocols import self_calibrating
from kalmark.results.measures import MAP_NEES, log_translation, map_nees
from kalmark.simulate.robots import Chance, drive_all, scenery_of, sight, spans
from kalmark.simulate.routes import MOTIONS, compiled_ways
from kalmark.simulate.sights import POINTS, Sighted
from kalmark.simulate.worlds import World
from kalmark.slam.slam import Slam

PREDICT = signature_of(
    "b1(Tuple((f8[::1], f8[::1], f8[:, ::1], i8, i8[:, ::1], i8[:, ::1], i8)), "
    "Tuple((Tuple((i8, f8[::1])), i8, i8[::1], b1, b1, f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8)), b1, b1)"
)
CORRECT = signature_of(
    f"Tuple((f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[::1], b1[::1], b1))({corrections.TO_CORRECT}, Tuple((i8, f8)))"
)
call_predict, call_correct = by_address(PREDICT), by_address(CORRECT)


# the first four that `by_landmark` returns, of each measurement the noise, of each landmark its first view v (L, d) and
# the covariance of that
Observations = tuple[Index, Index, Index, Array, Array, Array, Array]


# ---------------------------------------------------------------------- what the engine runs
def refusal(world: Any, configs: Mapping[str, Config]) -> str:
    """Return the reason why the engine does not run a scene with these filters; empty if it does."""
    return next((f"the batched engine {why}" for why in _reasons(world, configs)), "")


def _reasons(world: Any, configs: Mapping[str, Config]) -> Iterator[str]:
    """Yield the first thing in a scene and its filters that the engine does not run."""
    if not isinstance(world, World):
        yield "does not replay logs"
    if world.dimensions != 2 or len(world.robots) != 1:
        yield "runs one robot of the plane"
    ((name, simulated),) = world.robots.items()
    if any(sensing.outliers or sensing.swapped for sensing in simulated.sensing.values()):
        yield "has no outliers and no swapped ids: it rejects nothing"
    things = scenery_of(world, np.random.default_rng(0))
    landmarks = len(things[POINTS].values)
    if not world.ids or sum(len(sort.values) for sort in things.values()) > landmarks:
        yield "needs landmarks that are points with known ids"
    robots = [build_robot(world.models(), name), *(build_robot(config, name) for config in configs.values())]
    if any(type(robot.motion) not in MOTIONS or self_calibrating(robot.motion) is not None for robot in robots):
        yield "has velocities and increments of the plane that do not calibrate themselves"
    for config in configs.values():
        yield from _odd_filter(config, landmarks)


def _odd_filter(config: Config, landmarks: int) -> Iterator[str]:
    """Yield the first thing in a filter that the engine does not run."""
    if config.map.known is not None or config.map.landmarks:
        yield "has no known maps"
    slam = build_slam(config)
    (robot,), keys = slam.robots.values(), [*slam.state.channels]
    if (len(robot.sensors), len(keys)) != (1, 1):
        yield "runs one sensor, of landmarks"
    channel, policy = slam.state.channels[keys[0]], slam.state.policies[keys[0]]
    late, model = (policy.deferred, policy.delayed, policy.detector), channel.models[channel.landmark.kind]
    if any(late) or not (policy.by_ids and channel.gives_places and channel.mount < 0 and model.built_in):
        yield "has sensors of known calibration that determine points, all of them with known ids, used and kept"
    if type(slam.estimator) not in (Ekf, Invariant):
        yield f"has no estimator {config.estimator.type}"
    is_gated = policy.association.threshold(channel.dof, math.inf) < math.inf
    if is_gated or (robot.max_speed_mps, robot.max_turn_radps) != (None, None):
        yield "has no gate that is set, and no limits of its robot"
    kind = slam.state.settings.map
    if kind == "postponed" or (kind == "auto" and landmarks > DENSE):
        yield f"has dense maps, of up to {DENSE} landmarks"


# ---------------------------------------------------------------------- observations
def by_landmark(count: int, steps: Index, numbers: Index, y: Array) -> tuple[Any, ...]:
    """Return measurements y (N, m) of the points `numbers` (N,) in `count` steps, in each those of new landmarks last.

    That is where each step begins (count + 1,), where its new ones do (count,), the places of landmarks in the state
    (N,), y (N, m), and of each landmark its first measurement (L, m) and its number (L,), in the order of these.
    """
    first, place = np.zeros((2, numbers.max(initial=0) + 1), np.int64)
    first[numbers[::-1]] = np.arange(len(numbers))[::-1]  # the last one that is written
    new = first[numbers] == np.arange(len(numbers))
    place[numbers[new]] = np.arange(np.count_nonzero(new)) + 1
    rows = np.lexsort((new, steps))
    begins = np.searchsorted(steps, np.arange(count + 1))
    middle = begins[1:] - np.bincount(steps[new], minlength=count)
    return begins, middle, place[numbers[rows]], y[rows], y[new], numbers[new]


# ---------------------------------------------------------------------- filter
@compiled
def textbook(view: Any, map_: Any, scan: Any, limits: tuple[int, float]) -> Any:
    """Correct as `Ekf` does, with the arguments of `invariant`."""
    return corrections.textbook(view, map_, scan, None)


@compiled
def expectations_of(view: Any, x: Array, blocks: Table, slots: Index, y: Array) -> Array:
    """Return the expectations (K, m) of measurements y (K, m) of the landmarks on `slots` (K,)."""
    l = np.empty((len(slots), blocks[1, 1]))
    for i in range(len(slots)):
        for j in range(l.shape[1]):
            l[i, j] = x[blocks[slots[i], 0] + j]
    return call_linearize(view[0], (view, x[:3], l, y))[0]


@compiled
def start_landmark(
    of: int, at: Array, x: Array, x_first: Array, P: Array, block: Index, v: Array, Q: Array
) -> None:  # fmt: skip
    """Add a landmark on a block (6,), seen at v (1, d) with a covariance Q (d, d) from a mount.  [S] (32)-(38)."""
    T, T_r, _ = compose(x[:3], at)
    l, L_T, L_v = look(of, (T, v))
    for i in range(block[1]):
        x[block[0] + i] = x_first[block[0] + i] = l[0, i]
    n, L_r = block[2] + block[3], product(L_T[0], T_r)
    kernels.augment(P, n, np.arange(block[2], n), np.arange(3), L_r, kernels.quadratic(L_v[0], Q))


@compiled
def filter_run(
    ways: tuple[int, int, int, int, int], view: Any, started: corrections.Map, motion: tuple[int, Array],
    controls: tuple[Array, Array, Array, Array, bool], observations: Observations, noise: Array,
    rules: tuple[float, tuple[int, float]], scored: tuple[int, bool, Array, Array],
) -> tuple[bool, Array, Array, Array, Array, float, int]:  # fmt: skip
    """Filter a run: predict, correct and start landmarks step by step, as `Slam.process` does with known ids.

    `ways` are the addresses of the prediction, the correction, the generator, the landmark of a view and the noise at
    an expectation (0: it is that of `observations`), which has the numbers `noise`.  `started` is the map before the
    first step, with a block for each landmark to come.  `controls` are u (steps, m), seconds (steps,), the covariance N
    of a control's error, the diffusion (3 or 0, .) a second and whether controls are held, `rules` the gate and the
    limits of the iterations, `scored` how often `score_map` scores, its `turns`, the true states (steps + 1, 3) and
    places (L, 2).

    Returns whether all went well, the pose (steps, 3) after each scan and the lower triangle of its covariance, the
    scores of the map (steps, 6), the mean in the end, the sum of d2 and how many were fused.
    """
    x_0, P_0, _, blocks, atoms, axes, routines = started
    predicts, corrects, turns, of, noisy = ways
    u, dt_s, N, density, held = controls
    first, new, slots, y, R, v, Q = observations
    steps, robot, mount, never = len(u), 0, -1, False
    x, x_first, P, no_effect = x_0.copy(), x_0.copy(), P_0.copy(), np.empty((u.shape[1], 0))
    mean, cov, scores = np.full((steps, 3), np.nan), np.full((steps, 3, 3), np.nan), np.full((steps, 6), np.nan)
    none, nothing, count, nis, fused, ok = np.empty(0, np.int64), np.zeros((0, 0)), 0, 0.0, 0, True
    for k in range(steps):
        low, middle, high = first[k], new[k], first[k + 1]
        if held and k == steps - 1 and high == low:
            break  # no later event asks where the robot is
        there, kinds = blocks[: count + 1], atoms[: blocks[count, 4] + blocks[count, 5]]
        n = blocks[count, 2] + blocks[count, 3]
        D = density * dt_s[k] if len(density) and u[k].any() else nothing
        part = motion, robot, none, never, never, no_effect, u[k], N, D, dt_s[k]
        ok = call_predict(predicts, ((x, x_first, P, n, there, kinds, turns), part, never, never))
        if ok and middle > low:
            known, seen, R_k, d = slots[low:middle], y[low:middle], R[low:middle], blocks[1, 1]
            if noisy != 0:
                R_k = noise_of(noisy, (noise, expectations_of(view, x, blocks, known, seen)))
            scan = robot, mount, known, d, seen, R_k, rules[0]
            _e, _z, _Z, d2, near, ok = call_correct(
                corrects, (view, (x, P, n, there, kinds, axes, routines), scan, rules[1])
            )
            near_d2 = d2[near]
            nis, fused = nis + np.sum(near_d2), fused + len(near_d2)
        if not ok:
            break
        for _ in range(middle, high):
            start_landmark(of, view[MOUNT], x, x_first, P, blocks[count + 1], v[count : count + 1], Q[count])
            count += 1
        if high > low:
            mean[k], cov[k] = x[:3], P[:3, :3]
            if (k + 1) % scored[0] == 0 or k == steps - 1:
                scores[k] = score_map(x, P, blocks[1 : count + 1], scored[3], scored[1], scored[2][k + 1])
    return ok, mean, cov, scores, x, nis, fused


# ---------------------------------------------------------------------- scores
@compiled
def score_map(x: Array, P: Array, blocks: Table, places: Array, turns: bool, truth: Array) -> Array:
    """Return the NEES of the map (6,), as `map_nees`, of landmarks whose `blocks` (B, 6) begin with their positions.

    `turns`: errors are in the invariant filter's coordinates.  `truth` is the true state (3,) of the robot, `places`
    (B or more, 2) where the landmarks truly are.
    """
    count, a = len(blocks), wrap(truth[2] - x[2])
    d, index = np.empty((2, 3 + 2 * count)), np.empty(3 + 2 * count, np.int64)
    d[0, 2], d[1, 2], index[2] = a, a, 2
    for i in range(count + 1):
        j, at, row, true = (2 * i + 1, blocks[i - 1, 0], blocks[i - 1, 2], places[i - 1]) if i else (0, 0, 0, truth[:2])
        index[j], index[j + 1] = row, row + 1
        d[1, j], d[1, j + 1] = true[0] - x[at], true[1] - x[at + 1]
        d[0, j], d[0, j + 1] = log_translation(a if turns else 0.0, d[1, j], d[1, j + 1])
    return map_nees(d, kernels.submatrix(P, index), 3 + 2 * np.arange(count), np.full(count, 2))


# ---------------------------------------------------------------------- runs
class _Filter:
    """An estimator of the engine: the arguments of `filter_run` that are the same in all runs."""

    def __init__(self, slam: Slam, landmarks: int) -> None:
        (robot,), estimator = slam.robots.values(), slam.estimator
        (self.channel,), map_ = slam.state.channels.values(), slam.state.map
        landmark, sensor, motion = self.channel.landmark, self.channel.sensor, robot.motion
        assert isinstance(map_, StochasticMap) and isinstance(landmark, Point2D) and isinstance(motion, MOTIONS)
        for _ in range(landmarks):
            map_.add(landmark.space, np.zeros(landmark.space.size))
        self.started, self.coordinates = map_.whole, estimator.coordinates
        correct: Any = textbook
        limits = 1, 0.0
        if isinstance(estimator, Invariant):
            correct, limits = corrections.invariant, (estimator.iterations, float(estimator.tolerance))
        varies = self.channel.noise_at is not None
        self.ways = (
            address_of(prediction.predict, PREDICT), address_of(correct, CORRECT), corrections.generator_address(1),
            address_of(landmark.of, LOOK), address_of(type(sensor).noisy, NOISE) if varies else 0,
        )  # fmt: skip
        self.noise = sensor.noise_numbers if varies else np.zeros(0)
        self.view, self.motion = self.channel.models[landmark.kind].model, step_of(motion)
        u = np.ones(len(motion.columns))
        D = motion.diffusion(u, 1.0)
        self.control = motion.control_noise(u), np.zeros((0, 0)) if D is None else D, motion.held
        self.rules = float(self.channel.gate), limits

    def run(
        self, given: tuple[Array, Array], seen: Sequence[Any], truth: tuple[Array, Array], map_every: int
    ) -> Scores | None:  # fmt: skip
        """Filter and score a run; None if the filter diverges.

        `given` are the controls (steps, m) and their seconds (steps,), `seen` is what `by_landmark` returns but the
        last, `truth` the states (steps + 1, 3) and the places of the landmarks (L, 2).
        """
        first, new, slots, y, begun = seen
        sensor, noise_at = self.channel.sensor, self.channel.noise_at
        v, V_y = sensor.invert(begun)
        N = sensor.noise(begun) if noise_at is None else noise_at(v)
        observations = first, new, slots, y, sensor.noise(y), v, V_y @ N @ V_y.swapaxes(1, 2)
        scored = map_every, self.coordinates == "log", *truth
        ok, mean, L, of_map, x, nis, fused = filter_run(
            self.ways, self.view, self.started, self.motion, (*given, *self.control), observations, self.noise,
            self.rules, scored,
        )  # fmt: skip
        if not ok:
            return None
        series = {key: np.full((1, len(mean)), np.nan) for key in SERIES}
        for i, key in enumerate(MAP_NEES):
            series[key][0] = of_map[:, i]
        (states, places), dof = truth, self.channel.dof * fused
        at = self.started[3][1 : len(places) + 1, :1] + np.arange(2)
        found, P = (x[at], places, len(places), len(places)), np.tril(L) + np.tril(L, -1).swapaxes(1, 2)
        return scores_of(series, mean[None], P[None], states[None, 1:], self.coordinates, found, nis, dof, "")


class Engine:
    """Runs of a world under several filters.  Made once for many runs: it compiles, or loads, what they call."""

    def __init__(self, world: World, configs: Mapping[str, Config]) -> None:
        self.world = world
        (name,) = world.robots
        self.robot = build_robot(world.models(), name)
        self.landmarks = len(scenery_of(world, np.random.default_rng(0))[POINTS].values)
        self.filters = {label: _Filter(build_slam(c), self.landmarks) for label, c in configs.items()}
        self.ways = compiled_ways(self.robot.motion, world.dt_s)
        self.seconds = np.diff([0, *world.times()]) * 1e-9  # of each control: an increment's first has none before it
        self.seconds[0] *= self.robot.motion.held

    def run(self, seed: SeedSequence, map_every: int) -> dict[str, Scores] | None:
        """Simulate and score one run under every filter; None if that is left to the ordinary path."""
        world, chance = self.world, Chance(seed)
        (robot,), things = drive_all(world, [self.robot], chance, self.ways)
        (carried,), places = robot.sensors.values(), things[POINTS].centres()
        parts = [
            part
            for steps in spans(world, [robot], things)
            for part in sight(carried, robot, [robot], things, world, steps[carried.sensing.scans_at(steps)], chance)
        ]
        if len(places) != self.landmarks or not parts:
            return None
        seen = Sighted(*map(np.concatenate, zip(*parts, strict=True)))
        *observations, numbers = by_landmark(world.steps, seen.steps - 1, seen.ids, seen.e)
        truth, scores = (robot.states, places[numbers - 1]), {}
        for label, one in self.filters.items():
            score = one.run((robot.given, self.seconds), observations, truth, map_every)
            if score is None:
                return None
            scores[label] = score
        return scores
