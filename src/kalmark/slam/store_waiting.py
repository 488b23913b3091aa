"""What waits to become landmarks, in a file: kept poses, the measurements made there, the candidates made of those."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from kalmark.errors import MapError
from kalmark.events import Id, Scan
from kalmark.management.candidates import Candidate, Sight, Waiting
from kalmark.management.kept import Kept
from kalmark.slam.describe import State

if TYPE_CHECKING:
    from kalmark.management.tentative import Tentative
    from kalmark.slam.slam import Slam


def waiting_described(slam: Slam) -> list[Any]:
    """Return what waits of each sensor that starts landmarks late."""
    return [
        [robot, sensor, _described(view.waiting)]
        for (robot, sensor), view in slam._views.items()
        if view.delayed is not None or view.upkeep.keep_poses
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
        if view is None or (view.delayed is None and not view.upkeep.keep_poses):
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


def kept_described(t: Tentative) -> State:
    """Return the sightings kept of a tentative landmark."""
    rows = [
        [one.at, one.k, one.scan.t_ns, one.scan.robot, one.scan.sensor, one.scan.y.tolist(), one.R.tolist(),
         one.scan.cov is not None]
        for one in t.kept
    ]  # fmt: skip
    return {"first": t.first, "kept": rows}


def kept_restored(state: State) -> dict[str, Any]:
    """Return the sightings kept of a tentative landmark, and its first one, by their names in `Tentative`."""
    kept = []
    for at, k, t_ns, robot, sensor, y, R_, given in state.get("kept", ()):
        R = np.array(R_, dtype=np.float64)
        scan = Scan(t_ns=t_ns, robot=robot, sensor=sensor, y=y, cov=R[None] if given else None)
        kept.append(Kept(at, k, scan, R))
    first = state.get("first")
    return {"kept": kept, "first": None if first is None else tuple(first)}


def check_kept(slam: Slam) -> None:
    """Raise MapError if a sighting that is kept was made from a pose that is not."""
    for name, t in slam.members.tentative.items():
        for one in t.kept:
            view = slam._views.get((one.scan.robot, one.scan.sensor))
            if view is None or one.at not in view.waiting.poses or one.R.shape != (view.dof, view.dof):
                raise MapError(f"a sighting of the tentative {name!r} does not fit the poses that are kept")


def _name(name: Any, what: str) -> Id | None:
    if name is not None and not isinstance(name, int | str):
        raise MapError(f"{what} has the id {name!r}, expected an integer or a text")
    return name
