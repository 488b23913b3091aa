"""`open_log`: recognise the format of a log, read it, and select robots and time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from kalmark.declare import Values, Within, declared_options, documented
from kalmark.errors import LogError, PluginError, one_line
from kalmark.events import Event, Fix, Scan, short_text, sort_key
from kalmark.logs.increments import cut_increments
from kalmark.logs.log import Log, Names
from kalmark.logs.log_corrections import correct_log
from kalmark.logs.native import NATIVE, stream
from kalmark.logs.overflow import refuse_overflow
from kalmark.logs.places import find_data
from kalmark.logs.poses import KITTI, TUM, read_path
from kalmark.logs.source import Format, Request, one_of, raise_refusal, refuse_options
from kalmark.logs.table_columns import INCREMENT2, INCREMENT3
from kalmark.plugins import load_all

OnError = Literal["raise", "skip"]
RobotNames = Sequence[str | int] | str | int | None
Files = Path | str | Mapping[str, Path | str] | None
Since = Annotated[float | None, Within(ge=0)]
Sigma = Annotated[float | None, Within(ge=1e-9)]
FORMATS: dict[str, Format] = {entry.name: entry for entry in (NATIVE, TUM, KITTI)}
"""The formats of the core, and those that a program of the user's adds; `known_formats` has those of plug-ins, too."""


def known_formats() -> dict[str, Format]:
    """Return all formats of logs, in the order in which they are tried: general ones last.

    >>> from kalmark.logs import known_formats
    >>> "native" in known_formats()
    True
    """
    known = FORMATS | _of_plugins()[0]
    return dict(sorted(known.items(), key=lambda item: item[1].general))


@cache
def _of_plugins() -> tuple[dict[str, Format], dict[str, PluginError]]:
    return load_all("formats")


@documented
def open_log(
    path: Annotated[Path | str, "Folder or file: beside the configuration (`.` there), in KALMARK_DATA or downloaded."],
    format: Annotated[str | None, "Format of the log; recognised if absent."] = None,
    *,
    robots: Annotated[RobotNames, "Use only these robots, by name or number."] = None,
    from_s: Annotated[Since, "Start here, counted from the first event of the log."] = None,
    to_s: Annotated[Since, "End here, counted from the first event of the log."] = None,
    on_error: Annotated[OnError, "Action on bad input: refuse, or leave out."] = "raise",
    ids: Annotated[
        Literal["given", "hidden"],
        "`hidden`: the filter gets no ids of landmarks; the summary has its rate of wrong associations.",
    ] = "given",
    truth: Annotated[
        Files,
        "A file of true poses in the format of TUM or KITTI, to score against; by robot if there are several.",
    ] = None,
    fixes: Annotated[Files, "The same, of positions that the filter is given, as fixes."] = None,
    sigma_fixes_m: Annotated[Sigma, "Noise of each coordinate of `fixes`."] = None,
    sigma_fixes_z_m: Annotated[Sigma, "Noise of their heights; `sigma_fixes_m` if absent."] = None,
    factors: Annotated[
        Mapping[str, Any] | None,
        Values(),
        "Factors of columns, also of one robot or sensor: `{w_radps: -1, laser: {range_m: .001}}`; "
        "`t_s`: of all times.",
    ] = None,
    shift_s: Annotated[
        Mapping[str, Any] | None,
        Values(),
        "Added to the times of the scans of a sensor, by its name; of one robot: `{rover: {laser: .1}}`.",
    ] = None,
    increments: Annotated[
        Literal["recorded", "cut"],
        "`cut`: a scan between the ends of two increments cuts the second, and finds its robot where it was then.",
    ] = "recorded",
    progress: bool = False,
    **options: Any,
) -> Log:
    """Read the log at `path`, a folder or file of any known format.

    Bad rows that are left out are listed in `log.skipped`, ids that are hidden in `log.true_ids`.  In a configuration
    `increments` is "cut".  With `progress` tables that take longer than two seconds show a bar on standard error.
    `options` are the format's own (docs/datasets.md).  A relative path is looked for by `find_data`.
    Raises LogError, with ``file:line:`` for a bad row.

    >>> from kalmark.logs import write_native
    >>> from kalmark.simulate import load_world, simulate
    >>> folder = write_native(simulate(load_world("cloister", ["steps=50"])), "my_log")
    >>> km.open_log("my_log", to_s=2.0)
    <Log 'my_log' of 'robot': 42 events in 2.0 s, with truth>
    """
    chosen: dict[str, Any] = {
        "from_s": from_s, "to_s": to_s, "on_error": on_error, "ids": ids, "factors": factors, "shift_s": shift_s,
        "truth": truth, "fixes": fixes, "sigma_fixes_m": sigma_fixes_m, "sigma_fixes_z_m": sigma_fixes_z_m,
        "increments": increments,
    }  # fmt: skip
    entry, found = recognise(find_data(path), format)
    refuse_options(OPTIONS, chosen)
    refuse_options(entry.options, options, entry.name)
    request = request_of(robot_names(robots, entry.robot_prefix), on_error, progress)
    log = correct_log(entry.read(found, request, **options), factors, shift_s)
    refuse_overflow(log)
    log = with_poses(log, request, truth, fixes, sigma_fixes_m, sigma_fixes_z_m)
    log = select_events(log, request, from_s, to_s, ids)
    chosen |= {name: _names(log, name, chosen[name]) for name in ("truth", "fixes")} | options
    log = replace(log, options={name: value for name, value in chosen.items() if value is not None})
    return cut_increments(log) if increments == "cut" else log


OPTIONS = {option.name: option for option in declared_options(open_log)}
"""The options of logs of any format."""


def stream_log(
    path: Path | str, *, robots: RobotNames = None,
    on_error: OnError = "raise", progress: bool = False,
) -> Iterator[Event]:  # fmt: skip
    """Yield the events of a native log one by one, in the order of `open_log`, in memory that does not grow with it.

    The rows of each file must be in the order of time; the arguments are those of `open_log`.  Raises LogError, for a
    bad row when it is reached.

    >>> from kalmark.logs import stream_log, write_native
    >>> controls = {"t_s": [0.0, 0.1], "robot": ["rover"] * 2, "v_mps": [0.5, 0.5], "w_radps": [0.0, 0.1]}
    >>> folder = write_native(km.log_from(controls=controls), "my_log")
    >>> [event.t_s for event in stream_log("my_log")]
    [0.0, 0.1]
    """
    _, found = recognise(find_data(path), NATIVE.name)
    request = request_of(robot_names(robots), on_error, progress)
    return (event for event in stream(found, request) if request.includes(event.robot))


def request_of(robots: Names | None, on_error: str, progress: bool = False) -> Request:
    """Return the request of the caller.  Raises LogError."""
    refuse_options(OPTIONS, {"on_error": on_error})
    skipped: list[str] = []
    refuse = raise_refusal if on_error == "raise" else lambda line: skipped.append(one_line(line))
    return Request(robots, refuse, skipped, progress)


def select_events(log: Log, request: Request, from_s: float | None, to_s: float | None, ids: str) -> Log:
    """Return the robots, the time and the ids of a log that were asked for.  Raises LogError."""
    refuse_options(OPTIONS, {"from_s": from_s, "to_s": to_s, "ids": ids})
    log = clip_time(keep_robots(log, request), from_s, to_s)
    return hide_ids(log) if ids == "hidden" else log


def with_poses(
    log: Log, request: Request, truth: Any, fixes: Any, sigma_m: float | None, sigma_z_m: float | None
) -> Log:
    """Return the log with true poses and fixes of other files.  Raises LogError."""
    true, places = (
        {robot: read_path(path, request) for robot, path in _by_robot(log, name, given).items()}
        for name, given in (("truth", truth), ("fixes", fixes))
    )
    if (sigma_m is None) != (fixes is None) or (sigma_m is None and sigma_z_m is not None):
        raise LogError(
            f"log option fixes is {short_text(fixes)} and sigma_fixes_m is {short_text(sigma_m)}, expected both: a "
            "file of positions and their noise"
        )
    sigmas = [sigma for sigma in (sigma_m, sigma_z_m) if sigma is not None]
    events: list[Fix] = []
    for robot, path in places.items():
        d = 3 if any("z" in column for column in log.control_columns.get(robot, ("z",))) else 2
        cov = np.diag(np.square([sigmas[0], sigmas[0], sigmas[-1]][:d]))
        times = path.t_ns.tolist()
        events += [Fix(t_ns=t, robot=robot, y=y, cov=cov) for t, y in zip(times, path.poses[:, :d], strict=True)]
    found = sorted([*log.events, *events], key=sort_key) if events else log.events
    return replace(log, events=found, truth=log.truth | true) if true or events else log


def _by_robot(log: Log, name: str, given: Any) -> dict[str, Path]:
    """Return the files of an option by robot.  Raises LogError."""
    files = given if isinstance(given, Mapping) else {} if given is None else dict.fromkeys(log.robots, given)
    for robot in files:
        if robot not in log.robots or (len(files) > 1 and not isinstance(given, Mapping)):
            raise LogError(
                f"log option {name} is {short_text(given)}, expected a file, or one for each of the robots "
                f"{', '.join(log.robots)}: {{robot: file}}"
            )
    return {robot: find_data(path) for robot, path in files.items()}


def _names(log: Log, name: str, given: Any) -> dict[str, str] | None:
    """Return the names of the files of an option by robot, None if it is not given."""
    return {robot: str(path.resolve()) for robot, path in _by_robot(log, name, given).items()} or None


def recognise(path: Path, format: str | None) -> tuple[Format, Path]:
    """Return the format of the log at `path` and the path its reader takes.  Raises LogError."""
    known, missing = known_formats(), _of_plugins()[1]
    if format is not None:
        if format in missing:
            raise LogError(f"log format is {format!r}: {missing[format]}")
        if format not in known:
            raise LogError(f"log format is {format!r}, {one_of(known, format)}")
        found = known[format].find(path)
        if found is None:
            raise LogError(f"{path}: not a log of format {format}, expected {known[format].what}")
        return known[format], found
    for entry in known.values():
        found = entry.find(path)
        if found is not None:
            return entry, found
    below = sorted(child.name for child in path.iterdir() if child.is_dir()) if path.is_dir() else []
    inside = [name for name in below if any(entry.find(path / name) for entry in known.values())]
    hint = f"; it holds the logs {', '.join(inside)}" if inside else ""
    kinds = "; ".join(f"{entry.name}: {entry.what}" for entry in known.values())
    without = f"; of {', '.join(missing)} none can be read: {next(iter(missing.values()))}" if missing else ""
    raise LogError(f"{path}: no known log format, expected one of {kinds}{hint}{without}")


def robot_names(robots: Any, prefix: str = "") -> Names | None:
    """Return the names of the robots asked for; a number is put behind the format's prefix."""
    if robots is None:
        return None
    if isinstance(robots, str | int):
        robots = [robots]
    names = (f"{prefix}{robot}" if str(robot).isdecimal() else str(robot) for robot in robots)
    return tuple(dict.fromkeys(names))


def keep_robots(log: Log, request: Request) -> Log:
    """Return the log of the robots asked for; observations of the others are left out and listed."""
    if request.robots is None:
        return log
    for robot in request.robots:
        if robot not in log.robots:
            raise LogError(f"{log.path or log.name}: no robot {robot!r}, {one_of(log.robots, robot)}")
    entry = known_formats().get(log.format)
    others = {*log.robots, *(entry.robots if entry else ())} - {*request.robots}
    left_out: Counter[str] = Counter()
    kept = (remove_observations(event, others, left_out) for event in log if event.robot in request.robots)
    events = [event for event in kept if event is not None]
    for robot, count in sorted(left_out.items()):
        request.leave_out(count, f"{log.path or log.name}: {count} observations of {robot}, which was not asked for")
    names, rig = request.robots, log.describes
    if "robots" in rig:
        rig = rig | {"robots": select_robots(rig["robots"], (*names, "each"))}
    by_robot: dict[str, Any] = {
        field: select_robots(getattr(log, field), names) for field in ("truth", "gps", "control_columns")
    }
    sensors = {key: value for key, value in log.sensor_columns.items() if key[0] in names}
    robots = tuple(robot for robot in log.robots if robot in names)
    return replace(log, robots=robots, events=events, sensor_columns=sensors, describes=rig, **by_robot)


def select_robots(table: dict[str, Any], robots: Sequence[str]) -> dict[str, Any]:
    """Return the entries of these robots in a table by robot."""
    return {name: value for name, value in table.items() if name in robots}


def remove_observations(event: Event, others: set[str], left_out: Counter[str]) -> Event | None:
    """Return the event without the observations of these robots, or None if nothing else was seen."""
    if not isinstance(event, Scan) or event.ids is None or others.isdisjoint(event.ids):
        return event
    left_out.update(id_ for id_ in event.ids if isinstance(id_, str) and id_ in others)
    keep = np.array([id_ not in others for id_ in event.ids])
    if not keep.any():
        return None
    ids = tuple(id_ for id_ in event.ids if id_ not in others)
    cov = event.cov[keep] if event.cov is not None and event.cov.ndim == 3 else event.cov
    classes = None if event.classes is None else tuple(np.array(event.classes)[keep])
    return replace(event, y=event.y[keep], ids=ids, cov=cov, classes=classes)


def clip_time(log: Log, from_s: float | None, to_s: float | None) -> Log:
    """Return the log with the events from `from_s` to `to_s` (both included), s from its first event."""
    if not log.events and log.format in (TUM.name, KITTI.name):
        return log
    if not log.events:
        raise LogError(f"{log.path or log.name}: no event that can be used, expected controls and scans")
    if from_s is None and to_s is None:
        return log
    start = log.events[0].t_ns
    low = start if from_s is None else start + round(from_s * 1e9)
    high = log.events[-1].t_ns if to_s is None else start + round(to_s * 1e9)
    events = [event for event in log if low <= event.t_ns <= high]
    if not events:
        length = (log.events[-1].t_ns - start) * 1e-9
        raise LogError(
            f"{log.path or log.name}: no event from {from_s} to {to_s} s, expected times within 0 to {length:.9g} s"
        )
    return replace(log, events=events)


def hide_ids(log: Log) -> Log:
    """Return the log without the ids of landmarks; `true_ids` has those of every scan.  Robots keep their names."""
    true_ids, events = {}, log.events.copy()
    for n, event in enumerate(events):
        if isinstance(event, Scan) and event.ids is not None:
            if log.sensor_columns.get((event.robot, event.sensor)) in (INCREMENT2, INCREMENT3):
                continue  # times of earlier scans
            ids = tuple(i if i in log.robots else None for i in event.ids)
            events[n] = hidden = replace(event, ids=ids)
            true_ids[hidden] = event.ids
    return replace(log, events=events, true_ids=true_ids)
