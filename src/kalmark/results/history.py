"""What a run leaves behind: one row a step, one row an observation, and the map at some sixty instants.

A *step* is one scan and the controls before it.  Plain arrays, saved as ``history.npz`` without pickle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.events import Id
from kalmark.results.decisions import Decisions
from kalmark.results.inputs import Inputs

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Texts = npt.NDArray[np.str_]
Flags = npt.NDArray[np.bool_]


class Start(NamedTuple):
    """A robot before the first event: its name, mean and covariance, and the time of its first event."""

    robot: str
    mean: Array
    covariance: Array
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
    mount: Array
    size: tuple[float, float]
    columns: tuple[str, ...]
    corners: Array


class Mounted(NamedTuple):
    """A sensor that calibrates itself: its name in the map, and its mount (3,) or (7,) at the end.

    `covariance` at the end and `prior`, that before the first event, (3, 3) or (6, 6), are in the robot's frame.  Gain
    and offset of its range follow where they are in the map, too.
    """

    name: str
    mean: Array
    covariance: Array
    prior: Array


class Biased(NamedTuple):
    """The bias of a robot's controls at the end: `mean` (k,) of the control's `columns`, and its covariance (k, k)."""

    robot: str
    columns: tuple[str, ...]
    mean: Array
    covariance: Array


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

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return everything as named arrays, those of the contract (t in seconds) first."""
        named = {"t": self.t_ns * 1e-9} | {key: getattr(self, key) for key in ("robot", "mean", "covariance")}
        named |= {key: getattr(self, key) for key in ("y", "e", "z", "Z", "landmark")}
        named |= {key: getattr(self, key) for key in (*_EXTRA, "kind", "left_px", "true_id", "late", "noise")}
        named |= self.decisions.arrays()
        return (
            named | self.inputs.arrays() | _map_arrays(self.maps) | _start_arrays(self.starts) | self._sensor_arrays()
        )

    def _sensor_arrays(self) -> dict[str, npt.NDArray[Any]]:
        return {
            "camera": texts([f"{c.robot}\n{c.sensor}\n{','.join(c.columns)}" for c in self.cameras]),
            "camera_mount": np.array([c.mount for c in self.cameras]).reshape(-1, 7),
            "camera_size": np.array([c.size for c in self.cameras], dtype=np.float64).reshape(-1, 2),
            "camera_corners": np.array([c.corners for c in self.cameras]).reshape(-1, 4, 3),
            "mount": texts([m.name for m in self.mounts]),
            "mount_mean": padded_rows([m.mean for m in self.mounts]),
            "mount_covariance": padded_squares([m.covariance for m in self.mounts]),
            "mount_prior": padded_squares([m.prior for m in self.mounts]),
            "bias": texts([f"{b.robot}\n{','.join(b.columns)}" for b in self.biases]),
            "bias_mean": padded_rows([b.mean for b in self.biases]),
            "bias_covariance": padded_squares([b.covariance for b in self.biases]),
        }

    @classmethod
    def from_arrays(cls, named: Mapping[str, npt.NDArray[Any]]) -> History:
        """Return the history that `arrays` gave."""
        starts = tuple(
            Start(str(robot), mean[~np.isnan(mean)], _cut(covariance), int(t_ns))
            for robot, mean, covariance, t_ns in zip(
                *(named["start_" + key] for key in ("robot", "mean", "covariance", "t_ns")), strict=True
            )
        )
        count = len(named["landmark"])
        kind, left = named.get("kind", np.full(count, "", dtype=np.str_)), named.get("left_px", np.full(count, np.nan))
        maps, inputs, cameras = _maps(named), Inputs.from_arrays(named), _cameras(named)
        keys = ("mount", "mount_mean", "mount_covariance", "mount_prior")
        rows = zip(*(named.get(key, ()) for key in keys), strict=True)
        mounts = tuple(Mounted(str(name), mean[~np.isnan(mean)], _cut(P), _cut(C)) for name, mean, P, C in rows)
        columns: dict[str, Any] = {
            key: named[key] for key in ("robot", "mean", "covariance", "y", "e", "z", "Z", "landmark", *_EXTRA)
        }
        columns |= {"kind": kind, "left_px": left, "true_id": named.get("true_id", named["id"])}
        columns["late"] = named.get("late", np.zeros(count, dtype=np.bool_))
        columns["noise"] = named.get("noise", np.full((count, named["z"].shape[1]), np.nan))
        columns |= {"maps": maps, "starts": starts, "mounts": mounts, "biases": _biases(named)}
        return cls(**columns, inputs=inputs, cameras=cameras, decisions=Decisions.from_arrays(named))


def _biases(named: Mapping[str, npt.NDArray[Any]]) -> tuple[Biased, ...]:
    rows = zip(*(named.get(key, ()) for key in ("bias", "bias_mean", "bias_covariance")), strict=True)
    told = [(*str(name).split("\n"), mean[~np.isnan(mean)], _cut(P)) for name, mean, P in rows]
    return tuple(Biased(robot, tuple(columns.split(",")), mean, P) for robot, columns, mean, P in told)


def _map_arrays(maps: tuple[MapSnapshot, ...]) -> dict[str, npt.NDArray[Any]]:
    blocks = [m.covariances for m in maps]
    width = max((block.shape[1] for block in blocks), default=2)
    return {
        "map_step": np.array([m.step for m in maps], dtype=np.int64),
        "map_t_ns": np.array([m.t_ns for m in maps], dtype=np.int64),
        "map_size": np.array([len(m.ids) for m in maps], dtype=np.int64),
        "map_landmark": texts([i for m in maps for i in m.ids]),
        "map_kind": texts([kind for m in maps for kind in m.kinds]),
        "map_mean": padded_rows([mean for m in maps for mean in m.means]),
        "map_covariance": padded(blocks, [len(block) for block in blocks], width, matrices=True),
    }


def _maps(named: Mapping[str, npt.NDArray[Any]]) -> tuple[MapSnapshot, ...]:
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


def _start_arrays(starts: tuple[Start, ...]) -> dict[str, npt.NDArray[Any]]:
    return {
        "start_robot": texts([s.robot for s in starts]),
        "start_mean": padded_rows([s.mean for s in starts]),
        "start_covariance": padded_squares([s.covariance for s in starts]),
        "start_t_ns": np.array([s.t_ns for s in starts], dtype=np.int64),
    }


def _cameras(named: Mapping[str, npt.NDArray[Any]]) -> tuple[Camera, ...]:
    if "camera" not in named:
        return ()
    rows = zip(*(named[key] for key in ("camera", "camera_mount", "camera_size", "camera_corners")), strict=True)
    cameras = []
    for text, mount, (width, height), corners in rows:
        robot, sensor, columns = str(text).split("\n")
        cameras.append(Camera(robot, sensor, mount, (float(width), float(height)), tuple(columns.split(",")), corners))
    return tuple(cameras)


_EXTRA = (
    "t_ns",
    "step_us",
    "step",
    "sensor",
    "index",
    "id",
    "outcome",
    "d2",
    "reason",
)  # and kind and left_px, which runs saved by the first version lack


def texts(values: list[Any]) -> Texts:
    """Return ids or names as an array of texts, "" for None."""
    return np.array(["" if value is None else str(value) for value in values], dtype=np.str_)


def as_id(text: str) -> Id:
    """Return a landmark id from a file: a text that is an integer becomes one."""
    try:
        number = int(text)
    except ValueError:
        return text
    return number if str(number) == text else text


def padded(blocks: list[Array], counts: list[int], width: int, matrices: bool = False) -> Array:
    """Stack blocks (K, m) or (K, m, m) of several sizes m, K by `counts`, padded with NaN; an empty one is all NaN."""
    out = np.full((sum(counts), width, width) if matrices else (sum(counts), width), np.nan)
    at = 0
    for block, count in zip(blocks, counts, strict=True):
        if len(block) == count and block.size:
            out[(slice(at, at + count), *(slice(m) for m in block.shape[1:]))] = block
        at += count
    return out


def padded_rows(rows: list[Array]) -> Array:
    """Stack rows of several lengths, padded with NaN."""
    out = np.full((len(rows), max((len(row) for row in rows), default=2)), np.nan)
    for k, row in enumerate(rows):
        out[k, : len(row)] = row
    return out


def padded_squares(matrices: list[Array]) -> Array:
    """Stack square matrices of several sizes, padded with NaN."""
    width = max((len(P) for P in matrices), default=2)
    return padded([P[None] for P in matrices], [1] * len(matrices), width, matrices=True)


def _cut(P: Array) -> Array:
    """Return a square matrix without the NaN it was padded with."""
    n = int((~np.isnan(np.diagonal(P))).sum())
    return P[:n, :n]
