"""The estimate of a filter: means, covariances, places, expectations."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from kalmark.arrays import Array
from kalmark.association import Association
from kalmark.errors import MapError
from kalmark.events import Id
from kalmark.filter.estimators import Estimator
from kalmark.filter.map import AT_ONCE, Map
from kalmark.geometry.gaussian import normalized_weights
from kalmark.management import existence
from kalmark.models.protocols import Landmark, Segmented, place_of
from kalmark.report import Expectations, LandmarkTable
from kalmark.slam.robot import Robot
from kalmark.slam.state import State
from kalmark.tracks.clones import Clones
from kalmark.tracks.expecting import expectations
from kalmark.tracks.track import Tracks


class Estimate:
    """Robots and landmarks as one joint Gaussian, read by their names; `state` is where it is kept."""

    def __init__(self, state: State) -> None:
        self.state = state

    @property
    def t_ns(self) -> int | None:
        """The time of the last event, None before the first."""
        return self.state.t_ns

    @property
    def robots(self) -> dict[str, Robot]:
        """The robots by name."""
        return self.state.robots

    @property
    def association(self) -> Association:
        """The data association, where a mount has none of its own."""
        return self.state.settings.association

    @property
    def estimator(self) -> Estimator:
        """The estimator of the map: prediction and correction."""
        return self.state.estimator

    @property
    def map(self) -> Map:
        """The joint Gaussian over blocks in slots."""
        return self.state.map

    @property
    def tracks(self) -> Tracks:
        """One record a landmark, and the names of all blocks."""
        return self.state.tracks

    @property
    def clones(self) -> Clones:
        """The window of cloned poses."""
        return self.state.clones

    def is_known(self, name: Id) -> bool:
        """Return whether a landmark is known exactly: it is outside the map, and no scan moves it."""
        return name in self.tracks.known

    def mean(self, name: Id) -> Array:
        """Return the mean (size,) of a landmark or robot: x, y, heading in m and rad, or x, y, z, qx, qy, qz, qw."""
        known = self.tracks.known
        return known.mean(name) if name in known else self.map.mean(self.slot(name))

    def covariance(self, *names: Id) -> Array:
        """Return the joint covariance (n, n) of robots and landmarks, in the given order, in standard coordinates."""
        if not names:
            raise MapError("covariance of no blocks, expected names of robots or landmarks")
        known = self.tracks.known
        slots = [self.slot(name) for name in names if name not in known]
        P = self.map.covariance(slots) if slots else np.zeros((0, 0))
        if len(slots) == len(names):
            return P
        dofs = [known.model(name).space.dof if name in known else -1 for name in names]
        sizes = [len(self.map.rows(self.slot(name))) if d < 0 else d for name, d in zip(names, dofs, strict=True)]
        rows = np.flatnonzero(np.repeat(np.array(dofs) < 0, sizes))
        out = np.zeros((sum(sizes), sum(sizes)))
        out[np.ix_(rows, rows)] = P
        return out

    def classes(self, name: Id) -> dict[str, float]:
        """Return how likely a landmark is of each class, by what was reported of it; {} of one without a report."""
        track = self.tracks.confirmed.get(name)
        if track is None or not track.classes:
            return {}
        log_p = np.array([*track.classes.values()])
        return dict(zip(track.classes, normalized_weights(log_p).tolist(), strict=True))

    def landmarks(self, *, exactly_known: bool = True) -> LandmarkTable:
        """Return ids, kinds, means, covariances and numbers of observations of all landmarks.

        Those known exactly, outside the map, come last and have the covariance 0; or without them.
        """
        state, tracks = self.state, self.tracks.confirmed.values()
        kinds, counts = [track.model.kind for track in tracks], [track.observations for track in tracks]
        means, covs = self._each([track.slot for track in tracks])
        names, known = [track.id for track in tracks], self.tracks.known
        for name in known if exactly_known else ():
            space = known.model(name).space
            names.append(name)
            kinds.append(known.model(name).kind)
            means.append(known.mean(name))
            covs.append(np.zeros((space.dof, space.dof)))
            counts.append(known.observations(name))
        upkeep = next((state.policies[key].upkeep for key in self.tracks.looks), state.settings.upkeep)
        odds = existence.log_odds_of_map(self.tracks, upkeep)
        return LandmarkTable(names, kinds, means, covs, counts, odds, existence.unseen_landmarks(odds, upkeep))

    def _each(self, slots: list[int]) -> tuple[list[Array], list[Array]]:
        """Return the mean and the covariance of each of some blocks."""
        means, covs, robot = list[Array](), list[Array](), next(iter(self.state.moving.values())).slot
        for i in range(0, len(slots), AT_ONCE):
            m, _, _, here = self.map.marginal(robot, -1, np.array(slots[i : i + AT_ONCE]))
            means += [m.mean(at) for at in here.tolist()]
            covs += [m.covariance([at]) for at in here.tolist()]
        return means, covs

    def expect(
        self, robot: str, sensor: str, names: Iterable[Id] | None = None, *, in_view: bool = False
    ) -> Expectations:  # fmt: skip
        """Return what a sensor should measure of landmarks, by default of all, from where its robot is.

        In view or not and why, expectations, their covariances and Jacobians, as a correction would have them; with
        `in_view` of those in view alone.  Robots may be among the `names`.  A robot that lags is where it was (`lags`).
        Nothing changes.  Raises MapError.
        """
        if (robot, sensor) in self.state.readers or (robot, sensor) in self.state.of_blocks:
            raise MapError(f"sensor {sensor!r} of {robot!r} measures no landmarks, expected one of landmarks")
        if (robot, sensor) not in self.state.channels:
            known = ", ".join(f"{r!r} {s!r}" for r, s in self.state.channels) or "none"
            raise MapError(f"robot {robot!r} has no sensor {sensor!r}, expected one of: {known}")
        chosen = None if names is None else [*names]
        for name in chosen or ():
            if not self.is_known(name):
                self.slot(name)
            if self.tracks.sort(name) is None:
                raise MapError(f"{name!r} is a sensor's mount or a control's bias, expected a landmark or a robot")
        channel = self.state.channels[robot, sensor]
        if channel.sees_velocity and (why := self.state.look_back((robot, sensor))):
            raise MapError(f"sensor {sensor!r} of {robot!r} expects nothing: {why}")
        return expectations(self.map, self.tracks, channel, robot, sensor, chosen, in_view)

    def slot(self, name: Id) -> int:
        """Return the slot of a robot or landmark in `map`."""
        return self.tracks.slot(name)

    def place(self, name: Id) -> tuple[Array, Array]:
        """Return where a robot or a landmark is: mean (2 or 3,) and covariance, m and m^2, in the map's frame.

        A landmark's model gives its position (`HasPlace`); of a line it is its point nearest to the anchor or the
        origin.  Raises MapError for a landmark whose model has no position.
        """
        mean, P, model = self.mean(name), self.covariance(name), self.landmark_model(name)
        if model is None:
            d = next(iter(self.robots.values())).motion.space.d
            return mean[:d], P[:d, :d]
        placed = place_of(model, mean[None])
        if placed is None:
            raise MapError(f"{name!r} is a {model.kind}, which has no position, expected a model with place()")
        (p,), (P_l,) = placed
        return p, P_l @ P @ P_l.T

    def lags(self, robot: str) -> bool:
        """Return whether the pose of a robot is still that before the last event: nothing has read it since."""
        return self.state.moving[robot].held.lags(self.t_ns or 0)

    def landmark_model(self, name: Id) -> Landmark | None:
        """Return the model of a landmark, None of what is no landmark of the map."""
        track = self.tracks.confirmed.get(name)
        if track is None and name in self.tracks.known:
            return self.tracks.known.model(name)
        return None if track is None else track.model

    def segment(self, name: Id) -> tuple[Array, Array]:
        """Return the ends (2, 3) of the segment observed of a line so far, and their covariances (2, 3, 3)."""
        model, extent = self.landmark_model(name), self.segment_ends(name)
        if extent is None or not isinstance(model, Segmented):
            raise MapError(f"{name!r} is no line of the map, expected one with ends")
        p, P_l = model.endpoints(self.mean(name)[None], extent[None])
        return p[0], P_l[0] @ self.covariance(name) @ P_l[0].swapaxes(1, 2)

    def segment_ends(self, name: Id) -> Array | None:
        """Return the extent of the segment observed so far as abscissas (2,) on its line; None of what is no line."""
        track = self.tracks.confirmed.get(name)
        if track is None and name in self.tracks.known:
            return self.tracks.known.extent(name)
        return None if track is None else track.extent
