"""Which landmark was that?  By the identity the log gives, or by what fits: each for itself, together, or jointly.

What an association may ask and answer is in `decisions`; a user's own one needs no more than `Association` says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from kalmark.errors import ModelError
from kalmark.geometry.gaussian import gate as chi2_gate
from kalmark.slam.decisions import (
    ANEW,
    DEFERRED,
    FRESH,
    HELD_BACK,
    MIXED,
    NEW,
    STRANGE,
    Association,
    Decision,
    Matched,
    Mixture,
    Query,
)
from kalmark.slam.events import Id
from kalmark.slam.joint import best_matching
from kalmark.slam.posterior import JUST_SEEN, Posterior, added, agreeing, crowd, posterior

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

__all__ = [
    "ANEW", "DEFERRED", "NEW", "Association", "Automatic", "Averaged", "ByIdentity", "Cliques", "Decision",
    "GlobalAssignment", "JointCompatibility", "NearestNeighbour", "Query", "Sampled",
]  # fmt: skip

FORBIDDEN = 1e6  # times the gate: a pair outside
CLEAR = 0.05  # landmarks in a gate by chance, up to which each observation can be told by itself
NONE = 0.99  # how likely an observation must be of nothing in the map to be of something new
BY_CHANCE = 1e-3  # matchings as good to be expected by chance where there is more than one landmark in a gate
WIDEST = 256  # candidates for an observation

Gate = float | str


def _checked(gate: Gate, where: str) -> None:
    if gate in ("default", "off") or (isinstance(gate, int | float) and 0 < gate < 1):
        return
    raise ModelError(f"{where}: gate is {gate!r}, expected a probability between 0 and 1, 'off' or 'default'")


def _threshold(gate: Gate, m: int, default: float) -> float:
    if gate == "default":
        return default
    return math.inf if gate == "off" else chi2_gate(float(gate), m)


@dataclass(frozen=True)
class ByIdentity:
    """Trust the ids of the log; an id that is not in the map yet is a new landmark.

    `gate` is the probability with which a right pair is let through; "off" fuses all; "default" is the estimator's own:
    the guide's 3 sigma for `Ekf`, off for the others.
    """

    gate: Gate = "default"

    def __post_init__(self) -> None:
        _checked(self.gate, "ByIdentity")

    def threshold(self, m: int, default: float) -> float:
        """Return the gate as a squared Mahalanobis distance."""
        return _threshold(self.gate, m, default)

    def associate(self, query: Query) -> list[Decision]:
        """Answer with the ids as they are; the slam knows which are new."""
        return [(i, "") if i is not None else (None, "no id in the log") for i in query.ids]


@dataclass(frozen=True)
class _Gated:
    """Pairs of observations and landmarks inside an individual gate; ids are used where given.

    Beyond `new_gate` from every landmark an observation is a new one; what is nearer than that and stays without a pair
    is left alone.
    """

    gate: float = 0.99
    new_gate: float = 0.99999

    nearest: ClassVar[int] = 4  # candidates for an observation,
    farther: ClassVar[float] = 10.0  # none so many times as far as the nearest

    def __post_init__(self) -> None:
        for name in ("gate", "new_gate"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise ModelError(f"{type(self).__name__}: {name} is {value!r}, expected a probability between 0 and 1")

    def threshold(self, m: int, default: float) -> float:
        """Return the gate as a squared Mahalanobis distance."""
        return chi2_gate(self.gate, m)

    def associate(self, query: Query) -> list[Decision]:
        """Answer with the ids where there are, with the pairs of `match` elsewhere."""
        answers: list[Decision] = [(i, "") if i is not None else (NEW, "no landmark near") for i in query.ids]
        open_ = np.array([k for k, i in enumerate(query.ids) if i is None], dtype=np.int64)
        gate, far = chi2_gate(self.gate, query.dof()), chi2_gate(self.new_gate, query.dof())
        names, d2 = self.near(query, open_, gate) if len(open_) else ([], np.zeros((0, 0)))
        if not names:
            query.learn(0.0, float(len(open_)))
            return answers
        pairs, reasons, mixed, known = self.match(query, open_, names, d2, gate)
        if known is None and pairs.min() >= 0:
            for row, (k, pair) in enumerate(zip(open_.tolist(), pairs.tolist(), strict=True)):
                answers[k] = names[pair], reasons.get(row, "")
            query.learn(float(len(open_)), 0.0)
            return answers
        mixture = None if mixed is None else Mixture(open_, names, mixed)
        nearest, least = d2.argmin(axis=1).tolist(), d2.min(axis=1)
        for row, (k, pair, d) in enumerate(zip(open_.tolist(), pairs.tolist(), least.tolist(), strict=True)):
            if pair >= 0:
                answers[k] = (names[pair], reasons.get(row, ""))
            elif pair == HELD_BACK:
                answers[k] = (DEFERRED, reasons[row])
            elif pair == MIXED and mixture is not None:
                answers[k] = (mixture, reasons[row])
            elif pair == FRESH:
                answers[k] = (NEW, reasons[row])
            elif pair == STRANGE:
                answers[k] = (ANEW, reasons[row])
            elif d <= gate:
                why = f"its nearest landmark {names[nearest[row]]!r} is another observation's"
                answers[k] = (None, reasons.get(row, why))
            elif d <= far:
                answers[k] = (None, f"between {names[nearest[row]]!r} and a new landmark: d2 {d:.1f}")
        if known is None:
            known = np.where(pairs >= 0, 1.0, np.where(least > far, 0.0, np.nan))
        told = known[~np.isnan(known)]
        query.learn(float(told.sum()), float((1.0 - told).sum()))
        return answers

    def near(self, query: Query, open_: Index, gate: float) -> tuple[list[Id], Array]:
        """Return the candidates and their squared distances d2 (K, L) from the observations `open_`."""
        return self._near(query, open_, self.nearest)

    def _near(self, query: Query, open_: Index, nearest: int) -> tuple[list[Id], Array]:
        named = set(query.ids)
        names = [c for c in query.candidates(nearest, self.farther) if c not in named]
        d2 = query.distances(names) if names else np.zeros((len(query.ids), 0))
        return names, np.fmin(d2 if len(open_) == len(d2) else d2[open_], np.inf)  # NaN is as far as can be

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Return the number of the name paired with each row of d2 (K, L), -1 for none or its like, and why."""
        raise NotImplementedError


@dataclass(frozen=True)
class NearestNeighbour(_Gated):
    """Take the nearest landmark inside an individual gate, each at most once in a scan, the closest pair first."""

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Pair greedily; an observation whose nearest landmark is taken gets none."""
        nearest, least = d2.argmin(axis=1).tolist(), d2.min(axis=1)
        fits = (least <= gate).tolist()
        if all(fits) and len(set(nearest)) == len(nearest):
            return Matched(np.array(nearest), {})
        pairs, reasons, taken = np.full(len(d2), -1), {}, set()
        for row in np.argsort(least, kind="stable").tolist():
            column = nearest[row]
            if column in taken:
                reasons[row] = f"its nearest landmark {names[column]!r} is taken by a nearer observation"
            elif fits[row]:
                taken.add(column)
                pairs[row] = column
        return Matched(pairs, reasons)


@dataclass(frozen=True)
class GlobalAssignment(_Gated):
    """Take the pairs whose squared distances add up to the least, one without a pair counting as the gate.

    Bipartite matching: an observation gives way to another if that makes the whole better.
    """

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Pair by the linear assignment of the whole scan."""
        count = len(names)
        cost = np.full((len(d2), count + len(d2)), gate)
        cost[:, :count] = np.where(d2 <= gate, d2, FORBIDDEN * gate)
        columns = linear_sum_assignment(cost)[1]
        return Matched(np.where(columns < count, columns, -1), {})


@dataclass(frozen=True)
class JointCompatibility(_Gated):
    """Take the largest set of pairs that fit together: JCBB.  Neira and Tardos 2001.

    The error of the pose is common to all observations of a scan, and only a joint test knows.  At most `most_nodes` of
    the search are looked at; what is best by then is taken.
    """

    most_nodes: int = 20_000

    nearest: ClassVar[int] = 16
    farther: ClassVar[float] = math.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.most_nodes < 1:
            raise ModelError(f"JointCompatibility: most_nodes is {self.most_nodes}, expected at least 1")

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Pair by branch and bound, the observations with the fewest candidates first."""
        order = np.argsort((d2 <= gate).sum(axis=1), kind="stable")
        fitting = [np.flatnonzero(d2[row] <= gate) for row in order]
        fitting = [columns[np.argsort(d2[row, columns])] for row, columns in zip(order, fitting, strict=True)]
        first, columns = np.cumsum([0, *(len(c) for c in fitting)]), np.concatenate(fitting)
        pairs = np.full(len(d2), -1)
        if not len(columns):
            return Matched(pairs, {})
        z, Z = query.jointly(np.repeat(open_[order], np.diff(first)), [names[c] for c in columns.tolist()])
        gates = np.array([0.0, *(chi2_gate(self.gate, z.shape[1] * (n + 1)) for n in range(len(d2)))])
        chosen, finished = best_matching(first, columns, z, Z, gates, self.most_nodes)
        pairs[order] = np.where(chosen >= 0, columns[chosen], -1)
        why = "it does not fit with the others" + ("" if finished else f", as far as {self.most_nodes} nodes tell")
        return Matched(pairs, dict.fromkeys(range(len(d2)), why))


@dataclass(frozen=True)
class _Joint(_Gated):
    """Matchings as wholes, of landmarks however many are inside a gate.

    What is likely not to be in the map, by all matchings together, is new.  Where a gate holds more than one landmark
    on average, not counting those just seen, the robot is lost: pairs are then not held against the pose one by one.
    """

    most_nodes: int = 5_000_000

    weighs: ClassVar[bool] = True  # it says itself what is ambiguous
    nearest: ClassVar[int] = 8
    farther: ClassVar[float] = math.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.most_nodes < 1:
            raise ModelError(f"{type(self).__name__}: most_nodes is {self.most_nodes}, expected at least 1")

    def threshold(self, m: int, default: float) -> float:
        """Return that any pair of a matching is fused: it was tested as a whole."""
        return math.inf

    def near(self, query: Query, open_: Index, gate: float) -> tuple[list[Id], Array]:
        """Return candidates: of each observation's so many that not all of them are inside its gate."""
        nearest = self.nearest
        names, d2 = self._near(query, open_, nearest)
        while nearest < WIDEST and ((d2 <= gate).sum(axis=1) >= nearest).any():
            nearest *= 4
            names, d2 = self._near(query, open_, nearest)
        return names, d2

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Pair one by one where each observation can be told by itself, jointly elsewhere."""
        together = query.together(names)
        if together is None:
            return JointCompatibility(self.gate, self.new_gate).match(query, open_, names, d2, gate)
        rows, columns = np.nonzero(np.isfinite(d2))
        just = np.zeros(d2.shape, dtype=np.bool_)
        just[rows, columns] = together.room(open_[rows], columns) <= JUST_SEEN
        crowded, fit = crowd(np.where(just, np.inf, d2), gate, query.dof()).max(), d2 <= gate
        if crowded <= CLEAR and max(fit.sum(axis=0).max(), fit.sum(axis=1).max()) <= 1:
            return GlobalAssignment.match(self, query, open_, names, d2, gate)  # type: ignore[arg-type]
        lost = crowded > 1
        far = chi2_gate(self.new_gate, query.dof())
        near: Flags = np.isfinite(d2) if lost else fit  # far off, the distances themselves are not to be trusted
        found = posterior(together, open_, d2, near, query.dof(), self.gate, self.most_nodes, query.experience())
        told = np.asarray(near.any(axis=1))
        pairs, reasons, mixed, _ = self.choose(query, names, found, told, lost)
        none = np.where(told, found.none() if found.finished else np.nan, np.where(d2.min(axis=1) > far, 1.0, np.nan))
        if lost and (pairs == STRANGE).all():  # it has not recognised anything
            return self.anew(np.where(just, d2, np.inf), gate, far, reasons)
        for row in np.flatnonzero(told & (none >= NONE)).tolist() if not lost else ():
            pairs[row], reasons[row] = FRESH, "no landmark is likely there"
        for row in np.flatnonzero(pairs == -1).tolist() if (pairs >= 0).any() else ():
            if added(together, open_, pairs, row, np.flatnonzero(d2[row] <= far)) > far:
                pairs[row], reasons[row] = FRESH, "no landmark fits there, from where the others are seen"
        return Matched(pairs, reasons, mixed, 1.0 - none)

    def anew(self, d2: Array, gate: float, far: float, reasons: dict[int, str]) -> Matched:
        """Pair what a lost robot sees with what it has just seen, at these d2 (K, L); the rest is strange to it."""
        cost = np.full((len(d2), d2.shape[1] + len(d2)), gate)
        cost[:, : d2.shape[1]] = np.where(d2 <= gate, d2, FORBIDDEN * gate)
        columns = linear_sum_assignment(cost)[1]
        pairs = np.where(columns < d2.shape[1], columns, np.where(d2.min(axis=1) > far, STRANGE, HELD_BACK))
        return Matched(pairs, reasons, None, np.full(len(d2), np.nan))

    def choose(self, query: Query, names: list[Id], found: Posterior, near: Flags, lost: bool) -> Matched:
        """Choose from the matchings; `near` tells which observations any landmark could be."""
        raise NotImplementedError


@dataclass(frozen=True)
class Automatic(_Joint):
    """Pair one by one where the pose is clear, jointly where it is not, and hold back what remains ambiguous.

    Where gates are small against the gaps between landmarks, that is the global assignment.  Elsewhere the likeliest of
    the matchings whose pairs agree with each other is taken (`posterior`), and of it each pair that is at least as
    probable as `confidence`; the others are deferred.  Where there is more than one landmark in a gate on average, the
    robot is lost, and a matching is only taken if it holds most of the scan and none as good is expected by chance.
    """

    confidence: float = 0.9

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.confidence < 1:
            raise ModelError(f"Automatic: confidence is {self.confidence!r}, expected a probability below 1")

    def choose(self, query: Query, names: list[Id], found: Posterior, near: Flags, lost: bool) -> Matched:
        """Choose the likeliest matching, and hold back pairs that are not sure."""
        count = int((found.pairs[0] >= 0).sum())
        if lost and (found.chance > BY_CHANCE or 2 * count <= len(near)):
            why = f"its scan is ambiguous: {count} pairs, {found.chance:.1g} matchings as good are expected by chance"
            why = why if count else "no matching of its scan is likely"
            return Matched(np.full(len(near), STRANGE), dict.fromkeys(range(len(near)), why))
        pairs, shares = found.pairs[0].copy(), found.shares()
        unsure = ((shares < self.confidence) | (not found.finished)) & near
        reasons = {row: found.why(row, names) for row in np.flatnonzero(unsure).tolist()}
        pairs[unsure] = HELD_BACK
        return Matched(pairs, reasons)


@dataclass(frozen=True)
class Sampled(_Joint):
    """Draw a matching by how likely each is, instead of the likeliest: [F]'s independent samples from the posterior.

    The same scan draws the same matching for the same `seed`.
    """

    seed: int = 0

    def choose(self, query: Query, names: list[Id], found: Posterior, near: Flags, lost: bool) -> Matched:
        """Draw one."""
        rng = np.random.default_rng([self.seed, *query.key()])
        drawn = int(rng.choice(len(found.weights), p=found.weights))
        why = f"drawn with the probability {found.weights[drawn]:.2f}"
        return Matched(found.pairs[drawn].copy(), dict.fromkeys(range(len(near)), why))


@dataclass(frozen=True)
class Averaged(_Joint):
    """Average over all matchings, each by how likely it is, as [F] would ideally: JPDA, but jointly for a whole scan.

    The map becomes the mean of what it would be after each, and its covariance holds how far these are apart.  Needs a
    dense map.
    """

    averages: ClassVar[bool] = True

    def choose(self, query: Query, names: list[Id], found: Posterior, near: Flags, lost: bool) -> Matched:
        """Average over what any landmark could be."""
        unlikely = (found.pairs >= 0).T @ found.weights < 0.5
        pairs = np.where(near & ~unlikely, MIXED, -1)
        return Matched(pairs, {row: found.why(row, names) for row in np.flatnonzero(near).tolist()}, found)


@dataclass(frozen=True)
class Cliques(_Gated):
    """Take the largest set of pairs that agree with each other wherever the robot is, if it fits jointly.  Bailey 2002.

    Two pairs agree if the landmarks are as far from each other as what was seen is; the pose is not asked before the
    joint test.  Where two sets as large contradict each other, both are deferred.  For the closing of loops.
    """

    most_nodes: int = 5_000_000

    weighs: ClassVar[bool] = True
    nearest: ClassVar[int] = WIDEST
    farther: ClassVar[float] = math.inf

    def match(self, query: Query, open_: Index, names: list[Id], d2: Array, gate: float) -> Matched:
        """Pair by the largest clique."""
        together = query.together(names)
        if together is None:
            return JointCompatibility(self.gate, self.new_gate).match(query, open_, names, d2, gate)
        found, finished = agreeing(together, open_, d2, np.isfinite(d2), self.gate, self.most_nodes)
        sizes, fit = (found >= 0).sum(axis=1), np.full(len(found), np.inf)
        for i, pairs in enumerate(found):
            rows = np.flatnonzero(pairs >= 0)
            fit[i] = together.fit(open_[rows], pairs[rows])[0]
        fits = fit <= [chi2_gate(self.gate, query.dof() * int(n)) for n in sizes]
        best = np.flatnonzero(fits & (sizes == sizes[fits].max(initial=0)))
        if not len(best):
            return Matched(np.full(len(d2), -1), {})
        alike = (found[best] == found[best[0]]).all(axis=0)
        why = "cliques as large contradict each other" + ("" if finished else ", and the search was not finished")
        pairs = np.where(alike, found[best[0]], HELD_BACK)
        return Matched(pairs, dict.fromkeys(np.flatnonzero(~alike).tolist(), why))
