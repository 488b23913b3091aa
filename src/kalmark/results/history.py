"""What a run leaves behind: one row a step, one row an observation, and the map at some sixty instants.

A *step* is one scan and the controls before it.  Plain arrays, saved as ``history.npz`` without pickle.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from kalmark.events import Id
from kalmark.results.columns import (
    Array,
    Arrays,
    Flags,
    Ints,
    Matrix,
    Named,
    Names,
    Size,
    Texts,
    Vector,
    columns,
    padded,
    padded_all,
    rows_of,
    texts,
)
from kalmark.results.decisions import Decisions
from kalmark.results.inputs import Inputs


class Start(NamedTuple):
    """A robot before the first event: its name, mean and covariance, and the time of its first event."""

    robot: str
    mean: Vector
    covariance: Matrix
    t_ns: int


class MapSnapshot(NamedTuple):
    """The landmarks of the map after step `step`: ids, places (K, n) and their covariances (K, q, q), kinds.

    In the plane places are positions.  In space they are positions, endpoints of lines or poses of tags, padded with
    NaN (see `kalmark.results.shapes`).
    """

    step: int
    t_ns: int
    ids: tuple[Id, ...]
    means: Array
    covariances: Array
    kinds: tuple[str, ...] = ()


class Camera(NamedTuple):
    """A camera of a robot: its mount (7,), the image's width and height in pixels, and what its rows of y are.

    `corners` (4, 3) are the rays to the image's corners with z = 1, for drawing.
    """

    robot: str
    sensor: str
    mount: Vector
    size: Size
    columns: Names
    corners: Matrix


class Mounted(NamedTuple):
    """A sensor that calibrates itself: its name in the map, and its mount (3,) or (7,) at the end.

    `covariance` at the end and `prior`, that before the first event, (3, 3) or (6, 6), are in the robot's frame.  Gain
    and offset of its range follow where they are in the map, too.
    """

    name: str
    mean: Vector
    covariance: Matrix
    prior: Matrix


class Biased(NamedTuple):
    """The bias of a robot's controls at the end: `mean` (k,) of the control's `columns`, and its covariance (k, k)."""

    robot: str
    columns: Names
    mean: Vector
    covariance: Matrix


@dataclass(frozen=True, eq=False)
class History:
    """A run's steps (S of them) and observations (O of them).

    Steps: time, robot, its mean (S, n) and covariance (S, q, q) after the scan, and the wall time in microseconds.
    Observations: `step` is the row of the step, `id`, `landmark` and `true_id`, what the log knows and the filter may
    not, are texts ("" for none), `kind` is that of the landmark after the scan, `d2` is NaN where there is none;
    measured `y` and expected `e` (O, m), innovation `z` (O, p) and its covariance `Z` (O, p, p).  All are padded with
    NaN where robots or sensors differ in size.  `late` (O,) says which tentative ones
    were fused when their landmark was confirmed.  `left_px` (O,) is what the corners of tags are off by after the scan
    (`kalmark.results.corners`); `decisions` has what they were compared with.  `noise` (O, p) are the sigmas stated
    of z, NaN where they are not of its numbers.
    """

    t_ns: Ints
    robot: Texts
    mean: Array
    covariance: Array
    step_us: Array
    step: Ints
    sensor: Texts
    index: Ints
    id: Texts
    outcome: Texts
    landmark: Texts
    d2: Array
    reason: Texts
    y: Array
    e: Array
    z: Array
    Z: Array
    maps: tuple[MapSnapshot, ...] = ()
    starts: tuple[Start, ...] = ()
    inputs: Inputs = field(default_factory=Inputs)
    kind: Texts = field(default_factory=lambda: np.empty(0, dtype=np.str_))
    left_px: Array = field(default_factory=lambda: np.empty(0))
    cameras: tuple[Camera, ...] = ()
    mounts: tuple[Mounted, ...] = ()
    biases: tuple[Biased, ...] = ()
    true_id: Texts = field(default_factory=lambda: np.empty(0, dtype=np.str_))
    decisions: Decisions = field(default_factory=Decisions)
    late: Flags = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    noise: Array = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def fused(self) -> Flags:
        """Which observations (O,) have corrected or started what is in the map."""
        late = self.late if len(self.late) else np.zeros(len(self.outcome), dtype=np.bool_)
        return np.isin(self.outcome, ("associated", "new")) | late

    @property
    def in_space(self) -> bool:
        """Whether the robots move in space."""
        return self.mean.shape[1] > 3

    @property
    def poses(self) -> Array:
        """The poses after each scan, (S, 3) in the plane and (S, 7) in space."""
        return self.mean[:, : 7 if self.in_space else 3]

    @property
    def pose_covariances(self) -> Array:
        """The covariances of the poses, (S, 3, 3) or (S, 6, 6)."""
        q = 6 if self.in_space else 3
        return self.covariance[:, :q, :q]

    def map_at(self, step: int) -> MapSnapshot:
        """Return the last map that was kept up to a step; before the first there is nothing in it."""
        d = 3 if self.in_space else 2
        nothing = MapSnapshot(step, 0, (), np.empty((0, d)), np.empty((0, d, d)))
        return next((m for m in reversed(self.maps) if m.step <= step), nothing)

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots in the order of their starts, then of their first scans."""
        return tuple(dict.fromkeys([s.robot for s in self.starts] + self.robot.tolist()))

    def arrays(self) -> Arrays:
        """Return everything as named arrays, those of the contract among them (t in seconds)."""
        named: Arrays = {"t": self.t_ns * 1e-9}
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        named |= {key: value for key, value in values.items() if isinstance(value, np.ndarray)}
        named |= self.decisions.arrays() | self.inputs.arrays() | _map_arrays(self.maps)
        named |= columns("start", Start, self.starts) | columns("camera", Camera, self.cameras, joined=True)
        named |= columns("mount", Mounted, self.mounts, joined=True)
        named |= columns("bias", Biased, self.biases, joined=True)
        return named

    @classmethod
    def from_arrays(cls, named: Named) -> History:
        """Return the history that `arrays` gave; the first versions saved fewer arrays."""
        count, numbers = named["z"].shape[:2]
        given: dict[str, Any] = {
            "kind": np.full(count, "", dtype=np.str_),
            "left_px": np.full(count, np.nan),
            "true_id": named["id"],
        }
        given |= {"late": np.zeros(count, dtype=np.bool_), "noise": np.full((count, numbers), np.nan)}
        given |= {f.name: named[f.name] for f in fields(cls) if f.name in named}
        return cls(
            **given,
            maps=_maps(named),
            starts=rows_of("start", Start, named),
            inputs=Inputs.from_arrays(named),
            decisions=Decisions.from_arrays(named),
            cameras=rows_of("camera", Camera, named, joined=True),
            mounts=rows_of("mount", Mounted, named, joined=True),
            biases=rows_of("bias", Biased, named, joined=True),
        )


def _map_arrays(maps: tuple[MapSnapshot, ...]) -> Arrays:
    blocks = [m.covariances for m in maps]
    width = max((block.shape[1] for block in blocks), default=2)
    return {
        "map_step": np.array([m.step for m in maps], dtype=np.int64),
        "map_t_ns": np.array([m.t_ns for m in maps], dtype=np.int64),
        "map_size": np.array([len(m.ids) for m in maps], dtype=np.int64),
        "map_landmark": texts([i for m in maps for i in m.ids]),
        "map_kind": texts([kind for m in maps for kind in m.kinds]),
        "map_mean": padded_all([mean for m in maps for mean in m.means]),
        "map_covariance": padded(blocks, [len(block) for block in blocks], width, matrices=True),
    }


def _maps(named: Named) -> tuple[MapSnapshot, ...]:
    ends = np.cumsum(named["map_size"])
    kinds = named.get("map_kind", np.empty(0, dtype=np.str_))
    return tuple(
        MapSnapshot(
            int(named["map_step"][i]),
            int(named["map_t_ns"][i]),
            tuple(as_id(text) for text in named["map_landmark"][end - size : end].tolist()),
            named["map_mean"][end - size : end],
            named["map_covariance"][end - size : end],
            tuple(kinds[end - size : end].tolist()),
        )
        for i, (end, size) in enumerate(zip(ends, named["map_size"], strict=True))
    )


def as_id(text: str) -> Id:
    """Return a landmark id from a file: a text that is an integer becomes one."""
    try:
        number = int(text)
    except ValueError:
        return text
    return number if str(number) == text else text
