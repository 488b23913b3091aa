"""Plant faults in sensors of the state of simulated worlds; count what the verdict says of them and of good runs.

    python benchmarks/diagnosis_readings.py [WORLD ...] [--seeds 3] [--clean 10] [--told]

Alarmed: any cause of readings, or a misfit.  Named: the sensor and what is wrong with it.  Others: runs with further
causes, a receiver that moved its robot among them.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

from kalmark.config import build_slam
from kalmark.config.building import config_dict
from kalmark.diagnosis.mistakes import change_measurements
from kalmark.diagnosis.named_causes import MISFIT
from kalmark.diagnosis.state_readings import ARM, CONSTANT, NAMES, SCALE, SIGMA, SIGN
from kalmark.diagnosis.verdict import diagnose
from kalmark.results.record import record
from kalmark.simulate import load_world, simulate


class Fault(NamedTuple):
    """What the filter is told wrongly of a sensor (`keys`), or how its readings are multiplied (`by`)."""

    name: str
    what: str
    keys: Mapping[str, float] = MappingProxyType({})
    by: tuple[float, ...] = ()


def receiver(x_m: float, sigma_m: float) -> list[Fault]:
    """Return the faults of a receiver whose antenna is at x_m, of this noise."""
    arm = {"mount.x_m": x_m + 1.0, "mount.sigma_xy_m": 0.0}
    return [
        Fault(SIGMA, "noise a third", {"sigma_m": sigma_m / 3}), Fault(ARM, "antenna off by 1 m", arm),
        Fault(SIGN, "sign of x", by=(-1.0, 1.0)),
    ]  # fmt: skip


COMPASS = [
    Fault(SIGMA, "noise a third", {"sigma_heading_rad": 0.1 / 3}),
    Fault(CONSTANT, "declination off by 15 deg", {"declination_rad": math.radians(15.0), "sigma_declination_rad": 0.0}),
    Fault(SIGN, "sign", by=(-1.0,)),
]


def gyro(sigma_radps: float) -> list[Fault]:
    """Return the faults of a gyroscope of this noise."""
    stated = {"sigma_radps": sigma_radps / 3}
    return [
        Fault(SIGMA, "noise a third", stated),
        Fault(SIGN, "sign", by=(-1.0,)),
        Fault(SCALE, "1.5 times", by=(1.5,)),
    ]


WHEELS = [
    Fault(SIGMA, "noise a third", {"sigma_mps": 0.02 / 3}),
    Fault(SCALE, "1.2 times", {"sigma_scale": 0.0}, by=(1.2,)),
]
FAULTS: dict[str, dict[str, list[Fault]]] = {
    "lever_arm": {"receiver": receiver(0.2, 0.05)},
    "wheels_and_gyro": {"receiver": receiver(0.3, 0.5), "gyro": gyro(0.003)},
    "compass_and_gyro": {
        "receiver": receiver(0.3, 1.0), "compass": COMPASS, "gyro": gyro(0.005), "wheels": WHEELS,
    },
    "stop_and_go": {"gyro": gyro(0.005), "wheels": WHEELS},
}  # fmt: skip
NONE = Fault("", "")


def causes(world: str, sensor: str, fault: Fault, seed: int, more: list[str]) -> tuple[str, list[str]]:
    """Return the robot of a world, and the names of the causes that do harm, with the evidence behind a colon."""
    first = load_world(world)
    robot = next(iter(first.robots))
    keys = [f"filter.robots.{robot}.sensors.{sensor}.{key}={value}" for key, value in fault.keys.items()]
    made = load_world(world, [*more, *keys])
    log = simulate(made, seed)
    if fault.by:
        change = change_measurements({(robot, sensor)}, lambda y: y * fault.by)
        log = replace(log, events=[change(event) for event in log])
    log = log.without_truth()
    config = made.config()
    run = record(build_slam(config, log), log, progress=False, config=config_dict(config), pictures=False)
    return robot, [f"{c.name}: {c.evidence}; {c.cure}" for c in diagnose(run, 3000).causes if not c.harmless]


def main() -> None:
    """Print a row for each fault, and the sum of each world."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("worlds", nargs="*", default=[*FAULTS])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--clean", type=int, help="good runs of each world; as many as seeds if absent")
    parser.add_argument("--set", nargs="*", default=[], dest="more")
    parser.add_argument("--told", action="store_true")
    given = parser.parse_args()
    for world in given.worlds:
        planted = of_all = of_named = good = accused = 0
        for sensor, faults in {"": [NONE], **FAULTS[world]}.items():
            for fault in faults:
                alarmed = named = other = 0
                number = given.seeds if sensor or given.clean is None else given.clean
                for seed in range(number):
                    robot, found = causes(world, sensor, fault, seed, given.more)
                    if given.told:
                        print("   ", *found, sep="\n      ")
                    mine = [f for f in found if f.startswith((*NAMES, MISFIT))]
                    right = [f for f in mine if f.startswith(f"{fault.name}:") and f"{robot}.{sensor} " in f]
                    alarmed, named = alarmed + bool(mine), named + bool(right)
                    other += bool([f for f in found if f not in right])
                if sensor:
                    planted, of_all, of_named = planted + number, of_all + alarmed, of_named + named
                else:
                    good, accused = number, other
                what = f"{sensor}: {fault.what}" if sensor else "good"
                print(
                    f"{world:18s} {what:40s} alarmed {alarmed}, named {named}, others {other} of {number}",
                    flush=True,
                )
        print(
            f"sum of {world}: {of_all} alarmed, {of_named} named of {planted} planted; {accused} of {good} good accused"
        )


if __name__ == "__main__":
    main()
