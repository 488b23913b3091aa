"""The events of a robot: `Control`, `Scan`, `Frame` and `Fix`, the only input of the filter.

Logs, the simulator and a live robot all give these four.  Time is int64 nanoseconds inside, seconds at the edge.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Set
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import groupby
from numbers import Real
from operator import attrgetter
from typing import Any
from unicodedata import category

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import EventError, ImageError, KalmarkError

__all__ = ["Control", "Event", "Fix", "Frame", "Raw", "Scan", "sort_events", "sort_key"]

Id = int | str

FLOAT = np.dtype(np.float64)
LATEST_NS = 2**63  # times are int64: about 292 years either side of 0
LONGEST = 80  # characters of a value in a message
LONGEST_ID = 200  # characters or digits of a landmark's id
ROUNDED = 1e-3  # a quaternion is of length 1, and a matrix a rotation, up to this: files have few digits
_SHORT = 2**63  # ids that need no second look

MOST = {"m": 1e9, "mps": 1e6, "rad": 1e6, "radps": 1e6, "px": 1e9, "ns": LATEST_NS}
"""The largest magnitudes that mean anything, by unit: m, m/s, rad, rad/s, pixels and times.

A larger number leaves no digits for the rest of a map: a double that holds 1e9 m resolves 1e-7 m.
"""
MOST_OTHER = 1e12  # of what has no unit, or another one: signatures, logarithms, a user's own
SYMBOLS = {"mps": "m/s", "radps": "rad/s"}


def largest_magnitude(column: str) -> tuple[float, str]:
    """Return the largest magnitude of a column, or of a parameter, by the unit that its name ends in; and that unit."""
    unit = column.rpartition("_")[2]
    return (MOST[unit], SYMBOLS.get(unit, unit)) if unit in MOST else (MOST_OTHER, "")


def bound(column: str) -> str:
    """Return in words what is expected of a number that is too large."""
    limit, unit = largest_magnitude(column)
    return f"at most {limit:.0e} {unit}".strip()


def refuse_huge(value: Array, columns: tuple[str, ...], where: str) -> None:
    """Refuse numbers (..., m) in these columns that are larger than mean anything.  Raises EventError."""
    for column, numbers in zip(columns, value.reshape(-1, len(columns)).T, strict=True):
        worst = float(np.abs(numbers).max(initial=0.0))
        if worst > largest_magnitude(column)[0]:
            raise EventError(f"{where}: {column} is {worst:.3g}, expected {bound(column)}")


def fixed_seconds(t_ns: int) -> str:
    """Return integer nanoseconds as text in seconds, exactly, with nine decimals."""
    return f"{Decimal(int(t_ns)).scaleb(-9):.9f}"


def seconds_text(t_ns: int) -> str:
    """Return integer nanoseconds as text in seconds, exactly, without trailing zeros."""
    return f"{Decimal(int(t_ns)).scaleb(-9).normalize():f}"


def list_names(names: Iterable[object], most: int = 3) -> str:
    """Return names as a line shows them: the first ones, and how many more there are."""
    texts = [short_text(name) for name in names]
    more = [f"{len(texts) - most} more"] if len(texts) > most else []
    return ", ".join([*texts[:most], *more]) or "none"


def short_text(value: object) -> str:
    """Return a value as a message shows it: on one line, and cut where it is long."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # a value that cannot even be shown is refused all the same
        text = f"a {type(value).__name__}"
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


def is_number(value: Any) -> bool:
    """Return whether a value is a number, and no truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def time_in_ns(t_s: Any, t_ns: Any, kind: str, robot: Any) -> int:
    """Return the time of an event in integer nanoseconds, from exactly one of seconds and nanoseconds."""
    if t_ns is None and isinstance(t_s, float) and -9e9 < t_s < 9e9:
        return round(t_s * 1e9)
    if t_s is None and type(t_ns) is int and -LATEST_NS < t_ns < LATEST_NS:
        return t_ns
    try:
        return _nanoseconds(t_s, t_ns)
    except EventError as error:
        raise EventError(f"{kind} of {short_text(robot)}: {error}") from None


def _nanoseconds(t_s: Any, t_ns: Any) -> int:
    if (t_s is None) == (t_ns is None):
        raise EventError(f"expected exactly one of t_s and t_ns, got t_s={short_text(t_s)} and t_ns={short_text(t_ns)}")
    name, value, expected = "t_s", t_s, "a finite number of seconds"
    try:
        if t_s is None:
            name, value, expected = "t_ns", t_ns, "a whole number of nanoseconds"
            whole: Any = None if isinstance(t_ns, bool) else t_ns
            time = operator.index(whole)
        else:
            wrong = isinstance(t_s, bool | np.timedelta64) or not isinstance(t_s, Real)
            time = round(float("nan" if wrong else t_s) * 1e9)
    except (TypeError, ValueError, OverflowError):
        raise EventError(f"{name} is {short_text(value)}, expected {expected}") from None
    if abs(time) >= LATEST_NS:
        raise EventError(f"{name} is {short_text(value)}, expected a time within 292 years of 0, 2**63 ns")
    return time


def finite(value: Any, what: str, limit: float = MOST["m"], error: type[KalmarkError] = EventError) -> Array:
    """Return a copy of `value` as a float array (..., n); raise `error` if it is not finite or larger than `limit`."""
    return finite_and_largest(value, what, limit, error)[0]


def unit_quaternion(q: Array, error: type[Exception] = EventError, of: str = "") -> Array:
    """Return a quaternion (4,) normalised; raise `error` if its length is not 1 up to `ROUNDED`, as of few digits.

    `of` is the beginning of the message.  One whose length is 1 up to the last digits of a double is returned as it is.
    """
    norm = float(np.linalg.norm(q))
    if not abs(norm - 1) <= ROUNDED:
        raise error(f"{of}quaternion has length {norm:.6g}, expected 1 up to {ROUNDED:g}")
    return q if abs(norm - 1) < 1e-12 else np.asarray(q / norm)


def finite_and_largest(
    value: Any, what: str, limit: float = MOST["m"], error: type[KalmarkError] = EventError
) -> tuple[Array, float]:
    """Return what `finite` does, and the largest magnitude in it."""
    try:
        array = np.array(value, order="C")
    except (TypeError, ValueError):
        raise error(f"{what} is {short_text(value)}, expected numbers") from None
    if array.dtype is not FLOAT:
        if array.dtype.kind not in "iuf":
            raise error(f"{what} is {short_text(value)}, expected numbers")
        with np.errstate(over="ignore"):
            array = array.astype(FLOAT)
    flat = array.ravel()
    values = flat.tolist()
    if not math.isfinite(sum(values)) and not np.isfinite(flat).all():
        raise error(f"{what} holds {flat[~np.isfinite(flat)][0]}, expected finite numbers")
    worst = max(map(abs, values), default=0.0)
    if worst > limit:
        raise error(f"{what} holds {worst:.3g}, expected at most {limit:.0e}")
    return array, worst


def is_writable(text: str) -> bool:
    """Return whether files and terminals can have a text as it is: no control characters, no lone surrogates."""
    return text.isprintable() or not any(category(c) in ("Cc", "Cs") for c in text)


def checked_id(value: Any, what: str) -> Id:
    """Return a landmark's id as int or str, refusing all but whole numbers and texts that are not empty."""
    if isinstance(value, np.generic) and value.dtype.kind in "iufU":
        value = value.item()
    if isinstance(value, str) and value:
        if len(value) > LONGEST_ID:
            raise EventError(f"{what} is {short_text(value)}, expected at most {LONGEST_ID} characters")
        if not is_writable(value):
            raise EventError(
                f"{what} is {short_text(value)}, expected a text without control characters and surrogates"
            )
        return str(value)
    if isinstance(value, int) and not isinstance(value, bool):
        if abs(value) >= 10**LONGEST_ID:
            raise EventError(f"{what} is {short_text(value)}, expected at most {LONGEST_ID} digits")
        return int(value)
    if isinstance(value, float) and value.is_integer():
        return int(value)
    raise EventError(f"{what} is {short_text(value)}, expected a whole number or a text that is not empty")


def checked_ids(ids: Any, count: int) -> tuple[Id | None, ...]:
    """Return the landmark ids of one scan (None: unknown), refusing a wrong number of them and duplicates."""
    if isinstance(ids, np.ndarray) and ids.dtype.kind in "iufU":
        ids = ids.tolist()
    try:
        ids = tuple(None if isinstance(ids, str | bytes | Mapping | Set) else ids)  # type: ignore[arg-type]
    except TypeError:
        raise EventError(f"ids is {short_text(ids)}, expected a list with one id for each observation") from None
    if len(ids) != count:
        raise EventError(f"{len(ids)} ids for {count} observations, expected one id each")
    ids = tuple([i if i is None or (type(i) is int and -_SHORT < i < _SHORT) else checked_id(i, "an id") for i in ids])
    known = [i for i in ids if i is not None]
    if len(set(known)) != len(known):
        twice = next(i for i in known if known.count(i) > 1)
        raise EventError(f"id {twice!r} appears twice, expected each landmark once in a scan")
    return ids


def checked_classes(classes: Any, count: int) -> tuple[str | None, ...]:
    """Return the classes of the observations of one scan (None: not reported), refusing all but as many texts."""
    given = list(classes) if isinstance(classes, list | tuple | np.ndarray) else []
    if len(given) != count:
        wanted = f"a list with one text or None for each of {count} observations"
        raise EventError(f"classes is {short_text(classes)}, expected {wanted}")
    return tuple([None if each is None else str(checked_id(_text(each, "a class"), "a class")) for each in given])


def checked_blocks(of: Any, count: int) -> tuple[tuple[Id, ...], ...]:
    """Return the names of the blocks of each observation of a scan, refusing all but lists of different ones."""
    given = list(of) if isinstance(of, list | tuple) else []
    rows = [tuple(checked_id(name, "a name") for name in row) for row in given if isinstance(row, list | tuple)]
    if len(given) != count or len(rows) != count or not all(row and len({*row}) == len(row) for row in rows):
        wanted = f"a list of the names of different robots and landmarks for each of {count} observations"
        raise EventError(f"of is {short_text(of)}, expected {wanted}")
    return tuple(rows)


def _text(value: Any, what: str) -> str:
    if not isinstance(value, str):
        raise EventError(f"{what} is {short_text(value)}, expected a text")
    return value


def _rows(y: Array) -> Array:
    """Return the measurements of one scan, (K, m); () and [] are a scan that saw nothing."""
    if y.shape == (0,):
        return y.reshape(0, 0)
    if y.ndim != 2 or (len(y) and not y.size):
        raise EventError(f"y has shape {y.shape}, expected (K, m): one row an observation")
    return y


class _Timed:
    """An event at a time, of which `t_ns` are the nanoseconds."""

    __slots__ = ()
    t_ns: int

    @property
    def t_s(self) -> float:
        """The time in seconds."""
        return self.t_ns * 1e-9


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Control(_Timed):
    """A robot's control: a velocity held from `t_s` on, or an increment that ended at `t_s`.

    `u` has the motion model's shape and units; `cov` (same size, squared) overrides the model's own noise.
    `share` is less than 1 for a part of an increment, whose noise is that share of the whole one's, `cov` or the
    model's, and the variances `uneven` (k,) besides.  `largest` is the largest magnitude in `u`, `largest_cov` that
    in `cov`.

    >>> km.Control(t_s=0.5, robot="rover", u=(0.5, 0.02)).t_ns
    500000000
    """

    t_ns: int
    robot: str
    u: Array
    cov: Array | None
    share: float
    uneven: Array | None
    largest: float = field(init=False, repr=False)
    largest_cov: float = field(init=False, repr=False)

    def __init__(
        self,
        t_s: float | None = None,
        robot: str = "",
        u: Any = (),
        cov: Any = None,
        *,
        t_ns: int | None = None,
        share: float = 1.0,
        uneven: Any = None,
    ) -> None:
        set_ = object.__setattr__
        t_ns = time_in_ns(t_s, t_ns, "control", robot)
        try:
            if not is_number(share) or not 0.0 < share <= 1.0:
                raise EventError(f"share is {short_text(share)}, expected a number above 0 and at most 1")
            set_(self, "share", share)
            set_(self, "uneven", None if uneven is None else finite(uneven, "uneven", MOST_OTHER**2))
            set_(self, "t_ns", t_ns)
            set_(self, "robot", _text(robot, "robot"))
            u, largest = finite_and_largest(u, "u", MOST_OTHER)
            set_(self, "u", u)
            set_(self, "largest", largest)
            cov, largest_cov = (None, 0.0) if cov is None else finite_and_largest(cov, "cov", MOST_OTHER**2)
            set_(self, "cov", cov)
            set_(self, "largest_cov", largest_cov)
        except EventError as error:
            raise EventError(f"control of {short_text(robot)} at t={seconds_text(t_ns)} s: {error}") from None


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Scan(_Timed):
    """A scan of one sensor of one robot at one instant: K observations `y` of shape (K, m).

    `ids` names the landmarks (None, for one or all of them: unknown).  `cov` of shape (m, m) for all or (K, m, m)
    overrides the noise of the sensor model.  `classes` are what the sensor reports of each (None: nothing),
    which count where its mount has `km.Classes`.  `of` names, for each observation of a sensor of blocks, the robots
    and landmarks that it is of.  A scan that saw nothing, y = () or (0, m), has `y` of shape (0, 0);
    `width` is the m it was given, 0 for (), `largest` the largest magnitude in `y`, `largest_cov` in `cov`.

    >>> km.Scan(t_s=0.5, robot="rover", sensor="lidar", y=[[4.2, 0.3], [2.0, -0.1]], ids=[7, None]).ids
    (7, None)
    """

    t_ns: int
    robot: str
    sensor: str
    y: Array
    ids: tuple[Id | None, ...] | None
    cov: Array | None
    classes: tuple[str | None, ...] | None
    of: tuple[tuple[Id, ...], ...] | None
    width: int = field(init=False, repr=False)
    largest: float = field(init=False, repr=False)
    largest_cov: float = field(init=False, repr=False)

    def __init__(
        self,
        t_s: float | None = None,
        robot: str = "",
        sensor: str = "",
        y: Any = (),
        ids: Any = None,
        cov: Any = None,
        *,
        t_ns: int | None = None,
        classes: Any = None,
        of: Any = None,
    ) -> None:
        set_ = object.__setattr__
        t_ns = time_in_ns(t_s, t_ns, "scan", robot)
        try:
            y, largest = finite_and_largest(y, "y", MOST_OTHER)
            y = _rows(y)
            set_(self, "largest", largest)
            set_(self, "t_ns", t_ns)
            set_(self, "robot", _text(robot, "robot"))
            set_(self, "sensor", _text(sensor, "sensor"))
            set_(self, "width", y.shape[1])
            set_(self, "y", y if len(y) else y.reshape(0, 0))
            set_(self, "ids", None if ids is None else checked_ids(ids, len(y)))
            set_(self, "classes", None if classes is None else checked_classes(classes, len(y)))
            set_(self, "of", None if of is None else checked_blocks(of, len(y)))
            cov, largest_cov = (None, 0.0) if cov is None else finite_and_largest(cov, "cov", MOST_OTHER**2)
            set_(self, "cov", cov)
            set_(self, "largest_cov", largest_cov)
        except EventError as error:
            what = f"scan of {short_text(robot)} by {short_text(sensor)} at t={seconds_text(t_ns)} s"
            raise EventError(f"{what}: {error}") from None


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Fix(_Timed):
    """An absolute position of a robot, `y` = (x, y[, z]) in metres in the map's frame, with covariance `cov`.

    >>> km.Fix(t_s=0.5, robot="rover", y=(1.0, 2.0), cov=np.diag([0.04, 0.04])).y
    array([1., 2.])
    """

    t_ns: int
    robot: str
    y: Array
    cov: Array

    def __init__(
        self, t_s: float | None = None, robot: str = "", y: Any = (), cov: Any = None, *, t_ns: int | None = None
    ) -> None:
        set_ = object.__setattr__
        t_ns = time_in_ns(t_s, t_ns, "fix", robot)
        try:
            if cov is None:
                raise EventError("cov is missing, expected a covariance in m^2")
            set_(self, "t_ns", t_ns)
            set_(self, "robot", _text(robot, "robot"))
            set_(self, "y", finite(y, "y", MOST["m"]))
            set_(self, "cov", finite(cov, "cov", MOST["m"] ** 2))
        except EventError as error:
            raise EventError(f"fix of {short_text(robot)} at t={seconds_text(t_ns)} s: {error}") from None


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Raw(_Timed):
    """Raw data of one sensor of one robot at one instant, of which the detector of that sensor makes a scan.

    A frozen dataclass of its own for each kind of data: `Frame`, or one of a plug-in's.

    >>> frame = km.Frame(t_s=0.5, robot="rover", sensor="camera", image=np.zeros((480, 640), np.uint8))
    >>> isinstance(frame, Raw), frame.t_ns
    (True, 500000000)
    """

    t_ns: int
    robot: str
    sensor: str


@dataclass(frozen=True, slots=True, init=False, eq=False)
class Frame(Raw):
    """A frame of one camera of one robot at one instant: an image, and the depth of its pixels where that is measured.

    `image` (H, W) or (H, W, 3) of bytes, blue, green and red, `right`,
    that of the right camera of a rectified pair, of which `image` is the left one, and `depth` (H, W) in m, 0 where
    there is none, are arrays, or functions that read them each time they are needed: a log of many frames holds no
    pixel.

    >>> km.Frame(t_s=0.5, robot="rover", sensor="camera", image=np.zeros((480, 640), np.uint8)).image.shape
    (480, 640)
    """

    image: Array | Callable[[], Array]
    depth: Array | Callable[[], Array] | None
    right: Array | Callable[[], Array] | None

    def __init__(
        self,
        t_s: float | None = None,
        robot: str = "",
        sensor: str = "",
        image: Any = (),
        depth: Any = None,
        right: Any = None,
        *,
        t_ns: int | None = None,
    ) -> None:
        set_ = object.__setattr__
        t_ns = time_in_ns(t_s, t_ns, "frame", robot)
        try:
            set_(self, "t_ns", t_ns)
            set_(self, "robot", _text(robot, "robot"))
            set_(self, "sensor", _text(sensor, "sensor"))
            set_(self, "image", image if callable(image) else _pixels(image))
            set_(self, "depth", depth if depth is None or callable(depth) else _depths(depth))
            set_(self, "right", right if right is None or callable(right) else _pixels(right))
        except EventError as error:
            what = f"frame of {short_text(robot)} by {short_text(sensor)} at t={seconds_text(t_ns)} s"
            raise EventError(f"{what}: {error}") from None

    def pixels(self) -> Any:
        """Return the image (H, W) or (H, W, 3) as bytes.  Raises ImageError."""
        return self._read(self.image, _pixels)

    def grey(self) -> Any:
        """Return the image (H, W) as bytes, .114 blue + .587 green + .299 red (ITU-R BT.601).  Raises ImageError."""
        return _grey(self.pixels())

    def right_grey(self) -> Any:
        """Return the image of the right camera (H, W) likewise, None if there is none.  Raises ImageError."""
        return None if self.right is None else _grey(self._read(self.right, _pixels))

    def depths(self) -> Array | None:
        """Return the depth (H, W) of the pixels in m, 0 where there is none; None if none was measured.

        Raises ImageError.
        """
        return None if self.depth is None else self._read(self.depth, _depths)

    def _read(self, source: Any, checked: Callable[[Any], Any]) -> Any:
        try:
            return checked(source()) if callable(source) else source
        except (EventError, OSError) as error:
            raise ImageError(f"{label_of_event(self)}: {error}") from None


def _pixels(image: Any) -> Any:
    pixels = np.asarray(image)
    if pixels.dtype != np.uint8 or not pixels.size or not (pixels.ndim == 2 or pixels.shape[2:] == (3,)):
        raise EventError(f"the image is {pixels.dtype} {pixels.shape}, expected bytes (H, W) or (H, W, 3)")
    return np.ascontiguousarray(pixels)


def _grey(pixels: Any) -> Any:
    if pixels.ndim == 2:
        return pixels
    blue, green, red = (pixels[:, :, k].astype(np.uint32) for k in range(3))
    return ((1868 * blue + 9617 * green + 4899 * red + 8192) >> 14).astype(np.uint8)


def _depths(depth: Any) -> Array:
    metres = np.asarray(depth)
    if metres.dtype.kind not in "uif" or not metres.size or metres.ndim != 2:
        raise EventError(f"the depth is {metres.dtype} {metres.shape}, expected numbers (H, W) in m")
    return metres.astype(np.float64)


Event = Control | Scan | Raw | Fix
"""An argument of `Slam.process`."""

_RANK: dict[type, int] = {Control: 0, Fix: 2}  # 1: of a scan, or of raw data


def label_of_event(event: Event) -> str:
    """Return what kind of event it is and its time, for an error's line."""
    return f"{type(event).__name__.lower()} at t={seconds_text(event.t_ns)} s"


def kind_of(event: Event) -> tuple[str, str, str]:
    """Return the kind of an event, its robot and its sensor ("" of what has none)."""
    return type(event).__name__, event.robot, event.sensor if isinstance(event, Scan | Raw) else ""


def sort_key(event: Event) -> tuple[int, int, str, str]:
    """Sort key of events: time, then Control, Scan or raw data, Fix, then robot, then sensor.

    A stable sort keeps arrival.

    >>> sort_key(km.Control(0.1, "rover", (0.5, 0.1)))
    (100000000, 0, 'rover', '')
    >>> sort_key(km.Scan(0.1, "rover", "lidar", [[4.0, 0.3]]))
    (100000000, 1, 'rover', 'lidar')
    """
    return event.t_ns, _RANK.get(type(event), 1), *kind_of(event)[1:]


def sort_events(events: list[Event]) -> list[Event]:
    """Return events by `sort_key`: of a long log in the memory of a list, where keys take some 200 bytes an event.

    >>> scan, control = km.Scan(0.1, "rover", "lidar", [[4.0, 0.3]]), km.Control(0.1, "rover", (0.5, 0.1))
    >>> [type(event).__name__ for event in sort_events([scan, control])]
    ['Control', 'Scan']
    """
    t_ns = np.fromiter((event.t_ns for event in events), np.int64, len(events))
    by_time = (events[k] for k in np.argsort(t_ns, kind="stable"))
    out: list[Event] = []
    for _, same in groupby(by_time, key=attrgetter("t_ns")):
        first, *others = same
        out += sorted((first, *others), key=sort_key) if others else (first,)
    return out
