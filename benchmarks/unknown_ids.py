"""Cost of unknown ids: the same log with the ids given and hidden.

    python benchmarks/unknown_ids.py dlr dlr_unknown
    python benchmarks/unknown_ids.py mrclam mrclam --set log.ids=hidden --set association.type=auto

The map without ids is held against that with ids, of landmarks that have one name in the log the one seen most often.

    python benchmarks/unknown_ids.py mrclam --set "log.robots=[2]"

The best possible decisions: all that came before was fused by its true id, and the nearest landmark is taken.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

import kalmark as km
from kalmark import config as cfg
from kalmark.cli.run import run_log
from kalmark.results.association_errors import names_in_log
from kalmark.results.evaluate import known_landmarks
from kalmark.results.measures import rigid, rmse
from kalmark.results.record import record
from kalmark.results.run import Run

BESIDE_M = 0.5
FAR = 1e6  # a d2 of what is no candidate
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
    names, count = names_in_log(history), 0
    mine = history.fused & (history.id == "")
    for landmark, true in zip(history.landmark[mine].tolist(), history.true_id[mine].tolist(), strict=True):
        taken = names.get(landmark, true)
        count += taken in at and true in at and float(np.linalg.norm(at[taken] - at[true])) > BESIDE_M
    return count


class Foreseen(km.association.ByIdentity):
    """Fuses by the ids of the log, and remembers which landmark would have been the nearest of those in the map.

    `told` has, for each observation of a landmark of the map, whether its nearest is another, whether the one that the
    best assignment of the scan pairs it with is, and how much greater the d2 of the second nearest is.
    """

    def __init__(self, gate: float | str) -> None:
        super().__init__(gate)
        object.__setattr__(self, "told", [])

    def associate(self, query: km.association.Query) -> list[km.association.Decision]:
        names = query.candidates(8, np.inf)
        if len(names) > 1:
            d2 = np.nan_to_num(query.distances(names), nan=FAR, posinf=FAR)
            best = linear_sum_assignment(np.hstack([d2, np.full((len(d2), len(d2)), FAR)]))[1]
            for k, name in enumerate(query.ids):
                if name in names:
                    own, (least, second) = names.index(name), np.sort(d2[k])[:2]
                    self.told.append((np.argmin(d2[k]) != own, best[k] != own, second - least))
        return super().associate(query)


def foresee(config_path: str, overrides: list[str]) -> None:
    """Print how often the nearest landmark is the right one to a filter that had all ids until then."""
    config, log = cfg.open_run(config_path, None, overrides)
    built = cfg.build_slam(config, log)
    seer = Foreseen(getattr(built.association, "gate", "default"))
    settings = replace(built.state.settings, association=seer)
    slam = km.Slam(built.robots.values(), **vars(settings))
    record(slam, log, progress=False)
    nearest, best, gap = np.array(seer.told, dtype=float).T
    print(f"{len(gap)} observations of landmarks that are in the map, all fused by their ids")
    print(f"another is the nearest: {nearest.mean():.1%}, or by the best assignment of the scan: {best.mean():.1%}")
    for least in (3, 6, 12):
        clear, wrong = gap > least, nearest[gap > least]
        print(
            f"the second is farther by a d2 of {least}: {clear.mean():.1%} of them; of these wrong: {wrong.mean():.2%}"
        )


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("known")
    parser.add_argument("hidden", nargs="?")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    given = parser.parse_args()
    if given.hidden is None:
        foresee(given.known, given.overrides)
        return
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
