"""The search for the causes of a run: the likeliest first, each taken out of the data before the next."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.diagnosis import causes
from kalmark.diagnosis.causes import LEAST_GAIN, Finding
from kalmark.diagnosis.error_columns import DRIFT, LATE, Where, columns_of, errors_together, rates_of
from kalmark.diagnosis.linear import Linear
from kalmark.diagnosis.onsets import find_onsets
from kalmark.logs.progress import track

ALPHA = 0.01  # of runs in which nothing is wrong have a finding of the search
ROUNDS, MORE = 6, 14  # in which all that is certain is taken out, and further ones for what explains this
SHARE = (
    0.01  # of all that was explained: a log with many causes comes back to some of them, and more rounds are used up
)
ALIKE = 0.85  # of the gain of the strongest: systematic errors that may be in its place
MOST_CONDITION = 1e6  # of the information on errors of one column, as correlations
SCALINGS, SCALED = 5, 0.03


def strongest(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings of one kind that gain most together, the largest first; none of none."""
    kinds: dict[tuple[str, ...], list[Finding]] = {}
    for finding in sorted(findings, key=lambda f: -f.gain):
        kinds.setdefault(finding.kind, []).append(finding)
    return max(kinds.values(), key=total_gain, default=[])


def total_gain(findings: Iterable[Finding]) -> float:
    """Return what findings gain together, of things that are independent of each other."""
    return sum(f.gain for f in findings)


def joined(same: list[Finding]) -> Finding:
    """Return the findings of one cause in several rounds as one."""
    first, last = same[0], same[-1]
    value = math.prod(f.value for f in same) if last.unit == causes.TIMES else sum(f.value for f in same)
    noise, errors = math.prod(f.noise for f in same), math.prod(f.errors for f in same)
    return replace(first, value=value, sigma=last.sigma, gain=total_gain(same), noise=noise, errors=errors)


def problem_without(linear: Linear, finding: Finding) -> Linear:
    """Return a problem without a cause in its data."""
    if finding.Z is not None and finding.W is not None:
        linear = linear.without(finding.Z * finding.value, finding.W * finding.value)
    return linear.scaled(finding.noise, finding.errors)


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
        self.instead: list[tuple[Array, Array]] = []  # (z, w) of causes that may be in the place of one that is out
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
            wide, harmful = ([f for f in sure if f.overstated == which] for which in (True, False))
            if not harmful or lasting:
                lasting, harmful = lasting or bool(self.correlated()), wide
            if not harmful:
                break
            self.take(self.likeliest(harmful))
        self._leave_out_explained()
        for finding in self.correlated():
            self.take(finding)
        if lasting:
            self.linear = self.linear.scaled(
                *(np.maximum(1.0, 1.0 / a) for a in (self.linear.noise, self.linear.errors))
            )
        return sorted(self.found, key=lambda f: -f.gain)

    def likeliest(self, sure: list[Finding]) -> Finding:
        """Return the cause that explains most of some, with those that the log does not distinguish from it.

        Noise and outliers take up any misfit, so they count by what the strongest of the others leaves to them.
        """
        any_misfit, special = (strongest(f for f in sure if f.takes_up == which) for which in (True, False))
        if special and total_gain(any_misfit) > total_gain(special):
            left = self._any_misfit(reduce(problem_without, special, self.linear))
            of = {(f.name, f.of) for f in any_misfit}
            if total_gain(f for f in left if (f.name, f.of) in of) > total_gain(special):
                special = []
        one = (special or any_misfit or sure)[0]
        return self._with_alike(one, sure) if one.is_steady else one

    def _any_misfit(self, linear: Linear) -> list[Finding]:
        """Return what takes up any misfit of a problem: outliers, and noise that is larger than stated."""
        found = causes.noise(linear, linear.simulated(causes.SETS), self.sensors)
        return [*causes.outliers(linear, self.t_s), *(f for f in found if not f.overstated)]

    def _with_alike(self, first: Finding, sure: list[Finding]) -> Finding:
        """Return that of the systematic errors which explain about as much that leaves least to others.

        Those that explain as much with what they leave are not distinguished from it.  Where one sensor of two is long,
        the other is short beside it, and so are the ways of the robots.
        """
        rivals = [f for f in sure if f.is_steady and f.gain > ALIKE * first.gain]
        net = [f.gain - self._left(f) for f in rivals]
        equal = [f for f, gain in zip(rivals, net, strict=True) if gain > max(net) - LEAST_GAIN]
        of_cause = dict[tuple[str, ...], Finding]()
        for f in equal:
            cause = (f.name, *f.of[:2], f.unit)
            of_cause[cause] = max(of_cause.get(cause, f), f, key=lambda one: one.gain)
        one, *others = of_cause.values()
        return replace(one, alike=tuple(others))

    def _left(self, finding: Finding) -> float:
        """Return what another systematic error explains when one is taken out."""
        linear = problem_without(self.linear, finding)
        others = causes.systematic(linear, columns_of(linear, self.sensors, self.rates))
        return max((f.gain for f in others), default=0.0)

    def _leave_out_explained(self) -> None:
        """Leave out noise and outliers that the causes found after them explain, and count what is left of the others.

        Each is put back into the data, one after the other.
        """
        for finding in [f for f in self.found if f.takes_up]:
            self.found.remove(finding)
            self.linear = self.linear.scaled(1.0 / finding.noise, 1.0 / finding.errors)
            self.simulated = self.linear.simulated(causes.SETS)
            for again in self._sure(self._any_misfit(self.linear), LEAST_GAIN):
                if (again.name, again.of) == (finding.name, finding.of):
                    self.take(again)

    def correlated(self) -> list[Finding]:
        """Return the errors that are correlated from one observation to the next."""
        found = causes.correlations(self.linear, self.simulated, self.sensors, self.t_s)
        return self._sure(found, LEAST_GAIN)

    def candidates(self) -> list[Finding]:
        """Return all that may explain what is left."""
        columns = columns_of(self.linear, self.sensors, self.rates)
        late = (c._replace(unit=DRIFT, Z=c.Z * self.t_s[self.linear.rows.node]) for c in columns if c.name == LATE)
        every = [*columns, *(c._replace(of=(*c.of, DRIFT)) for c in late)]
        found = [
            *causes.systematic(self.linear, [*every, *errors_together(every)]),
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
        if finding.unit == causes.TIMES:
            finding = self._scaled(finding)
        else:
            self.suspects = [f for f in self.suspects if f not in finding.alike]
            before, self.linear = self.linear, problem_without(self.linear, finding)
            for one in finding.alike:
                other = problem_without(before, one)
                self.instead.append((other.z - self.linear.z, other.w - self.linear.w))
            if finding.is_steady:
                finding = self._beside(finding)
            else:
                self.simulated = self.linear.simulated(causes.SETS)
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
        steps, step = list[Finding](), finding
        for _ in range(SCALINGS):
            self._scale(step)
            steps.append(step)
            again = causes.noise(self.linear, self.simulated, self.sensors)
            step = next((f for f in again if (f.name, f.of) == (finding.name, finding.of)), step)
            if abs(step.value - 1.0) < SCALED:
                break
        one = joined(steps)
        return replace(one, sigma=finding.sigma * one.value / finding.value, gain=finding.gain)

    def _scale(self, finding: Finding) -> None:
        self.linear = self.linear.scaled(finding.noise, finding.errors)
        self.simulated = self.linear.simulated(causes.SETS)
