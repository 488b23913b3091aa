"""What a run leaves behind: one row a step, one row an observation, and the map at some sixty instants.

A *step* is one scan and the controls before it.  Plain arrays, saved as ``history.npz`` without pickle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kalmark.results.inputs import Inputs
from kalmark.slam.events import Id

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Texts = npt.NDArray[np.str_]


class Start(NamedTuple):
    """A robot before the first event: its name, mean and covariance, and the time of its first event."""

    robot: str
    mean: Array
    covariance: Array
    t_ns: int


class MapSnapshot(NamedTuple):
    """The landmarks of the map after step `step`: ids, positions (K, d) and their covariances (K, d, d)."""

    step: int
    t_ns: int
    ids: tuple[Id, ...]
    means: Array
    covariances: Array


@dataclass(frozen=True, eq=False)
class History:
    """A run's steps (S of them) and observations (O of them).

    Steps: time, robot, its mean (S, p) and covariance (S, q, q) after the scan, and the wall time in microseconds.
    Observations: `step` is the row of the step, `id` and `landmark` are texts ("" for none), `d2` is NaN where there
    is none; `y`, `e`, `z` (O, m) and `Z` (O, m, m) are padded with NaN where sensors differ in size.
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

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots in the order of their starts, then of their first scans."""
        return tuple(dict.fromkeys([s.robot for s in self.starts] + self.robot.tolist()))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return everything as named arrays, those of the contract (t in seconds) first."""
        named = {"t": self.t_ns * 1e-9} | {key: getattr(self, key) for key in ("robot", "mean", "covariance")}
        named |= {key: getattr(self, key) for key in ("y", "e", "z", "Z", "landmark")}
        named |= {key: getattr(self, key) for key in _EXTRA}
        d = max((m.means.shape[1] for m in self.maps), default=2)
        return (
            named
            | self.inputs.arrays()
            | {
                "map_step": np.array([m.step for m in self.maps], dtype=np.int64),
                "map_t_ns": np.array([m.t_ns for m in self.maps], dtype=np.int64),
                "map_size": np.array([len(m.ids) for m in self.maps], dtype=np.int64),
                "map_landmark": texts([i for m in self.maps for i in m.ids]),
                "map_mean": np.concatenate([m.means for m in self.maps] or [np.empty((0, d))]),
                "map_covariance": np.concatenate([m.covariances for m in self.maps] or [np.empty((0, d, d))]),
                "start_robot": texts([s.robot for s in self.starts]),
                "start_mean": np.array([s.mean for s in self.starts]),
                "start_covariance": np.array([s.covariance for s in self.starts]),
                "start_t_ns": np.array([s.t_ns for s in self.starts], dtype=np.int64),
            }
        )

    @classmethod
    def from_arrays(cls, named: Mapping[str, npt.NDArray[Any]]) -> History:
        """Return the history that `arrays` gave."""
        keys = ("robot", "mean", "covariance", "y", "e", "z", "Z", "landmark", *_EXTRA)
        ends = np.cumsum(named["map_size"])
        maps = tuple(
            MapSnapshot(
                int(named["map_step"][i]),
                int(named["map_t_ns"][i]),
                tuple(as_id(text) for text in named["map_landmark"][end - size : end].tolist()),
                named["map_mean"][end - size : end],
                named["map_covariance"][end - size : end],
            )
            for i, (end, size) in enumerate(zip(ends, named["map_size"], strict=True))
        )
        starts = tuple(
            Start(str(robot), mean, covariance, int(t_ns))
            for robot, mean, covariance, t_ns in zip(
                *(named["start_" + key] for key in ("robot", "mean", "covariance", "t_ns")), strict=True
            )
        )
        return cls(**{key: named[key] for key in keys}, maps=maps, starts=starts, inputs=Inputs.from_arrays(named))


_EXTRA = ("t_ns", "step_us", "step", "sensor", "index", "id", "outcome", "d2", "reason")


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
