"""A sensor on its mount as the filter sees it, and what an association may ask about one of its scans."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np
import numpy.typing as npt

from kalmark.association.index import Pairs, has_place
from kalmark.association.protocol import ANEW, DEFERRED, NEW, Association
from kalmark.association.together import Landmarks
from kalmark.errors import ModelError
from kalmark.events import Id, Scan
from kalmark.filter import corrections, kernels
from kalmark.filter.estimators import Map
from kalmark.filter.map import StochasticMap
from kalmark.filter.observed import add_blocks, observed_block
from kalmark.filter.reading import AT_ONCE
from kalmark.management.candidates import Waiting
from kalmark.management.delayed import Delayed
from kalmark.management.initialization import initialization_of
from kalmark.management.upkeep import Upkeep
from kalmark.models import landmarks as kinds
from kalmark.models.landmarks import InverseDepth2D
from kalmark.models.observe import composed, is_built_in, landmark_at, linearize, view_of
from kalmark.models.protocols import FullSensor, Landmark, NonAdditiveSensor
from kalmark.models.sensors import TagPose
from kalmark.report import Compared, Report
from kalmark.tracks.natural import natural
from kalmark.tracks.robot import Mount

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

ROBOT = "robot"
ALIKE = {"point": ("point_signature", ROBOT), "point3": (ROBOT,), "tag": (ROBOT,)}  # what else one view applies to
EUCLIDEAN = ("point", "point3")
TINY_RHO = 1e-9  # 1 / m: as good as infinitely far
BY_KIND = {kind.kind: kind for kind in kinds.BUILT_IN}


@dataclass(frozen=True, eq=False)
class Look:
    """How a sensor on a mount `at` sees landmarks of one type."""

    landmark: Landmark
    sensor: Any
    at: Array

    @cached_property
    def view(self) -> Any:
        """What `linearize` takes.  Made when it is first needed: models that are built in are compiled then."""
        return view_of(self.sensor, self.landmark, self.at)

    @cached_property
    def built_in(self) -> bool:
        """Whether sensor and landmark are kalmark's own."""
        return is_built_in(self.sensor, self.landmark)

    @cached_property
    def d(self) -> int:
        """How many of the landmark's numbers are seen."""
        return self.landmark.space.size

    def predict(
        self, m: StochasticMap, robot: int, mount: int, slots: Index, y: Array, R: Array
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return the innovations' covariance Z (K, p, p) and d2 (K,) of y (K, m) from the blocks `slots`.  [S] (83)."""
        run = corrections.compiled_compared if isinstance(self.view, tuple) else corrections.compared
        scan = robot, mount, slots, self.d, y, np.ascontiguousarray(R), math.inf
        return run(self.view, (m.x, m.P, m.n, m.blocks, m.atoms, m.axes), scan)

    def __getstate__(self) -> dict[str, Any]:
        """Return all but the view, whose addresses mean nothing to another process."""
        return {name: value for name, value in self.__dict__.items() if name != "view"}


class View:
    """A mounted sensor with its landmark type and gate, ready for the kernels."""

    def __init__(self, mount: Mount, landmarks: Landmark | None, slam: Slam, slot: int) -> None:
        self.sensor, self.attention, self.detector = mount.sensor, mount.attention, mount.detector
        self.at: Array = np.array(mount.at)  # writable, like all else: numba compiles per kind of array
        self.mount = slot  # of the mount in the map, -1 if it is not there
        self.landmark: Landmark = mount.landmark or landmarks or natural(mount)
        late = mount.initialization
        self.delayed, self.waiting = late if isinstance(late, Delayed) else None, Waiting()
        slam.refuse_other_world(type(self.sensor).__name__, getattr(self.sensor, "world", ""))
        slam.refuse_other_world(self.landmark.kind, self.landmark.space.world)
        self.association = mount.association or slam.association
        self.upkeep = mount.upkeep or slam.upkeep
        self.averages = getattr(self.association, "averages", False)
        self.starts = _starts(self.association, self.upkeep)
        mounts = [mount for robot in slam.robots.values() for mount in robot.sensors.values()]
        self.looks = self._looks(any((m.landmark or landmarks or natural(m)).kind == "polar" for m in mounts))
        self.kinds = frozenset(self.looks)
        self._refuse_misfit()
        self.dof = self._dof()
        self.gate = self.association.threshold(self.dof, slam.estimator.default_gate)
        depth = getattr(self.sensor, "finds_depth", True) or hasattr(self.landmark, "prior_rho_per_m")
        starts = isinstance(self.sensor, FullSensor) and (depth or self.landmark.kind not in EUCLIDEAN)
        self.initialization = initialization_of(mount, starts)
        full = isinstance(self.sensor, FullSensor) and getattr(self.sensor, "finds_depth", True)
        self.tells_places = full and all(has_place(look.landmark.space) for look in self.looks.values())
        varies = isinstance(self.sensor, NonAdditiveSensor) and not self.sensor.additive
        self.noise_at = self.sensor.noise_at if varies else None  # type: ignore[attr-defined]
        kinds_ = [look.landmark for look in self.looks.values()]
        self.changes = self.attention.delete or any(hasattr(k, "linearity") or hasattr(k, "extend") for k in kinds_)
        self.rough: Look | None = None  # how to come near to what is far away: `approach`
        if hasattr(self.sensor, "is_far"):
            self.rough = Look(self.landmark, TagPose(), self.at)

    def _looks(self, polar: bool) -> dict[str, Look]:
        """Return the looks at all kinds of blocks that this sensor can see: its own landmarks and those like them."""
        seen = [*getattr(self.sensor, "sees_kinds", ())]
        if self.landmark.kind == "polar" or (self.landmark.kind == "point" and polar):  # whichever a sensor starts
            seen = list(dict.fromkeys([*seen, "point", "polar"]))
        types = [BY_KIND[kind]() for kind in seen if kind != self.landmark.kind]
        looks: dict[str, Look] = {}
        for landmark in (*types, self.landmark):
            look = Look(landmark, self.sensor, self.at)
            looks |= {kind: look for kind in (landmark.kind, *ALIKE.get(landmark.kind, ()))}
        return looks

    def _refuse_misfit(self) -> None:
        """Refuse a kind of landmark that one of kalmark's own sensors does not see."""
        sensor, kind = type(self.sensor).__name__, self.landmark.kind
        if isinstance(self.landmark, InverseDepth2D) and getattr(self.sensor, "finds_depth", True):
            raise ModelError(f"a {sensor} does not see the rays to landmarks of unknown depth, {kind}, expected point")
        if self.delayed is not None and not (hasattr(self.sensor, "meet") and kind == "point"):
            raise ModelError(
                f"a {sensor} does not start a {kind} late: expected one that has meet(), and points of the plane"
            )
        if not self.looks[kind].built_in:
            return
        seen = getattr(self.sensor, "sees_kinds", None)
        if seen is not None and kind not in seen:
            raise ModelError(f"a {sensor} does not see a landmark of the type {kind}, expected {' or '.join(seen)}")
        if kind == "polar" and tuple(self.sensor.columns) != ("range_m", "bearing_rad"):
            raise ModelError(f"a {sensor} does not start polar points, expected a sensor of ranges and bearings")
        numbers = 3 if "signature" in self.sensor.columns else 4 if kind == "polar" else 2
        if seen is None and numbers != self.landmark.space.size:
            raise ModelError(f"a {sensor} finds {numbers} numbers, a {kind} has {self.landmark.space.size}")

    def _dof(self) -> int:
        """Return the size p of one innovation."""
        if self.looks[self.landmark.kind].built_in:
            return int(self.sensor.noise(np.zeros((1, len(self.sensor.columns)))).shape[1])
        return len(self.sensor.angular)

    def head(self, map_: Map, robot: int) -> Array:
        """Return the robot's pose, followed by the mount's and the sensor's own parameters if they are in the map."""
        pose = map_.mean(robot)[: len(self.at)]
        return pose if self.mount < 0 else np.concatenate([pose, map_.mean(self.mount)])

    def head_index(self, map_: Map, robot: int) -> Index:
        """Return the rows of the robot's pose and, if it is in the map, of the mount."""
        pose = map_.index(robot)[: 3 if len(self.at) == 3 else 6]
        return pose if self.mount < 0 else np.concatenate([pose, map_.index(self.mount)])

    def pose(self, map_: Map, robot: int) -> Array:
        """Return the sensor's pose T in the map's frame."""
        head = self.head(map_, robot)
        size = len(self.at)
        return composed(head[:size], head[size : 2 * size] if len(head) > size else self.at)[0]

    def calibrated(self, map_: Map) -> Any:
        """Return the sensor with the parameters that it has by now."""
        if self.mount < 0 or len(own := map_.mean(self.mount)[len(self.at) :]) == 0:
            return self.sensor
        return self.sensor.with_parameters(own)  # type: ignore[attr-defined]

    def places(self, map_: Map, robot: int, y: Array) -> Array | None:
        """Return where measurements y (K, m) seem to come from (K, 2 or 3); None if this sensor does not tell."""
        if not self.tells_places:
            return None
        sensor = self.calibrated(map_)
        return self.landmark.from_view(self.pose(map_, robot), sensor.invert(y)[0])[0][
            :, : 2 if len(self.at) == 3 else 3
        ]

    def in_sight(self, map_: Map, robot: int, look: Look, slots: list[int], ends: list[Any]) -> Index:
        """Return which of the blocks `slots` the sensor should see now; `ends` are those of the segments of lines."""
        T, l = self.pose(map_, robot), map_.means(np.array(slots), look.d)
        sensor: Any = self.sensor
        if not hasattr(look.landmark, "endpoints"):
            v = look.landmark.seen_from(T, l)[0]
            if isinstance(look.landmark, InverseDepth2D):  # a ray, as long as rho times the distance
                v = v / np.maximum(l[:, -1:], TINY_RHO)
            return np.flatnonzero(sensor.sees(v))
        p, _ = look.landmark.endpoints(l, np.array(ends))
        return np.flatnonzero(sensor.sees_segments(T, p[:, 0], p[:, 1])[0])

    def noise(self, map_: Map, robot: int, look: Look, slots: Index, R: Array, event: Scan) -> Array:
        """Return the noise of observations of the blocks `slots`: R, unless it depends on where they are  [F]."""
        if self.noise_at is None or event.cov is not None:
            return R
        return self.noise_at(look.landmark.seen_from(self.pose(map_, robot), map_.means(slots, look.d))[0])

    def innovation_of(self, map_: Map, robot: int, look: Look, slots: Index, y: Array) -> Array:
        """Return the innovations z (K, p) of y (K, m) from the blocks `slots`."""
        return linearize(look.view, self.head(map_, robot), map_.means(slots, look.d), y)[1]

    def predict(self, map_: Map, robot: int, look: Look, slots: Index, y: Array, R: Array) -> tuple[Array, Array]:
        """Return the innovations' covariance Z (K, p, p) and d2 (K,) of y (K, m) from the blocks `slots`.  [S] (83)."""
        if len(slots) > AT_ONCE and len(set(slots.tolist())) > AT_ONCE:  # an excerpt is dense
            cuts = [slice(i, i + AT_ONCE) for i in range(0, len(slots), AT_ONCE)]
            parts = [self.predict(map_, robot, look, slots[cut], y[cut], R[cut]) for cut in cuts]
            return np.concatenate([Z for Z, _ in parts]), np.concatenate([d2 for _, d2 in parts])
        return look.predict(*map_.excerpt(robot, self.mount, slots), y, R)

    def information(
        self, map_: Map, robot: int, look: Look, slots: Index, event: Scan, rows: list[int], R: Array
    ) -> Array:
        """Return how much the observations `rows` tell of the blocks `slots`: log |Z| / |R| (K,), -inf if unknown."""
        noise = self.noise(map_, robot, look, slots, R, event)
        Z, _ = self.predict(map_, robot, look, slots, event.y[rows], noise)
        return np.nan_to_num(np.linalg.slogdet(Z)[1] - np.linalg.slogdet(noise)[1], nan=-np.inf)

    def explain(
        self, map_: Map, robot: int, event: Scan, k: int, R: Array, which: int = 0
    ) -> tuple[Array, Array, Array]:
        """Return the landmark (n,) that explains the k-th observation, whose noise is R, and how it came about.

        L_h (., 3 or more) with respect to the head, and Q = L_y R L_y' + prior.  [S] (32)-(35).  Of two that do,
        `which` is taken.
        """
        y = event.y[k : k + 1]
        head, size = self.head(map_, robot), len(self.at)
        r, mount = head[:size], head[size : 2 * size] if self.mount >= 0 else self.at
        sensor = self.calibrated(map_)
        v, V_y = (a[:, which] for a in sensor.both(y)[:2]) if hasattr(sensor, "both") else sensor.invert(y)
        depth = getattr(sensor, "finds_depth", True)
        l, L_r, L_s, L_y, prior = landmark_at(r, mount, self.landmark, v, V_y, depth)
        if self.noise_at is not None and event.cov is None:
            R = self.noise_at(self.sensor.invert(y)[0])[0]  # type: ignore[attr-defined]
        if hasattr(self.sensor, "start_noise"):
            R = (
                self.sensor.start_noise(y)[0]
                if event.cov is None
                else np.broadcast_to(event.cov, (len(event.y), 4, 4))[k]
            )
        L_h = L_r[0] if self.mount < 0 else np.concatenate([L_r[0], L_s[0]], axis=1)
        if len(head) > 2 * size:  # y = h(v, p) stays what it is: V_p = -V_y E_p
            L_h = np.concatenate([L_h, -L_y[0] @ sensor.parameters_jacobian(v)[0]], axis=1)
        return l[0], L_h, L_y[0] @ R @ L_y[0].T + prior[0]


def _starts(association: Association, upkeep: Upkeep) -> tuple[Any, ...]:
    """Return the answers to an observation without an id that start a landmark.

    An association that weighs matchings defers what may be one of several landmarks: that is none to be mapped anew.
    """
    if not upkeep.hold_back:
        return (NEW,)
    return (NEW, ANEW) if getattr(association, "weighs", False) else (NEW, ANEW, DEFERRED)


class Scene:
    """One scan before it is fused: the association's window on the map."""

    def __init__(self, slam: Slam, view: View, event: Scan, ids: tuple[Id | None, ...], R: Array) -> None:
        self.ids, self.y, self.robot = ids, event.y, event.robot
        self._slam, self._view, self._event, self._R = slam, view, event, R
        self._pairs: Pairs | None = None  # that were near each other when candidates were asked for,
        self._names: list[Id] = []  # and the landmarks of these
        self.seen_at: Array | None = None  # where the observations seem to come from, once that was asked for
        self.compared: Compared | None = None  # by the last question for `distances`

    def dof(self) -> int:
        """Return the size p of one innovation."""
        return self._view.dof

    def experience(self) -> tuple[float, float]:
        """Return how many of the last observations without ids were of landmarks of the map, and how many were not."""
        known, unknown = self._slam.members.experience
        return known, unknown

    def learn(self, known: float, unknown: float) -> None:
        """Remember how many observations without ids are likely of landmarks of the map, and how many are not."""
        self._slam.members.learn(known, unknown)

    def key(self) -> tuple[int, ...]:
        """Return numbers, at least 0, that tell this scan from all others."""
        event = self._event
        return event.t_ns % 2**63, crc32(event.robot.encode()), crc32(event.sensor.encode())

    def candidates(self, nearest: int = 4, farther: float = 10.0) -> list[Id]:
        """Return the ids of the landmarks that this sensor could have seen where these observations seem to come from.

        That is the `nearest` ones to each place, but none so many times `farther` than the nearest.  A sensor that does
        not tell where its measurements come from could have seen any.
        """
        view, members = self._view, self._slam.members
        robot = members.slots[self._event.robot]
        places = view.places(self._slam.map, robot, self._event.y)
        if places is None:
            return members.in_reach(view)
        self.seen_at, head = places, (robot, view.mount)
        self._pairs = self._slam.nearby.pairs(self._slam, view.kinds, head, places, nearest, farther)
        self._names = [members.names[slot] for slot in self._pairs.slots.tolist()]
        return self._names.copy()

    def distances(self, candidates: list[Id]) -> Array:
        """Return the squared Mahalanobis distances (K, L) of the observations from the candidates.  [S] (83).

        inf where a candidate is not near an observation.
        """
        d2 = np.full((len(self.y), len(candidates)), np.inf)
        if self._pairs is None:
            slots = self._slam.members.slots_of(candidates)
            rows, numbers = (a.ravel() for a in np.indices(d2.shape))
            d2[rows, numbers] = self._squared(Pairs(rows, numbers, slots, np.zeros((len(slots), 0)), None), candidates)
            return d2
        pairs, columns = self._pairs, self._pairs.numbers
        if candidates != self._names:
            at = {name: i for i, name in enumerate(candidates)}
            columns = np.array([at.get(name, -1) for name in self._names], dtype=np.int64)[columns]
            asked = columns >= 0
            columns, pairs = columns[asked], pairs._replace(rows=pairs.rows[asked], numbers=pairs.numbers[asked])
        d2[pairs.rows, columns] = squared = self._squared(pairs, self._names)
        self.compared = Compared(pairs.rows, pairs.numbers, self._names, squared, pairs.places)
        return d2

    def _squared(self, pairs: Pairs, names: list[Id]) -> Array:
        """Return the squared distances (M,) of pairs of an observation and a landmark."""
        view, event, out = self._view, self._event, np.empty(len(pairs.rows))
        map_, robot = self._slam.map, self._slam.members.slots[event.robot]
        for look, which in self._slam.members.by_look(view, names):
            some = slice(None) if len(which) == len(names) else np.isin(pairs.numbers, which)
            k, l = pairs.rows[some], pairs.numbers[some]
            y, R = event.y[k], view.noise(map_, robot, look, pairs.slots[l], self._R[k], event)
            if pairs.excerpt is None:
                out[some] = view.predict(map_, robot, look, pairs.slots[l], y, R)[1]
            else:
                m, robot_here, mount, here = pairs.excerpt
                out[some] = look.predict(m, robot_here, mount, here[l], y, R)[1]
        return out

    def report(self) -> Report:
        """Return a report of what was compared, before anything is fused."""
        report = Report(self._event, self.y)
        if self.seen_at is not None:
            report.seen_at, report.compared = self.seen_at, self.compared
        return report

    def jointly(self, rows: Index, names: list[Id]) -> tuple[Array, Array]:
        """Return the innovations z (M, p) of M pairs of an observation and a landmark, and their Z (M p, M p).

        The noise of an observation is in the blocks of its pairs, not between them: only one of them can be right.
        """
        view, event, p = self._view, self._event, self._view.dof
        map_, robot = self._slam.map, self._slam.members.slots[event.robot]
        slots = self._slam.members.slots_of(names)
        m, robot_here, mount, here = map_.excerpt(robot, view.mount, slots)
        z, R, H, at = np.empty((len(rows), p)), np.empty((len(rows), p, p)), [], []
        for look, which in self._slam.members.by_look(view, names):
            index, _, mean = observed_block(m.x, m.blocks, m.atoms, robot_here, mount, here[which], look.d)
            head = len(mean) - look.d * len(which)
            l = mean[head:].reshape(len(which), look.d)
            _, z[which], E_h, E_l = linearize(look.view, mean[:head], l, event.y[rows[which]])
            R[which] = view.noise(map_, robot, look, slots[which], self._R[rows[which]], event)
            H += [(i, E_h[k], E_l[k]) for k, i in enumerate(which)]
            h, d = E_h.shape[2], E_l.shape[2]
            at += [np.concatenate([index[:h], index[h + k * d : h + (k + 1) * d]]) for k in range(len(which))]
        index = np.concatenate(at)
        S, starts = kernels.submatrix(m.P, index), np.cumsum([0, *(len(a) for a in at)])
        J = np.zeros((z.size, len(index)))
        for (i, E_h, E_l), start, end in zip(H, starts[:-1], starts[1:], strict=True):
            J[i * p : (i + 1) * p, start:end] = np.hstack([E_h, E_l])
        Z = J @ S @ J.T
        add_blocks(Z, R)
        return z, Z

    def together(self, names: list[Id]) -> Landmarks | None:
        """Return landmarks to be asked about jointly; None if of several kinds, or if this sensor tells no place."""
        sorts = {self._slam.members.sorts[name] for name in names}
        if not self._view.tells_places or len(sorts) > 1:
            return None
        read = None if self._pairs is None else self._pairs.excerpt
        if read is not None and names != self._names:
            at = {name: i for i, name in enumerate(self._names)}
            read = (*read[:3], read[3][[at[name] for name in names]]) if at.keys() >= set(names) else None
        return Landmarks(self._slam, self._view, self._event, names, self._R, read)
