"""Classes of landmarks that sensors report, sometimes wrong ones: colours of cones, kinds of trees or signs.

A class is a likelihood in the association, not an innovation: the track of a landmark has the log-likelihoods of the
classes that it may be of, and each observation that is fused with it adds that of the class it was reported with.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np

from kalmark.arrays import Array
from kalmark.declare import Probability, Within, refuse, register
from kalmark.geometry.gaussian import normalized_weights

LogClasses = dict[str, float]  # log-likelihoods, those of classes that are not there are 0


@register("classes", "classes")
class Classes:
    """The classes that a sensor reports of landmarks, and how often it reports a wrong one.

    >>> cones = km.Classes(("blue", "yellow"), error=0.1)
    >>> cones.confusion_matrix
    array([[0.9, 0.1],
           [0.1, 0.9]])
    """

    names: Annotated[tuple[str, ...], "The classes, as the observations name them."] = ("blue", "yellow")
    error: Annotated[Probability, "Probability that another class is reported than the true one."] = 0.05
    confusion: Annotated[
        tuple[float, ...] | None,
        Within(gt=0, lt=1),
        "Probability of each class to be reported, of the first true class, then of the second, and so on; by `error` "
        "if absent.",
    ] = None

    def __post_init__(self) -> None:
        count = len(self.names)
        if count < 2 or len(set(self.names)) < count:
            raise refuse(self, "names", "at least two different texts")
        object.__setattr__(self, "names", tuple(self.names))
        if self.confusion is None:
            return
        object.__setattr__(self, "confusion", tuple(self.confusion))
        if len(self.confusion) != count**2 or abs(self.confusion_matrix.sum(axis=1) - 1.0).max() > 1e-6:
            raise refuse(self, "confusion", f"{count} times {count} probabilities, each {count} of the sum 1")

    @property
    def confusion_matrix(self) -> Array:
        """The probability (C, C) of each true class, by rows, to be reported as each class, by columns."""
        count = len(self.names)
        if self.confusion is not None:
            return np.array(self.confusion).reshape(count, count)
        wrong = self.error / (count - 1)
        return np.full((count, count), wrong) + (1.0 - self.error - wrong) * np.eye(count)

    def likelihoods(self, reported: Sequence[str | None]) -> Array:
        """Return the likelihood (K, C) of each true class, of what is reported; 1 of None."""
        M, at = self.confusion_matrix, {name: i for i, name in enumerate(self.names)}
        return np.array([np.ones(len(at)) if name is None else M[:, at[name]] for name in reported]).reshape(
            -1, len(at)
        )

    def distances(self, reported: Sequence[str | None], known: Sequence[Mapping[str, float]]) -> tuple[Array, Array]:
        """Return by how much d2 is larger for a pair (K, L) of what is reported and a landmark, and for a new one (K,).

        That is -2 log p(reported | landmark), less that of the class which is likeliest to be reported so.  `known` are
        the log-likelihoods of the classes of the landmarks.
        """
        of_class = self.likelihoods(reported)
        best = of_class.max(axis=1)
        weights = np.array([self.probabilities(of) for of in known]).reshape(-1, len(self.names))
        pairs, new = of_class @ weights.T / best[:, None], of_class.mean(axis=1) / best
        return -2.0 * np.log(pairs), -2.0 * np.log(new)

    def probabilities(self, known: Mapping[str, float]) -> Array:
        """Return how likely a landmark is of each class (C,), by its log-likelihoods."""
        return normalized_weights(np.array([known.get(name, 0.0) for name in self.names]))


def add_report(known: LogClasses, classes: Classes, reported: str | None) -> None:
    """Add what is reported of a landmark to the log-likelihoods of its classes."""
    if reported is not None:
        for name, p in zip(classes.names, classes.likelihoods([reported])[0].tolist(), strict=True):
            known[name] = known.get(name, 0.0) + math.log(p)


def distance_of_landmarks(one: Mapping[str, float], other: Mapping[str, float]) -> float:
    """Return -2 log of how much likelier the classes of two landmarks are if both are one, than if they are not."""
    names = list({**one, **other})
    if not names:
        return 0.0
    p, q = (normalized_weights(np.array([of.get(name, 0.0) for name in names])) for of in (one, other))
    return -2.0 * math.log(len(names) * float(p @ q))
