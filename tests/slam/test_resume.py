"""A map saved while landmarks of every kind are pending resumes bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km

NOISE = np.array([0.01, 0.003, 0.005])
RADIO, SONAR, EYE = km.sensors.Range(0.1), km.sensors.Range(0.1), km.sensors.Bearing(0.02, range_max_m=40.0)
MARKS = np.random.default_rng(2).uniform([0, -8], [16, 12], (40, 2))
BEACONS = np.array([[5.0, 9.0], [9.0, -7.0], [-6.0, 2.0]])
SEEN = 3.0  # m: how far the lidar sees


def slam_of(map_: str) -> km.Slam:
    """Return a Slam of a robot whose sensors start landmarks in all ways, with a mount that calibrates itself."""
    point, held = km.landmarks.Point2D(), km.Upkeep(confirm=4, within=8, keep_poses=6)
    lidar, cov = km.sensors.Position2D(0.05, 0.05, range_max_m=SEEN), np.diag([0.01, 0.01, 0.001])
    matched = km.association.GlobalAssignment()
    sensors = {
        "radio": km.Mount(RADIO, at=(0.2, 0.1, 0.3), cov=cov),
        "sonar": km.Mount(SONAR, initialization=km.initialization.Hypotheses()),
        "eye": km.Mount(EYE, initialization=km.Delayed(), association=matched, landmark=point),
        "lidar": km.Mount(lidar, association=matched, upkeep=held, landmark=point),
    }
    robot = km.Robot("r", km.motion.Odometry2D(*NOISE), sensors=sensors)
    return km.Slam([robot], map=map_, landmarks=point)


def drive(steps: int) -> list[Any]:
    rng, truth, events = np.random.default_rng(8), np.zeros(3), list[Any]()
    for t in range(steps):
        u = np.array([0.4, 0.0, 0.05])
        truth = km.geometry.compose(truth, u)[0]
        events.append(km.Control(float(t), "r", u + rng.normal(size=3) * NOISE))
        for sensor, at, names in (("radio", (0.2, 0.1, 0.3), (0, 1)), ("sonar", (0.0, 0.0, 0.0), (2,))):
            place = km.geometry.compose(truth, np.array(at))[0][:2]
            y = np.linalg.norm(BEACONS[list(names)] - place, axis=1) + 0.1 * rng.normal(size=len(names))
            events.append(km.Scan(float(t), "r", sensor, y[:, None], names))
        local = km.geometry.to_frame(truth, MARKS)[0]
        far = np.linalg.norm(local, axis=1)
        rays, near = local[(far > SEEN) & (far < 7.0)], local[far < SEEN]
        y = np.arctan2(rays[:, 1], rays[:, 0]) + 0.02 * rng.normal(size=len(rays))
        events.append(km.Scan(float(t), "r", "eye", y[:, None]))
        events.append(km.Scan(float(t), "r", "lidar", near + 0.05 * rng.normal(size=near.shape)))
    return events


def bits(slam: km.Slam) -> tuple[Any, ...]:
    slots = [slot for slot, space in enumerate(slam.map.spaces) if space is not None]
    means = [slam.map.mean(slot).tobytes() for slot in slots]
    return slots, means, slam.map.covariance(slots).tobytes(), slam.landmarks().ids, slam.landmarks().observations


def everything_waits(slam: km.Slam) -> bool:
    """Return whether there are ranges, hypotheses, candidates and kept measurements, and clones that sensors share."""
    pending = [track.pending for track in slam.tracks.pending.values() if track.pending is not None]
    return (
        any(p.measurements for p in pending)
        and any(p.hypotheses for p in pending)
        and any(candidate.mean is not None for candidate in slam.tracks.candidates.get(("r", "eye"), ()))
        and any(len(track.measurements) > 1 for track in slam.tracks.tentative.values())
        and any(len(clone.users) > 1 for clone in slam.clones.clones.values())
    )


@pytest.mark.parametrize("map_", ["dense", "postponed"])
def test_all_that_is_pending_and_tentative_resumes_bit_for_bit(map_: str, tmp_path: Path) -> None:
    slam, events, started, path = slam_of(map_), iter(drive(40)), set[str](), tmp_path / "map.kmk"
    while not everything_waits(slam):
        slam.process(next(events))
    slam.save(path)
    again = km.Slam.load(path)
    assert bits(again) == bits(slam)
    assert everything_waits(again)
    for k, event in enumerate(events):
        reports = slam.process(event), again.process(event)
        said = [(r.observations, r.late, r.removed, r.merged) for r in reports]
        assert said[0] == said[1]
        started |= {event.sensor for o in reports[0].observations if o.outcome == "new"}
        if k % 40 == 7:  # saved and loaded again and again
            slam.save(tmp_path / "other.kmk")  # to save finishes a full update of a compressed map
            again.save(path)
            again = km.Slam.load(path)
    assert started == {"radio", "sonar", "eye", "lidar"}
    assert bits(again) == bits(slam)
