"""Landmarks that are not seen again: how many of trees, and of a person who walks about, are marked.

    python benchmarks/ghosts.py [--seeds 3] [--steps 900]

The worlds are those of the tests (`tests/walkers.py`): 40 trees that a robot wanders about, with sensors that see 180
or 90 degrees, that state no limit, that see half of what is in view, with trees that hide others; each without and with
somebody who walks about.  Then the scans of a filter that marks over those of one that does not, by turns.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from kalmark.management import existence
from walkers import WALKER, Field, mapped

WORLDS = {
    "180 degrees, p .9": {},
    "180 degrees, p .7": {"p_detect": 0.7},
    "180 degrees, p .5": {"p_detect": 0.5},
    "90 degrees, p .9": {"fov_rad": 0.5 * math.pi},
    "360 degrees, p .7": {"fov_rad": 2 * math.pi, "p_detect": 0.7},
    "no limit stated, p .8": {"stated": False, "p_detect": 0.8},
    "trees hide others, p .9": {"hides": True},
    "trees hide others, p .6": {"hides": True, "p_detect": 0.6},
}


def table(seeds: int, steps: int) -> None:
    """Print how many landmarks of trees and of who walks are marked, world by world."""
    total = np.zeros(6, dtype=int)
    print(
        "world                       trees marked (clean)   (with walker)   walker's marked   of those expected again"
    )
    for name, of in WORLDS.items():
        n = np.zeros(8, dtype=int)
        for walks in (False, True):
            for seed in range(seeds):
                field = Field(walks=walks, **of)
                log, things = field.log(steps, seed)
                slam = field.slam()
                what, marks = mapped(slam, log.events, things), slam.landmarks().unseen
                tree = [i for i in what if what[i] != WALKER]
                ghost = [i for i in what if what[i] == WALKER]
                again = [i for i in ghost if slam.tracks.confirmed[i].missed + slam.tracks.confirmed[i].absent > 5.0]
                k = 2 * walks
                n[k : k + 2] += len(marks & {*tree}), len(tree)
                n[4:8] += len(marks & {*ghost}), len(ghost), len(marks & {*again}), len(again)
        total += n[[0, 1, 4, 5, 6, 7]]
        print(
            f"{name:28}{n[0]:6} of {n[1]:<14}{n[2]:3} of {n[3]:<9}{n[4]:3} of {n[5]:<11}{n[6]:3} of {n[7]}", flush=True
        )
    print("all: {} of {} trees in clean worlds; of the walker {} of {}, expected again {} of {}".format(*total))


def cost(steps: int) -> None:
    """Print the mean time of a scan over that without marks, by turns."""
    field, spent = Field(), np.zeros((2, 0))
    for seed in range(4):
        log, _ = field.log(steps, seed)
        slams, took = (field.slam(), field.slam()), np.zeros((2, steps))
        concerns = existence.concerns
        for k, event in enumerate(log.events):
            for i in (0, 1) if k % 4 < 2 else (1, 0):
                existence.concerns = concerns if i else lambda *_: False
                begin = time.perf_counter()
                slams[i].process(event)
                took[i, k // 2] += time.perf_counter() - begin
        existence.concerns = concerns
        if seed:  # the first compiles
            spent = np.concatenate([spent, took], axis=1)
    without, marks = spent.mean(axis=1)
    print(f"a step with marks over one without, mean: {marks / without:.3f} ({1e6 * without:.0f} us)")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=900)
    options = parser.parse_args()
    cost(options.steps)
    table(options.seeds, options.steps)


if __name__ == "__main__":
    main()
