"""Ring roads without ids and without any fault: how many of their maps are right at the end.

    python benchmarks/ring_road.py [--seeds 20] [--set KEY=VALUE ...]

The world is `ring_road`: 500 m, a tree every 9 m, one to three trees in a scan, and a pose known to some metres where
the first trees are seen again.  A line a seed: landmarks in the map, trees mapped twice, wrong pairs, the RMS error of
the landmarks after a rigid alignment, the pose NEES, averaged, and what the map is:

right   no pair wrong, no tree twice, and the landmarks within `NEAR_M` (RMS)
open    no pair wrong, but the loop is not closed
wrong   any pair of an observation and the landmark of another tree
"""

from __future__ import annotations

import argparse
from collections import Counter

import kalmark as km
from kalmark.config import build_slam
from kalmark.logs.formats import hide_ids
from kalmark.simulate import load_world, simulate

NEAR_M = 1.0


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    given = parser.parse_args()
    world = load_world("ring_road", ["ids=true", *given.overrides])
    ends: Counter[str] = Counter()
    columns = ("seed", "landmarks", "twice", "wrong pairs", "landmarks, aligned", "pose NEES", "map")
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for seed in range(given.first, given.first + given.seeds):
        log = hide_ids(simulate(world, seed))
        run = km.record(build_slam(world.config(), log), log, progress=False)
        s = run.evaluate()
        missed = s["duplicates"] or s["landmark_rmse_m"] > NEAR_M
        end = "wrong" if s["wrong"] else "open" if missed else "right"
        ends[end] += 1
        nees = s["robots"]["car"]["pose_nees"]
        print(
            f"| {seed} | {s['landmarks']} | {s['duplicates']} | {s['wrong']} of {s['judged']} |"
            f" {s['landmark_rmse_m']:.2f} m | {nees:.1f} | {end} |",
            flush=True,
        )
    print(", ".join(f"{end} {ends[end]}" for end in ("right", "open", "wrong")))


if __name__ == "__main__":
    main()
