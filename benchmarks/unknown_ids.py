"""What not being told which landmark is which costs: the same log with the ids given and hidden.

    python benchmarks/unknown_ids.py dlr dlr_unknown
    python benchmarks/unknown_ids.py mrclam mrclam --set log.ids=hidden --set association.type=auto

The map without ids is held against that with ids, of landmarks that have one name in the log the one seen most often.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from kalmark.cli.run import run_log
from kalmark.results.align import rigid, rmse
from kalmark.results.evaluate import known_landmarks
from kalmark.results.run import Run
from kalmark.results.scoring import known_as

BESIDE_M = 0.5
COMMON = ("log.robots",)  # settings that hold for the run with ids as well


def compared(known: Run, hidden: Run) -> tuple[int, float, float]:
    """Return how many landmarks both maps have, and the RMS of their differences, raw and after a rigid alignment."""
    maps = []
    for run in (known, hidden):
        landmarks = known_landmarks(run)
        maps.append(dict(zip(map(str, landmarks.ids), landmarks.positions()[0], strict=True)))
    both = sorted(maps[0].keys() & maps[1].keys())
    one, other = (np.array([each[name] for name in both]) for each in maps)
    return len(both), rmse(other - one), rmse(rigid(other, one)(other) - one)


def misplaced(known: Run, hidden: Run) -> int:
    """Return how many of the wrong pairs are of landmarks farther apart than `BESIDE_M` in the map with ids."""
    landmarks, history = known_landmarks(known), hidden.history
    at = dict(zip(map(str, landmarks.ids), landmarks.positions()[0], strict=True))
    names, count = known_as(history), 0
    mine = history.fused & (history.id == "")
    for landmark, true in zip(history.landmark[mine].tolist(), history.true_id[mine].tolist(), strict=True):
        taken = names.get(landmark, true)
        count += taken in at and true in at and float(np.linalg.norm(at[taken] - at[true])) > BESIDE_M
    return count


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("known")
    parser.add_argument("hidden")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    given = parser.parse_args()
    start = time.process_time()
    known = run_log(given.known, overrides=[o for o in given.overrides if o.startswith(COMMON)], progress=False)
    middle = time.process_time()
    hidden = run_log(given.hidden, overrides=given.overrides, progress=False)
    end = time.process_time()
    one, two = known.evaluate(), hidden.evaluate()
    count, raw, aligned = compared(known, hidden)
    print(f"landmarks: {one['landmarks']} with ids, {two['landmarks']} without, {count} in both")
    print(f"difference of the maps, RMS: {raw:.3f} m, {aligned:.3f} m after a rigid alignment")
    print(f"wrong: {two['wrong']} of {two['judged']} ({two['wrong'] / max(two['judged'], 1):.2%})")
    print(f"of these, of landmarks more than {BESIDE_M} m apart: {misplaced(known, hidden)}")
    print(f"duplicates: {two['duplicates']}; CPU: {middle - start:.0f} s with ids, {end - middle:.0f} s without")
    if two["nameless"]:
        out = 1 - two["nameless_fused"] / two["nameless"]
        print(f"without an id in the log: {two['nameless']}, of these not fused {out:.1%}")
    for name, figures in two["robots"].items():
        if "ate_m" in figures:
            ate = one["robots"][name]["ate_m"]
            print(f"{name}: aligned path RMSE {figures['ate_m']:.3f} m, with ids {ate:.3f} m")


if __name__ == "__main__":
    main()
