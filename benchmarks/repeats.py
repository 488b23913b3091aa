"""Maps that repeat themselves: how many are found, merged to what they are, and how many are found that are none.

    python benchmarks/repeats.py                  # halls mapped twice and once, 20 seeds; worlds without repeats, 100
    python benchmarks/repeats.py --runs 5 --worlds 10

Halls are those of `hall.py`: gaps of their recorders are ignored, so that the place is mapped twice from there on.  A
world without repeats is a map as if all was observed from everywhere: landmarks at random, an orchard, an avenue,
clusters, pallets.  A line a case: runs, those with a repeat at the end, those whose map has every pillar once; and
the time of a search.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from hall import hall, mapped, right

import kalmark as km
from kalmark.arrays import Array
from kalmark.management.repeated_places import find_repeats

REACH_M, SIGMA_M = 8.0, 0.03
World = Callable[[np.random.Generator], Array]


def empty(map_: str = "dense") -> km.Slam:
    """Return a filter without landmarks."""
    laser = {"laser": km.Mount(km.sensors.RangeBearing(0.03, 0.01))}
    return km.Slam(km.Robot("cart", km.motion.Odometry2D(), sensors=laser), map=map_)


def part(slam: km.Slam, places: Array, rng: np.random.Generator) -> list[str]:
    """Map places (N, 2) as if observed from everywhere among them; return their names."""
    first = len(slam.landmarks())
    names = [f"u{first + i + 1}" for i in range(len(places))]
    for name, place in zip(names, places + SIGMA_M * rng.normal(size=places.shape), strict=True):
        slam.add_landmark(name, place, SIGMA_M**2 * np.eye(2))
    slam.tracks.reserved.clear()  # as if all had been made up
    low, high = places.min(axis=0), places.max(axis=0)
    for pose in rng.uniform(low, high, (int(np.prod((high - low) / REACH_M * 2)) + 10, 2)):
        slam.tracks.note_scan([names[i] for i in np.flatnonzero(np.linalg.norm(places - pose, axis=1) < REACH_M)])
    return names


def orchard(columns: int, rows: int, off_m: float, gone: float) -> World:
    """Return a world of trees 4 m and 3 m apart, off their places by so much, of which so many are gone."""

    def trees(rng: np.random.Generator) -> Array:
        places = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2) * (4.0, 3.0)
        places = places[rng.random(len(places)) >= gone]
        return places + off_m * rng.normal(size=places.shape)

    return trees


def clusters(rng: np.random.Generator) -> Array:
    """Return twelve clusters of eight."""
    return (rng.uniform(0, 60, (12, 1, 2)) + 1.5 * rng.normal(size=(12, 8, 2))).reshape(-1, 2)


def pallets(rng: np.random.Generator) -> Array:
    """Return the feet of thirty pallets, all turned alike."""
    feet = np.array([[-0.6, -0.4], [0.6, -0.4], [0.6, 0.4], [-0.6, 0.4]])
    return (rng.uniform(0, 60, (30, 1, 2)) + feet).reshape(-1, 2)


WORLDS: dict[str, World] = {
    "at random": lambda rng: rng.uniform(0, 40, (120, 2)),
    "many at random": lambda rng: rng.uniform(0, 120, (1000, 2)),
    "orchard": orchard(12, 8, 0.0, 0.0),
    "orchard, trees off their places": orchard(12, 8, 0.1, 0.0),
    "orchard, far off": orchard(12, 8, 0.3, 0.0),
    "orchard with gaps": orchard(14, 10, 0.05, 0.1),
    "orchard with many gaps": orchard(14, 10, 0.05, 0.3),
    "large orchard": orchard(30, 30, 0.05, 0.03),
    "avenue": orchard(40, 2, 0.05, 0.1),
    "clusters": clusters,
    "pallets": pallets,
}


def halls(runs: int, gap_s: float, gaps: str, action: str) -> tuple[int, int]:
    """Print a line about halls; return how many repeat themselves at the end, and how many maps are right."""
    found = good = 0
    for seed in range(runs):
        log = hall(seed, gap_s)
        run = mapped(log, gaps=gaps, repeats=action)
        found += bool(run.history.repeats)
        good += right(run, log)
    case = f"hall, gap of {gap_s:g} s, gaps={gaps}, repeats={action}"
    print(f"{case:<48} {runs:>5} {found:>6} {good:>6}", flush=True)
    return found, good


def worlds(runs: int) -> int:
    """Print a line about each world without repeats; return in how many one is found."""
    total = 0
    for name, world in WORLDS.items() if runs else ():
        found, lasts = 0, []
        for seed in range(runs):
            rng, slam = np.random.default_rng(seed), empty()
            part(slam, world(rng), rng)
            begin = time.perf_counter()
            found += bool(find_repeats(slam.map, slam.tracks))
            lasts.append(time.perf_counter() - begin)
        total += found
        size = len(slam.landmarks())
        print(f"{name:<48} {runs:>5} {found:>6} {'':>6} {size:>6} {1e3 * float(np.median(lasts)):>6.0f}", flush=True)
    return total


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20, help="halls of each kind")
    parser.add_argument("--worlds", type=int, default=100, help="worlds of each kind")
    options = parser.parse_args()
    print(f"{'case':<48} {'runs':>5} {'found':>6} {'right':>6} {'size':>6} {'ms':>6}")
    runs, lost = options.runs, (2.0, 4.0, 16.0)
    once = [halls(runs, gap_s, "widen", "merge") for gap_s in (0.0, 4.0)]
    twice = [halls(runs, gap_s, "ignore", "off") for gap_s in lost]
    merged = [halls(runs, gap_s, "ignore", "merge") for gap_s in lost]
    false = worlds(options.worlds)
    print(f"gaps ignored  {sum(good for _, good in twice)}  {sum(good for _, good in merged)}  {runs * len(lost)}")
    print(f"mapped once  {sum(found for found, _ in once)}  {sum(good for _, good in once)}  {runs * len(once)}")
    print(f"without repeats  {false}  {options.worlds * len(WORLDS)}")


if __name__ == "__main__":
    main()
