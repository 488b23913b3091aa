"""The systematic errors that sensors and controls may have: what one unit of each adds to the data."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.batch.batch_state import LANDMARKS, POSES, BatchState, Ints
from kalmark.batch.motion_chain import TURNING
from kalmark.batch.problem import Factor
from kalmark.diagnosis.linear import Linear
from kalmark.geometry.angles import rotation
from kalmark.geometry.named_poses import POSES as KEYS
from kalmark.geometry.rotations import matrix
from kalmark.models.observe import MOUNT, sensor_pose
from kalmark.results.measures import pose_error

MOST_SCALE = 0.25  # beyond it the problem is not linear: of a scale, and of a mount's share of the way to what it sees
SLOW_S = 1e-3  # least time between two poses
LENGTHS = ("range", "distance")  # how columns of lengths begin
ALL = "all sensors"
ALSO = " and "  # between the columns of wheels that have an error together
DRIFT = "s/s"  # the unit of a clock that drifts
LATE = "time_offset"
SHARED = ("range_scale", "range_offset", "bearing_offset", LATE)  # errors of several sensors
TURNED = "mount"  # a sensor that is turned
HEIGHT = "height"  # of things above or below a sensor of the plane, its square

Where = tuple[str, str]


class Column(NamedTuple):
    """A systematic error: what it is, and what one unit of it adds to the data, Z (N,) and W (q n,).

    Beyond `most` of it the problem is not linear.  A height is its square: none is negative.
    """

    name: str
    of: tuple[str, ...]
    unit: str
    Z: Array
    W: Array
    most: float = math.inf

    @property
    def group(self) -> tuple[str, ...]:
        """Robot, sensor and column, or robot and column of its controls: errors of the same column share it."""
        return self.of[:2] if self.W.any() else self.of


def columns_of(linear: Linear, sensors: Mapping[Where, tuple[str, ...]], rates: Array) -> list[Column]:
    """Return the systematic errors that data may have.

    `sensors` are the columns that each sensor measures, `rates` (n, q) the velocities of the poses, in the world.
    """
    found = [*_of_sensors(linear, sensors, rates), *_of_controls(linear)]
    return [column for column in found if np.isfinite(column.Z).all() and (column.Z.any() or column.W.any())]


def stacked(columns: list[Column]) -> tuple[Array, Array]:
    """Return what one unit of each error adds to the data: Z (N, K) and W (q n, K)."""
    return np.stack([c.Z for c in columns], axis=1), np.stack([c.W for c in columns], axis=1)


def errors_together(columns: list[Column]) -> list[Column]:
    """Return the errors that all sensors of a robot may share, where it has several: one laser, one clock.

    And the scale of all its wheels: one of a single wheel is a turn.
    """
    on_wheels, found = {c.of[0] for c in columns if c.of[1] == TURNING}, dict[tuple[str, ...], list[Column]]()
    for column in columns:
        robot, second, *kind = column.of
        if column.name in SHARED:
            found.setdefault((column.name, robot, column.unit), []).append(column)
        elif robot in on_wheels and kind == ["scale"] and second != TURNING:
            found.setdefault(("odometry_scale", robot, ""), []).append(column)
    return [_sum(name, same) for (name, *_), same in found.items() if len(same) > 1]


def _sum(name: str, same: list[Column]) -> Column:
    """Return the error of a name that several sensors, or wheels, have together."""
    (robot, *_), kinds = same[0].of, dict.fromkeys(x for c in same for x in c.of[2:])
    of = ALL if name in SHARED else ALSO.join(c.of[1] for c in same)
    Z, W = (column.sum(axis=1) for column in stacked(same))
    return Column(name, (robot, of, *kinds), same[0].unit, Z, W, same[0].most)


def _of_sensors(linear: Linear, sensors: Mapping[Where, tuple[str, ...]], rates: Array) -> list[Column]:
    """Return the systematic errors of the sensors.  Landmarks and robots that one sensor observes share its errors."""
    factors, nothing = linear.problem.factors, np.zeros(len(linear.at.w))
    found: dict[tuple[str, ...], Column] = {}
    for f, factor in enumerate(factors):
        names = sensors.get(factor.sensor)
        for name, of, unit, most, part in () if names is None else _of_sensor(factor, linear.state, names, rates):
            parts = [np.zeros(other.R.shape[:2]) for other in factors]
            parts[f] = part
            have, Z = found.get((name, *of)), linear.whitened(parts)
            found[name, *of] = Column(name, of, unit, Z if have is None else have.Z + Z, nothing, most)
    return [*found.values()]


def _of_sensor(
    factor: Factor, state: BatchState, names: tuple[str, ...], rates: Array
) -> Iterator[tuple[str, tuple[str, ...], str, float, Array]]:
    """Yield the name, place, unit and limit of each error of a sensor, and what it adds to its innovations (K, p).

    Errors of its columns are those of a sensor with one innovation of each.
    """
    z, E = factor.term.at(state)
    if len(names) == z.shape[1]:
        yield from _of_its_columns(factor, names, z, state.d == 2)
    moving, first = np.zeros_like(z), 0
    for block in factor.term.blocks:
        dof = block.space.dof
        if block.group == POSES:
            moving += np.einsum("kij,kj->ki", E[:, :, first : first + dof], rates[block.rows, :dof])
        first += dof
    yield LATE, factor.sensor, "s", math.inf, moving
    (observer, *_, seen), d = factor.term.blocks, state.d
    if (observer.group, seen.group) == (POSES, LANDMARKS) and (d > 2 or not any(map(is_bearing, names))):
        for key, turn in zip(KEYS["plane" if d == 2 else "space"][d:], _turns(factor, state), strict=True):
            changed = np.nan_to_num(np.einsum("kij,kj->ki", E[:, :, : turn.shape[1]], turn))
            yield TURNED, (*factor.sensor, key), "rad", math.pi / 2, changed
    if observer.group == POSES:
        poses = state.groups[POSES][observer.rows]
        axes, away = _axes(poses), state.groups[seen.group][seen.rows, :d] - poses[:, :d]
        most = MOST_SCALE * float(np.median(np.linalg.norm(away, axis=1)))
        shifted = np.einsum("kij,kjc->kic", E[:, :, :d], axes)
        for k, name in enumerate(("x_m", "y_m", "z_m")[:d]):
            yield "mount_position", (*factor.sensor, name), "m", most, shifted[:, :, k]


def is_bearing(column: str) -> bool:
    """Return whether an offset of a column is a turn of its sensor, in the plane about its only axis."""
    return column.startswith(("bearing", "normal", "azimuth"))


def _turns(factor: Factor, state: BatchState) -> Iterator[Array]:
    """Yield how robots would move (K, dof), about their sensor, to see what it sees if that turns by one radian.

    In space that is about each axis of the robot.
    """
    mount = factor.view[MOUNT] if isinstance(factor.view, tuple) else factor.view.mount
    poses, d = state.groups[POSES][factor.term.blocks[0].rows], state.d
    arm = poses[:, :d] - np.array([sensor_pose(pose, mount)[0][:d] for pose in poses])
    if d == 2:
        yield np.column_stack([-arm[:, 1], arm[:, 0], np.ones(len(poses))])
        return
    for axis in _axes(poses).transpose(2, 0, 1):
        yield np.column_stack([np.cross(axis, arm), axis])


def _of_its_columns(
    factor: Factor, names: tuple[str, ...], z: Array, plane: bool
) -> Iterator[tuple[str, tuple[str, ...], str, float, Array]]:
    """Yield the errors of the columns of a sensor, as `_of_sensor`, whose innovations are z (K, p).

    A range r of what is h higher, in the plane, is longer by about h^2 / 2 r.
    """
    e, one = factor.y[:, : z.shape[1]] - z, np.ones_like(z)  # of a wall, not its ends
    longer = _longer(names, e)
    for c, name in enumerate(names):
        of, mine = (*factor.sensor, name), np.eye(len(names))[c]
        if name.startswith(LENGTHS) and name.endswith("_m"):
            yield "range_scale", of, "", MOST_SCALE, longer * mine
            yield "range_offset", of, "m", math.inf, one * mine
            if plane:
                yield HEIGHT, (*of, HEIGHT), "m2", math.inf, 0.5 * mine / np.where(longer, longer, math.inf)
        elif name.endswith("_rad"):
            offset = "bearing_offset" if is_bearing(name) else f"{name.removesuffix('_rad')}_offset"
            yield offset, of, "rad", math.inf, one * mine
        elif longer[:, c].any() and not longer[:, :c].any():  # one scale of all columns
            scaled = [other for k, other in enumerate(names) if longer[:, k].any()]
            yield "range_scale", (*factor.sensor, *scaled), "", MOST_SCALE, longer


def _axes(poses: Array) -> Array:
    """Return the axes (K, d, d) of robots at poses (K, 3) or (K, 7), in the world."""
    turns = map(rotation, poses[:, 2].tolist()) if poses.shape[1] == 3 else map(matrix, poses[:, 3:])
    return np.array([*turns])


def _longer(names: tuple[str, ...], e: Array) -> Array:
    """Return by how much measurements (K, p), expected as e, change for each unit by which distances are scaled."""
    out = np.zeros_like(e)
    for c, name in enumerate(names):
        if name in ("x_m", "y_m", "z_m") or (name.startswith(LENGTHS) and name.endswith("_m")):
            out[:, c] = e[:, c]
        elif name == "rho_per_m":
            out[:, c] = -e[:, c]
        elif name == "ur_px":  # the disparity is inverse to the depth
            out[:, c] = e[:, names.index("ul_px")] - e[:, c]
    return out


def _of_controls(linear: Linear) -> Iterator[Column]:
    """Yield the systematic errors of the controls, scales before offsets: the likelier of two that are alike.

    A scale is that of the control as estimated.  The measured one has its noise in it: its scale would come out short.
    The `most` of an offset is its share of the robot's way, as that of a scale: bearings alone explain any way by none.
    """
    motions, nothing = linear.problem.motions, np.zeros(len(linear.at.z))
    e, kinds = linear.errors_of(linear.residuals), np.array(motions.kinds, dtype=np.str_)
    ways = dict[str, float]()
    for k, error in sorted(enumerate(motions.errors), key=lambda one: one[1].kind != "scale"):
        turns = error.column.endswith(("_rad", "_radps", TURNING))
        name = "odometry_turn" if turns else "odometry_scale" if error.kind == "scale" else "odometry_offset"
        if error.column == "steering_rad":
            name = "steering_offset"
        W = motions.systematic[:, k]
        if error.kind == "scale":
            of_turns = error.column == TURNING
            mine = (
                np.char.startswith(kinds, f"{error.robot}.") if of_turns else kinds == f"{error.robot}.{error.column}"
            )
            added = (linear.root @ np.where(mine, e, 0.0)).reshape(-1, linear.state.spaces[POSES].dof)
            W = W + (added * ([0.0, 0.0, 1.0] if of_turns else 1.0)).ravel()
        size, most = float(np.linalg.norm(W)), math.inf if error.unit else MOST_SCALE
        if name == "odometry_scale":
            ways[error.robot] = math.hypot(ways.get(error.robot, 0.0), size)
        elif name == "odometry_offset":
            most = MOST_SCALE * ways.get(error.robot, math.inf) / max(size, 1e-300)
        yield Column(name, (error.robot, error.column, error.kind), error.unit, nothing, W, most)


def rates_of(linear: Linear, t_ns: Ints) -> Array:
    """Return the velocities (n, q) of the poses at the scans, at `t_ns` (S,), of their robots and those they observe.

    They are in the world, from the pose before to the one after; zero of all other poses.
    """
    poses, robots = linear.state.groups[POSES], np.array(linear.problem.robots)
    t, out = np.full(len(poses), np.nan), np.zeros((len(poses), linear.state.spaces[POSES].dof))
    own = linear.problem.nodes
    t[own] = t_ns * 1e-9
    for observer, *others in (factor.term.blocks for factor in linear.problem.factors if factor.sensor[1]):
        for other in others:
            if observer.group == other.group == POSES:
                t[other.rows] = t[observer.rows]
    t[own] = t_ns * 1e-9  # a robot that did not move since then has the pose of its own scan
    for robot in dict.fromkeys(linear.problem.robots):
        node = np.flatnonzero((robots == robot) & np.isfinite(t))
        node = node[np.argsort(t[node], kind="stable")]  # others may have observed it out of order
        node = node[np.diff(t[node], prepend=-np.inf) > SLOW_S]  # several scans may be at one pose
        after = t[node[2:]] - t[node[:-2]]
        out[node[1:-1]] = pose_error(poses[node[:-2]], poses[node[2:]]) / after[:, None]
    return out
