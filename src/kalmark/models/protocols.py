"""The protocols of a motion, a sensor and a landmark, and their optional capabilities.

N + M, not N x M: a sensor measures a point in its own frame only.  Models are batched: K landmarks at once, values (K,
d), Jacobians (K, m, d).  `pointwise` lifts one-point functions.

A capability is optional.  One with a default is read by a function, as in `finds_depth(sensor)`; one that
decides what is done with a model is a Protocol, as in `isinstance(sensor, Visible)`.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from typing import Any, Protocol, TypeVar, cast, runtime_checkable

import numpy as np

from kalmark.arrays import Array, Flags
from kalmark.errors import ModelError
from kalmark.geometry.spaces import RHO, VECTOR, VECTOR3, Space

__all__ = [
    "Ambiguous", "Calibrated", "Capability", "Checked", "Completing", "Distant", "Drifting", "FarCorrected",
    "FullSensor", "HasPlace", "HasVelocity", "HoldsRate", "Intersecting", "Joining", "Landmark", "Motion",
    "NonAdditiveSensor", "NonlinearCalibration", "OfState", "OwnNoise", "Parametrized", "Pointed", "Ranging",
    "Reparametrizable", "SeesVelocity", "SegmentVisible", "Segmented", "SelfCalibrating", "Sensor", "StartNoise",
    "StateDiffusion", "TimedNoise", "UnknownDepth", "Visible",
]  # fmt: skip
T = TypeVar("T")
_FOUND: dict[tuple[type, type, tuple[str, ...]], bool] = {}


class _Remembered(type(Protocol)):  # type: ignore[misc]
    """Type of protocols whose `isinstance` is computed once for a class and the names of an instance's attributes.

    That of `typing` costs 20 us and more.
    """

    def __instancecheck__(cls, model: object) -> bool:
        if isinstance(model, type):  # a class is compared by its own attributes
            return bool(super().__instancecheck__(model))
        key = cls, type(model), tuple(getattr(model, "__dict__", ()))
        if key not in _FOUND:
            _FOUND[key] = super().__instancecheck__(model)
        return _FOUND[key]


class Capability(Protocol, metaclass=_Remembered):
    """Optional attributes and methods of a model.

    >>> isinstance(km.sensors.RangeBearing(), Visible), isinstance(km.sensors.Heading(), Visible)
    (True, False)
    """


@runtime_checkable
class Motion(Capability, Protocol):
    """The motion of a robot.  [S] (1), (14)-(17).

    >>> rover = km.motion.Unicycle(sigma_v_mps=0.1, sigma_w_radps=0.2)
    >>> isinstance(rover, Motion), rover.columns, rover.held
    (True, ('v_mps', 'w_radps'), True)
    >>> rover.move(np.zeros(3), np.array([1.0, 0.0]), 2.0)[0], rover.control_noise(np.array([1.0, 0.0])).round(3)
    (array([2., 0., 0.]), array([[0.01, 0.  ],
           [0.  , 0.04]]))
    """

    @property
    def space(self) -> Space:
        """The space of the robot's state; its first coordinates are the pose."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Names, with units, of the control's components: the columns of a native log."""

    @property
    def held(self) -> bool:
        """True for a rate held until the next control, False for an increment that ended at its time."""

    def move(self, r: Array, u: Array, dt_s: float) -> tuple[Array, Array, Array]:
        """Return the moved state (size,), R_r (dof, dof) and R_u (dof, m)."""

    def control_noise(self, u: Array) -> Array:
        """Return the covariance N (k, k) of the control's error, which is held as long as the control is."""

    def diffusion(self, u: Array, dt_s: float) -> Array | None:
        """Return the covariance gathered in `dt_s`, in the frame where the robot ends, or None for none at all.

        It is (3, 3) in the plane, or that of the whole state; in space always the latter.
        """


@runtime_checkable
class Sensor(Capability, Protocol):
    """The measurement of a landmark at v in the frame of the sensor.  [S] (2), (18).

    >>> lidar = km.sensors.RangeBearing(sigma_range_m=0.1, sigma_bearing_rad=0.02, range_max_m=10.0, fov_rad=3.14)
    >>> isinstance(lidar, Sensor), lidar.columns, lidar.angular
    (True, ('range_m', 'bearing_rad'), (False, True))
    >>> lidar.expect(np.array([[3.0, 4.0]]))[0].round(3)
    array([[5.   , 0.927]])
    """

    @property
    def columns(self) -> tuple[str, ...]:
        """Names, with units, of the measurement's m components."""

    @property
    def angular(self) -> tuple[bool, ...]:
        """Flags of the components that are angles, whose differences are wrapped."""

    def expect(self, v: Array) -> tuple[Array, Array]:
        """Return the expected measurements (K, m) of v (K, d), and E_v (K, m, d)."""

    def noise(self, y: Array) -> Array:
        """Return the measurement noise R (K, m, m) of measurements y (K, m)."""


@runtime_checkable
class FullSensor(Sensor, Protocol):
    """A sensor that measures everything a landmark has, so that it can start one.  [S] (3).

    >>> lidar = km.sensors.RangeBearing(sigma_range_m=0.1, sigma_bearing_rad=0.02, range_max_m=10.0, fov_rad=3.14)
    >>> lidar.invert(np.array([[5.0, 0.0]]))[0]
    array([[5., 0.]])
    >>> isinstance(lidar, FullSensor), isinstance(km.sensors.Heading(), FullSensor)
    (True, False)
    """

    def invert(self, y: Array) -> tuple[Array, Array]:
        """Return what is at v (K, d) in the sensor's frame when y (K, m) is measured, and V_y (K, d, m)."""


@runtime_checkable
class NonAdditiveSensor(Sensor, Protocol):
    """A sensor whose noise depends on the landmark, or enters inside the measurement, y = g(v, n)  [F].

    The noise must not be taken at the measured values: of a range noise that grows with the range, this weights the
    short ranges more and biases every landmark towards the sensor.

    >>> lidar = km.sensors.RangeBearing(sigma_range_m=0.1, sigma_bearing_rad=0.02, sigma_range_rel=0.05)
    >>> lidar.additive, lidar.noise_at(np.array([[10.0, 0.0]])).round(4)
    (False, array([[[0.26  , 0.    ],
            [0.    , 0.0004]]]))
    """

    @property
    def additive(self) -> bool:
        """Return True if `noise` is the complete noise."""

    def noise_at(self, v: Array) -> Array:
        """Return E_n N E_n' (K, m, m) at v (K, d)."""


@runtime_checkable
class Landmark(Capability, Protocol):
    """The view of a landmark from a pose: v, the landmark in the frame T of the sensor.

    >>> point = km.landmarks.Point2D()
    >>> isinstance(point, Landmark), point.kind
    (True, 'point')
    >>> point.seen_from(np.array([1.0, 0.0, np.pi / 2]), np.array([[1.0, 2.0]]))[0].round(3)
    array([[2., 0.]])
    """

    @property
    def kind(self) -> str:
        """The name of this type in configurations and tables."""

    @property
    def space(self) -> Space:
        """The space of the landmark's state."""

    def seen_from(self, T: Array, l: Array) -> tuple[Array, Array, Array]:
        """Return v (K, d) of landmarks l (K, n) seen from the pose T, V_T (K, d, 3) and V_l (K, d, n)."""

    def from_view(self, T: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return landmarks l (K, n) that look like v (K, d) from the pose T, L_T (K, n, 3) and L_v (K, n, d)."""


# ------------------------------------------------------------------ capabilities with a default
def optional(name: str, default: T) -> Callable[[object], T]:
    """Return the function that reads an optional attribute of a model, which is `default` where it has none.

    >>> optional("finds_depth", True)(km.sensors.Bearing()), optional("finds_depth", True)(km.sensors.RangeBearing())
    (False, True)
    """
    OPTIONAL.add(name)

    def read(model: object) -> T:
        return getattr(model, name, default)

    return read


OPTIONAL = {"cov_size", "parameter_names"}
keep = optional("keep", 1)
"""Of how many of its last scans a sensor of a change keeps the poses."""
finds_depth = optional("finds_depth", True)
"""True where one measurement determines the distance of the landmark."""
has_second_camera = optional("of_pair", False)
"""True where a frame of the sensor has the image of a second camera, to the right."""
sees_kinds = optional("sees_kinds", cast("tuple[str, ...] | None", None))
"""The kinds of landmarks that a sensor measures, None for any that fits."""
world_of = optional("world", "")
""""plane" or "space", "" for a model of either."""
image_size = optional("image", cast("tuple[float, float] | None", None))
"""The width and height of a sensor's image, px; None: it has none."""
why_unseen = optional("why_unseen", cast("Callable[[Array], str] | None", None))
"""Reason for which a sensor does not observe v (d,), in its frame and out of view; None: range and field of view."""
sample_segments = optional("sample_segments", cast("Callable[[Any, int], Array] | None", None))
"""Segments (K, m) as a sensor of segments may measure them, by a random generator and their number."""
range_limit = optional("range_max_m", math.inf)
"""The distance of the farthest landmark that a sensor measures, m."""
field_of_view = optional("fov_rad", 2 * math.pi)
"""A sensor's field of view about its x axis, rad."""
coasts = optional("coasts", False)
"""True where a robot moves without a control, as its state has a velocity."""
state_columns = optional("state_columns", cast("tuple[str, ...]", ()))
"""The names, with units, of a state's components behind the pose."""
sees_rates = optional("sees_rates", False)
"""True where a sensor of a twist measures turn rates."""


@runtime_checkable
class SelfCalibrating(Capability, Protocol):
    """A motion of which constants may be in the map, and estimated.

    >>> rover = km.motion.Unicycle(sigma_v_bias_mps=0.05)
    >>> rover.calibration, rover.calibration_cov, rover.calibration_effect(np.array([1.0, 0.0]), 0.1)
    (('v_mps',), array([[0.0025]]), array([[1.],
           [0.]]))
    """

    @property
    def calibration(self) -> tuple[str, ...]:
        """The names of the c constants that are in the map."""

    @property
    def calibration_cov(self) -> Array:
        """Their covariance (c, c)."""

    def calibration_effect(self, u: Array, dt_s: float) -> Array:
        """Return B (m, c): with the constants a, a control u (m,) of `dt_s` is u + B a in truth."""


@runtime_checkable
class NonlinearCalibration(SelfCalibrating, Protocol):
    """A motion of which the constants in the map do not change a control by B a.

    >>> [isinstance(one, NonlinearCalibration) for one in (km.motion.DifferentialDrive(), km.motion.Unicycle())]
    [True, False]
    """

    def calibrated(self, u: Array, a: Array, dt_s: float) -> tuple[Array, Array]:
        """Return the control (m,) that u (m,) is in truth with the constants a (c,), and U_a (m, c)."""


@runtime_checkable
class StateDiffusion(Capability, Protocol):
    """A motion of which the diffusion depends on its state, such as a velocity in it.

    >>> isinstance(km.motion.Inertial(), StateDiffusion), isinstance(km.motion.Unicycle(), StateDiffusion)
    (True, False)
    """

    def diffusion_at(self, r: Array, u: Array, dt_s: float) -> Array | None:
        """Return what `diffusion` does, from the state r (size,) on."""


@runtime_checkable
class HasVelocity(Capability, Protocol):
    """A motion whose state contains the velocity of the robot.

    >>> motion = km.motion.ConstantVelocity()
    >>> motion.body_velocity(np.array([0.0, 0.0, np.pi / 2, 2.0, 0.0, 0.1]))[0].round(3)
    array([2. , 0. , 0.1])
    """

    def body_velocity(self, r: Array) -> tuple[Array, Array]:
        """Return the velocity of a state r (size,) in the robot's frame, and its Jacobian (3 or 6, dof).

        In the plane (vx, vy, w), in space (v (3), w (3)), m/s and rad/s; NaN where the state does not contain it.
        """


@runtime_checkable
class HoldsRate(Capability, Protocol):
    """A motion of which the state has the velocity, and the control in force the turn rate: an inertial unit.

    >>> isinstance(km.motion.Inertial(), HoldsRate), isinstance(km.motion.Unicycle(), HoldsRate)
    (True, False)
    """

    columns: tuple[str, ...]

    def body_velocity_under(self, r: Array, u: Array) -> tuple[Array, Array]:
        """Return what `HasVelocity` does, under a control u (k,); NaN where there is none yet: it does not turn."""


def has_velocity_state(motion: object) -> bool:
    """Return whether the velocity of a robot is in its state; by default it is not."""
    return isinstance(motion, HasVelocity | HoldsRate)


def velocity_in(motion: Any, r: Array, u: Array) -> tuple[Array, Array]:
    """Return the velocity of a state r (size,) in the robot's frame under a control u (k,), and its Jacobian."""
    if isinstance(motion, HoldsRate):
        return motion.body_velocity_under(r, u)
    velocity: tuple[Array, Array] = motion.body_velocity(r)
    return velocity


def self_calibrating(motion: object) -> SelfCalibrating | None:
    """Return a motion of which constants are in the map; by default None: it has none."""
    return motion if isinstance(motion, SelfCalibrating) and motion.calibration else None


def true_control(motion: SelfCalibrating, u: Array, a: Array, dt_s: float) -> tuple[Array, Array]:
    """Return the control (m,) that u (m,) is in truth with the constants a (c,), and U_a (m, c); by default u + B a."""
    if isinstance(motion, NonlinearCalibration):
        return motion.calibrated(u, a, dt_s)
    B = motion.calibration_effect(u, dt_s)
    return u + B @ a, B


def diffusion_of(motion: Motion, r: Array, u: Array, dt_s: float) -> Array | None:
    """Return the diffusion of a motion in `dt_s` from a state r (size,) on; by default it does not depend on that."""
    return motion.diffusion_at(r, u, dt_s) if isinstance(motion, StateDiffusion) else motion.diffusion(u, dt_s)


def parameter_covariance(sensor: object) -> Array | None:
    """Return the covariance (p, p) of a sensor's own parameters; by default None: they are known."""
    return sensor.parameter_cov if isinstance(sensor, Calibrated) else None


def parameter_names(sensor: object) -> tuple[str, ...]:
    """Return the names of a sensor's own parameters that are in the map; by default numbers."""
    cov = parameter_covariance(sensor)
    numbers = tuple(f"constant {k}" for k in range(1, 1 + (0 if cov is None else len(cov))))
    return getattr(sensor, "parameter_names", numbers)


def innovation_size(sensor: Sensor) -> int:
    """Return how many numbers an innovation has; by default as many as the measurement."""
    return int(getattr(sensor, "cov_size", len(sensor.columns)))


# ------------------------------------------------------------------ capabilities of sensors
@runtime_checkable
class Visible(Capability, Protocol):
    """A sensor with a limited field of view.

    >>> lidar = km.sensors.RangeBearing(sigma_range_m=0.1, sigma_bearing_rad=0.02, range_max_m=10.0, fov_rad=3.14)
    >>> lidar.sees(np.array([[5.0, 0.0], [-5.0, 0.0], [20.0, 0.0]]))
    array([ True, False, False])
    """

    def sees(self, v: Array) -> Flags:
        """Return which of v (K, d), in the sensor's frame, can be measured."""


def in_view(sensor: Sensor, v: Array) -> Flags:
    """Return which of v (K, d), in the sensor's frame, can be measured; by default all."""
    return sensor.sees(v) if isinstance(sensor, Visible) else np.ones(len(v), dtype=np.bool_)


@runtime_checkable
class SegmentVisible(Capability, Protocol):
    """A sensor that measures parts of line segments.

    >>> isinstance(km.sensors.Wall(), SegmentVisible), isinstance(km.sensors.RangeBearing(), SegmentVisible)
    (True, False)
    """

    def sees_segments(self, T: Array, p1: Array, p2: Array) -> tuple[Flags, Array]:
        """Return which segments from p1 to p2 (K, 2 or 3) of the world are seen from T, and what is measured."""


@runtime_checkable
class Parametrized(Capability, Protocol):
    """A sensor with parameters of its own, which its compiled expectation takes.

    >>> km.sensors.RangeBearing(scale=1.02, bias_m=0.1).parameters
    array([0.98039216, 0.09803922])
    """

    @property
    def parameters(self) -> Array:
        """The parameters (p,)."""


@runtime_checkable
class Calibrated(Parametrized, Protocol):
    """A sensor whose own parameters may be in the map, and estimated.

    >>> lidar = km.sensors.RangeBearing(sigma_scale=0.02)
    >>> lidar.parameter_cov, km.sensors.RangeBearing().parameter_cov is None
    (array([[0.0004, 0.    ],
           [0.    , 0.    ]]), True)
    """

    @property
    def parameter_cov(self) -> Array | None:
        """Their covariance (p, p), None if they are known."""

    def with_parameters(self, parameters: Array) -> Any:
        """Return the sensor with other parameters (p,)."""

    def parameters_jacobian(self, v: Array) -> Array:
        """Return E_p (K, m, p): how the measurements of v (K, d) change with the parameters."""


@runtime_checkable
class SeesVelocity(Capability, Protocol):
    """A sensor of landmarks that stand still, whose measurements depend on its own velocity, too.

    Its v (K, 2 d) are points and, behind them, the velocity of the sensor, both in its frame (`observe.py`).

    >>> isinstance(km.sensors.Radar2D(), SeesVelocity), isinstance(km.sensors.RangeBearing(), SeesVelocity)
    (True, False)
    """

    sees_velocity: bool


POSE, CHANGE, TWIST = "pose", "change", "twist"  # the views of a sensor of the state, see `models/state_view.py`
BLOCKS, PLACES = "blocks", "places"  # what a sensor of any blocks is given: their means, or where they are


@runtime_checkable
class OfState(Sensor, Protocol):
    """A sensor that measures its own robot: `views` is POSE, CHANGE or TWIST.

    Or any blocks of the map: `views` is BLOCKS or PLACES, and `expect(*x)` returns the expectation (m,) from the means
    of the blocks (as `Slam.mean` has them), or from their places (d,), alone or as (e, E_1, ..., E_k) with its
    Jacobians in the errors of each.  docs/factors.md.

    >>> km.sensors.Heading().views, km.sensors.Odometer2D().views, km.sensors.Gyro2D().views
    ('pose', 'change', 'twist')
    """

    views: str
    pass_share: float
    """The share of good readings that pass its gate."""


def measures_blocks(sensor: object) -> bool:
    """Return whether a sensor measures any robots and landmarks, which each observation names."""
    return isinstance(sensor, OfState) and sensor.views in (BLOCKS, PLACES)


def with_jacobians(expected: Any) -> tuple[Any, ...]:
    """Return an expectation e (m,), and its Jacobians if `expect` of a sensor of blocks returned them behind it."""
    return expected if isinstance(expected, tuple) and np.ndim(expected[0]) else (expected,)


def poses_kept(sensor: OfState) -> int:
    """Return of how many of its last scans a sensor of a change keeps the poses; by default of the last one."""
    return keep(sensor) if sensor.views == CHANGE else 1


@runtime_checkable
class TimedNoise(Capability, Protocol):
    """A sensor of the state whose noise depends on how long a reading means.

    >>> isinstance(km.sensors.Gyro2D(), TimedNoise), isinstance(km.sensors.RangeBearing(), TimedNoise)
    (True, False)
    """

    def noise_since(self, dt_s: float) -> Array:
        """Return the noise R (1, p, p) of a reading that means the last `dt_s` seconds."""


@runtime_checkable
class Drifting(Capability, Protocol):
    """A sensor whose parameters walk at random.

    >>> isinstance(km.sensors.Gyro2D(), Drifting), isinstance(km.sensors.RangeBearing(), Drifting)
    (True, False)
    """

    def drift(self, dt_s: float) -> Array:
        """Return the variances (p,) that its parameters gather in `dt_s`."""


@runtime_checkable
class Distant(Capability, Protocol):
    """A sensor each of whose measurements determines a distance: a range, or a received signal strength.

    >>> km.sensors.RangeBearing().distances(np.array([[5.0, 0.3]]))
    array([5.])
    """

    def distances(self, y: Array) -> Array:
        """Return the distances (K,) in m of measurements y (K, m); in the plane, those along the plane."""


def gives_distances(sensor: Sensor) -> bool:
    """Return whether a sensor measures one number alone that determines a distance: range, strength."""
    return len(sensor.columns) == 1 and isinstance(sensor, Distant)


def distances_alone(sensor: Sensor) -> bool:
    """Return whether a sensor measures one number alone that determines a distance in the plane."""
    return gives_distances(sensor) and world_of(sensor) != "space"


@runtime_checkable
class Ranging(Distant, Protocol):
    """A sensor whose first component is a range.

    >>> km.sensors.Range(sigma_range_m=0.2).range_variance(np.array([[5.0]])).round(3)
    array([0.04])
    """

    def range_variance(self, y: Array) -> Array:
        """Return the variances (K,) of the ranges of measurements y (K, m), m^2."""


@runtime_checkable
class Intersecting(Capability, Protocol):
    """A sensor of which two measurements, from two poses, determine a point.

    >>> here, there = np.array([[np.pi / 4]]), np.array([[3 * np.pi / 4]])
    >>> km.sensors.Bearing().meet(np.array([2.0, 0.0, 0.0]), here, there)[0].round(3)
    array([[1., 1.]])
    """

    def meet(self, T: Array, y: Array, y2: Array) -> Array:
        """Return the points (K, c, d) that explain y (K, m) from the origin and y2 (K, m) from T, NaN where none."""


@runtime_checkable
class Ambiguous(Capability, Protocol):
    """A sensor of which one measurement fits two poses: planar pose ambiguity, Schweighofer and Pinz 2006.

    >>> isinstance(km.sensors.TagCorners(), Ambiguous), isinstance(km.sensors.TagPose(), Ambiguous)
    (True, False)
    """

    def both(self, y: Array) -> tuple[Array, Array, Array]:
        """Return both poses (K, 2, 7) that explain y (K, m), the better first, V_y (K, 2, 6, p), chi-squares (K, 2)."""


@runtime_checkable
class FarCorrected(Capability, Protocol):
    """A sensor whose measurements far from the expected ones are first corrected as poses.

    >>> isinstance(km.sensors.TagCorners(), FarCorrected), isinstance(km.sensors.PinHole(), FarCorrected)
    (True, False)
    """

    def is_far(self, y: Array, z: Array) -> Flags:
        """Return which measurements y (K, m) are far from the expected ones by their innovations z (K, p)."""

    def poses(self, y: Array, R: Array) -> tuple[Array, Array]:
        """Return y (K, m) with noise R (K, p, p) as poses (K, 7) with covariances (K, 6, 6), or NaN."""


@runtime_checkable
class OwnNoise(Capability, Protocol):
    """A sensor whose innovations are something else than its measurements, so that a scan's covariance is converted.

    >>> isinstance(km.sensors.Segments(), OwnNoise), isinstance(km.sensors.RangeBearing(), OwnNoise)
    (True, False)
    """

    def noise_from(self, y: Array, cov: Array) -> Array:
        """Return the noise (K, p, p) of the innovations, of the covariances (K, m, m) of measurements y (K, m)."""


@runtime_checkable
class StartNoise(Capability, Protocol):
    """A sensor whose noise when a landmark starts is another one than in a correction.

    >>> isinstance(km.sensors.Segments(), StartNoise), isinstance(km.sensors.RangeBearing(), StartNoise)
    (True, False)
    """

    def start_noise(self, y: Array) -> Array:
        """Return the noise (K, m, m) of the measurements y (K, m) themselves."""


@runtime_checkable
class Checked(Capability, Protocol):
    """A sensor that cannot have made every measurement of the right shape.

    >>> try:
    ...     km.sensors.RangeBearing().check(np.array([[-1.0, 0.0]]))
    ... except km.KalmarkError as error:
    ...     print(error)
    observation 0: range is -1.0 m, expected at least 0
    """

    def check(self, y: Array) -> None:
        """Raise EventError if this sensor cannot have made the measurements y (K, m)."""


# ------------------------------------------------------------------ capabilities of landmarks
@runtime_checkable
class UnknownDepth(Capability, Protocol):
    """A landmark that starts at a prior inverse distance where the sensor finds no depth.

    >>> km.landmarks.InverseDepth2D().prior_rho_per_m
    0.5
    """

    prior_rho_per_m: float


@runtime_checkable
class Completing(Capability, Protocol):
    """A landmark that supplies what a measurement does not determine of it.

    >>> isinstance(km.landmarks.InverseDepth2D(), Completing), isinstance(km.landmarks.Point2D(), Completing)
    (True, False)
    """

    def complete(self, v: Array, V_y: Array, depth: bool) -> tuple[Array, Array, Array | None]:
        """Return what `from_view` takes (K, e) for a sensor's v (K, d), its Jacobian in y, and the prior (K, e, e)."""


@runtime_checkable
class Pointed(Capability, Protocol):
    """A landmark that is one point.

    >>> ray = km.landmarks.InverseDepth2D()
    >>> ray.to_point(np.array([[1.0, 0.0, 0.0, 0.5]]))[0]
    array([[3., 0.]])
    """

    def to_point(self, l: Array) -> tuple[Array, Array]:
        """Return the points p (K, 2 or 3) of landmarks l (K, n), m, and P_l (K, 2 or 3, n)."""


@runtime_checkable
class Reparametrizable(Pointed, Protocol):
    """A landmark that becomes a Euclidean point once that is as good.  Civera, Davison and Montiel 2008.

    >>> [isinstance(one, Reparametrizable) for one in (km.landmarks.InverseDepth2D(), km.landmarks.Point2D())]
    [True, False]
    """

    def linearity(self, T: Array, l: Array, sigmas: Array) -> Array:
        """Return the linearity indices (K,) of landmarks l (K, n) with `sigmas` (K, n), seen from the pose T."""


@runtime_checkable
class Segmented(Capability, Protocol):
    """A line, of which a segment from abscissa to abscissa is kept.

    >>> isinstance(km.landmarks.Wall2D(), Segmented), isinstance(km.landmarks.Point2D(), Segmented)
    (True, False)
    """

    first_ends: tuple[float, float]
    extend: bool

    def endpoints(self, l: Array, t: Array) -> tuple[Array, Array]:
        """Return the points (K, 2, 2 or 3) of lines l (K, n) at abscissas t (K, 2), and P_l (K, 2, 2 or 3, n)."""

    def abscissas(self, T: Array, l: Array, v: Array) -> Array:
        """Return the abscissas (K, 2) on lines l (K, n) of the ends that v (K, m) of a sensor's `invert` has from T.

        In space v are two viewing rays (K, 6), which pass the lines nearest there.
        """


@runtime_checkable
class Joining(Segmented, Protocol):
    """A line of the plane of which segments that join are one landmark, and others are others.

    >>> isinstance(km.landmarks.Wall2D(), Joining), isinstance(km.landmarks.PlueckerLine(), Joining)
    (True, False)
    """

    join_m: float

    def difference(self, a: Array, b: Array, t: float) -> tuple[Array, Array, Array]:
        """Return angle and distance (2,) of b from a, both (n,), at the abscissa t of a, Z_a and Z_b (2, n)."""


@runtime_checkable
class HasPlace(Capability, Protocol):
    """A landmark that is somewhere.

    >>> km.landmarks.Polar2D().place(np.array([[1.0, 2.0, 0.0, 3.0]]))[0]
    array([[4., 2.]])
    """

    def place(self, l: Array) -> tuple[Array, Array]:
        """Return where landmarks l (K, n) are in the world, p (K, 2 or 3) in m, and P_l (K, 2 or 3, n)."""


def place_of(landmark: Landmark, l: Array) -> tuple[Array, Array] | None:
    """Return where landmarks l (K, n) are in the world, p (K, 2 or 3) in m, and P_l (K, 2 or 3, n).

    By default that is the vector with which the landmark's space begins.  None if it begins with something else, or
    has an inverse distance: then the vector is an anchor.
    """
    if isinstance(landmark, HasPlace):
        return landmark.place(l)
    kinds = landmark.space.kinds
    size = None if RHO in kinds else {VECTOR: 2, VECTOR3: 3}.get(kinds[0])
    if size is None:
        return None
    return np.array(l[:, :size]), np.tile(np.eye(size, landmark.space.dof), (len(l), 1, 1))


# ------------------------------------------------------------------ spelling
_OF: dict[type, tuple[type, ...]] = {
    Motion: (Motion, NonlinearCalibration, StateDiffusion, HasVelocity),
    Sensor: (
        FullSensor, NonAdditiveSensor, Visible, SegmentVisible, Calibrated, Ranging, Intersecting, Ambiguous,
        FarCorrected, OwnNoise, StartNoise, Checked, SeesVelocity, OfState, TimedNoise, Drifting,
    ),
    Landmark: (Landmark, UnknownDepth, Completing, Reparametrizable, Segmented, Joining, HasPlace),
}  # fmt: skip
_NEAR = 0.85  # of difflib: "see" is near "sees", "extent" is not near "extend"


def refuse_misspelt_names(model: object, what: str) -> None:
    """Refuse a user's model with a public name near that of a capability which the model does not have.

    Raises ModelError with both names.  kalmark's own models are not looked at.
    """
    own = [cls for cls in type(model).__mro__ if not cls.__module__.startswith(("kalmark.", "builtins"))]
    if not own:
        return
    given = set(dir(model))
    parts = [part for role, all_of_it in _OF.items() if isinstance(model, role) for part in all_of_it]
    known = {name for part in parts for name in _members(part)} | OPTIONAL
    inherited = {name for cls in type(model).__mro__ if cls not in own for name in dir(cls)}
    for name in sorted(given - known - inherited):
        near = [] if name.startswith("_") else difflib.get_close_matches(name, known - given, n=1, cutoff=_NEAR)
        if near:
            raise ModelError(f"{what}: {type(model).__name__} has {name!r}, expected {near[0]!r}, or another name")


def refuse_other_views(sensor: object, what: str) -> None:
    """Refuse a sensor with unknown `views`, or without the share that passes its gate.

    Without that it would be taken for a sensor of landmarks.
    """
    if not hasattr(sensor, "views"):
        return
    name = type(sensor).__name__
    views = POSE, CHANGE, TWIST, BLOCKS, PLACES
    if sensor.views not in views:
        raise ModelError(f"{what}: {name}.views is {sensor.views!r}, expected one of {', '.join(map(repr, views))}")
    if not hasattr(sensor, "pass_share"):
        raise ModelError(f"{what}: {name} has views and no pass_share, expected the share of good readings that pass")


def _members(protocol: type) -> set[str]:
    """Return the public names that a Protocol and its bases declare."""
    parts = [cls for cls in protocol.__mro__ if cls.__module__ == __name__]
    names = {name for cls in parts for name in (*vars(cls), *vars(cls).get("__annotations__", ()))}
    return {name for name in names if not name.startswith("_")}
