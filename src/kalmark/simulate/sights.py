"""Simulated measurements from true poses, right or wrong.

Visibility is decided without noise, and noise is added afterwards: a measurement may so be beyond the border of the
image, but its noise is that of the sensor everywhere.  ([TB] adds it before and cuts what falls outside.)
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.random import Generator
from pydantic import Field

from kalmark import presets
from kalmark.arrays import Array, Flags, Index
from kalmark.config.sections import Section
from kalmark.declare import Count, NotNegative, Positive, Within
from kalmark.geometry.angles import wrap
from kalmark.geometry.rotations import matrix
from kalmark.geometry.spaces import SE3
from kalmark.models.landmarks import Point2D, Point3D
from kalmark.models.protocols import StartNoise, in_view, range_limit, world_of
from kalmark.models.sensors import Wall
from kalmark.models.tags import corners, tag_seen_from
from kalmark.models.walls import orient_segments
from kalmark.simulate.layouts import Scenery

Share = Annotated[float, Within(ge=0, le=1)]
Pair = Annotated[tuple[int, int], Field(strict=False)]

POINTS, SEGMENTS, TAGS = "points", "segments", "tags"
HERE = {2: np.zeros(3), 3: np.array([0.0, 0, 0, 0, 0, 0, 1])}
_LOOK = {3: Point2D(), 7: Point3D()}
_TRIES = 200  # places drawn for a false measurement before it is given up


def looks_for(sensor: Any) -> str:
    """Return the sort of landmarks of a sensor: points, segments or tags."""
    return {"Segments": SEGMENTS, "Wall": SEGMENTS, "TagPose": TAGS, "TagCorners": TAGS}.get(
        type(sensor).__name__, POINTS
    )


class Sighted(NamedTuple):
    """Observations of a sensor, those of one step after those of another: at which `steps` (N,), in order.

    `ids` (N,) are reported, `real` (N,) those of what is really seen: a landmark's, -1, -2, ... for a robot by its
    number, 0 for nothing.  Then v (N, n) in the sensor's frame, measurements e (N, m), sizes of tags (N,).
    """

    steps: Index
    ids: Index
    real: Index
    v: Array
    e: Array
    sizes: Array

    def rows(self, rows: Index) -> Sighted:
        """Return some of them."""
        parts: tuple[Any, ...] = self
        return Sighted(*(part.take(rows, axis=0) for part in parts))


class SimulatedSensing(Section):
    """Deviations of a simulated sensor from its model: a slower rate, and faults."""

    every: Count | None = None
    """A scan at every so manieth step: at every one, or that of the sensor's `preset`."""
    first: Count | None = None
    """The first step with a scan; if absent the one of `every`."""
    beams: Annotated[int, Within(ge=3)] = 541
    """Beams of a scan, where the sensor has the detector of a laser: then its scans are raw."""
    beams_fov_deg: Annotated[float, Within(gt=0, le=360)] = 270.0
    """Angle between the first and the last of them."""
    images: bool = False
    """A camera in a world of textures: give its images instead of measurements."""
    depth: bool = False
    """With the depth of every pixel."""
    noise_grey: NotNegative = 2.0
    """Noise of a pixel of the images, grey values."""
    blur_px: NotNegative = 0.5
    """Blur of the images: standard deviation of a Gaussian."""
    dropouts: Share | None = None
    """Probability that a visible landmark is not reported: 0, or that of the sensor's `preset`."""
    outliers: Share = 0.0
    """Probability that a measurement is false: of a place drawn from its field of view."""
    loop_reach_m: Positive | None = None
    """An `odometer` that keeps poses: read a scan against an earlier one, too, if the robot is so near to it again."""
    between: Annotated[tuple[Annotated[tuple[int | str, ...], Field(strict=False)], ...], Field(strict=False)] = ()
    """Of a sensor of blocks: the robots and landmarks of each of its observations; if empty its robot."""
    swapped: Annotated[tuple[Pair, ...], Field(strict=False)] = ()
    """Pairs of ids that are taken for each other."""
    hidden: Annotated[tuple[int, ...], Field(strict=False)] = ()
    """Ids that are never reported."""
    late_s: NotNegative = 0.0
    """By so much the stamps of its scans are later than the lag of the sensor makes them."""
    faults_from_step: Count = 1
    """All is well before this step."""

    def of(self, section: Any, dt_s: float) -> SimulatedSensing:
        """Return it with what it leaves open taken from the `preset` of the sensor's section, if that has one."""
        preset = presets.ALL.get(section.model_dump().get("preset") or "")
        if preset is None:
            return self
        usual = {"every": max(1, round(1 / (preset.rate_hz * dt_s))), "dropouts": preset.dropouts}
        return self.model_copy(update={key: value for key, value in usual.items() if getattr(self, key) is None})

    def scans_at(self, k: Any) -> Any:
        """Return whether there is a scan at step k, or at each of k (K,)."""
        every = self.every or 1
        first = every if self.first is None else self.first
        return (k >= first) & ((k - first) % every == 0)

    @property
    def has_faults(self) -> bool:
        """True if anything but the rate is unusual."""
        return bool(self.dropouts or self.outliers or self.swapped or self.hidden)


@dataclass
class Things:
    """All there is to see of one sort: ids from `first` on, `values` (M, n), and which of it was ever seen.

    `classes` (M,) are the numbers of the classes of points, None where no sensor reports classes.
    """

    sort: str
    first: int
    values: Array
    sizes: Array
    seen: Flags = field(init=False)
    dimensions: int = 2
    classes: Index | None = None

    def __post_init__(self) -> None:
        self.seen = np.zeros(len(self.values), dtype=np.bool_)

    @cached_property
    def tree(self) -> Any:
        """All of it in a tree of places.  Sensors without a limit of range do without."""
        from scipy.spatial import cKDTree

        return cKDTree(self.centres())

    def extent(self) -> float:
        """Return the length of the diagonal of all of it, in m, at least 1."""
        return max(1.0, float(np.linalg.norm(np.ptp(self.centres(), axis=0)))) if len(self.values) else 1.0

    def centres(self) -> Array:
        """Return where they are (M, 2|3), segments by their middles."""
        return centre(self.sort, self.values, self.dimensions)

    def near(self, place: Array, reach_m: float) -> Index:
        """Return the indices (K,) of those within `reach_m` of a place (D,), in order."""
        if math.isinf(reach_m) or not len(self.values):
            return np.arange(len(self.values))
        return np.array(sorted(self.tree.query_ball_point(place, reach_m)), dtype=np.int64)


def points_in_reach(T: Array, points: Array, reach_m: float) -> tuple[Index, Index, Array]:
    """Return which points (M, n) are in reach of which of the frames T (K, 3) of the plane, and how they are there.

    That is the numbers of frames (N,) and of points (N,), and v (N, n), what is behind x and y unchanged.
    """
    places, origins = (p[:, 0] + 1j * p[:, 1] for p in (points, T))
    d = places - origins[:, None]
    frames, numbers = np.nonzero(d.real**2 + d.imag**2 <= reach_m**2)
    v = d[frames, numbers] * np.exp(-1j * T[:, 2])[frames]
    return frames, numbers, np.column_stack([v.real, v.imag, points[numbers, 2:]])


def things_of(scenery: Scenery, dimensions: int) -> dict[str, Things]:
    """Return what there is to see, by sort; ids are 1, 2, ... over points, then segments, then tags."""
    points = scenery.points
    if dimensions == 3 and points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    first, things = 1, {}
    for sort, rows in ((POINTS, points), (SEGMENTS, scenery.segments), (TAGS, scenery.tags)):
        sizes = scenery.tag_sizes if sort == TAGS else np.zeros(len(rows))
        things[sort] = Things(sort, first, rows, sizes, dimensions=dimensions)
        first += len(rows)
    return things


def centre(sort: str, values: Array, dimensions: int) -> Array:
    """Return the positions (K, 2|3) of things (K, n)."""
    if sort == SEGMENTS:
        one, other = halves(values)
        return 0.5 * (one + other)
    return values[:, :dimensions]


def halves(segments: Array) -> tuple[Array, Array]:
    """Return both ends (K, 2|3) of segments (K, 4|6)."""
    d = segments.shape[1] // 2
    return segments[:, :d], segments[:, d:]


def things_in_frame(sort: str, T: Array, values: Array) -> Array:
    """Return things (K, n) as they are in the frame T: points, both ends of segments, poses of tags."""
    look: Any = _LOOK[len(T)]
    if sort == POINTS:
        v: Array = look.seen_from(T, values)[0]
        return v
    if sort == SEGMENTS:
        return np.column_stack([look.seen_from(T, ends)[0] for ends in halves(values)])
    return tag_seen_from(T, np.ascontiguousarray(values))[0]


def exact_measurements(sensor: Any, v: Array, sizes: Array) -> tuple[Flags, Array]:
    """Return which v (K, n) in the sensor's frame are observable, and their measurements (K, m) without noise."""
    sort = looks_for(sensor)
    if sort == SEGMENTS:
        seen: tuple[Flags, Array] = sensor.sees_segments(HERE[v.shape[1] // 2], *halves(v))
        return seen
    if sort == TAGS:
        return tags_seen(sensor, v, sizes)
    inside = in_view(sensor, v)
    e = np.full((len(v), len(sensor.columns)), np.nan)
    if inside.any():
        e[inside] = sensor.expect(v[inside])[0]
    return inside, e


def noisy_measurements(sensor: Any, e: Array, rng: Generator, cov: Array | None = None) -> Array:
    """Return noisy measurements of the exact ones e (K, m), angles wrapped, poses turned.

    A covariance `cov` (K, m, m) overrides the sensor's own noise.
    """
    if len(e) == 0:
        return np.empty((0, len(sensor.columns)))
    # of what is measured, where innovations are something else
    noise = sensor.start_noise if isinstance(sensor, StartNoise) else sensor.noise
    n = gaussian(noise(e) if cov is None else cov, rng)
    if e.shape[1] == 7 and n.shape[1] == 6:
        return np.array([SE3.plus(pose, d) for pose, d in zip(e, n, strict=True)])
    y = e.copy()
    y[:, : n.shape[1]] += n  # a tag's size is known, not measured
    y = np.where(sensor.angular, wrap(y), y) if len(sensor.angular) == y.shape[1] else y
    return orient_segments(y) if isinstance(sensor, Wall) else y  # noise may take a line to the other side


def is_reportable(sensor: Any, y: Array) -> Index:
    """Return which noisy measurements y (K, m) a sensor can report: noise may take a range below zero."""
    return np.flatnonzero((y[:, 0] >= 0) | (sensor.columns[0] != "range_m"))


def gaussian(cov: Array, rng: Generator) -> Array:
    """Draw from zero-mean Gaussians with positive semidefinite covariances (..., n, n)."""
    return correlated(cov, rng.standard_normal(cov.shape[:-1]))


def correlated(cov: Array, z: Array) -> Array:
    """Return standard normal numbers z (..., n) with the covariances (..., n, n)."""
    variances = np.einsum("...ii->...i", cov)
    if np.count_nonzero(cov) == np.count_nonzero(variances):
        return np.sqrt(variances) * z
    variances, axes = np.linalg.eigh(cov)
    return np.einsum("...ij,...j->...i", axes, np.sqrt(np.maximum(variances, 0.0)) * z)


def reported_rows(
    things: Things, seen: Sighted, new_per_step: int | None, max_per_scan: int | None, rng: Generator
) -> Iterator[Index]:
    """Yield rows of what is seen that are reported, and note them as seen.

    These are of many steps at once; alone are those that start new landmarks, for which they draw from the same source
    of chance as the noise does.
    """
    distance = np.linalg.norm(centre(things.sort, seen.v, things.dimensions), axis=1)
    steps, near, at = seen.steps, seen.real - things.first, 0
    rows = np.arange(len(steps))
    if max_per_scan is not None:
        rows = np.sort(np.lexsort((distance, steps))[rows - np.searchsorted(steps, steps) < max_per_scan])
    if new_per_step is None:
        yield rows
        return
    while at < len(steps):
        unseen = np.flatnonzero(~things.seen[near[at:]])
        k = steps[at + unseen[0]] if len(unseen) else steps[-1] + 1
        here, then = np.searchsorted(steps, (k, k + 1)).tolist()
        yield rows[slice(*np.searchsorted(rows, (at, here)))]
        at = then
        if then > here:
            known = things.seen[near[here:then]]
            new = rng.permutation(here + np.flatnonzero(~known))[:new_per_step]
            told = np.union1d(here + np.flatnonzero(known), new)
            told = np.sort(told[np.argsort(distance[told], kind="stable")[:max_per_scan]])
            things.seen[near[told]] = True
            yield told


def report_with_faults(
    sensor: Any, seen: Sighted, sensing: SimulatedSensing, things: Things, rng: Generator
) -> Sighted:
    """Return what is reported of what is seen, before noise."""
    late = np.flatnonzero(seen.steps >= sensing.faults_from_step)
    if not sensing.has_faults or not len(late):
        return seen
    if sensing.outliers:
        wrong = late[rng.random(len(late)) < sensing.outliers]
        reach_m = min(range_limit(sensor), things.extent())
        found, y = false_measurements(sensor, seen.v[wrong], seen.sizes[wrong], reach_m, rng)
        seen.e[wrong[found]], seen.real[wrong[found]] = y[found], 0
    told, kept = seen.ids[late], np.ones(len(seen.ids), dtype=np.bool_)
    kept[late] = (rng.random(len(late)) >= (sensing.dropouts or 0.0)) & ~np.isin(told, sensing.hidden)
    for name, other in dict([*sensing.swapped, *((b, a) for a, b in sensing.swapped)]).items():
        seen.ids[late[told == name]] = other
    return seen.rows(np.flatnonzero(kept))


def false_measurements(sensor: Any, v: Array, sizes: Array, reach_m: float, rng: Generator) -> tuple[Flags, Array]:
    """Return false measurements (K, m): of the same things at places drawn from the field of view, and which succeeded.

    Places are uniform in the field of view within reach: in an image, uniform over its pixels.
    """
    sort, plane = looks_for(sensor), world_of(sensor) == "plane"
    found, e = np.zeros(len(v), dtype=np.bool_), np.full((len(v), len(sensor.columns)), np.nan)
    for _ in range(_TRIES):
        missing = np.flatnonzero(~found)
        if not len(missing):
            break
        d = 2 if plane else 3
        places = rng.standard_normal((len(missing), d))  # uniform in a ball: of any direction first
        places /= np.linalg.norm(places, axis=1, keepdims=True)
        places *= reach_m * rng.uniform(0.0, 1.0, (len(missing), 1)) ** (1.0 / d)
        moved = v[missing].copy()
        if sort == SEGMENTS:
            shift = places - centre(sort, moved, places.shape[1])
            moved += np.column_stack([shift, shift])
        else:
            moved[:, : places.shape[1]] = places
        inside, y = exact_measurements(sensor, moved, sizes[missing])
        found[missing], e[missing[inside]] = inside, y[inside]
    return found, e


def tags_seen(sensor: Any, v: Array, sizes: Array) -> tuple[Flags, Array]:
    """Return which tags at v (K, 7) are observable: those that face it, with all corners in its image; and e (K, m)."""
    axis = np.array([matrix(q)[:, 2] for q in np.ascontiguousarray(v[:, 3:])]).reshape(-1, 3)
    inside: Flags = np.einsum("ki,ki->k", axis, v[:, :3]) > 0
    if len(sensor.columns) == 7:
        return inside & sensor.sees(v), v.copy()
    e = np.full((len(v), 9), np.nan)
    for i in np.flatnonzero(inside):
        inside[i] = sensor.sees(corners(sizes[i]) @ matrix(v[i, 3:].copy()).T + v[i, :3]).all()
    if inside.any():
        known = np.column_stack([np.zeros((int(inside.sum()), 8)), sizes[inside]])
        e[inside] = sensor.expect(v[inside], known)[0]
    return inside, e
