"""A storm of bad events: is each refused with its reason, and is the map that of the log without them, to the last bit?

    python benchmarks/storm.py                        # 24,000 events, shared by all estimators, maps, plane and space
    python benchmarks/storm.py --events 1000000 --estimator invariant --map postponed --world plane
    python benchmarks/storm.py --events 66000 --share 0.91   # 60,000 bad events between few good ones

Two robots drive among landmarks that they know by their ids; 5 % of the events are bad.  One filter gets all events, a
second one those that the first one took.  A digest of the whole state is taken before and after each bad event.  A line
a filter: events, refused ones, those that did not leave the state as it was, growth of memory since a tenth of the
events, and whether both filters have the same state in the end.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from state_digest import digest, digest_of_saved

import kalmark as km
from kalmark.errors import KalmarkError

ESTIMATORS = {"ekf": km.estimators.Ekf, "invariant": km.estimators.Invariant, "fej": km.estimators.Fej}
MAPS, WORLDS = ("dense", "postponed"), ("plane", "space")
LANDMARKS, RADIUS_M, SPEED_MPS, PERIOD_S = 40, 10.0, 0.8, 0.05
BAD = 0.05  # of the events
NAN, INF = math.nan, math.inf
Make = Callable[[], Any]
PLANE, SPACE = km.sensors.RangeBearing(), km.sensors.RangeBearing3D()


class Told(NamedTuple):
    """What is told of an event: its class and its arguments."""

    kind: Any
    arguments: dict[str, Any]

    def made(self, **changed: Any) -> Any:
        """Return the event with some arguments changed."""
        return self.kind(**(self.arguments | changed))


def robots(space: bool) -> list[km.Robot]:
    """Return a robot with velocities and one with increments, in space two with increments."""
    sensor: Any = SPACE if space else PLANE
    moves: Any = km.motion.Odometry3D(0.01, 0.01, 0.01, 0.005) if space else km.motion.Odometry2D(0.01, 0.01, 0.005)
    held: Any = moves if space else km.motion.Unicycle(0.1, 0.05, sigma_v_bias_mps=0.01)
    found = []
    for name, motion, angle in (("a", held, 0.0), ("b", moves, np.pi)):
        x, y, heading = RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), angle + np.pi / 2
        start = (x, y, 0, 0, 0, np.sin(heading / 2), np.cos(heading / 2)) if space else (x, y, heading)
        found.append(km.Robot(name, motion, start, {"eye": km.Mount(sensor)}))
    return found


def events(space: bool, rng: np.random.Generator) -> Iterator[Told]:
    """Yield the good events of two robots on a circle: controls, scans, now and then a fix."""
    places = rng.uniform(-1.5 * RADIUS_M, 1.5 * RADIUS_M, (LANDMARKS, 3)) * [1, 1, 0.1]
    turn = SPEED_MPS / RADIUS_M
    for k in itertools.count(1):
        t_ns = k * round(PERIOD_S * 1e9)
        for name, angle in (("a", 0.0), ("b", np.pi)):
            at, step = angle + turn * k * PERIOD_S, np.array([SPEED_MPS, 0.0, turn]) * PERIOD_S
            p = RADIUS_M * np.array([np.cos(at), np.sin(at), 0.0])
            increment = step + rng.normal(size=3) * [0.01, 0.01, 0.005]
            u = increment if name == "b" else (SPEED_MPS + 0.1 * rng.normal(), turn + 0.05 * rng.normal())
            if space:
                u = [*increment[:2], 0.01 * rng.normal(), *(0.005 * rng.normal(size=2)), increment[2]]
            yield Told(km.Control, {"t_ns": t_ns, "robot": name, "u": np.array(u), "cov": None})
            if k % 2 == (name == "a"):
                d, heading = places - p, at + np.pi / 2
                flat = np.hypot(d[:, 0], d[:, 1])
                range_m = np.hypot(flat, d[:, 2]) if space else flat
                ids = np.flatnonzero((range_m < 8.0) & (range_m > 0.5))[:8]
                bearing = np.arctan2(d[:, 1], d[:, 0]) - heading
                y = np.column_stack([range_m, bearing, np.arctan2(d[:, 2], flat)][: 3 if space else 2])[ids]
                y = y + rng.normal(size=y.shape) * [0.1, 0.02, 0.02][: y.shape[1]]
                arguments = {"t_ns": t_ns, "robot": name, "sensor": "eye", "y": y, "ids": ids.tolist(), "cov": None}
                yield Told(km.Scan, arguments)
            if k % 50 == 0:
                size = 3 if space else 2
                yield Told(km.Fix, {"t_ns": t_ns, "robot": name, "y": p[:size] + 0.3 * rng.normal(size=size),
                                    "cov": 0.09 * np.eye(size)})  # fmt: skip


def numbers(told: Told) -> tuple[str, Any]:
    """Return which argument has the numbers of an event, and these."""
    key = "u" if told.kind is km.Control else "y"
    return key, told.arguments[key]


def spoilt(told: Told, rng: np.random.Generator) -> tuple[str, Make]:
    """Return what is wrong with an event, and what makes and hands it over."""
    key, value = numbers(told)
    size = value.shape[-1]

    def put(number: float) -> Any:
        changed = np.array(value)
        if changed.size:
            changed.reshape(-1)[rng.integers(changed.size)] = number
            return changed
        return np.full((1, size), number)

    def cov(matrix: Any) -> Make:
        return lambda: told.made(cov=matrix)

    skewed, flipped = np.eye(size), np.eye(size)
    skewed[0, -1], flipped[0, 0] = 0.5, -1.0
    kinds: dict[str, Make] = {
        "not a number": lambda: told.made(**{key: put(NAN)}),
        "infinite": lambda: told.made(**{key: put(rng.choice([INF, -INF]))}),
        "huge": lambda: told.made(**{key: put(10.0 ** rng.uniform(13, 308))}),
        "wrong shape": lambda: told.made(**{key: np.ones((*value.shape, 2))}),
        "too long": lambda: told.made(**{key: np.ones((*value.shape[:-1], size + 1))}),
        "a text": lambda: told.made(**{key: "three"}),
        "nothing": lambda: told.made(**{key: None}),
        "stale": lambda: told.made(t_ns=told.arguments["t_ns"] - int(rng.integers(10**9, 10**12)) - 1),
        "future": lambda: told.made(t_ns=told.arguments["t_ns"] + int(rng.integers(2**55, 2**62))),
        "beyond all time": lambda: told.made(t_ns=2**63 + int(rng.integers(2**40))),
        "no time": lambda: told.made(t_ns=None),
        "two times": lambda: told.made(t_s=1.0),
        "unknown robot": lambda: told.made(robot=rng.choice(["c", "", "a bias", "a.eye"])),
        "robot without a name": lambda: told.made(robot=None),
        "negative covariance": cov(-np.eye(size)),
        "indefinite covariance": cov(flipped),
        "skewed covariance": cov(skewed),
        "covariance without numbers": cov(np.full((size, size), NAN)),
        "huge covariance": cov(1e100 * np.eye(size)),
        "covariance of a wrong shape": cov(np.eye(size + 1)),
        "no event": lambda: rng.choice([None, 7, "scan"]),  # type: ignore[arg-type]
    }
    if told.kind is km.Scan and len(value):
        names = told.arguments["ids"]
        backwards = value * np.where(np.arange(size) == 0, -1.0, 1.0)
        kinds |= {
            "negative range": lambda: told.made(y=backwards),
            "unknown sensor": lambda: told.made(sensor="ear"),
            "id of an inner block": lambda: told.made(ids=["a bias", *names[1:]]),
            "id that is none": lambda: told.made(ids=[[True, 1.5, "", b"x"][rng.integers(4)], *names[1:]]),
            "id too long": lambda: told.made(ids=["x" * 5000, *names[1:]]),
            "too few ids": lambda: told.made(ids=[*names, 7]),
            "no covariance at all": cov(np.zeros((size, size))),
        }
        if len(names) > 1:
            kinds["duplicate ids"] = lambda: told.made(ids=[names[1], *names[1:]])
    if told.kind is km.Fix:
        kinds["fix without a covariance"] = cov(None)
    name = str(rng.choice(sorted(kinds)))
    return name, kinds[name]


def odd(told: Told, rng: np.random.Generator) -> Make:
    """Return what makes an event that is odd and may be taken."""
    if told.kind is km.Scan:
        return [lambda: told.made(y=(), ids=None), lambda: told.made(y=told.arguments["y"][:0], ids=[])][
            rng.integers(2)
        ]
    if told.kind is km.Control:
        size = len(told.arguments["u"])
        return [lambda: told.made(cov=1e-300 * np.eye(size)), lambda: told.made(cov=np.zeros((size, size))),
                lambda: told.made(u=told.arguments["u"] * 1e-300)][rng.integers(3)]  # fmt: skip
    return lambda: told.made(cov=1e-12 * told.arguments["cov"])


class Outcome(NamedTuple):
    """What became of a storm: bad events that were `taken` or `changed` the state, by kind, and other `errors`."""

    events: int
    refused: int
    taken: Counter[str]
    changed: Counter[str]
    errors: Counter[str]
    growth_mb: float
    equal: bool


def resident_mb() -> float:
    """Return the memory that this process has."""
    text = Path("/proc/self/statm")
    return int(text.read_text().split()[1]) * 4096 / 1e6 if text.exists() else 0.0


def storm(estimator: Any, space: bool, map_: str, count: int, seed: int = 0, share: float = BAD) -> Outcome:
    """Hand so many events to a filter, before a `share` of them a bad one, and those that it takes to a second one."""
    rng, told = np.random.default_rng(seed), events(space, np.random.default_rng(seed + 1))
    one, two = (km.Slam(robots(space), estimator=estimator, map=map_) for _ in range(2))
    taken, changed, errors, refused, before_mb = Counter[str](), Counter[str](), Counter[str](), 0, 0.0
    for k in range(count):
        if k == count // 10:
            before_mb = resident_mb()
        bad = rng.random() < share
        good = next(told)
        if bad:
            name, make = spoilt(good, rng)
            before = digest(one)
            try:
                one.process(make())
            except KalmarkError as error:
                refused += 1
                if "\n" in str(error) or not str(error):
                    errors[f"{name}: no plain line"] += 1
            except Exception as error:
                errors[f"{name}: {type(error).__name__}: {error}"] += 1
            else:
                taken[name] += 1
            changed[name] += digest(one) != before
        make = odd(good, rng) if rng.random() < 0.01 else good.made
        event = make()
        one.process(event)
        two.process(event)
    growth = resident_mb() - before_mb
    return Outcome(count, refused, +taken, +changed, errors, growth, digest_of_saved(one) == digest_of_saved(two))


def main() -> None:
    """Run the storms that are asked for, and print a line for each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--events", type=int, default=24_000, help="of all storms together")
    parser.add_argument("--estimator", choices=ESTIMATORS, nargs="*", default=list(ESTIMATORS))
    parser.add_argument("--map", choices=MAPS, nargs="*", default=list(MAPS))
    parser.add_argument("--world", choices=WORLDS, nargs="*", default=list(WORLDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--share", type=float, default=BAD, help="of the events that are bad")
    asked = parser.parse_args()
    cases = list(itertools.product(asked.world, asked.estimator, asked.map))
    total, refused, broken, equal, growth = 0, 0, 0, 0, 0.0
    for world, name, map_ in cases:
        done = storm(ESTIMATORS[name](), world == "space", map_, asked.events // len(cases), asked.seed, asked.share)
        wrong = sum(done.taken.values()) + sum(done.changed.values()) + sum(done.errors.values())
        said = f"{done.events} events, {done.refused} refused, {wrong} not as they should be"
        equals = "equal" if done.equal else "not equal"
        print(f"{world} {name} {map_}: {said}, memory {done.growth_mb:+.1f} MB, {equals}", flush=True)
        for what, counts in (("taken", done.taken), ("changed", done.changed), ("error", done.errors)):
            for kind, number in counts.items():
                print(f"  {what}: {kind}: {number}")
        total, refused, broken = total + done.events, refused + done.refused, broken + wrong
        equal, growth = equal + done.equal, max(growth, done.growth_mb)
    print(f"total {total} {refused} {broken} {equal} {len(cases)} {growth:.1f}")
    print("(events, refused, not as they should be, storms that end equal, storms, largest growth of memory in MB)")


if __name__ == "__main__":
    main()
