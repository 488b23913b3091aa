"""From images to landmarks: a detector that asks where landmarks must appear, and searches only there.  [S] 1.1, 2.4.

For each frame: the expectations of all landmarks in view (`Prospect`), their expected appearance (`appearance`), a
search that accepts matches that agree (`selection`), new landmarks in empty cells (`features`).  The matches are a scan
with ids, which the filter fuses like any other.  The report of the scan then updates patches of new landmarks, and of
old ones from another side, and removes landmarks that are seldom matched.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from kalmark.arrays import Array, Index
from kalmark.declare import Count, Positive, Within, register
from kalmark.errors import EventError, MapError
from kalmark.events import Frame, Id, Raw, Scan, label_of_event
from kalmark.geometry.rotations import matrix
from kalmark.models.protocols import UnknownDepth, finds_depth, has_second_camera
from kalmark.models.sensors import PinHole, PixelDepth, Stereo
from kalmark.report import Report
from kalmark.slam.sources import BufferedScans, FilterView, Found
from kalmark.vision import opencv as cv2
from kalmark.vision.appearance import ANOTHER_COSINE, ANOTHER_SCALE, MOST_VIEWS, View, predict_templates, take_view
from kalmark.vision.beginning import Beginning
from kalmark.vision.depth_images import inverse_depths, with_depths
from kalmark.vision.features import FORGIVEN, Cells
from kalmark.vision.joint_expectation import PIXEL, Prospect, places_of
from kalmark.vision.pairs import with_pairs
from kalmark.vision.planes import Plane, plane_from_depths, plane_from_match
from kalmark.vision.recognition import match_expected, recognize_place
from kalmark.vision.searches import TRIAL, Searches, make_room
from kalmark.vision.selection import ImageSearch, Selection
from kalmark.vision.surveyed_corners import FirstLook
from kalmark.vision.template_matching import Searcher, shift_covariances

FEW, ENOUGH = 4, 20  # matches, with fewer of which the sensor is lost; landmarks by which it may recognise the place
EVERY, AWAY = 5, 30  # frames: how often it asks if a place is seen again; how long landmarks of it were not found
SHIFT_PX = 0.04  # sigma of the shift of a match that counts half: as much as a pixel of the sensor
PATCH, TEMPLATE = 12, 6  # half widths of what is kept and of what is compared, px


@register("detector", "active_search")
class ActiveSearch:
    """Points of an image, found where the filter expects them: normalised correlation with their patches.

    Each frame, `in_view` landmarks are kept in view, at most `starts` new ones from corners with a gradient of at least
    `contrast` grey values a pixel; a match correlates by `accept` at least.  `keep` selects the landmarks that stay:
    "global" those that are found in half of the searches for them, the `most` best, "odometry" only those in view.  The
    search begins with a random landmark, by `seed`: the same seed, the same result.

    >>> camera = km.Mount(km.sensors.PinHole(), detector=km.vision.ActiveSearch(in_view=30))
    >>> camera.detector.columns
    ('u_px', 'v_px')
    """

    columns: ClassVar[tuple[str, ...]] = PinHole.columns

    in_view: Annotated[Count, "Least number of landmarks in view."] = 60
    starts: Annotated[int, Within(ge=0), "At most so many new ones in a frame."] = 10
    updates: Annotated[Count, "At most so many landmarks are matched in a frame."] = 100
    most: Annotated[Count, "At most so many landmarks in the map: the least useful out of view make room."] = 300
    keep: Annotated[Literal["global", "odometry"], "Keep landmarks that are out of view, or not."] = "global"
    accept: Annotated[float, Within(gt=0, lt=1), "Correlation of a match, at least."] = 0.85
    contrast: Annotated[
        Positive, "Gradient of a corner in the direction of least change, RMS, grey values a pixel."
    ] = 4.0
    seed: Annotated[int, Within(ge=0), "Of what is chosen at random."] = 0

    def source(self, sensor: Any) -> FrontEnd:
        """Return the source of the scans of one sensor."""
        return FrontEnd(self, sensor)


@dataclass
class LandmarkViews(Searches):
    """Views of a landmark, and its counts of searches, matches and fits."""

    views: list[View] = field(default_factory=list)
    plane: Plane | None = None  # about it; none as long as it has no view
    surveyed: bool = False  # known beforehand: it has no view until it is first seen, and is not given up


class FrontEnd:
    """Searches the frames of one sensor; `looks` has how each landmark looked."""

    takes: ClassVar[type[Raw]] = Frame
    waits: ClassVar[bool] = False
    random: np.random.Generator
    cells: Cells
    looks: dict[Id, LandmarkViews]
    frame: int
    named: int
    beginning: Beginning | None
    is_lost: bool

    def __init__(self, settings: ActiveSearch, sensor: Any) -> None:
        self.settings, self.sensor = settings, sensor
        cv2.setNumThreads(1)
        self.random = np.random.default_rng(settings.seed)
        width = sensor.image[0]
        across = max(4, round(np.sqrt(1.6 * settings.in_view * width / sensor.image[1])))
        self.cells = Cells(across, TEMPLATE, settings.contrast)
        self.looks, self.frame, self.named, self.is_lost = {}, 0, 0, False
        self.beginning = Beginning() if isinstance(sensor, PinHole) else None
        self.selection: Selection | None = None
        self.prospect: Prospect | None = None
        self.image: Any = None
        self.observation: Found | None = None

    @property
    def begins(self) -> bool:
        """True if it keeps the first frames: together they may determine the first landmarks' distances."""
        return self.beginning is not None

    def read(self, raw: Frame) -> tuple[Any, Any]:
        """Return the image (H, W) of a frame, and the right one of a pair or the depth in m, 0: none; None without.

        Raises EventError.
        """
        image, pair = raw.grey(), has_second_camera(self.sensor)
        beside = raw.right_grey() if pair else raw.depths() if finds_depth(self.sensor) else None
        if beside is not None and beside.shape != image.shape:
            what = "right image is" if pair else "depths are"
            raise EventError(f"{label_of_event(raw)}: the {what} {beside.shape}, expected {image.shape} as the image")
        return image, beside

    def located(self, data: tuple[Any, Any], view: FilterView) -> tuple[Array, Array] | None:
        """Return the pose (7,) of a lost sensor that has recognised the place, and its covariance (6, 6)."""
        known = [name for name, look in self.looks.items() if look.fitted >= TRIAL and look.views]
        if not self.is_lost or len(known) < ENOUGH:
            return None
        places = places_of(view.map, view.tracks, view.channel, known)
        here = np.flatnonzero(np.isfinite(places).all(axis=1))
        views = [self.looks[known[k]].views for k in here.tolist()]
        found = recognize_place(data[0], views, places[here], view.channel.calibrated(view.map))
        return None if found is None else (found.T, found.cov)

    def found(self, raw: Raw, data: tuple[Any, Any], view: FilterView) -> Found:
        """Search an image for the landmarks in view, and for new ones."""
        prospect, (image, beside) = Prospect(view.map, view.tracks, view.channel, view.robot), data
        settings = self.settings
        self.frame += 1
        self.image, self.prospect = image, prospect
        views = [self._views(name) for name in prospect.names]
        planes = [self.looks[name].plane if name in self.looks else None for name in prospect.names]
        looks = self.likely = predict_templates(views, planes, prospect.places, prospect.T, prospect.sensor, TEMPLATE)
        self.beside = beside if isinstance(self.sensor, PixelDepth) else None
        searcher = Searcher(image, looks.templates, settings.accept)
        search, drifted = ImageSearch(prospect, looks.valid, searcher, settings.updates), None
        found = self.selection = search.run(self.random)
        again = self._matched_again(image, prospect, searcher)
        if again is not None and search.run_again(*again).wider > 1.0:
            drifted = [name for name in prospect.names if self._seen_lately(name)], found.wider
        self.is_lost = found.matched.sum() < FEW
        removed = self._count(prospect, found)
        self._first_look(image, prospect, found)
        rows = np.flatnonzero(found.matched).tolist()
        y = found.y[rows]
        ids: list[Id] = [prospect.names[k] for k in rows]
        new = self._new(image, found, prospect, len(rows))
        ids += [self._name(raw) for _ in new]
        stay = {*prospect.names, *(name for name, look in self.looks.items() if look.surveyed)}
        removed += make_room(self.looks, settings.most - len(new), stay, {name for name, _ in removed})
        y, cov = np.concatenate([y, new]), None
        if isinstance(self.sensor, PixelDepth | Stereo):
            y, cov = self._measured(y, rows, beside, prospect, found)
            self._add_shifts(cov, y, rows)
            there = np.flatnonzero(np.isfinite(y).all(axis=1))
            y, cov, ids = y[there], cov[there], [ids[k] for k in there.tolist()]
        scan = Scan(t_ns=raw.t_ns, robot=raw.robot, sensor=raw.sensor, y=y if len(y) else (), ids=ids or None,
                    cov=cov if len(y) else None)  # fmt: skip
        self.observation = Found(scan, removed, drifted)
        return self.observation

    def update(self, report: Report, view: FilterView) -> BufferedScans | None:
        """Update patches and counts of landmarks by the report of a frame; return what is to be filtered again."""
        T = view.T
        assert self.prospect is not None
        at = {name: k for k, name in enumerate(self.prospect.names)}
        for o in report.observations:
            name = o.landmark
            if name is None or o.outcome not in ("new", "associated"):
                continue
            y = report.y[o.index, :PIXEL]
            if o.outcome == "new" and name not in self.looks:  # else it was only started again
                shot = self._taken(y, T)
                if shot is not None:
                    look = self.looks[name] = LandmarkViews(views=[shot], seen=self.frame)
                    look.plane = self._plane(y, shot)
                continue
            look, k = self.looks[name], at[name]
            look.fits((o.d2 or 0.0) / report.y.shape[1], self.frame)
            cosine, scale = self.likely.likeness[k]  # 0 where there is no view yet
            if look.plane is not None and cosine:
                plane_from_match(
                    self.image, self.likely.templates[k], y, look.plane.slopes, self.likely.rates[k], look.plane
                )
            other = cosine < ANOTHER_COSINE or not 1 / ANOTHER_SCALE < scale < ANOTHER_SCALE
            if other and len(look.views) < MOST_VIEWS:
                shot = self._taken(y, T)
                if shot is not None:
                    look.views.append(shot)
                    look.plane = look.plane or self._plane(y, shot)
        for name, _ in report.removed:
            self.looks.pop(name, None)
        if self.beginning is not None:
            assert self.observation is not None
            fitted = {o.landmark: report.y[o.index] for o in report.observations
                      if o.landmark is not None and o.outcome in ("new", "associated")}  # fmt: skip
            self.beginning.add(self.observation.scan, [name for name, _ in self.observation.removed], fitted, T)
        return self._begun(view.channel.landmark)

    # ------------------------------------------------------------------ the beginning
    def _begun(self, landmark: Any) -> BufferedScans | None:
        """Return, once, the start of the map, if the first frames determine it; the median of rho is the prior."""
        if self.beginning is None or not isinstance(landmark, UnknownDepth) or landmark.prior_rho_per_m <= 0.0:
            return None
        found = self.beginning.tried(self.sensor, landmark.prior_rho_per_m)
        if self.beginning.over:
            self.beginning = None
        return found

    def replace_poses(self, poses: list[Array], names: Set[Id]) -> None:
        """Set the poses (7,) of the sensor in all frames so far, one a frame, and remove all landmarks but `names`."""
        self.looks = {name: look for name, look in self.looks.items() if name in names}
        for look in self.looks.values():
            look.views = [replace(view, T=poses[view.frame]) for view in look.views]
            look.plane = Plane(matrix(look.views[0].T[3:]) @ look.views[0].rays[4]) if look.views else None

    def settle(self) -> None:
        """Take the map as it is: something else than frames has changed it."""
        self.beginning = None

    def survey(self, name: Id) -> None:
        """Search, too, for a landmark known beforehand: its patch is taken where it is first seen."""
        self.looks[name] = LandmarkViews(surveyed=True)

    def restored(self) -> None:
        """Check the views of a file.  Raises MapError."""
        side = 2 * PATCH + 1
        for name, look in self.looks.items():
            for view in look.views:
                if (view.patch.shape, view.T.shape, view.rays.shape) != ((side, side), (7,), (5, 3)):
                    raise MapError(f"a view of landmark {name!r} is a patch {view.patch.shape} from {view.T.shape}")

    # ------------------------------------------------------------------ landmarks
    def _taken(self, y: Array, T: Array) -> View | None:
        return take_view(self.image, y, T, self.sensor, PATCH, self.frame - 1)

    def _plane(self, y: Array, view: View) -> Plane:
        """Return the plane about the pixel y (2,) of a first view."""
        plane = Plane(matrix(view.T[3:]) @ view.rays[4])
        if self.beside is not None:
            plane_from_depths(self.beside, y, self.sensor, view.T, TEMPLATE, plane)
        return plane

    def _views(self, name: Id) -> list[View]:
        look = self.looks.get(name)
        return [] if look is None else look.views

    def _seen_lately(self, name: Id) -> bool:
        look = self.looks.get(name)
        return look is not None and not look.surveyed and self.frame - look.seen <= AWAY

    def _name(self, raw: Raw) -> Id:
        """Return the id of a new landmark, which no other sensor gives."""
        self.named += 1
        return f"{raw.robot}.{raw.sensor} {self.named}"

    def _matched_again(self, image: Any, prospect: Prospect, searcher: Searcher) -> tuple[Index, Array] | None:
        """Return landmarks (n,) and where they are recognised (n, 2), if those that come into view again are not found.

        Asked now and then, as it takes long: the sensor has drifted, or they are hidden.
        """
        found = self.selection
        if self.frame % EVERY or found is None:
            return None
        looks = [(k, self.looks[prospect.names[k]]) for k in self.likely.valid.tolist()]
        old = np.array([k for k, look in looks if look.fitted >= TRIAL and self.frame - look.seen > AWAY], np.int64)
        if len(old) < ENOUGH or found.matched[old].sum() > len(old) / 2:
            return None
        views = [self._views(prospect.names[k]) for k in old.tolist()]
        return match_expected(image, views, old, prospect, searcher)

    def _first_look(self, image: Any, prospect: Prospect, found: Selection) -> None:
        """Enter where landmarks known beforehand are that have no view yet; not in each frame, as it takes long."""
        if self.frame % FORGIVEN != 1:
            return
        rows = [k for k, name in enumerate(prospect.names) if name in self.looks and not self.looks[name].views]
        if rows:
            first = FirstLook(image, prospect, self.settings.contrast)
            for k, y in first.found(found.belief, rows).items():
                found.matched[k], found.y[k] = True, y

    def _new(self, image: Any, found: Selection, prospect: Prospect, count: int) -> Array:
        """Return the pixels (n, 2) of new landmarks."""
        known = any(not look.surveyed for look in self.looks.values())
        wanted = min(self.settings.in_view - count, self.settings.starts if known else self.settings.in_view)
        if wanted <= 0:
            return np.zeros((0, 2))
        e = np.where(found.matched[:, None], found.y, found.belief.pixels)
        return self.cells.corners(image, e[np.isfinite(e).all(axis=1)], wanted, PATCH + 1, self.frame, self.random)

    def _measured(
        self, y: Array, rows: list[int], beside: Any, prospect: Prospect, found: Selection
    ) -> tuple[Array, Array]:
        """Return measurements (n, m) and their noise (n, m, m) of pixels y (n, 2), the first of landmarks `rows`."""
        sensor, landmark, e = prospect.sensor, prospect.channel.landmark, found.belief.e[rows]
        Z = prospect.whole_innovations(found.belief, np.array(rows, dtype=np.int64))
        if isinstance(sensor, Stereo):
            images = self.image, beside
            return with_pairs(sensor, landmark, images, y, e, Z, TEMPLATE, self.settings.accept)
        rho = np.full(len(y), np.nan) if beside is None else inverse_depths(beside, y, sensor.sigma_rho_per_m)
        return with_depths(sensor, landmark, y, rho, e[:, 2], Z[:, 2, 2])

    def _add_shifts(self, R: Array, y: Array, rows: list[int]) -> None:
        """Add to the noise R (n, m, m) of y (n, m), first landmarks `rows`, what the image leaves open of the pixels.

        A match that slides along an edge counts less.  The right image of a pair is searched for what the left one
        shows at the match: both err by the same shift.
        """
        n, which = len(rows), np.array(rows, dtype=np.int64)
        found = np.ascontiguousarray(y[:n, :PIXEL])
        C = shift_covariances(self.image, self.likely.templates, which, found)
        C *= R[:n, :1, :1] / SHIFT_PX**2
        if isinstance(self.sensor, Stereo):
            C = np.tile(C, (1, 2, 2))
        R[:n, : C.shape[1], : C.shape[1]] += C

    def _count(self, prospect: Prospect, found: Selection) -> list[tuple[Id, str]]:
        """Count searches; return the landmarks that are given up, each with the reason.

        A frame with almost no match counts for no landmark.
        """
        removed: list[tuple[Id, str]] = []
        for k in np.flatnonzero(found.searched).tolist() if not self.is_lost else ():
            look = self.looks[prospect.names[k]]
            reason = look.searched_for(bool(found.matched[k]))
            if reason and not look.surveyed:
                removed.append((prospect.names[k], reason))
        if self.settings.keep == "odometry":
            gone = {name for name, _ in removed}
            view = set(prospect.names)
            removed += [(name, "out of view") for name, look in self.looks.items()
                        if not (name in view or name in gone or look.surveyed)]  # fmt: skip
        return removed
