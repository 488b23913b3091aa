"""Copies of a Slam, by `copy`, `pickle` and in other processes: each goes on bit for bit as the original does."""

from __future__ import annotations

import copy
import multiprocessing as mp
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import kalmark as km

WAYS: list[tuple[str, Callable[[Any], Any]]] = [
    ("copy", copy.copy),
    ("deepcopy", copy.deepcopy),
    *((f"pickle {n}", lambda slam, n=n: pickle.loads(pickle.dumps(slam, n))) for n in (2, 4, 5)),
]


def a_slam(map_: str = "auto") -> km.Slam:
    wheels, seen = km.motion.Unicycle(sigma_v_mps=0.05, sigma_w_radps=0.03), km.sensors.RangeBearing()
    mount = km.Mount(seen, at=(0.3, 0, 0), cov=np.diag([1e-4, 1e-4, 1e-4]))
    heading = km.Mount(km.sensors.Heading(sigma_heading_rad=0.01))
    return km.Slam([km.Robot("r", wheels, sensors={"l": mount, "compass": heading})], map=map_)


def feed(slam: km.Slam, first: int, last: int) -> None:
    for k in range(first, last):
        slam.process(km.Control(t_ns=k * 10**8, robot="r", u=(0.5, 0.1)))
        y = [[3 + 0.1 * j, 0.3 * j - 2] for j in range(12)]
        slam.process(km.Scan(t_ns=k * 10**8 + 1, robot="r", sensor="l", y=y, ids=[k // 5 * 3 + j for j in range(12)]))
        slam.process(km.Scan(t_ns=k * 10**8 + 2, robot="r", sensor="compass", y=[[0.01 * k]]))


def digest(slam: km.Slam) -> bytes:
    names = [one.id for one in slam.landmarks()]
    return bytes(slam.covariance("r", *names).tobytes()) + slam.mean("r").tobytes() + repr(names).encode()


@pytest.mark.parametrize("map_", ["dense", "postponed"])
@pytest.mark.parametrize("way", WAYS, ids=[name for name, _ in WAYS])
def test_a_copy_goes_on_as_the_original_and_leaves_it_alone(way: tuple[str, Callable[[Any], Any]], map_: str) -> None:
    slam = a_slam(map_)
    feed(slam, 0, 20)
    before, other = digest(slam), way[1](slam)
    assert digest(other) == before
    feed(other, 20, 30)
    assert digest(slam) == before
    feed(slam, 20, 30)
    assert digest(slam) == digest(other)


def fed(slam: km.Slam) -> bytes:
    feed(slam, 20, 30)
    return digest(slam)


@pytest.mark.parametrize("how", sorted({"fork", "spawn"} & set(mp.get_all_start_methods())))
def test_a_slam_goes_on_in_another_process(how: str) -> None:
    slam = a_slam()
    feed(slam, 0, 20)
    with mp.get_context(how).Pool(1) as pool:
        there = pool.apply(fed, (slam,))
    assert there == fed(slam)


class Steady(km.landmarks.Point2D):
    """A user's own type of landmark."""


def test_models_of_a_users_own_go_with_it() -> None:
    wheels, seen = km.motion.Unicycle(), km.Mount(km.sensors.RangeBearing())
    slam = km.Slam([km.Robot("r", wheels, sensors={"l": seen})], landmarks=Steady())
    feed_one = partial(km.Scan, robot="r", sensor="l", y=[[3.0, 0.1]], ids=[7])
    slam.process(feed_one(t_s=1.0))
    other = pickle.loads(pickle.dumps(slam))
    for one in (slam, other):
        one.process(feed_one(t_s=2.0))
    assert type(other.tracks.confirmed[7].model) is Steady
    assert digest(other) == digest(slam)
