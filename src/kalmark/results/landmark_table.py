"""The places that landmarks are at: Euclidean points, the endpoints of lines, the poses of tags, with covariances.

A place is a row of numbers, and its covariance that of its error:

==========  ==============================  ==========================  =====
kind        place                           error                       sizes
==========  ==============================  ==========================  =====
point       x y z                           x y z                       3, 3
line        both endpoints, x y z x2 y2 z2  the same                    6, 6
wall        both endpoints, x y x2 y2       the same                    4, 4
tag         x y z qx qy qz qw               x y z, rotation vector      7, 6
==========  ==============================  ==========================  =====

Whatever else a landmark is in the map (inverse depth, homogeneous, Pluecker), its model has its position: by `place`,
lines by `endpoints` at the abscissas of their ends (`kalmark.models.protocols.HasPlace`, `Segmented`).
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from kalmark.arrays import Array, block_diagonal
from kalmark.declare import is_own
from kalmark.errors import KalmarkError, RunError
from kalmark.events import Id
from kalmark.files import csv_text
from kalmark.geometry.spaces import SCALAR, SE3, VECTOR, VECTOR3
from kalmark.logs.known_map import cov_names, errors_of, from_triangle
from kalmark.logs.native import LANDMARK3
from kalmark.logs.native import WALL as WALL_COLUMNS
from kalmark.logs.table_columns import POSE3, POSITION
from kalmark.models.landmarks import Point2D, PointHeight2D, Wall2D
from kalmark.models.protocols import Landmark, Segmented, place_of
from kalmark.results.gauge import Datum, generators
from kalmark.results.history import Ints, as_id, padded_all

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam

POINT, WALL, LINE, TAG = 3, 4, 6, 7
DATUM = 128  # landmarks
UNSEEN = "not seen again"
TINY = 1e-30
EUCLIDEANS, OTHERS, LINES = range(3)  # groups of what is drawn alike
# kinds whose state is their place; others (inverse depth, for example) are not well known yet
EUCLIDEAN = ("", "point", "point3", "point_signature", "point_height", "tag")
_PLANE = {"point_signature": (*POSITION[:2], "signature"), "point_height": POSITION, "wall": WALL_COLUMNS}
_PLACES = (*LANDMARK3, "signature")
_SPACE = {POINT: POSITION, LINE: LANDMARK3[:6], TAG: POSE3}


def places(
    model: Landmark | None, means: Array, covariances: Array, ends: Sequence[Array | None]
) -> tuple[Array, Array] | None:
    """Return the places and covariances of the states (K, n) of landmarks of one model.

    `ends` (K of (2,)) are the abscissas of lines' ends.  The pose of a tag and a point of the plane, with its
    signature or height, are their own places.  None if a model has no position.
    """
    if model is None or model.space.kinds == SE3.kinds or isinstance(model, Point2D):
        return means, covariances
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        found = _places_of_states(model, means, ends)
        if found is None:
            return None
        p, P_l = found
        covariances = P_l @ covariances @ P_l.swapaxes(1, 2)
    return np.where(np.isfinite(p), p, np.inf), np.where(np.isfinite(covariances), covariances, np.inf)


def _places_of_states(model: Landmark, means: Array, ends: Sequence[Array | None]) -> tuple[Array, Array] | None:
    """Return the places (K, n) of states (K, n') and their Jacobians (K, m, dof), None if a model has no position."""
    if not isinstance(model, Segmented):
        return place_of(model, means)
    p, P_l = model.endpoints(means, np.array([model.first_ends if t is None else t for t in ends]))
    return p.reshape(len(means), -1), P_l.reshape(len(means), p[0].size, -1)


class Shapes(NamedTuple):
    """The drawing of a map: Gaussian points (of lines both endpoints), `lines` (L, 2, d) and `tags` (T, 7).

    Of the points: which landmark each belongs to (K,), `means` (K, d), `covariances` (K, d, d), and as its `group`
    whether it is of a Euclidean landmark (0), another (1) or a line (2).
    """

    row: Ints
    means: Array
    covariances: Array
    lines: Array
    tags: Array
    group: Ints


def shapes(means: Array, covariances: Array, kinds: Sequence[str], d: int = 3) -> Shapes:
    """Sort the places (K, n) of landmarks, padded with NaN, and covariances (K, q, q), by what they are.

    In the plane (d = 2) all are points or walls.
    """
    size = (~np.isnan(means)).sum(axis=1)
    lines, tags = np.flatnonzero(size == 2 * d), np.flatnonzero(size == TAG)
    row = np.concatenate([np.arange(len(means)), lines])
    ends, P = means[lines, : 2 * d].reshape(-1, 2, d), covariances[lines, d : 2 * d, d : 2 * d].reshape(-1, d, d)
    return Shapes(
        row,
        np.concatenate([means[:, :d].reshape(-1, d), ends[:, 1, :d]]),
        np.concatenate([covariances[:, :d, :d].reshape(-1, d, d), P]),
        ends,
        means[tags, :TAG].reshape(-1, TAG),
        np.where(np.isin(row, lines), LINES, np.where(np.isin(kinds, EUCLIDEAN), EUCLIDEANS, OTHERS)[row]),
    )


def _ends(places: Array, d: int) -> Array:
    """Return the points (K, 1, d) of places (K, n), of lines both ends (K, 2, d)."""
    return places.reshape(len(places), 2, d) if places.shape[1] == 2 * d else places[:, None, :d]


def across_line(ends: Array) -> Array:
    """Return the projection (d, d) across the line through two ends (2, d)."""
    u = ends[1] - ends[0]
    return np.eye(len(u)) - np.outer(u, u) / max(float(u @ u), TINY)


def _motions(places: Array, d: int, size: int, origin: Array) -> Array:
    """Return how the errors (K, size) of places (K, n) move, (K, size, q), with the world about an origin."""
    G = generators(_ends(places, d).reshape(-1, d), origin)
    whole = G if d == 3 and places.shape[1] == TAG else G[:, :d].reshape(len(places), -1, G.shape[2])
    return np.pad(whole, ((0, 0), (0, size - whole.shape[1]), (0, 0)))


def place_and_jacobian(model: Landmark, l: Array, ends: Array | None = None) -> tuple[Array, Array] | None:
    """Return the place (m,) of a landmark's state l (n,) and its Jacobian (m, dof) in the landmark's error.

    `ends` (2,) are the abscissas of a line's ends.  None if its model has no position.
    """
    if model.kind in EUCLIDEAN:
        return l, np.eye(model.space.dof)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        found = _places_of_states(model, l[None], [ends])
    return None if found is None else (found[0][0], found[1][0])


def _place_jacobian(slam: Slam, name: Id) -> Array:
    """Return the Jacobian (m, dof) of a landmark's place in its error."""
    model = slam.landmark_model(name)
    assert model is not None  # it is in the map
    found = place_and_jacobian(model, slam.mean(name), slam.segment_ends(name))
    return np.eye(model.space.dof) if found is None else found[1]


def _crosses(slam: Slam, names: Sequence[Id], others: Sequence[Id]) -> Iterator[tuple[Id, Array]]:
    """Yield the cross-covariance (dof, n) of each of some robots and landmarks with others, all of these."""
    among = set(others)
    rest = [name for name in names if name not in among]
    for first in range(0, len(rest), DATUM):
        some = rest[first : first + DATUM]
        yield from _parts(slam, some, slam.covariance(*some, *others), len(some))
    yield from _parts(slam, others, slam.covariance(*others), 0)


def _parts(slam: Slam, names: Sequence[Id], P: Array, before: int) -> Iterator[tuple[Id, Array]]:
    """Yield the rows of each name in a joint covariance, without the columns of the names before the others."""
    ends = np.cumsum([0, *(len(slam.map.rows(slam.slot(name))) for name in names)]).tolist()
    for name, first, end in zip(names, ends, ends[1:], strict=False):
        yield name, P[first:end, ends[-1] if before else 0 :]


@dataclass(frozen=True)
class MapLandmarks:
    """The landmarks of a map: ids, kinds, places with covariances and how often each was observed.

    The place of a landmark is its position in the plane, its position, endpoints or pose in space, whatever its state
    in the map is (`kalmark.results.landmark_table`); NaN if its model has no position.  `exact` are those
    known exactly beforehand, which the filter had outside its map.  `log_odds` are those that a landmark exists, of the
    landmarks that were looked at again, and `unseen` those that were not seen again where they should be.  `classes`
    have the likeliest class of those of which one was reported, and how likely it is.
    """

    ids: list[Id]
    kinds: list[str]
    means: list[Array]
    covariances: list[Array]
    observations: list[int]
    in_space: bool = False
    exact: frozenset[Id] = frozenset()
    log_odds: Mapping[Id, float] = field(default_factory=dict)
    unseen: frozenset[Id] = frozenset()
    classes: Mapping[Id, tuple[str, float]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<MapLandmarks: {len(self)}, known exactly {len(self.exact)}>"

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def d(self) -> int:
        """The dimensions of the robots' world, 2 or 3."""
        return 3 if self.in_space else 2

    @classmethod
    def of(cls, slam: Slam, *, exactly_known: bool = True) -> MapLandmarks:
        """Return the places of the landmarks of a filter's map, and of those known exactly beside it."""
        table = slam.landmarks(exactly_known=exactly_known)
        in_space = any(robot.motion.space.world == "space" for robot in slam.robots.values())
        d = 3 if in_space else 2
        means, covariances = [np.full(d, np.nan)] * len(table), [np.full((d, d), np.nan)] * len(table)
        of_models: dict[int, list[int]] = defaultdict(list)
        models = [slam.landmark_model(i) for i in table.ids]
        for k, model in enumerate(models):
            of_models[id(model)].append(k)
        for rows in of_models.values():
            states = np.array([table.means[k] for k in rows]), np.array([table.covariances[k] for k in rows])
            found = places(models[rows[0]], *states, [slam.segment_ends(table.ids[k]) for k in rows])
            for k, mean, covariance in zip(rows, *found, strict=True) if found is not None else ():
                means[k], covariances[k] = mean, covariance
        observations = [int(count) for count in table.observations]
        exact = frozenset(name for name in table.ids if slam.is_known(name))
        classes = {name: max(own.items(), key=itemgetter(1)) for name in table.ids if (own := slam.classes(name))}
        of = means, covariances, observations, in_space, exact, table.log_odds, table.unseen, classes
        return cls(list(table.ids), list(table.kinds), *of)

    def shape(self, slam: Slam, robots: Sequence[str]) -> tuple[MapLandmarks, Array]:
        """Return the map with the covariances of its shape, and those (R, d, d) of the robots' positions.

        The datum are at most `DATUM` landmarks, evenly chosen by their certainty.
        """
        d, (points, P) = self.d, self.positions()
        exact = np.array([name in self.exact for name in self.ids], dtype=np.bool_)
        sigma = np.where(np.isfinite(points).all(axis=1) & ~exact, np.trace(P, axis1=1, axis2=2), np.inf)
        order = np.argsort(sigma, kind="stable")[: np.isfinite(sigma).sum()]
        own = np.array([slam.covariance(name)[:d, :d] for name in robots]).reshape(-1, d, d)
        if not len(order):
            return self, own
        some = order[np.unique(np.linspace(0, len(order) - 1, min(DATUM, len(order))).round().astype(int))].tolist()
        ends, names = [_ends(self.means[k][None], d)[0] for k in some], [self.ids[k] for k in some]
        to_place = {k: _place_jacobian(slam, self.ids[k]) for k in order.tolist()}
        J = block_diagonal([to_place[k][: e.size] for k, e in zip(some, ends, strict=True)])
        across = np.concatenate([[across_line(e) if len(e) > 1 else np.eye(d)] * len(e) for e in ends])
        datum = Datum.of(np.concatenate(ends), across, J @ slam.covariance(*names) @ J.T, points[exact])
        onto = (datum.T @ J).T
        X = {name: C @ onto for name, C in _crosses(slam, [*robots, *(self.ids[k] for k in to_place)], names)}
        out = self._shapes(datum, d, {k: J_k @ X[self.ids[k]] for k, J_k in to_place.items()})
        G = generators(np.array([slam.mean(name)[:d] for name in robots]).reshape(-1, d), datum.origin)[:, :d]
        own = datum.shape(G, own, np.array([X[name][:d] for name in robots]).reshape(G.shape))
        return replace(self, covariances=out), own

    def _shapes(self, datum: Datum, d: int, X: Mapping[int, Array]) -> list[Array]:
        """Return the covariances of the map, of the rows in X = C T' those of their shape; all of one size at once."""
        out, alike = list(self.covariances), defaultdict[tuple[int, ...], list[int]](list)
        for k in X:
            alike[len(self.means[k]), len(out[k])].append(k)
        for (_, size), rows in alike.items():
            G = _motions(np.array([self.means[k] for k in rows]), d, size, datum.origin)
            P = datum.shape(G, np.array([out[k] for k in rows]), np.array([X[k] for k in rows]))
            for k, P_k in zip(rows, P, strict=True):
                out[k] = P_k
        return out

    def split(self) -> tuple[MapLandmarks, MapLandmarks]:
        """Return the landmarks of the map, and those known exactly beside it."""
        rows = range(len(self))
        mapped = self._of([k for k in rows if self.ids[k] not in self.exact])
        return mapped, self._of([k for k in rows if self.ids[k] in self.exact])

    def _of(self, rows: list[int]) -> MapLandmarks:
        """Return the landmarks of these rows."""
        lists: list[list[Any]] = [self.ids, self.kinds, self.means, self.covariances, self.observations]
        ids, kinds, means, covariances, observations = ([values[k] for k in rows] for values in lists)
        return replace(self, ids=ids, kinds=kinds, means=means, covariances=covariances, observations=observations)

    def positions(self) -> tuple[Array, Array]:
        """Return the positions (K, d) and their covariances (K, d, d), of lines their first endpoints."""
        d = self.d
        means = np.array([mean[:d] for mean in self.means]).reshape(-1, d)
        return means, np.array([cov[:d, :d] for cov in self.covariances]).reshape(-1, d, d)

    def places(self) -> tuple[Array, Array]:
        """Return the places (K, n) and covariances (K, q, q), padded with NaN; of points of the plane the positions."""
        if self.in_space:
            return padded_all(self.means), padded_all(self.covariances, 2)
        if not any(len(mean) == WALL for mean in self.means):
            return self.positions()
        sizes = [WALL if len(mean) == WALL else 2 for mean in self.means]
        means = [mean[:n] for mean, n in zip(self.means, sizes, strict=True)]
        return padded_all(means), padded_all([P[:n, :n] for P, n in zip(self.covariances, sizes, strict=True)], 2)

    def to_csv(self) -> str:
        """Return the text of ``landmarks.csv``: id, kind, coordinates, triangle of the covariance, observations.

        If classes were reported, `class` is the likeliest one and `class_p` how likely it is.
        If there are any known exactly, `known` is "exactly" in their rows; if any were looked at again, there are the
        `log_odds` that they exist, and `mark` is "not seen again" of those that were not where they should be.
        """
        rows = [self._cells(k) for k in range(len(self))]
        usual = POSITION if self.in_space else POSITION[:2]
        used = dict.fromkeys(name for row in rows for name in row) or dict.fromkeys((*usual, *cov_names(usual)))
        header = ["id", "kind", *(name for name in used if name in _PLACES)]
        header += [*(name for name in cov_names(_PLACES) if name in used), "observations"]
        header += ["class", "class_p"] * bool(self.classes) + ["known"] * bool(self.exact)
        header += ["log_odds", "mark"] * bool(self.log_odds)
        return csv_text(header, ([row.get(name, "") for name in header] for row in rows))

    def _cells(self, k: int) -> dict[str, Any]:
        """Return the cells of a row by column."""
        name, kind, mean, P = self.ids[k], self.kinds[k], self.means[k], self.covariances[k]
        axes = _SPACE.get(len(mean), POSITION) if self.in_space else _PLANE.get(kind, POSITION)[: len(mean)]
        cells: dict[str, Any] = {"id": name, "kind": kind, "observations": self.observations[k]}
        cells |= zip(axes, mean.tolist(), strict=False)
        cells |= zip(cov_names(axes), P[np.triu_indices(len(errors_of(axes)))].tolist(), strict=True)
        cells |= zip(("class", "class_p"), self.classes.get(name, ()), strict=False)
        cells |= {"known": "exactly"} if name in self.exact else {}
        cells |= {"log_odds": float(self.log_odds[name])} if name in self.log_odds else {}
        return cells | ({"mark": UNSEEN} if name in self.unseen else {})

    @classmethod
    def read(cls, path: Path) -> MapLandmarks:
        """Read a ``landmarks.csv``.  Raises RunError naming file and line."""
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            table, exact = cls([], [], [], [], [], "z_m" in (rows.fieldnames or ())), set[Id]()
            plane, odds, unseen = False, dict[Id, float](), set[Id]()
            of_class = dict[Id, tuple[str, float]]()
            for number, row in enumerate(rows, start=2):
                try:
                    names = [name for name in _PLACES if row.get(name)]
                    cov = from_triangle([float(row[name]) for name in cov_names(names)])
                    table.ids.append(as_id(row["id"]))
                    table.kinds.append(row["kind"])
                    plane |= row["kind"] == PointHeight2D.kind or not row.get("z_m")
                    table.means.append(np.array([float(row[name]) for name in names]))
                    table.covariances.append(cov)
                    table.observations.append(int(row["observations"]))
                    of_class |= {table.ids[-1]: (row["class"], float(row["class_p"]))} if row.get("class") else {}
                    exact |= {table.ids[-1]} if row.get("known") else set()
                    odds |= {table.ids[-1]: float(row["log_odds"])} if row.get("log_odds") else {}
                    unseen |= {table.ids[-1]} if row.get("mark") else set()
                except (KeyError, TypeError, ValueError) as error:
                    raise RunError(f"{path}:{number}: not a row of a landmark table: {error}") from None
        in_space = table.in_space and not plane
        table = replace(table, in_space=in_space, exact=frozenset(exact), log_odds=odds)
        return replace(table, unseen=frozenset(unseen), classes=of_class)


def refuse_other_than_points(slam: Slam, what: str, *, walls: bool = False) -> None:
    """Refuse a map with walls, unless `walls` may be, or a user's own landmarks that are more than points with numbers.

    Raises KalmarkError.
    """
    for track in slam.tracks.confirmed.values():
        if walls and isinstance(track.model, Wall2D):
            continue
        first, *others = track.model.space.kinds
        odd = not is_own(type(track.model)) and (first not in (VECTOR, VECTOR3) or {*others} - {SCALAR})
        if odd or isinstance(track.model, Wall2D):
            raise KalmarkError(f"{what}: landmark {track.id!r} is a {track.model.kind}, expected points")
