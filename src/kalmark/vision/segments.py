"""Line segments of an image, matched to the lines that the filter expects in it.  [S] 2.4, [TB] 4.3 and Fig. 9.

Segments are detected in the whole image (LSD, Grompone von Gioi and others 2010), each with the dark side on its left.
One can be of a line if it lies along the expected segment within the uncertainty of that, the same way round; of those
the one whose profile of grey values across is alike counts.  The ends of a segment have no information: an edge may be
hidden, or break, anywhere.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from kalmark.arrays import Array, Flags, Index
from kalmark.declare import Count, Positive, Within, register
from kalmark.events import Frame, Id, Raw, Scan
from kalmark.geometry.gaussian import gate
from kalmark.models.sensors import Segments
from kalmark.report import Expectations, Report
from kalmark.slam.sources import FilterView, Found
from kalmark.tracks.expecting import expectations
from kalmark.vision import opencv as cv2
from kalmark.vision.searches import TRIAL, Searches, make_room

GATE = gate(0.99, 2)
TURNED = np.sin(np.radians(20.0))  # a segment may be turned against what is expected, at most
OVERLAP = 0.3  # of the shorter one of the two
REACH_PX, ALONG = 6, 16  # of a profile to either side, and places along the segment of which it is the mean
APART_PX = 8.0  # a new line from those expected
WIDE_PX, HALVED, FULL = 600, 0.5, 0.8  # from this width on, segments are detected at half the resolution


@register("detector", "line_search")
class LineSearch:
    """Lines of an image without distortion: segments are detected and matched to the lines that are expected.

    Each frame, `in_view` lines are kept in view, at most `starts` new ones, the longest first, of at least
    `min_length_px`.  A match has a profile of grey values across that correlates by `accept` with that of the line.  A
    line that leaves the view before it has fitted often is given up: little is known of it, perhaps not the side of the
    camera it is on.  Of more than `most` lines those out of view that fitted least make room.

    >>> camera = km.Mount(km.sensors.Segments(), detector=km.vision.LineSearch(in_view=10))
    >>> camera.detector.columns
    ('u1_px', 'v1_px', 'u2_px', 'v2_px')
    """

    columns: ClassVar[tuple[str, ...]] = Segments.columns

    in_view: Annotated[Count, "Least number of lines in view."] = 20
    starts: Annotated[int, Within(ge=0), "At most so many new ones in a frame."] = 5
    min_length_px: Annotated[Positive, "Shortest segment that begins a line."] = 40.0
    most: Annotated[Count, "At most so many lines in the map: the least useful out of view make room."] = 100
    accept: Annotated[float, Within(gt=0, lt=1), "Correlation of the profiles of a match, at least."] = 0.8

    def source(self, sensor: Any) -> LineFrontEnd:
        """Return the source of the scans of one sensor."""
        return LineFrontEnd(self, sensor)


@dataclass
class LineLook(Searches):
    """Counts of searches, matches and fits of a line, and its `profile` (2 REACH_PX + 1,) when it last fitted."""

    profile: Array | None = None


class Matches(NamedTuple):
    """The segments (M, 4) of an image with their profiles (M, .), and of each line expected the segment's number.

    -1 where it was not found.
    """

    segments: Array
    profiles: Array
    of: Index


class LineFrontEnd:
    """Searches the frames of one sensor for lines; `looks` has how each looked."""

    takes: ClassVar[type[Raw]] = Frame
    waits: ClassVar[bool] = True
    begins: ClassVar[bool] = False
    looks: dict[Id, LineLook]
    frame: int
    named: int

    def __init__(self, settings: LineSearch, sensor: Any) -> None:
        self.settings, self.sensor = settings, sensor
        cv2.setNumThreads(1)
        width = sensor.image[0]
        self.detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, HALVED if width >= WIDE_PX else FULL)
        self.looks, self.frame, self.named = {}, 0, 0
        self.expected: Expectations | None = None
        self.matches: Matches | None = None
        self._numbers: list[int] = []  # of the segments of the last scan
        self.image: Any = None

    def read(self, raw: Frame) -> Any:
        """Return the image (H, W) of a frame.  Raises EventError."""
        return raw.grey()

    def located(self, data: Any, view: FilterView) -> None:
        """Return that lines recognise no place."""

    def found(self, raw: Raw, data: Any, view: FilterView) -> Found:
        """Search an image (H, W) for the lines expected, and for new ones."""
        image, expected = data, expectations(view.map, view.tracks, view.channel, view.robot, "", only_in_view=True)
        self.frame, self.image, self.expected = self.frame + 1, image, expected
        segments = self._detected(image)
        across = profiles(image, segments)
        known = [self.looks.get(name) for name in expected.names]
        mine = np.array([np.zeros(across.shape[1]) if look is None or look.profile is None else look.profile
                         for look in known]).reshape(len(known), across.shape[1])  # fmt: skip
        may, length = compatible_segments(expected.e, expected.Z, segments, self.sensor.sigma_px)
        alike = mine @ across.T
        of = assign_pairs(np.where(may & (alike >= self.settings.accept), alike * length, 0.0))
        self.matches = Matches(segments, across, of)
        removed = []
        for name, look, number in zip(expected.names, known, of.tolist(), strict=True):
            if look is not None and (reason := look.searched_for(number >= 0)):
                removed.append((name, reason))
        removed += [(name, f"out of view, {look.fitted} fits before") for name, look in self.looks.items()
                    if look.fitted < TRIAL and name not in expected.names]  # fmt: skip
        rows = np.flatnonzero(of >= 0)
        new = self._new(expected, len(rows))
        removed += make_room(self.looks, self.settings.most - len(new), expected.names, {name for name, _ in removed})
        ids: list[Id] = [expected.names[k] for k in rows.tolist()]
        for _ in new:
            self.named += 1
            ids.append(f"{raw.robot}.{raw.sensor} {self.named}")
        y = segments[np.concatenate([of[rows], new]).astype(np.int64)]
        scan = Scan(t_ns=raw.t_ns, robot=raw.robot, sensor=raw.sensor, y=y if len(y) else (), ids=ids or None)
        self._numbers = [*of[rows].tolist(), *new]
        return Found(scan, removed)

    def update(self, report: Report, view: FilterView) -> None:
        """Update profiles and counts of lines by the report of a frame."""
        assert self.matches is not None
        for o in report.observations:
            if o.landmark is None or o.outcome not in ("new", "associated"):
                continue
            look = self.looks.setdefault(o.landmark, LineLook())
            look.profile = self.matches.profiles[self._numbers[o.index]]
            if o.outcome == "associated":
                look.fitted, look.missed = look.fitted + 1, 0
            look.seen = self.frame
        for name, _ in report.removed:
            self.looks.pop(name, None)

    def _detected(self, image: Any) -> Array:
        """Return the segments (M, 4) of an image."""
        found = self.detector.detect(np.ascontiguousarray(image))[0]
        segments = np.asarray([] if found is None else found, dtype=np.float64).reshape(-1, 4)
        high = np.array([image.shape[1], image.shape[0]] * 2) - 1.0
        inside = np.clip(segments, 0.0, high)
        length = np.hypot(inside[:, 2] - inside[:, 0], inside[:, 3] - inside[:, 1])
        return inside[length >= self.sensor.min_length_px]

    def _new(self, expected: Expectations, count: int) -> list[int]:
        """Return the numbers of the segments that begin lines: long ones where none is expected."""
        assert self.matches is not None
        segments, of = self.matches.segments, self.matches.of
        wanted = min(self.settings.in_view - count, self.settings.starts)
        length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
        taken, new = np.concatenate([expected.e, segments[of[of >= 0]]]), list[int]()
        for k in np.argsort(-length, kind="stable").tolist() if wanted > 0 else ():
            if length[k] < self.settings.min_length_px or len(new) == wanted:
                break
            if not near_segments(segments[k], taken).any():
                new.append(k)
                taken = np.concatenate([taken, segments[k : k + 1]])
        return new

    # ------------------------------------------------------------------ what a source is asked besides
    def settle(self) -> None:
        """Nothing is kept of the first frames."""

    def survey(self, name: Id) -> None:
        """Search for a line known beforehand: its profile is not known, so that it is not found."""

    def replace_poses(self, poses: list[Array], names: Set[Id]) -> None:
        """Take over that only `names` are left."""
        self.looks = {name: look for name, look in self.looks.items() if name in names}


def profiles(image: Any, segments: Array) -> Array:
    """Return the grey values across segments (M, 4), means along them, of mean 0 and length 1: (M, 2 REACH_PX + 1)."""
    a, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    s, offset = np.linspace(0.0, 1.0, ALONG + 2)[1:-1], np.arange(-REACH_PX, REACH_PX + 1)
    at = a[:, None, None] + s[:, None, None] * along[:, None, None] + offset[:, None] * normal[:, None, None]
    u, v = np.ascontiguousarray(at.reshape(-1, len(offset), 2).transpose(2, 0, 1), dtype=np.float32)
    grey = np.zeros((0, len(offset)))
    if len(segments):
        grey = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
    mean = grey.reshape(-1, ALONG, len(offset)).mean(axis=1)
    mean -= mean.mean(axis=1, keepdims=True)
    return mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)


def compatible_segments(e: Array, Z: Array, segments: Array, sigma_px: float) -> tuple[Flags, Array]:
    """Return which segments (M, 4) can be of lines expected at e (K, 4), and the length along these, px: (K, M) both.

    Z (K, 2, 2) is the covariance of the distances of the expected ends from the line that is measured, with the noise
    of a pixel in it.  The distances of other places are between these: d(s) = (1 - s) d_1 + s d_2, s along e.
    """
    a, along = e[:, None, None, :2], e[:, 2:] - e[:, :2]
    length = np.maximum(np.hypot(*along.T), 1e-9)
    t = (along / length[:, None])[:, None, None]
    p = segments.reshape(1, -1, 2, 2) - a  # (K, M, 2, 2) from the first end
    s, d = (p * t).sum(axis=3) / length[:, None, None], t[..., 0] * p[..., 1] - t[..., 1] * p[..., 0]
    A = np.stack([1.0 - s, s], axis=3)
    noise = sigma_px**2 * np.eye(2)
    Z_s = A @ (Z - noise)[:, None] @ A.swapaxes(2, 3) + noise
    det = Z_s[..., 0, 0] * Z_s[..., 1, 1] - Z_s[..., 0, 1] ** 2
    squares = Z_s[..., 1, 1] * d[..., 0] ** 2 - 2.0 * Z_s[..., 0, 1] * d[..., 0] * d[..., 1]
    squares += Z_s[..., 0, 0] * d[..., 1] ** 2
    long = s[..., 1] - s[..., 0]  # the same way round: positive
    turned = np.abs(d[..., 1] - d[..., 0]) <= TURNED * np.hypot(d[..., 1] - d[..., 0], long * length[:, None])
    common = np.minimum(s[..., 1], 1.0) - np.maximum(s[..., 0], 0.0)
    may = (long > 0) & turned & (common >= OVERLAP * np.minimum(long, 1.0)) & (squares <= GATE * det)
    return may, np.maximum(common, 0.0) * length[:, None]


def near_segments(segment: Array, others: Array) -> Flags:
    """Return which of other segments (K, 4) a segment (4,) lies near: within APART_PX of their lines, along them."""
    along = others[:, 2:] - others[:, :2]
    length = np.maximum(np.hypot(*along.T), 1e-9)
    p = segment.reshape(2, 2)[None] - others[:, None, :2]
    s = (p * along[:, None]).sum(axis=2) / length[:, None] ** 2
    d = np.abs(along[:, None, 0] * p[..., 1] - along[:, None, 1] * p[..., 0]) / length[:, None]
    near: Flags = (d.max(axis=1) < APART_PX) & (s.max(axis=1) > 0.0) & (s.min(axis=1) < 1.0)
    return near


def assign_pairs(worth: Array) -> Index:
    """Return of each row of what pairs are worth (K, M) its column, -1: none; the best first, each once, above 0."""
    of, worth = np.full(len(worth), -1), worth.copy()
    while worth.size and worth.max() > 0.0:
        k, m = divmod(int(worth.argmax()), worth.shape[1])
        of[k] = m
        worth[k], worth[:, m] = 0.0, 0.0
    return of
