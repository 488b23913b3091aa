"""Factors: measurements y = h(x_1, ..., x_k) + v of any blocks of the map.  [S] A.5, docs/factors.md.

The value h becomes a block of the map, computed from the others, which is then observed itself.  So each estimator and
each map corrects by a factor without knowing of it: a landmark relative to another, a robot relative to another, two
landmarks that are one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import signature
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.errors import EventError
from kalmark.events import Id, Scan, checked_id, finite, is_number, label_of_event, list_names, short_text
from kalmark.filter.estimators import Correction, Update
from kalmark.filter.map import NO_SLOTS, Map
from kalmark.geometry.angles import wrap
from kalmark.geometry.gaussian import gate as gate_of
from kalmark.geometry.spaces import Rn, Space
from kalmark.models.protocols import PLACES, Landmark, place_of, with_jacobians
from kalmark.report import INDEFINITE, Observation, Report
from kalmark.slam import moves
from kalmark.slam.checks import check_covariance, check_numbers, measurements
from kalmark.slam.state import State
from kalmark.tracks.scan import Start
from kalmark.tracks.track import Tracks

ROUNDS, SETTLED = 20, 1e-3  # linearisations at most, until nothing moves by that many of its sigmas
EXACT = "all of these are known exactly"
STEP = 1e-6  # of central differences, in m and rad


@dataclass(frozen=True, eq=False)
class ObservedItself:
    """The observation model of a block that is measured as it is, by a sensor on a mount (3,) or (7,)."""

    mount: Array
    numbers: int

    def linearize(self, head: Array, l: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Return e = l (K, n), z = y - e, E_h = 0 (K, n, h) and E_l = 1 (K, n, n)."""
        count, n = l.shape
        E_l = np.tile(np.eye(n), (count, 1, 1))
        pose = 3 if len(self.mount) == 3 else 6
        return l.copy(), y - l, np.zeros((count, n, pose * (len(head) // len(self.mount)))), E_l


def update_by_blocks(robot: int, mount: int, at: Array, y: Array, R: Array, gate: float = math.inf) -> Update:
    """Return the correction by y (K, n) of K blocks that are measured as they are, R (K, n, n) being its noise.

    `robot` and `mount` are the slots of the robot and of the mount `at` with which the map turns (-1: no mount in it).
    `State.corrected_by` has the blocks.
    """
    return Update(ObservedItself(at, y.shape[1]), robot, mount, NO_SLOTS, y.shape[1], y, R, gate)


class MeasuredBlock(NamedTuple):
    """A block that a factor measures: its slot, its space, its mean, and its model if it is a landmark.

    Of a landmark known exactly the slot is -1.
    """

    slot: int
    space: Space
    mean: Array
    model: Landmark | None

    @property
    def dof(self) -> int:
        """The numbers of its error, 0 of what is known exactly."""
        return 0 if self.slot < 0 else self.space.dof

    def place(self, x: Array) -> tuple[Array, Array]:
        """Return where it is if its mean is x (size,), p (2 or 3,), and P_x (2 or 3, dof).  Raises EventError."""
        if self.model is None:
            d = 2 if self.space.world == "plane" else 3
            return x[:d], np.eye(d, self.space.dof)
        found = place_of(self.model, x[None])
        if found is None:
            raise EventError(f"a {self.model.kind} has no position, expected a model with place()")
        return found[0][0], found[1][0]


@dataclass(frozen=True, eq=False)
class BlockMeasurement:
    """A measurement y (p,) of blocks by their `names`, with the noise R (p, p).

    `expect` returns its expectation from their means, or from their `places`, and may return its Jacobians behind it;
    `angular` (p,) marks angles; `what` names it in messages.
    """

    names: Sequence[Id]
    expect: Callable[..., Any]
    y: Array
    R: Array
    angular: Flags
    what: str
    places: bool = False

    def expectation(self, values: Sequence[Array]) -> tuple[Array, list[Array]]:
        """Return e (p,), h at the means or places, and its own Jacobians, if it has any.  Raises EventError."""
        e, *E = with_jacobians(self.expect(*values))
        e = e.ravel() if isinstance(e, np.ndarray) else e if isinstance(e, list | tuple) else [e]
        return check_numbers(e, len(self.y), f"{self.what}: expectation", EventError), E

    def residual(self, a: Array, b: Array) -> Array:
        """Return a - b (p,), the angles wrapped."""
        return np.where(self.angular, wrap(a - b), a - b)

    def linearize(self, blocks: Sequence[MeasuredBlock], x: Sequence[Array]) -> tuple[Array, Array]:
        """Return e (p,) at the means x and its Jacobian G (p, n) in the errors of all blocks.

        It is by differences where the function does not return it.
        """
        values, of_errors = list(x), [np.eye(block.space.dof) for block in blocks]
        if self.places:
            placed = [block.place(each) for block, each in zip(blocks, x, strict=True)]
            values, of_errors = [p for p, _ in placed], [P_x for _, P_x in placed]
        e, given = self.expectation(values)
        if given:
            shapes = [(len(e), len(D)) for D in of_errors]
            if [np.shape(E) for E in given] != shapes:
                raise EventError(f"{self.what}: Jacobians are {[np.shape(E) for E in given]}, expected {shapes}")
            parts = zip(given, of_errors, blocks, strict=True)
            return e, np.column_stack([np.asarray(E) @ D for E, D, block in parts if block.dof])
        return e, self._differences(blocks, x, values)

    def _differences(self, blocks: Sequence[MeasuredBlock], x: Sequence[Array], values: list[Array]) -> Array:
        """Return the Jacobian (p, n) in the errors of blocks at the means x, `values` being these or their places."""
        columns = []
        for i, block in enumerate(blocks):
            for d in STEP * np.eye(block.dof):
                ends = [block.space.plus(x[i], by) for by in (d, -d)]
                ends = [block.place(end)[0] for end in ends] if self.places else ends
                ahead, behind = (self.expectation([*values[:i], end, *values[i + 1 :]])[0] for end in ends)
                columns.append(self.residual(ahead, behind) / (2.0 * STEP))
        return np.column_stack(columns)

    def as_block(self, blocks: Sequence[MeasuredBlock], P: Array) -> tuple[Correction, Start]:
        """Return the innovation at the means, and h as a block, linearised where they are after the correction.

        Gauss-Newton on these blocks alone, of the covariance P (n, n), as the corrections of scans iterate.
        """
        x, step, first = [block.mean for block in blocks], np.zeros(len(P)), None
        ends = np.cumsum([block.dof for block in blocks])
        for _ in range(ROUNDS):
            e, G = self.linearize(blocks, x)
            back = [b.space.minus(b.mean, now)[: b.dof] for b, now in zip(blocks, x, strict=True)]
            value = e + G @ np.concatenate(back)  # of h at the means, as it is linearised at x
            z, Z = self.residual(self.y, value), G @ P @ G.T + self.R  # [S] (26)-(27)
            d2 = z @ np.linalg.solve(Z, z)  # [S] (83)
            one = value[None], z[None], Z[None], np.array([d2]), np.zeros(1, dtype=np.bool_)
            first = first or Correction(*one, valid=True)
            before, step = step, P @ G.T @ np.linalg.solve(Z, z)  # [S] (28)-(29)
            moved = zip(blocks, np.split(step, ends), strict=False)
            x = [block.space.plus(block.mean, d) if block.dof else block.mean for block, d in moved]
            if (np.abs(step - before) <= SETTLED * np.sqrt(np.maximum(np.diag(P), 0.0))).all():
                break
        assert first is not None
        parts = tuple((block.slot, block.dof) for block in blocks if block.dof)
        return first, Start(Rn(len(e)), value, parts, G, np.zeros((len(e), len(e))))


def factor_of(
    names: Sequence[Id], expect: Callable[..., Any], y: Any, cov: Any, angular: Sequence[bool]
) -> BlockMeasurement:
    """Return a factor of the blocks `names`.  Raises EventError for numbers that it cannot have."""
    own, what = _checked_names(names)
    if not callable(expect):
        raise EventError(f"{what}: expect is {short_text(expect)}, expected a function of the means of these")
    y = finite(y, f"{what}: y").ravel()
    p = len(y)
    if not p:
        raise EventError(f"{what}: y is empty, expected one number or more")
    R = check_covariance([[cov]] if p == 1 and np.ndim(cov) == 0 else cov, p, f"{what}: cov", definite=True)
    turns = [*angular] if isinstance(angular, list | tuple) and len(angular) in (0, p) else [None]
    if not all(isinstance(each, bool) for each in turns):
        raise EventError(f"{what}: angular is {short_text(angular)}, expected {p} truth values")
    return BlockMeasurement(own, expect, y, R, np.array(turns or [False] * p), what)


def _checked_names(names: Any) -> tuple[list[Id], str]:
    """Return the names of different blocks, and how messages call their factor.  Raises EventError."""
    several = list(names) if isinstance(names, list | tuple) else []
    what = f"factor of {list_names(several) if several else short_text(names)}"
    own = [checked_id(name, f"{what}: a name") for name in several]
    if not own or len({*own}) < len(own):
        raise EventError(f"{what}: expected the names of different robots and landmarks, in a list")
    return own, what


def correct_by_factor(state: State, factor: BlockMeasurement, share: float) -> tuple[Observation, Correction]:
    """Correct by a factor if d2 is within the gate of the probability `share`."""
    if not is_number(share) or not 0.0 < share <= 1.0:
        raise EventError(f"{factor.what}: gate is {short_text(share)}, expected a probability above 0, 1 for no gate")
    names, robots = factor.names, [str(name) for name in factor.names if name in state.robots]
    if {*names} <= {*state.tracks.known}:
        raise EventError(f"{factor.what}: {EXACT}, expected one that is estimated")
    blocks = _checked_blocks(state, factor)
    if robots and state.t_ns is not None:
        moves.advance(state, *robots)  # a gap that is found here goes on: the robot's next report has it
        blocks = _blocks(state.map, state.tracks, names)
    found, start = factor.as_block(blocks, state.map.covariance([block.slot for block in blocks if block.dof]))
    d2, limit = float(found.d2[0]), gate_of(share, len(factor.y))
    if d2 > limit:
        return Observation(0, None, "rejected", names[0], d2, f"outside the gate of {limit:.2f}"), found
    moving = state.moving[next(iter([*robots, *state.robots]))]
    y = start.mean + factor.residual(factor.y, start.mean)
    at = state.map.mean(moving.slot)[: moving.motion.space.pose.size]
    done = state.corrected_by([start], update_by_blocks(moving.slot, -1, at, y[None], factor.R[None]))
    outcome, reason = ("associated", "") if done.fused[0] else ("rejected", INDEFINITE)
    return Observation(0, None, outcome, names[0], d2, reason), found._replace(fused=done.fused)


def correct_by_blocks(state: State, event: Scan, sensor: Any) -> Report:
    """Correct by what a sensor of blocks measures, one observation after the other; without names, of its robot.

    An observation of what is not in the map, or only of what is known exactly, is ignored.  Raises EventError for one
    that the sensor cannot make, and changes nothing.
    """
    R, report = measurements(event, sensor, getattr(sensor, "check", None)), Report(event, event.y)
    what, found = f"{label_of_event(event)} by {event.sensor!r}", list[Observation]()
    angular, places = np.array(sensor.angular, dtype=np.bool_), sensor.views == PLACES
    of = event.of or ((event.robot,),) * len(event.y)
    factors = [
        BlockMeasurement(names, sensor.expect, event.y[k], R[k], angular, what, places) for k, names in enumerate(of)
    ]
    reasons = [_reason_to_ignore(state, names) for names in of]
    for factor, reason in zip(factors, reasons, strict=True):
        if not reason:
            _checked_blocks(state, factor)
    state.t_ns = event.t_ns
    report.gaps = moves.advance(state, event.robot)
    report.blank(len(sensor.columns))
    for k, (factor, reason) in enumerate(zip(factors, reasons, strict=True)):
        if reason:
            found.append(Observation(k, None, "ignored", event.robot, None, reason))
            continue
        seen, done = correct_by_factor(state, factor, sensor.pass_share)
        report.fill([k], done)
        found.append(seen._replace(index=k, landmark=event.robot))
    report.observations = found
    return report


def _reason_to_ignore(state: State, names: Sequence[Id]) -> str:
    """Return why nothing can be corrected by an observation of these blocks, "" if something can."""
    missing = [name for name in names if not state.is_there(name)]
    return f"{missing[0]!r} is not in the map" if missing else EXACT if {*names} <= {*state.tracks.known} else ""


def _checked_blocks(state: State, factor: BlockMeasurement) -> list[MeasuredBlock]:
    """Return the blocks of a factor.  Raises EventError for what is wrong with it, before anything moves."""
    blocks = _blocks(state.map, state.tracks, factor.names)
    try:
        takes = signature(factor.expect)
        takes.bind(*factor.names)
    except TypeError:
        wanted = f"one for each of {', '.join(takes.parameters)}"
        raise EventError(f"{factor.what}: blocks {list_names(factor.names)}, expected {wanted}") from None
    except ValueError:  # a function in C may have no signature
        pass
    factor.linearize(blocks, [block.mean for block in blocks])
    return blocks


def _blocks(map_: Map, tracks: Tracks, names: Sequence[Id]) -> list[MeasuredBlock]:
    """Return what a factor needs of its blocks.  Raises MapError for a name that is not in the map."""
    blocks, known = [], tracks.known
    for name in names:
        slot = -1 if name in known else tracks.slot(name)
        track = tracks.confirmed.get(name)
        model = known.model(name) if slot < 0 else None if track is None else track.model
        space = map_.spaces[slot] if model is None else model.space
        assert space is not None
        blocks.append(MeasuredBlock(slot, space, known.mean(name) if slot < 0 else map_.mean(slot), model))
    return blocks
