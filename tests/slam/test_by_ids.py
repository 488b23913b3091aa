"""The short way of a scan whose ids are all known answers and leaves what the long way does, bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import EventError
from kalmark.slam import by_ids

MARKS = np.random.default_rng(5).uniform(-8, 8, (30, 2))
GAP = range(60, 75)  # steps without a control


def events(names: tuple[str, ...], held: bool) -> Iterator[Any]:
    """Return steps of robots that see six of the landmarks each, now and then another robot, nothing, or an outlier."""
    rng, truth = np.random.default_rng(3), {name: np.array([0.0, i, 0.1]) for i, name in enumerate(names)}
    for t in range(120):
        for name in names:
            u = np.array([0.2, 0.0, 0.06])
            truth[name] = km.geometry.compose(truth[name], u)[0]
            if t not in GAP:
                u = u[[0, 2]] if held else u
                yield km.Control(float(t), name, u + 0.003 * rng.normal(size=len(u)))
            ids: list[Any] = rng.choice(len(MARKS), 6, replace=False).tolist() if t % 9 else []
            others = [truth[other][:2] for other in names if other != name and t % 7 == 0 and t > 20]
            seen = np.array([*MARKS[ids], *others]).reshape(-1, 2)
            y = km.geometry.observe(truth[name], seen)[0] + rng.normal(size=seen.shape) * [0.1, 0.02]
            y[:, 0] = np.abs(y[:, 0]) + 8.0 * (t % 11 == 5)
            ids += [other for other in names if other != name and others]
            yield km.Scan(float(t) + 0.4 * held, name, "lidar", y, ids)


def slam_of(names: tuple[str, ...], held: bool, off_m: float = 0.0, rel: float = 0.0, **settings: Any) -> km.Slam:
    motion: Any = km.motion.Unicycle(0.05, 0.02) if held else km.motion.Odometry2D(0.02, 0.01, 0.01)
    sensor = km.sensors.RangeBearing(0.1, 0.02, sigma_range_rel=rel)
    robots = [
        km.Robot(name, motion, (0.0, i, 0.1), {"lidar": km.Mount(sensor)}, gaps="widen") for i, name in enumerate(names)
    ]
    slam = km.Slam(robots, **settings)
    for i in range(8):
        slam.add_landmark(i, MARKS[i] + off_m * (i == 3), 0.01 * np.eye(2))
    return slam


def bits(slam: km.Slam) -> tuple[Any, ...]:
    tracks, surveys = slam.tracks, slam.state.surveys
    held = [vars(moving.held.gaps) | {"largest": 0, "motion": 0, "pending": 0} for moving in slam.state.moving.values()]
    slots = [slot for slot, space in enumerate(slam.map.spaces) if space is not None]
    means = [slam.map.mean(slot).tobytes() for slot in slots]
    counts = {name: track.observations for name, track in tracks.confirmed.items()}
    return means, slam.map.covariance(slots).tobytes(), counts, held, surveys.trial, surveys.misfits, slam.t_ns


WAYS: dict[str, dict[str, Any]] = {
    "dense": {},
    "compressed": {"map": "postponed"},
    "ekf": {"estimator": km.estimators.Ekf()},
    "gate off": {"association": km.association.ByIdentity("off")},
    "gate": {"association": km.association.ByIdentity(0.99)},
    "wrong survey": {"off_m": 1.0},
    "a range noise that grows": {"rel": 0.05},
}


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("names", [("a",), ("a", "b")])
@pytest.mark.parametrize("way", WAYS)
def test_both_ways_are_equal(way: str, names: tuple[str, ...], held: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    taken, corrected = list[bool](), by_ids.correct_by_ids

    def counted(*arguments: Any) -> Any:
        report = corrected(*arguments)
        taken.append(report is not None)
        return report

    monkeypatch.setattr(by_ids, "correct_by_ids", counted)
    short, long = (slam_of(names, held, **WAYS[way]) for _ in range(2))
    long.before_scan = lambda *_: None  # which asks for the long way
    for event in sorted(events(names, held), key=lambda event: event.t_ns):
        one, other = short.process(event), long.process(event)
        assert one.observations == other.observations or any(o.d2 != o.d2 for o in one.observations)
        assert one.gaps == other.gaps
        for a, b in ((one.y, other.y), (one.e, other.e), (one.z, other.z), (one.Z, other.Z)):
            assert a.tobytes() == b.tobytes()
    assert bits(short) == bits(long)
    assert 0 < sum(taken) < len(taken)


def test_a_bad_scan_is_refused_on_the_short_way_and_changes_nothing() -> None:
    slam = slam_of(("a",), held=True)
    for event in list(events(("a",), held=True))[:80]:
        slam.process(event)
    before = bits(slam)
    with pytest.raises(EventError, match="range is -1"):
        slam.process(km.Scan(500.0, "a", "lidar", [[1.0, 0.0], [-1.0, 0.0]], [10, 11]))
    assert bits(slam) == before
