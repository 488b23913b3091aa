"""Strategies of hypothesis: whole streams of events of two robots, most of them right, some odd or wrong."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from hypothesis import strategies as st

import kalmark as km

ODD = (0.0, -0.0, 1e-300, 1e6, 1e9, 1e13, 1e155, -1e155, float("inf"), float("nan"))
NUMBERS = st.one_of(st.floats(-4, 4), st.floats(-4, 4), st.floats(-4, 4), st.sampled_from(ODD))
STEPS_NS = st.sampled_from((0, 1, 50_000_000, 50_000_000, 50_000_000, 10**9, -1, -(10**9), 2**62))
ROBOTS = st.sampled_from(("a", "b", "a", "b", "a", "b", "c"))
IDS = st.sampled_from((1, 2, 3, 4, 5, 6, None, "post", "b", "a bias", 2**70))


class Told(NamedTuple):
    """What is told of an event: its class, its arguments, and how long it is after the last one that was taken."""

    kind: Any
    arguments: dict[str, Any]
    step_ns: int

    def made(self, now_ns: int) -> Any:
        """Return the event.  Raises EventError."""
        return self.kind(t_ns=now_ns + self.step_ns, **self.arguments)


def arrays(*shape: int) -> st.SearchStrategy[Any]:
    """Return arrays of a shape, of numbers that are usual or odd."""
    size = int(np.prod(shape))
    return st.lists(NUMBERS, min_size=size, max_size=size).map(lambda values: np.array(values).reshape(shape))


def covariances(size: int) -> st.SearchStrategy[Any]:
    """Return None, covariances, and what is none."""
    return st.one_of(
        st.none(), st.floats(1e-6, 1).map(lambda v: v * np.eye(size)), arrays(size).map(np.diag), arrays(size, size)
    )


@st.composite
def controls(draw: st.DrawFn, space: bool) -> Told:
    """Draw a control: in the plane of velocities for `a`, of increments for `b`, in space of increments."""
    robot = draw(ROBOTS)
    size = draw(st.sampled_from((6 if space else 2 if robot == "a" else 3,) * 9 + (4,)))
    return Told(km.Control, {"robot": robot, "u": draw(arrays(size)), "cov": draw(covariances(size))}, draw(STEPS_NS))


@st.composite
def scans(draw: st.DrawFn, space: bool) -> Told:
    """Draw a scan of ranges and bearings."""
    many, width = draw(st.integers(0, 4)), draw(st.sampled_from((3 if space else 2,) * 9 + (1,)))
    y = draw(arrays(many, width))
    if many and draw(st.booleans()):
        y[:, 0] = np.abs(y[:, 0])
    ids = draw(st.one_of(st.none(), st.lists(IDS, min_size=many, max_size=many, unique=draw(st.booleans()))))
    told = {"robot": draw(ROBOTS), "sensor": draw(st.sampled_from(("eye",) * 9 + ("ear",))), "y": y, "ids": ids}
    return Told(km.Scan, told | {"cov": draw(covariances(width))}, draw(STEPS_NS))


@st.composite
def fixes(draw: st.DrawFn, space: bool) -> Told:
    """Draw a fix."""
    size = 3 if space else 2
    return Told(
        km.Fix, {"robot": draw(ROBOTS), "y": draw(arrays(size)), "cov": draw(covariances(size))}, draw(STEPS_NS)
    )


def streams(space: bool, most: int = 25) -> st.SearchStrategy[list[Told]]:
    """Return streams of events."""
    return st.lists(st.one_of(controls(space), scans(space), scans(space), fixes(space)), min_size=1, max_size=most)
