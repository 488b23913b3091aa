"""Robots and the mounts of their sensors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np

from kalmark.arrays import Array
from kalmark.association.protocol import Association
from kalmark.declare import Role, Within, check_parameters, documented, parameters
from kalmark.errors import ModelError
from kalmark.events import MOST, ROUNDED, Scan, finite, is_writable, short_text, unit_quaternion
from kalmark.geometry.spaces import SE2, SE3, Space, mount_space
from kalmark.management.attention import EVERYTHING, Attention
from kalmark.management.delayed import Delayed
from kalmark.management.hypotheses import Hypotheses
from kalmark.management.trilateration import Trilateration
from kalmark.management.upkeep import Upkeep
from kalmark.models.protocols import (
    Landmark,
    Motion,
    OfState,
    SeesVelocity,
    Sensor,
    parameter_covariance,
    parameter_names,
    refuse_misspelt_names,
    refuse_other_views,
)
from kalmark.slam.checks import check_covariance, instance, refuse_odd_association, require_methods
from kalmark.slam.gaps import Gaps
from kalmark.slam.sources import SearchingDetector, finds
from kalmark.tracks.classes import Classes

INFINITE = math.inf
MOST_LAG_S = 2.0  # what is later has another clock
IDENTITY = {3: (0.0, 0.0, 0.0), 7: (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)}
WANTED = {
    3: "three finite numbers: x and y in m, heading in rad",
    7: "seven finite numbers: x, y, z in m and a unit quaternion qx, qy, qz, qw",
}


def _pose(value: Any, what: str, sizes: tuple[int, ...]) -> Array:
    """Return a pose of one of the sizes 3 (plane) and 7 (space), its quaternion normalised."""
    try:
        pose = finite(value, what, INFINITE, ModelError)
    except ModelError:
        pose = np.empty(0)
    unit = pose.shape == (7,) and abs(np.linalg.norm(pose[3:]) - 1) <= ROUNDED
    if pose.ndim != 1 or len(pose) not in sizes or (len(pose) == 7 and not unit):
        raise ModelError(f"{what} is {short_text(value)}, expected {' or '.join(WANTED[n] for n in sizes)}")
    if unit:
        pose[3:] = unit_quaternion(pose[3:])
    pose = finite(pose, what, error=ModelError)
    pose.flags.writeable = False
    return pose


@documented
@dataclass(frozen=True, eq=False)
class Mount:
    """A sensor and where it sits in the robot's frame: `at` = (x, y, heading), m and rad, or (x, y, z, qx, qy, qz, qw).

    With `cov`, (3, 3) or (6, 6) in the robot's frame, the mount is uncertain: a block of the map, "robot.sensor", that
    calibrates itself.  So are scale and bias of a range, if they have sigmas, and the lag (docs/race_track.md).  A
    `detector` turns raw scans into scans of landmarks.

    >>> km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1), at=(0.3, 0.0, 0.0)).at
    array([0.3, 0. , 0. ])
    """

    sensor: Sensor
    at: Any = (0.0, 0.0, 0.0)
    landmark: Annotated[
        Landmark | None,
        Role("landmark"),
        "Landmark type of this sensor; `landmarks` if absent.  "
        "A camera with a calibrated mount requires anchored ones.",
    ] = None
    association: Annotated[
        Association | None,
        Role("association"),
        "Association of this sensor; the configuration's `association` if absent.",
    ] = None
    detector: Annotated[
        Callable[[Scan], Scan] | None,
        Role("detector"),
        "Detector of landmarks in raw scans: one that finds what the sensor measures.",
    ] = None
    attention: Annotated[
        Attention, Role("attention"), "Selection of the landmarks of a scan; all if absent."
    ] = EVERYTHING  # fmt: skip
    cov: Any = None
    upkeep: Annotated[
        Upkeep | None, Role("upkeep"), "Confirmation of landmarks; the configuration's `upkeep` if absent."
    ] = None  # fmt: skip
    initialization: Annotated[
        Delayed | Trilateration | Hypotheses | None,
        Role("initialization"),
        "Start landmarks at first sight, or late; late ones are points.",
    ] = None
    robust: Annotated[
        Literal["huber", "student"] | None,
        "Robust weight of outliers: bounded, or nearly zero.  All observations count in full if absent.",
    ] = None
    lag_s: Annotated[
        float, Within(ge=-MOST_LAG_S, le=MOST_LAG_S), "Time by which the stamps of its scans are late."
    ] = 0.0
    sigma_lag_s: Annotated[
        float, Within(ge=0, le=MOST_LAG_S), "Standard deviation of the lag; above 0 it is in the map and is estimated."
    ] = 0.0
    classes: Annotated[
        Classes | None, Role("classes"), "Classes that the sensor reports of landmarks, as colours; none if absent."
    ] = None

    def __post_init__(self) -> None:
        instance(self.sensor, Sensor, "Mount: sensor", "columns, angular, expect and noise")
        refuse_misspelt_names(self.sensor, "Mount: sensor")
        refuse_other_views(self.sensor, "Mount: sensor")
        optional: tuple[tuple[str, Any, str], ...] = (
            ("landmark", Landmark, "a landmark model"),
            ("upkeep", Upkeep, "an Upkeep"),
            ("initialization", (Delayed, Trilateration, Hypotheses), "a Delayed, a Trilateration or Hypotheses"),
            ("classes", Classes, "a Classes"),
        )
        for name, kind, expected in optional:
            if vars(self)[name] is not None:
                instance(vars(self)[name], kind, f"Mount: {name}", expected)
        if self.landmark is not None:
            refuse_misspelt_names(self.landmark, "Mount: landmark")
        if self.association is not None:
            refuse_odd_association(self.association, "Mount: association")
        if self.detector is not None:
            self._refuse_odd_detector()
            declared = {own.name for own in parameters(type(self.detector))}
            if "signature" in declared and vars(self.detector)["signature"] is None:
                chosen: Any = replace(self.detector, signature="signature" in self.sensor.columns)  # type: ignore[type-var]
                object.__setattr__(self, "detector", chosen)
        instance(self.attention, Attention, "Mount: attention", "an Attention")
        check_parameters(self, "Mount: ")
        of_robot = f"but a {type(self.sensor).__name__} measures its robot, expected"
        if self.robust is not None and isinstance(self.sensor, OfState):
            raise ModelError(f"Mount: robust is {short_text(self.robust)}, {of_robot} None")
        if self.classes is not None and isinstance(self.sensor, OfState):
            raise ModelError(f"Mount: classes are given, {of_robot} None")
        if self.lags and isinstance(self.sensor, OfState | SeesVelocity):
            raise ModelError(f"Mount: lag_s is {self.lag_s:g}, {of_robot} 0 and no sigma")
        object.__setattr__(self, "at", _pose(self.at, "Mount: at", (3, 7)))

    def _refuse_odd_detector(self) -> None:
        searches = isinstance(self.detector, SearchingDetector)
        one = "an object like km.detect.Trunks(), or a function"
        require_methods(self.detector, ("source" if searches else "__call__",), "Mount: detector", one)
        found, sensor = type(self.detector), type(self.sensor)
        if not finds(found, sensor):
            one = f"one for the {', '.join(self.sensor.columns)} of a {sensor.__name__}"
            raise ModelError(f"Mount: detector is a {found.__name__}, expected {one}")

    @property
    def lags(self) -> bool:
        """True if its lag is in the map."""
        return self.lag_s != 0.0 or self.sigma_lag_s > 0.0

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The names of what is in the map behind the mount: the lag, and the sensor's own parameters."""
        return (*["lag_s"][: self.lags], *parameter_names(self.sensor))

    def covariance(self, dof: int, what: str) -> Array | None:
        """Return the covariance (dof, dof) of the mount in a robot's frame, or None if it is known exactly."""
        return None if self.cov is None else check_covariance(self.cov, dof, what, definite=False, error=ModelError)

    def block(self, what: str) -> tuple[Space, Array, Array] | None:
        """Return the space, the mean (size,) and the covariance (dof, dof) of this sensor's block, None if it has none.

        That is the mount, if it is uncertain, with its lag and the sensor's own parameters behind it, if they are.
        """
        from scipy.linalg import block_diag

        pose, dof = len(self.at), 3 if len(self.at) == 3 else 6
        cov, own = self.covariance(dof, what), parameter_covariance(self.sensor)
        if cov is None and own is None and not self.lags:
            return None
        means, covs = [self.at], [np.zeros((dof, dof)) if cov is None else cov]
        if self.lags:
            means, covs = [*means, np.array([self.lag_s])], [*covs, np.array([[self.sigma_lag_s**2]])]
        if own is not None:
            means, covs = [*means, self.sensor.parameters], [*covs, own]  # type: ignore[attr-defined]
        mean = np.concatenate(means)
        return mount_space(pose, len(mean) - pose), mean, block_diag(*covs)


@documented
@dataclass(frozen=True, eq=False)
class Robot:
    """A robot: its motion model, its start with covariance `cov` (None: known exactly), its sensors.

    `start` is (x, y, heading) in the plane and (x, y, z, qx, qy, qz, qw) in space, by default the origin.

    >>> km.Robot("rover", km.motion.Unicycle(sigma_v_mps=0.1), start=(1.0, 2.0, 0.0)).name
    'rover'
    """

    name: str
    motion: Annotated[Motion, Role("motion"), "Motion model."]
    start: Any = None
    sensors: Mapping[str, Mount] = field(default_factory=dict)
    cov: Any = None
    gaps: Annotated[
        Literal["refuse", "widen", "ignore"],
        "Controls that stop: refuse the log, widen the covariance by what the robot may have moved, or ignore it.",
    ] = "widen"
    max_speed_mps: Annotated[
        float | None, Within(gt=0), "Greatest speed in a gap; from the controls so far if absent."
    ] = None  # fmt: skip
    max_turn_radps: Annotated[
        float | None, Within(gt=0), "Greatest turn rate in a gap; from the controls so far if absent."
    ] = None  # fmt: skip
    rests_until_ns: Annotated[
        int | None, "Controls up to this time do not move the robot; by `start.at_rest` if absent."
    ] = None  # fmt: skip

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ModelError(f"Robot: name is {short_text(self.name)}, expected a text that is not empty")
        sensors = self.sensors if isinstance(self.sensors, Mapping) else ()
        for name in (self.name, *(name for name in sensors if isinstance(name, str))):
            if not is_writable(name):
                raise ModelError(
                    f"Robot: the name {short_text(name)} has control characters or surrogates, expected none"
                )
        what = f"robot {self.name!r}"
        check_parameters(self, f"{what}: ")
        instance(self.motion, Motion, f"{what}: motion", "a motion model")
        refuse_misspelt_names(self.motion, f"{what}: motion")
        k = len(self.motion.columns)
        noise = np.shape(self.motion.control_noise(np.zeros(k)))
        if noise != (k, k):
            raise ModelError(f"{what}: motion: control_noise has shape {noise}, expected ({k}, {k})")
        space = self.motion.space
        pose = 3 if space.kinds[:2] == SE2.kinds else 7 if space.kinds[:2] == SE3.kinds else 0
        if not pose:
            raise ModelError(
                f"{what}: motion is in {getattr(space, 'name', short_text(space))}, expected SE2, SE3 or more"
            )
        start = IDENTITY[pose] if self.start is None else self.start
        object.__setattr__(self, "start", _state(start, pose, space, f"{what}: start"))
        object.__setattr__(self, "sensors", _mounts(self.sensors, what, pose))
        for name, mount in self.sensors.items():
            mount.covariance(3 if pose == 3 else 6, f"{what}: sensor {name!r}: cov")
        if self.cov is not None:
            object.__setattr__(self, "cov", _cov(self.cov, pose, space, f"{what}: cov"))

    def watch(self) -> Gaps:
        """Return what watches for controls that stop."""
        return Gaps(self.name, self.motion, self.gaps, self.max_speed_mps, self.max_turn_radps)


def robots_given(value: Any) -> list[Robot]:
    """Return the robots of a Slam: any number of them, or one alone.  Raises ModelError."""
    if isinstance(value, Robot):
        return [value]
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise ModelError(f"robots is {short_text(value)}, expected a list of Robots")
    robots = list(value)
    for robot in robots:
        instance(robot, Robot, "robots: one", "a Robot")
    if not robots:
        raise ModelError("a Slam needs at least one robot, got none")
    return robots


def mount_name(robot: str, sensor: str) -> str:
    """Return the name of a sensor's mount in the map."""
    return f"{robot}.{sensor}"


def _state(value: Any, pose: int, space: Space, what: str) -> Array:
    """Return a start of a motion's space: the whole state, or a pose, the rest of it zero."""
    try:
        given = finite(value, what, INFINITE, ModelError)
    except ModelError:
        given = np.empty(0)
    whole = given.shape == (space.size,)
    rest = given[pose:] if whole else np.zeros(space.size - pose)
    state = np.concatenate([_pose(given[:pose] if whole else value, what, (pose,)), rest])
    state = finite(state, what, error=ModelError)
    state.flags.writeable = False
    return state


def _cov(value: Any, pose: int, space: Space, what: str) -> Array:
    """Return the covariance of a start, of the whole state or of the pose alone, the rest of it known."""
    given, dof = finite(value, what, MOST["m"] ** 2, ModelError), 3 if pose == 3 else 6
    size = dof if given.shape == (dof, dof) else space.dof
    cov = np.zeros((space.dof, space.dof))
    cov[:size, :size] = check_covariance(given, size, what, definite=False, error=ModelError)
    return cov


def _mounts(sensors: Any, what: str, size: int) -> dict[str, Mount]:
    """Return a copy of a robot's sensors, by name; one at the robot's own origin is there in space too."""
    if not isinstance(sensors, Mapping):
        raise ModelError(f"{what}: sensors is {short_text(sensors)}, expected a mapping of names to Mounts")
    for name, mount in sensors.items():
        if not isinstance(name, str) or not name:
            raise ModelError(f"{what}: the name of a sensor is {short_text(name)}, expected a text that is not empty")
        if not isinstance(mount, Mount):
            raise ModelError(
                f"{what}: sensor {name!r} is {short_text(mount)}, expected a Mount: Mount(sensor, at=(x, y, heading))"
            )
    mounts = {}
    for name, mount in sensors.items():
        if len(mount.at) != size and not mount.at.any():
            mount = replace(mount, at=IDENTITY[size])  # noqa: PLW2901
        if len(mount.at) != size:
            at = f"{what}: sensor {name!r} sits at {mount.at.tolist()}"
            raise ModelError(f"{at}, expected {WANTED[size]}")
        mounts[name] = mount
    return mounts
