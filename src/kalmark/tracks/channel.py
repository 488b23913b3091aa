"""A channel: a mounted sensor with an observation model for each kind of block."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.compiled import form_for
from kalmark.errors import ModelError
from kalmark.events import Id
from kalmark.filter import corrections, kernels
from kalmark.filter.map import AT_ONCE, Map, StochasticMap
from kalmark.filter.nearest_blocks import has_place
from kalmark.geometry.gaussian import gate
from kalmark.models import landmarks as kinds
from kalmark.models import protocols
from kalmark.models.landmarks import (
    AsPoint,
    InverseDepth2D,
    Point2D,
    Point3D,
    PointHeight2D,
    PointSignature2D,
    Polar2D,
    Tag,
    Wall2D,
)
from kalmark.models.observe import is_built_in, landmark_at, linearize, mount_ago, sensor_pose, view_of
from kalmark.models.protocols import Landmark, Sensor, finds_depth, sees_kinds
from kalmark.models.sensors import RangeBearing, TagPose
from kalmark.models.state_view import velocity_of
from kalmark.tracks.classes import Classes

Parts = tuple[tuple[int, int], ...]  # slots of blocks, and how many rows of each from the first on

ROBOT = "robot"
ALIKE = {
    "point": ("point_signature", "point_height", ROBOT),
    "point3": (ROBOT,),
    "tag": (ROBOT,),
}  # what else one model applies to
EUCLIDEAN = ("point", "point3")
TINY_RHO = 1e-9  # 1 / m: as good as infinitely far
HUBER, STUDENT = ("huber", "student")
FULL, DEGREES = 0.95, 4.0  # of right observations count in full for Huber; degrees of freedom of Student's weights
BY_KIND = {kind.kind: kind for kind in kinds.BUILT_IN}


@dataclass(frozen=True, eq=False)
class ObservationModel:
    """Observation of landmarks of one type by a sensor on a mount `at`."""

    landmark: Landmark
    sensor: Any
    at: Array
    motion: Any = None
    since: Array = field(default_factory=lambda: np.zeros(1))
    past: Array = field(default_factory=lambda: np.zeros(0))

    known: bool = False
    """True where the landmarks are known exactly: y (K, m + n) ends with their numbers; the slots are the robot's."""

    @cached_property
    def model(self) -> Any:
        """The view for `linearize`.  Made when it is first needed: models that are built in are compiled then."""
        return view_of(self.sensor, self.landmark, self.at, self.motion, self.since, self.past)

    @cached_property
    def exactly(self) -> ObservationModel:
        """The same for landmarks known exactly, which are not in the map."""
        return replace(self, known=True)

    @cached_property
    def built_in(self) -> bool:
        """True if sensor and landmark are kalmark's own."""
        return is_built_in(self.sensor, self.landmark)

    @cached_property
    def d(self) -> int:
        """Number of the landmark's components in the map that are observed."""
        return 0 if self.known else self.landmark.space.size

    def predict(
        self, m: StochasticMap, robot: int, mount: int, slots: Index, y: Array, R: Array
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return the innovations' covariance Z (K, p, p) and d2 (K,) of y (K, m) from the blocks `slots`.  [S] (83)."""
        run = form_for(self.model, corrections.innovation_covariances)
        scan = robot, mount, slots, self.d, y, np.ascontiguousarray(R), math.inf
        return run(self.model, m.whole, scan)

    def weighed(
        self, m: StochasticMap, robot: int, mount: int, slots: Index, y: Array, R: Array, how: str
    ) -> Array:  # fmt: skip
        """Return the noise (K, p, p) with which outliers count less, `how`: "huber" or "student"."""
        run = form_for(self.model, corrections.robust_noise)
        k = DEGREES if how == STUDENT else huber_length(R.shape[1])
        scan = robot, mount, slots, self.d, y, np.ascontiguousarray(R), k
        return np.asarray(run(self.model, m.whole, scan, how == STUDENT))

    def __getstate__(self) -> dict[str, Any]:
        """Return all but the compiled model, whose addresses mean nothing to another process."""
        return {name: value for name, value in self.__dict__.items() if name not in ("model", "exactly")}


def huber_length(dof: int) -> float:
    """Return the length of a whitened residual of `dof` numbers up to which it counts in full for Huber."""
    return math.sqrt(gate(FULL, dof))


class Channel:
    """A sensor of a robot on its mount `at`, whose slot is `mount` (-1: not in the map), starting `landmark`s.

    `threshold` gives the gate on d2 from the size of an innovation.  `others` are the landmarks that sensors start.
    `motion` is that of its robot: a sensor that measures its velocity has it from the state; else it `counts`, from a
    clone of the robot's pose at its last scan.  `since` (1 + k,): the seconds since then, and the control in force
    where that has the turn rate.  `robust`: how outliers count less, "huber" or "student" (None: all count in full).
    Of a sensor that `lags`, whose lag is in the map, `past` (7 or 14,) is that of its robot (`mount_ago`).
    `classes` are those that the sensor reports of landmarks, None where it reports none.  Its scans determine where its
    robot is where it `locates` (by points of the plane) and, if all ids are known, where it `locates_by_ids`.
    """

    def __init__(
        self, sensor: Sensor, at: Array, mount: int, landmark: Landmark, threshold: Callable[[int], float],
        others: Sequence[Landmark], motion: Any = None, robust: str | None = None,
        lags: bool = False, classes: Classes | None = None,
    ) -> None:  # fmt: skip
        self.sensor: Any = sensor
        self.motion, self.sees_velocity = motion, isinstance(sensor, protocols.SeesVelocity)
        self.counts = self.sees_velocity and not protocols.has_velocity_state(motion)
        held = len(motion.columns) if isinstance(motion, protocols.HoldsRate) else 0
        self.clone, self.since = -1, np.zeros(1 + held)
        self.at: Array = np.array(at)  # writable, like all else: numba compiles per kind of array
        self.mount, self.landmark = mount, landmark
        self.pose_dof, self.dimensions = (3, 2) if len(self.at) == 3 else (6, 3)
        self.lags, self.past = lags, np.zeros(1 + self.pose_dof + len(self.at) if lags else 0)
        self.models = self._models(others)
        self.kinds = frozenset(self.models)
        joining = (isinstance(model.landmark, protocols.Joining) for model in self.models.values())
        self.joins = any(joining)  # it observes walls
        self._refuse_misfit()
        self.dof = self._dof()
        self.gate = threshold(self.dof)
        self.robust, self.classes = robust, classes
        self.rho: dict[Id, float] = {}  # inverse distances at which landmarks of these ids start, in place of the prior
        full, self.finds_depth = isinstance(sensor, protocols.FullSensor), finds_depth(sensor)
        any_depth = self.finds_depth or isinstance(landmark, protocols.UnknownDepth) or landmark.kind not in EUCLIDEAN
        self.starts_landmarks = full and any_depth
        placed = all(has_place(model.landmark.space) for model in self.models.values())
        self.gives_places = full and self.finds_depth and placed
        self.gives_distances = protocols.gives_distances(sensor)
        points = any(kind in EUCLIDEAN for kind in self.kinds) and not self.gives_distances
        self.gives_rays = full and points and not (self.finds_depth or self.sees_velocity)
        kind, flat = landmark.kind, self.dimensions == 2
        self.locates = self.gives_places and flat and not self.joins and kind == "point"
        of_space = not flat and (self.gives_distances or (self.gives_places and kind in ("point3", "tag")))
        self.locates_by_ids = self.locates or self.gives_rays or of_space
        self.has_limits, self.fov_rad = isinstance(sensor, protocols.Visible), protocols.field_of_view(sensor)
        segmented = (kind for kind, model in self.models.items() if isinstance(model.landmark, protocols.Segmented))
        self.points = self.kinds - {*segmented}  # kinds of landmarks that are no lines
        self.is_ambiguous = isinstance(sensor, protocols.Ambiguous)
        self.check = sensor.check if isinstance(sensor, protocols.Checked) else None
        self.start_noise = sensor.start_noise if isinstance(sensor, protocols.StartNoise) else None
        varies = isinstance(sensor, protocols.NonAdditiveSensor) and not sensor.additive
        self.noise_at: Any = sensor.noise_at if varies else None  # type: ignore[attr-defined]
        self.far: ObservationModel | None = None  # of poses, for measurements far from what is expected
        if isinstance(sensor, protocols.FarCorrected):
            self.far = ObservationModel(landmark, TagPose(), self.at)
        rays = any(isinstance(model.landmark, AsPoint) for model in self.models.values())
        self.depths = rays and (full or not self.sees_velocity)  # it determines depths; a range rate alone does not
        self.approaches = self.far is not None or self.depths  # what is far from its expectation

    def _models(self, others: Sequence[Landmark]) -> dict[str, ObservationModel]:
        """Return the models of all kinds of blocks that this sensor can observe: its landmarks and those like them."""
        polar = any(other.kind == "polar" for other in others)
        seen = [*(sees_kinds(self.sensor) or ())]
        if self.landmark.kind == "polar" or (self.landmark.kind == "point" and polar):  # whichever a sensor starts
            seen = list(dict.fromkeys([*seen, "point", "polar"]))
        types: list[Any] = [BY_KIND[kind]() for kind in seen if kind != self.landmark.kind]
        if finds_depth(self.sensor) and self.landmark.kind in (*EUCLIDEAN, "polar"):
            types += [AsPoint(ray) for ray in others if self._has_point(ray) and ray.kind not in seen]
        models: dict[str, ObservationModel] = {}
        for landmark in (*types, self.landmark):
            model = ObservationModel(landmark, self.sensor, self.at, self.motion, self.since, self.past)
            models = dict.fromkeys(ALIKE.get(landmark.kind, ()), model) | models | {landmark.kind: model}
        if self.sees_velocity:
            models.pop(ROBOT, None)  # which does not stand still
        return models

    def _has_point(self, other: Landmark) -> bool:
        """Return whether a landmark is a point of unknown depth in the world of this sensor's points."""
        of_depth = isinstance(other, protocols.UnknownDepth) and isinstance(other, protocols.Pointed)
        return of_depth and other.space.world == self.landmark.space.world

    def _refuse_misfit(self) -> None:
        """Refuse a kind of landmark that one of kalmark's own sensors does not observe."""
        sensor, kind = type(self.sensor).__name__, self.landmark.kind
        if self.sees_velocity and self.mount >= 0:
            raise ModelError(f"the mount of a {sensor} has sigmas, expected one that is known")
        if isinstance(self.landmark, InverseDepth2D) and finds_depth(self.sensor):
            raise ModelError(f"a {sensor} does not see the rays to landmarks of unknown depth, {kind}, expected point")
        if not self.models[kind].built_in:
            return
        seen = sees_kinds(self.sensor)
        if seen is not None and kind not in seen:
            raise ModelError(f"a {sensor} does not see a landmark of the type {kind}, expected {' or '.join(seen)}")
        if kind == "polar" and tuple(self.sensor.columns) != ("range_m", "bearing_rad"):
            raise ModelError(f"a {sensor} does not start polar points, expected a sensor of ranges and bearings")
        if kind == Wall2D.kind and seen is None:
            raise ModelError(f"a {sensor} does not see walls, expected a Wall")
        numbers = 3 if "signature" in self.sensor.columns else 4 if kind == "polar" else 2
        if seen is None and numbers != self.landmark.space.size:
            raise ModelError(f"a {sensor} finds {numbers} numbers, a {kind} has {self.landmark.space.size}")

    def _dof(self) -> int:
        """Return the size p of one innovation."""
        if self.models[self.landmark.kind].built_in:
            return int(self.sensor.noise(np.zeros((1, len(self.sensor.columns)))).shape[1])
        return len(self.sensor.angular)

    # ------------------------------------------------------------------ where it is
    def second(self, robot: int) -> int:
        """Return the slot of what the head has behind the robot's pose: state, clone, mount, or -1 for nothing."""
        return self.clone if self.counts else robot if self.sees_velocity else self.mount

    def head(self, map_: Map, robot: int) -> Array:
        """Return the head (h,) of what is observed: the robot's pose and what comes `second`."""
        second, pose = self.second(robot), map_.mean(robot)[: len(self.at)]
        return pose if second < 0 else np.concatenate([pose, map_.mean(second)])

    def velocity(self, map_: Map, robot: int) -> Array:
        """Return the velocity (2 or 3,) of a sensor that measures it, in its frame, of another one nothing (0,)."""
        if not self.sees_velocity:
            return np.zeros(0)
        second, pose = map_.mean(self.second(robot)), map_.mean(robot)[: len(self.at)]
        return velocity_of(self.motion, self.at, pose, second, self.since)[0]

    def observer(self, map_: Map, robot: int) -> Array:
        """Return the observer block (size,): the robot's pose, then mount and parameters if they are in the map."""
        pose = map_.mean(robot)[: len(self.at)]
        return pose if self.mount < 0 else np.concatenate([pose, map_.mean(self.mount)])

    def parts(self, map_: Map, robot: int) -> Parts:
        """Return the blocks that the observer block is made of."""
        pose = (robot, self.pose_dof)
        return (pose,) if self.mount < 0 else (pose, (self.mount, len(map_.rows(self.mount))))

    def split(self, observer: Array) -> tuple[Array, Array, Array]:
        """Return pose, mount, both (3,) or (7,), and the sensor's own parameters (k,) of an observer block.

        The mount of a sensor that lags is where it was when it saw what it shows now.
        """
        size = len(self.at)
        mount = observer[size : 2 * size] if len(observer) > size else self.at
        if self.lags:
            mount = mount_ago(mount, observer[2 * size], self.past)[0]
        return observer[:size], mount, observer[2 * size + self.lags :]

    def composed(self, map_: Map, robot: int) -> tuple[Array, Array, Array]:
        """Return the sensor's pose T (3,) or (7,) in the map's frame, T_r and T_s (dof, dof)."""
        return sensor_pose(*self.split(self.observer(map_, robot))[:2])

    def pose(self, map_: Map, robot: int) -> Array:
        """Return the sensor's pose T, (3,) or (7,), in the map's frame."""
        return self.composed(map_, robot)[0]

    def calibrated(self, map_: Map) -> Any:
        """Return the sensor with its parameters as they are estimated."""
        if self.mount < 0 or len(own := map_.mean(self.mount)[len(self.at) + self.lags :]) == 0:
            return self.sensor
        return self.sensor.with_parameters(own)

    # ------------------------------------------------------------------ what it observes
    def places(self, map_: Map, robot: int, y: Array) -> Array | None:
        """Return where measurements y (K, m) seem to come from (K, 2 or 3); None if they do not determine it."""
        if not self.gives_places:
            return None
        v = self.calibrated(map_).invert(y)[0]
        return self.landmark.from_view(self.pose(map_, robot), v)[0][:, : self.dimensions]

    def in_view(
        self, map_: Map, robot: int, model: ObservationModel, slots: list[int], extents: list[Array | None]
    ) -> Index:
        """Return the indices (K,) of the `slots` in view; `extents` are the segments (2,) of lines, or None."""
        T, l = self.pose(map_, robot), map_.means(np.array(slots), model.d)
        if not isinstance(model.landmark, protocols.Segmented):
            return np.flatnonzero(self.sensor.sees(landmarks_in_frame(model.landmark, T, l)))
        ends = [model.landmark.first_ends if t is None else t for t in extents]
        p, _ = model.landmark.endpoints(l, np.array(ends))
        return np.flatnonzero(self.sensor.sees_segments(T, p[:, 0], p[:, 1])[0])

    def noise(self, map_: Map, robot: int, model: ObservationModel, slots: Index, R: Array, own_noise: bool) -> Array:
        """Return the noise (K, p, p) of observations of blocks: R, unless it varies with their places  [F]."""
        if self.noise_at is None or own_noise:
            return R
        return self.noise_of(map_, robot, model, map_.means(slots, model.d), R, own_noise)

    def noise_of(self, map_: Map, robot: int, model: ObservationModel, l: Array, R: Array, own_noise: bool) -> Array:
        """Return the noise (K, p, p) of observations of landmarks l (K, n): R, unless it varies with their places."""
        if self.noise_at is None or own_noise:
            return R
        return self.noise_at(model.landmark.seen_from(self.pose(map_, robot), l)[0])

    def innovations(self, map_: Map, robot: int, model: ObservationModel, slots: Index, y: Array) -> Array:
        """Return the innovations z (K, p) of y (K, m) from the blocks `slots`."""
        return linearize(model.model, self.head(map_, robot), map_.means(slots, model.d), y)[1]

    def predict(
        self, map_: Map, robot: int, model: ObservationModel, slots: Index, y: Array, R: Array
    ) -> tuple[Array, Array]:
        """Return the innovations' covariance Z (K, p, p) and d2 (K,) of y (K, m) from the blocks `slots`.  [S] (83)."""
        if len(slots) > AT_ONCE and len(set(slots.tolist())) > AT_ONCE:  # a joint marginal is dense
            cuts = [slice(i, i + AT_ONCE) for i in range(0, len(slots), AT_ONCE)]
            parts = [self.predict(map_, robot, model, slots[cut], y[cut], R[cut]) for cut in cuts]
            return np.concatenate([Z for Z, _ in parts]), np.concatenate([d2 for _, d2 in parts])
        return model.predict(*map_.marginal(robot, self.second(robot), slots), y, R)

    def landmark_of(
        self, map_: Map, robot: int, y: Array, R: Array, own_noise: bool, which: int = 0, id_: Id | None = None,
        way: float = 0.0,
    ) -> tuple[Array, Array, Array]:  # fmt: skip
        """Return the landmark l (n,) that explains a measurement y (1, m) with the noise R, L_h and Q.  [S] (32)-(35).

        L_h (., 3 or more) is with respect to the observer block, Q = L_y R L_y' + prior.  Of two landmarks that explain
        it, `which` is taken.  Of an unknown depth the nearest landmark of the prior is at least at twice a `way`.
        """
        observer = self.observer(map_, robot)
        r, mount, own = self.split(observer)
        sensor = self.calibrated(map_)
        v, V_y = (a[:, which] for a in sensor.both(y)[:2]) if self.is_ambiguous else sensor.invert(y)
        rho = self.rho.get(id_) if id_ is not None else None
        landmark: Any = self.landmark if rho is None else replace(self.landmark, prior_rho_per_m=rho)  # type: ignore[type-var]
        if way > 0.0:
            rho, sigma = landmark.prior_rho_per_m, landmark.sigma_rho_per_m
            by = min(0.5 / (way * (rho + 2.0 * sigma)), 1.0)
            landmark = replace(landmark, prior_rho_per_m=by * rho, sigma_rho_per_m=by * sigma)
        l, L_r, L_s, L_y, prior = landmark_at(r, mount, landmark, v, V_y, self.finds_depth)
        if self.noise_at is not None and not own_noise:
            R = self.noise_at(self.sensor.invert(y)[0])[0]
        if self.start_noise is not None and not own_noise:
            R = self.start_noise(y)[0]
        if self.lags:
            size = len(self.at)
            _, B_s, B_lag = mount_ago(observer[size : 2 * size], observer[2 * size], self.past)
            L_h = np.concatenate([L_r[0], L_s[0] @ B_s, L_s[0] @ B_lag], axis=1)
        else:
            L_h = L_r[0] if self.mount < 0 else np.concatenate([L_r[0], L_s[0]], axis=1)
        if len(own):  # y = h(v, p) stays what it is: V_p = -V_y E_p
            L_h = np.concatenate([L_h, -L_y[0] @ sensor.parameters_jacobian(v)[0]], axis=1)
        return l[0], L_h, kernels.quadratic(L_y[0], np.array(R, dtype=np.float64)) + prior[0]


def landmarks_in_frame(landmark: Landmark, T: Array, l: Array) -> Array:
    """Return landmarks l (K, n) in the frame T, v (K, d) as `sees` takes them."""
    v = landmark.seen_from(T, l)[0]
    if isinstance(landmark, InverseDepth2D):  # a ray, as long as rho times the distance
        v = v / np.maximum(l[:, -1:], TINY_RHO)
    return v


def default_landmark(sensor: Sensor, at: Array, calibrated: bool, delayed: bool) -> Landmark:
    """Return the type of landmark that a sensor at `at` (3,) or (7,) starts by default.

    Homogeneous points move with steps of the robot (`generator`), not with those of a mount: a mount's place that
    cannot be observed would seem to be.  Stereo pixels are linear in an inverse distance, not in a distance: with a
    mount in the map, the bias of poor depths would end up there.
    """
    if "size_m" in sensor.columns or "qw" in sensor.columns:
        return Tag()
    measured = sees_kinds(sensor) or ()
    if len(at) == 3:
        alone: dict[tuple[str, ...], Landmark] = {(kind.kind,): kind() for kind in (Wall2D, PointHeight2D)}
        if measured in alone:
            return alone[measured]
        if not finds_depth(sensor) and not delayed:
            return InverseDepth2D()
        if "signature" in sensor.columns:
            return PointSignature2D()
        return Polar2D() if _arcs_matter(sensor) else Point2D()
    if measured and "point3" not in measured:
        return kinds.AnchoredHomogeneousLine()
    anchored = kinds.AnchoredHomogeneous()
    if finds_depth(sensor):
        return anchored if calibrated and anchored.kind in measured else Point3D()
    return anchored if calibrated else kinds.Homogeneous()


def _arcs_matter(sensor: Sensor) -> bool:
    """Return whether the arc of a bearing's sigma leaves its tangent by half a sigma of the range, far away."""
    if not isinstance(sensor, RangeBearing) or np.isinf(d := protocols.range_limit(sensor)):
        return False
    return bool(d * sensor.sigma_bearing_rad**2 > np.sqrt(sensor.range_variance(np.array([[d]]))[0]))
