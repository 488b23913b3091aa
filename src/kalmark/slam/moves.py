"""Moving robots up to an event, by the controls they hold.  [S] 2.4: prediction."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from kalmark.errors import EventError, MapError
from kalmark.events import seconds_text
from kalmark.geometry.spaces import Rn
from kalmark.models.state_view import twist_between
from kalmark.report import Gap
from kalmark.slam.held_control import MotionPart
from kalmark.slam.state import State


def advance(state: State, *names: str) -> tuple[Gap, ...]:
    """Move robots up to now by the controls they hold, all or none of them; return gaps in their controls."""
    assert state.t_ns is not None
    gaps: tuple[Gap, ...] = ()
    moves: list[tuple[str, MotionPart]] = []
    clocks = []
    try:
        for name in names:
            held = state.moving[name].held
            if not held.stays(state.t_ns):
                clocks.append((held, held.snapshot()))
                if (part := held.advance(state.t_ns)) is not None:
                    moves.append((name, part))
        for name, part in moves if len(moves) > 1 else ():
            refuse_nowhere(state, name, [part])
        for name, part in moves:
            move(state, name, part)
    except EventError:
        for held, clock in clocks:
            held.put_back(clock)
        raise
    for held, _ in clocks:
        gaps += held.noticed()
    return gaps


def refuse_nowhere(state: State, name: str, parts: Sequence[MotionPart]) -> None:
    """Refuse, before anything has moved, parts of a robot's controls that lead nowhere."""
    if not state.moving[name].leads_somewhere(state.map, parts):
        raise _nowhere(state, name, parts[-1])


def _nowhere(state: State, name: str, part: MotionPart) -> EventError:
    what = f"{name!r} at t={seconds_text(state.t_ns or 0)} s"
    return EventError(f"{what}: u is {part.u.tolist()}, expected a control that moves it somewhere finite")


def move(state: State, name: str, part: MotionPart) -> None:
    """Move a robot by one part of its control: R <- f(R, u), P <- F P F' + Q.  [S] (14)-(17)."""
    moving, estimator = state.moving[name], state.estimator
    if not isinstance(moving.model, tuple):  # a user's: nothing is known of it
        refuse_nowhere(state, name, [part])
    if moving.error is None and part.shares and moving.leads_somewhere(state.map, [part]):
        with suppress(MapError):  # it is full: each part has an error of its own
            moving.error = state.map.add(Rn(len(part.u)), np.zeros(len(part.u)), part.N)
    before = state.pose(name) if moving.past is not None else None
    if not estimator.predict(state.map, moving.movement(state.map, part)):
        raise _nowhere(state, name, part)
    if moving.has_velocity:
        moving.note_speed(state.map)
    if moving.past is not None and before is not None and part.dt_s > 0.0:
        moving.past.add(part.dt_s, twist_between(before, state.pose(name), part.dt_s))
    for key, given in state.given.items():
        if key[0] == name:
            given.add_motion(part)
    for others in (state.pose_hypotheses, state.sums):
        if name in others and not others[name].move(estimator, part):
            del others[name]
    state.clones.forget_current(name)
