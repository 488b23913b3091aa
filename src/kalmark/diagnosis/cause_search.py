"""The search for the causes of a run: the likeliest first, each taken out of the data before the next."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from kalmark.diagnosis import causes
from kalmark.diagnosis.causes import LEAST_GAIN, Finding
from kalmark.diagnosis.error_columns import Where, columns_of, errors_of_all_sensors, rates_of
from kalmark.diagnosis.linear import Linear
from kalmark.diagnosis.onsets import find_onsets
from kalmark.logs.progress import track

ALPHA = 0.01  # of runs in which nothing is wrong have a finding of the search
ROUNDS, MORE = 6, 14  # in which all that is certain is taken out, and further ones for what explains this
SHARE = (
    0.01  # of all that was explained: a log with many causes comes back to some of them, and more rounds are used up
)
TAKEN_UP, ALIKE = 0.5, 0.85
MOST_CONDITION = 1e6  # of the information on errors of one column, as correlations
ORDER = ("steering_offset", "mount_position", "odometry_scale", "odometry_turn", "odometry_offset")
SCALINGS, SCALED = 5, 0.03
NEAR = 9.0  # d2 of a landmark that an observation may well be of
LOOKED_AT, DRAWS = 200, 40  # outliers whose landmarks are looked for, and draws of their errors
MANY = 0.3  # of the outliers, beyond chance, are of another landmark: it pulls its scan, and what is right is off, too


def strongest_findings(sure: list[Finding]) -> list[Finding]:
    """Return the finding of the largest gain, and those that gain as much after it.

    Surveys that are off go before outliers and noise that would take them up, which are one for all of them, landmarks
    that move before outliers, and noise of several columns before outliers that explain clearly less: these would be
    one for all columns.
    A single step of the motion or a systematic error goes before a noise that would take it up.  Of those that explain
    as much, one in the sensors goes before one in the controls.
    """
    first = max(sure, key=lambda f: f.gain)
    surveys = [f for f in sure if f.name == "landmark_prior"]
    spread = first.name == "outliers" or first.unit == causes.TIMES
    if surveys and spread and sum(f.gain for f in surveys) > TAKEN_UP * first.gain:
        return [max(surveys, key=lambda f: f.gain)]
    moving = [f for f in sure if f.name == "moving_landmark"]
    if first.name == "outliers" and sum(f.gain for f in moving) > TAKEN_UP * first.gain:
        return [max(moving, key=lambda f: f.gain)]
    noisy = [f for f in sure if f.unit == causes.TIMES and f.noise is not None]
    if first.name == "outliers" and ALIKE * sum(f.gain for f in noisy) >= first.gain:
        first = max(noisy, key=lambda f: f.gain)
    jump = [f for f in sure if f.at is not None and f.gain > TAKEN_UP * first.gain]
    if jump and first.unit == causes.TIMES:
        return jump
    steady = [f for f in sure if f.Z is not None and f.at is None and f.gain > TAKEN_UP * first.gain]
    if not steady or first.at is not None or (first.unit != causes.TIMES and first.Z is None):
        return [first]
    most = max(f.gain for f in steady)
    alike = sorted((f for f in steady if f.gain > ALIKE * most), key=lambda f: -f.gain)
    by_name = {f.name: f for f in reversed(alike)}
    return sorted(by_name.values(), key=lambda f: (ORDER.index(f.name) if f.name in ORDER else 0, -f.gain))


def joined(same: list[Finding]) -> Finding:
    """Return the findings of one cause in several rounds as one."""
    first, last = same[0], same[-1]
    value = math.prod(f.value for f in same) if last.unit == causes.TIMES else sum(f.value for f in same)
    return replace(first, value=value, sigma=last.sigma, gain=sum(f.gain for f in same))


class Search:
    """The causes found so far, and the problem with these taken out."""

    def __init__(self, linear: Linear, sensors: Mapping[Where, tuple[str, ...]], t_ns: Any) -> None:
        self.first = self.linear = linear
        self.sensors = sensors
        self.rates = rates_of(linear, t_ns)
        order, poses = np.argsort(linear.problem.nodes, kind="stable"), np.arange(len(linear.problem.robots))
        at = np.searchsorted(linear.problem.nodes[order], poses)  # a pose at a fix has the time of the next scan
        self.t_s = ((t_ns - t_ns[:1].sum()) * 1e-9)[order[np.minimum(at, len(order) - 1)]]
        self.found: list[Finding] = []
        self.suspects: list[Finding] = []  # systematic errors that explain most at first, sure or not
        self.simulated = linear.simulated(causes.SETS)

    def run(self, progress: bool = False) -> list[Finding]:
        """Return all causes, the one that explains most first.

        Overstated noise is removed last, because it is harmless and does not mask other causes.  Where errors are
        correlated it ends the search: their innovations are smaller than the errors, and a weight by the innovations
        would take correlated errors for systematic ones and make the map overconfident.  So the problem keeps at least
        the stated noise.
        """
        rounds, lasting = ROUNDS + MORE, False
        for n in track(range(rounds), "causes, one after the other", rounds, show=progress):
            candidates = self.candidates()
            if n == 0:
                steady = [f for f in candidates if f.is_steady and f.gain > LEAST_GAIN]
                self.suspects = sorted(steady, key=lambda f: -f.gain)
            least = max(LEAST_GAIN, SHARE * sum(f.gain for f in self.found) if n >= ROUNDS else 0.0)
            sure = self._sure(candidates, least)
            harmful = [] if lasting else [f for f in sure if not f.overstated]
            lasting = lasting or (not harmful and bool(self.correlated()))
            if not sure or (lasting and not any(f.overstated for f in sure)):
                break
            some = harmful or [f for f in sure if f.overstated]
            first, *alike = strongest_findings(some)
            first = self._of_its_name(first, some)
            self.take(replace(first, alike=tuple(alike)))
        for finding in self.correlated():
            self.take(finding)
        if lasting:
            self.linear = self.linear.scaled(
                *(np.maximum(1.0, 1.0 / a) for a in (self.linear.noise, self.linear.errors))
            )
        return sorted(self.found, key=lambda f: -f.gain)

    def _of_its_name(self, first: Finding, sure: list[Finding]) -> Finding:
        """Return that of the systematic errors of one name, and of about one gain, which leaves least for others.

        Where one sensor of two is long, the other is short beside it, and so are the ways of the robots.
        """
        same = [f for f in sure if f.name == first.name and f.at is None and f.gain > ALIKE * first.gain]
        if first.Z is None or first.at is not None or len(same) < 2:
            return first

        def alone(f: Finding) -> float:
            assert f.Z is not None and f.W is not None
            linear = self.linear.without(f.Z * f.value, f.W * f.value)
            others = causes.systematic(linear, columns_of(linear, self.sensors, self.rates))
            return f.gain - max((other.gain for other in others), default=0.0)

        return max(same, key=alone)

    def correlated(self) -> list[Finding]:
        """Return the errors that are correlated from one observation to the next."""
        found = causes.correlations(self.linear, self.simulated, self.sensors, self.t_s)
        return [f for f in found if f.p * len(found) < ALPHA and f.gain > LEAST_GAIN]

    def candidates(self) -> list[Finding]:
        """Return all that may explain what is left."""
        columns = columns_of(self.linear, self.sensors, self.rates)
        found = [
            *causes.systematic(self.linear, [*columns, *errors_of_all_sensors(columns)]),
            *causes.noise(self.linear, self.simulated, self.sensors),
            *causes.outliers(self.linear, self.t_s),
            *causes.moving_landmarks(self.linear, self.t_s),
            *causes.jumps(self.linear, self.t_s),
            *causes.priors(self.linear, self.t_s),
        ]
        if any(not f.overstated for f in self._sure(found, LEAST_GAIN)):  # else no part of it can be off
            found += find_onsets(self.linear, columns, self.t_s)
        return found

    def _sure(self, candidates: list[Finding], least: float) -> list[Finding]:
        """Return the candidates that are surely not by chance, of more than the least gain."""
        return [f for f in candidates if f.p * len(candidates) < ALPHA and f.gain > least]

    def take(self, finding: Finding) -> None:
        """Take a cause out of the data."""
        if finding.Z is not None and finding.W is not None:
            self.linear = self.linear.without(finding.Z * finding.value, finding.W * finding.value)
            if finding.errors is not None:
                self._scale(finding)
            elif finding.is_steady:
                finding = self._beside(finding)
        elif finding.unit == causes.TIMES:
            finding = self._scaled(finding)
        else:
            self._scale(finding)
        same = [
            f
            for f in self.found
            if (f.name, f.of) == (finding.name, finding.of) and (f.unit, f.begins) == (finding.unit, finding.begins)
        ]
        self.found = [f for f in self.found if f not in same] + [joined([*same, finding])]

    def _beside(self, finding: Finding) -> Finding:
        """Return a systematic error as it is beside the others of its column, and take these out of the data.

        One that is no cause alone may still do the opposite: of a speed that is .94 v + .02 m/s the offset alone
        would move the map.  Those that the data cannot distinguish from it, alone or with others, are left.
        """
        every = columns_of(self.linear, self.sensors, self.rates)
        mine = next((c for c in every if (c.name, c.of) == (finding.name, finding.of)), None)
        same = [c for c in every if mine and c is not mine and c.group == mine.group]
        if mine is None or not same:
            return finding
        I = causes.joint_errors(self.linear, [mine, *same])[1]
        told = [0]
        for k in range(1, len(I)):
            part = I[np.ix_([*told, k], [*told, k])]
            scaled = part / np.sqrt(np.outer(part.diagonal(), part.diagonal()))
            if np.linalg.cond(scaled) < MOST_CONDITION and np.linalg.inv(scaled)[0, 0] < 1.0 / (1.0 - ALIKE**2):
                told.append(k)
        s, _ = causes.joint_errors(self.linear, [(mine, *same)[k] for k in told])
        for k, value in zip(told, s, strict=True):
            column = (mine, *same)[k]
            self.linear = self.linear.without(column.Z * value, column.W * value)
        return replace(finding, value=finding.value + float(s[0]))

    def _scaled(self, finding: Finding) -> Finding:
        """Make a noise as large as it is, which takes a few rounds: other noise was taken for it, or it for other."""
        value, step = 1.0, finding
        for _ in range(SCALINGS):
            self._scale(step)
            value *= step.value
            again = causes.noise(self.linear, self.simulated, self.sensors)
            step = next((f for f in again if (f.name, f.of) == (finding.name, finding.of)), step)
            if abs(step.value - 1.0) < SCALED:
                break
        return replace(finding, value=value, sigma=finding.sigma * value / finding.value)

    def _scale(self, finding: Finding) -> None:
        self.linear = self.linear.scaled(finding.noise, finding.errors)
        self.simulated = self.linear.simulated(causes.SETS)
