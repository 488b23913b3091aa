"""The keys of a configuration that a tuning may change: where they are in the file, and their values."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from copy import deepcopy
from typing import Any

import numpy as np

from kalmark.config.tree import EACH, Configuration, KeyPath, Plain, put, robot_section, value_at
from kalmark.diagnosis.components import Noise
from kalmark.diagnosis.error_columns import Column
from kalmark.results.run import Run

CALIBRATIONS = {"range_scale": ("scale",), "range_offset": ("bias_m",), "bearing_offset": ("mount", "theta_rad")}

Values = dict[KeyPath, Any]


class Keys:
    """The keys of a configuration in force, by their paths in the file: `written` is the file's section of robots.

    Those to `keep` are not offered.
    """

    def __init__(self, config: Plain, written: Configuration, keep: Collection[str] = ()) -> None:
        self.config, self.written, self.keep = config, written, {*keep}

    def changed(self, values: Values) -> Plain:
        """Return the configuration with other values of some keys."""
        content = deepcopy(self.config)
        for path, value in values.items():
            for owner in self._owners(path):
                put(content, owner, value)
        return content

    def _owners(self, path: KeyPath) -> list[KeyPath]:
        """Return the paths in the configuration in force of a key in the file."""
        robots = self.config["robots"]
        if path[0] != "robots" or path[1] in robots:
            return [path]
        return [("robots", name, *path[2:]) for name in robots if self.section(name) == path[1]]

    def section(self, name: str) -> str:
        """Return the name of the section of the file that a robot, or section, of the configuration in force is in."""
        return EACH if name not in self.written and EACH in self.written else name

    def noises(self, run: Run) -> list[Noise]:
        """Return the noises of the configuration that may be estimated."""
        found: dict[KeyPath, Noise] = {}
        for path, names, value in self._keys(run):
            if not path[-1].startswith("sigma_") or "_bias_" in path[-1] or path[-1] == "sigma_scale":
                continue
            scale = value or self._begin(run, path)
            if scale > 0 and ".".join(path) not in self.keep:
                robots = (*(found[path].robots if path in found else ()), *names)
                found[path] = Noise(path, robots, float(value), scale)
        return [*found.values()]

    def _keys(self, run: Run) -> Iterator[tuple[KeyPath, tuple[str, ...], float]]:
        """Yield the numbers of the models: path in the file, robots, value."""
        robots: Configuration = self.config["robots"]
        for name, robot in robots.items():
            names = tuple(n for n in run.final_slam().robots if n == name or (name == EACH and n not in robots))
            here = ("robots", self.section(name))
            parts: list[tuple[KeyPath, Any]] = [((*here, "motion"), robot["motion"])]
            parts += [((*here, "sensors", s), section) for s, section in robot["sensors"].items()]
            for path, section in parts if names else ():
                for key, value in section.items():
                    if isinstance(value, float | int) and not isinstance(value, bool):
                        yield (*path, key), names, value

    def _begin(self, run: Run, path: KeyPath) -> float:
        """Return the value that a noise which is not stated is looked for from: that of a range may grow with it."""
        if path[-1] != "sigma_range_rel":
            return 0.0
        h = run.history
        mine = (h.sensor == path[3]) & np.isfinite(h.y[:, 0])
        sigma = run.section(str(h.robot[h.step[mine][0]]), path[3]).get("sigma_range_m", 0.0) if mine.any() else 0.0
        return float(sigma / max(np.median(h.y[mine, 0]), 1e-3)) if mine.any() else 0.0

    def calibration(self, run: Run, column: Column) -> KeyPath | None:
        """Return the path of the key of a systematic error, None if it has none, or is in the map."""
        if column.name not in CALIBRATIONS:
            return None
        robot, sensor = column.of[:2]
        path: KeyPath = ("robots", self.section(robot_section(self.config, robot)), "sensors", sensor)
        section = run.section(robot, sensor)
        mount = section.get("mount") or {}
        in_map = any(section.get(key) for key in ("sigma_scale", "sigma_bias_m"))
        in_map |= any(value for key, value in mount.items() if key.startswith("sigma_"))
        path = (*path, *CALIBRATIONS[column.name])
        known = CALIBRATIONS[column.name][0] in section
        return path if known and not in_map and ".".join(path) not in self.keep else None

    def stated(self, path: KeyPath) -> Any:
        """Return the value of a key as it is in force."""
        return value_at(self.config, self._owners(path)[0])
