"""What a log holds for a replay: the map that its filter ends with, what each scan saw of it, where the robots were.

The log goes through the filter twice: once as it is, for the map and the association; then on that map, known, so that
the path fits the map at every time and does not jump where a loop closes.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from kalmark.config.building import build_slam
from kalmark.config.schema import Config
from kalmark.config.sections import section_of
from kalmark.errors import DivergedError, EventError, KalmarkError
from kalmark.events import Control, Event, Fix, Id, Scan
from kalmark.logs.log import Log
from kalmark.report import Report
from kalmark.results.landmarks import MapLandmarks
from kalmark.results.progress import track
from kalmark.results.warnings import NO_ID
from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]

LEAST = np.diag(np.square([1e-3, 1e-3, 1e-3]))  # m, m, rad: no path is followed nearer than that


class Steer(NamedTuple):
    """A control of the log, where the robot was `dt_s` later, (3,), and how sure that is, (3, 3)."""

    event: Control
    dt_s: float = 0.0
    goal: Array = np.zeros(3)
    cov: Array = LEAST


class Look(NamedTuple):
    """A scan of the log: rows of it, and the landmark of the map or the robot that each of these was of."""

    event: Scan
    rows: tuple[int, ...]
    real: tuple[Id, ...]

    @property
    def cov(self) -> Array | None:
        """The covariances (K, m, m) that came with the log, if any did."""
        cov = self.event.cov
        return cov if cov is None else np.broadcast_to(cov, (len(self.event.y), *cov.shape[-2:]))[list(self.rows)]

    def scan(self, y: Array, ids: Any, keep: Any = slice(None)) -> Scan:
        """Return a scan at the same time with other measurements y (K, m) and ids of the rows `keep`."""
        e, cov = self.event, self.cov
        return Scan(t_ns=e.t_ns, robot=e.robot, sensor=e.sensor, y=y, ids=ids, cov=None if cov is None else cov[keep])


class Recorded(NamedTuple):
    """What there is to replay, in the order of the log, and the landmarks: (2,) m, or (3,) with a signature."""

    events: list[Steer | Look | Fix]
    landmarks: dict[Id, Array]


def recorded(config: Config, log: Log, progress: bool = True) -> Recorded:
    """Return what a log holds for a replay.  Raises KalmarkError where the filter gives up, or nothing was seen."""
    slam = build_slam(config, log)
    bar = track(log.events, f"{log.name}, the map", len(log.events), show=progress)
    reports = [report for event in bar if (report := _processed(slam, event, config)) is not None]
    found = MapLandmarks.of(slam)
    landmarks = {i: p for i, p in zip(found.ids, found.means, strict=True) if np.isfinite(p).all()}
    sizes = {len(p) for p in landmarks.values()}
    if len(sizes) > 1:
        raise KalmarkError(f"{log.name}: got points with and without a signature, expected one kind to replay")
    events = _recognised(reports, landmarks, (*slam.robots,) if sizes == {2} else ())
    if not any(isinstance(event, Look) for event in events):
        nameless = any(o.reason == NO_ID for report in reports for o in report.observations)
        hint = "; without ids try --set association.type=auto" if nameless else ""
        raise KalmarkError(f"{log.name}: no observation is of a landmark of the map, expected some to replay{hint}")
    slam = build_slam(_on_known_map(config), log)
    for name, mean in landmarks.items():
        slam.add_landmark(name, mean)
    again = track(events, f"{log.name}, the path", len(events), show=progress)
    return Recorded(_followed(slam, again, config), landmarks)


def _processed(slam: Slam, event: Event, config: Config) -> Report | None:
    """Process an event; None for a bad one that the configuration leaves out."""
    try:
        return slam.process(event)
    except EventError:
        if config.log.on_error == "raise":
            raise
        return None
    except DivergedError as error:
        raise KalmarkError(f"campaign: {error}, expected a filter that gets through its own log") from None


def _recognised(reports: list[Report], landmarks: dict[Id, Array], robots: tuple[str, ...]) -> list[Event | Look]:
    """Return the events with scans as looks at the landmarks of the final map; each is looked at once in a scan."""
    merged: dict[Id, Id] = {}
    for report in reversed(reports):
        for gone, into, _ in report.merged:
            merged[gone] = merged.get(into, into)
    events: list[Event | Look] = []
    for report in reports:
        if not isinstance(report.event, Scan):
            events.append(report.event)
            continue
        rows: dict[Id, int] = {}
        for o in report.observations:
            name: Any = o.id if o.landmark is None else merged.get(o.landmark, o.landmark)
            if o.outcome != "rejected" and name != report.robot and (name in landmarks or name in robots):
                rows.setdefault(name, o.index)
        if rows:
            events.append(Look(report.event, tuple(rows.values()), tuple(rows)))
    return events


def _on_known_map(config: Config) -> Config:
    """Return the configuration with the association given, and every landmark kept as it is."""
    own = {"association": None, "upkeep": None, "attention": None}
    robots = {
        name: robot.model_copy(
            update={"sensors": {key: sensor.model_copy(update=own) for key, sensor in robot.sensors.items()}}
        )
        for name, robot in config.robots.items()
    }
    trusted = section_of("association", "identity").model_validate({"gate": "off"})
    given = {"association": trusted, "upkeep": section_of("upkeep", "upkeep")()}
    return config.model_copy(update={"robots": robots, **given})


def _followed(slam: Slam, events: Iterable[Event | Look], config: Config) -> list[Steer | Look | Fix]:
    """Return the events, each control with the pose at the end of its interval."""
    followed: list[Steer | Look | Fix] = []
    acting: dict[str, tuple[int, Steer]] = {}  # by robot: which control is in force, or was the last increment
    for event in events:
        raw = event.scan(event.event.y[list(event.rows)], event.real) if isinstance(event, Look) else event
        if _processed(slam, raw, config) is None:
            continue
        if not isinstance(event, Control):
            followed.append(cast("Look | Fix", event))
            continue
        name = event.robot
        at, before = acting.get(name, (0, None))
        end = slam.mean(name), _apart(slam.covariance(name)) + LEAST
        dt_s = 0.0 if before is None else (event.t_ns - before.event.t_ns) * 1e-9
        held = slam.robots[name].motion.held
        if held and before is not None:
            followed[at] = Steer(before.event, dt_s, *end)
        steer = Steer(event) if held else Steer(event, dt_s, *end)
        acting[name] = len(followed), steer
        followed.append(steer)
    return followed


def _apart(P: Array) -> Array:
    """Return a pose's covariance (3, 3) the same in all directions: a robot beside its path may turn towards it."""
    xy = 0.5 * (P[0, 0] + P[1, 1])
    return np.diag([xy, xy, P[2, 2]])
