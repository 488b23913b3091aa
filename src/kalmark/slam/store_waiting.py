"""What waits to become landmarks, in a file: kept poses, the measurements made there, the candidates made of those."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.errors import MapError
from kalmark.slam.candidates import Candidate, Sight, Waiting
from kalmark.slam.describe import State
from kalmark.slam.events import Id

if TYPE_CHECKING:
    from kalmark.slam.slam import Slam


def waiting_described(slam: Slam) -> list[Any]:
    """Return what waits of each sensor that starts landmarks late."""
    return [
        [robot, sensor, _described(view.waiting)]
        for (robot, sensor), view in slam._views.items()
        if view.delayed is not None
    ]


def _described(waiting: Waiting) -> State:
    sights = {(s.at, s.k): s for c in waiting.candidates for s in c.sights}
    number = {key: i for i, key in enumerate(sights)}
    return {
        "numbered": waiting.numbered,
        "poses": [[n, slot] for n, slot in waiting.poses.items()],
        "sights": [[at, k, s.y.tolist(), s.R.tolist()] for (at, k), s in sights.items()],
        "candidates": [
            {
                "name": c.name.item() if isinstance(c.name, np.generic) else c.name,
                "sights": [number[s.at, s.k] for s in c.sights],
                "mean": None if c.mean is None else c.mean.tolist(),
                "cov": None if c.cov is None else c.cov.tolist(),
                "missed": c.missed,
            }
            for c in waiting.candidates
        ],
    }


def waiting_restored(slam: Slam, state: list[Any]) -> None:
    """Give each sensor back what waits of it.  Raises MapError if it is not what such a sensor keeps."""
    for robot, sensor, description in state:
        view = slam._views.get((robot, sensor))
        if view is None or view.delayed is None:
            raise MapError(f"measurements of {robot!r}, {sensor!r} wait, expected a sensor that starts landmarks late")
        view.waiting = _restored(description, len(view.sensor.columns), f"what waits of {robot!r}, {sensor!r}")


def _restored(state: State, m: int, what: str) -> Waiting:
    poses: dict[int, int] = dict(map(tuple, state["poses"]))
    sights = [
        Sight(at, k, np.array(y, dtype=np.float64), np.array(R, dtype=np.float64)) for at, k, y, R in state["sights"]
    ]
    candidates = [
        Candidate(
            _name(c["name"], what),
            [sights[i] for i in c["sights"]],
            None if c["mean"] is None else np.array(c["mean"], dtype=np.float64),
            None if c["cov"] is None else np.array(c["cov"], dtype=np.float64),
            int(c["missed"]),
        )
        for c in state["candidates"]
    ]
    bad = [s for s in sights if s.y.shape != (m,) or s.R.shape != (m, m) or s.at not in poses]
    shapes: list[Any] = [(getattr(c.mean, "shape", None), getattr(c.cov, "shape", None)) for c in candidates]
    odd = [
        c for c, of in zip(candidates, shapes, strict=True) if not c.sights or of not in ((None, None), ((2,), (2, 2)))
    ]
    numbers = [*poses, state["numbered"]]
    if bad or odd or any(type(n) is not int or n > state["numbered"] for n in numbers):
        raise MapError(f"{what} does not fit together")
    return Waiting(poses, candidates, state["numbered"])


def _name(name: Any, what: str) -> Id | None:
    if name is not None and not isinstance(name, int | str):
        raise MapError(f"{what} has the id {name!r}, expected an integer or a text")
    return name
