"""`World`: what is simulated, in one frozen model, read from YAML; and the configuration its filter runs with."""

from __future__ import annotations

import io
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Discriminator, Field, PrivateAttr, Tag, model_validator
from ruamel.yaml import YAML

from kalmark.config.data_sheets import take_data_sheets
from kalmark.config.reading import resolve_name, run_plugins, shipped_configs, validate
from kalmark.config.schema import (
    TRUTH,
    Config,
    OfFile,
    Plugins,
    RobotConfig,
    SpaceRobotConfig,
    SpaceStartConfig,
    StartConfig,
    robot_world,
)  # fmt: skip
from kalmark.config.sections import Section, model_of, unexpected_value
from kalmark.config.tree import Tree, merge_trees, read_tree
from kalmark.declare import Count, Positive
from kalmark.models.landmarks import PointHeight2D
from kalmark.models.protocols import keep, sees_kinds
from kalmark.plugins import entry_points_of
from kalmark.simulate.layouts import Layout
from kalmark.simulate.routes import Constant, Route, Waypoints
from kalmark.simulate.sights import SimulatedSensing
from kalmark.slam.description import plain_value


class _Underway(Section):
    route: Route
    """Its commanded path."""
    sensing: dict[str, SimulatedSensing] = Field(default_factory=dict)
    """By a sensor's name: its rate, and what is wrong with it."""

    @model_validator(mode="after")
    def _all_fits(self) -> Self:
        """Refuse a constant control of another motion, and settings of a sensor that the robot does not have."""
        robot: Any = self
        size, route = len(model_of(robot.motion).columns), self.route
        if isinstance(route, Constant) and len(route.u) != size:
            raise unexpected_value(f"a route whose u has the {size} numbers of {robot.motion.type}, not {len(route.u)}")
        if isinstance(route, Waypoints) and isinstance(self, SimulatedRobot) and len(route.points_m[0]) != 2:
            raise unexpected_value("a route whose points_m are [x, y]: the robot moves in the plane")
        for name in self.sensing:
            if name not in robot.sensors:
                raise unexpected_value(f"sensing of {' or '.join(robot.sensors) or 'no sensor'}, not of {name!r}")
            if self.sensing[name].loop_reach_m is not None and keep(robot.sensors[name]) == 1:
                raise unexpected_value(f"loop_reach_m of an odometer whose keep is 0, or 2 or more, not of {name!r}")
        return self


class SimulatedRobot(_Underway, RobotConfig):
    """One robot of the plane: how it truly moves and measures, noise included, and where it goes."""

    start: StartConfig = StartConfig()
    """Start; with sigmas, the true start is drawn around it."""


class SpaceSimulatedRobot(_Underway, SpaceRobotConfig):
    """One robot of space.  A mount with sigmas truly sits elsewhere: where it is drawn around what is given."""

    start: SpaceStartConfig = SpaceStartConfig()
    """Start; with sigmas, the true start is drawn around it."""


AnySimulatedRobot = Annotated[
    Annotated[SimulatedRobot, Tag("(plane)")] | Annotated[SpaceSimulatedRobot, Tag("(space)")],
    Discriminator(robot_world),
]


class World(OfFile):
    """A world to simulate: landmarks, robots, noise, and how long.

    >>> world = load_world("cloister", ["steps=100"])
    >>> isinstance(world, World), world.steps, world.dt_s, list(world.robots)
    (True, 100, 0.1, ['robot'])
    """

    called: ClassVar[str] = "world"

    world: Layout
    """Places of the landmarks."""
    robots: Annotated[dict[str, AnySimulatedRobot], Field(min_length=1)]
    """Robots by name."""
    steps: Count = 1000
    """Steps: one motion and one scan of every sensor each."""
    dt_s: Positive = 0.1
    """Duration of a step."""
    noise_on: Literal["control", "robot"] = "control"
    """Disturb the control that the filter is given, or the robot."""
    ids: bool = True
    """Give the filter the ids of the landmarks."""
    new_per_step: Count | None = None
    """At most so many landmarks are seen for the first time in a scan."""
    max_per_scan: Count | None = None
    """At most so many landmarks in a scan, the nearest ones."""
    sight_robots: bool = False
    """Robots see each other."""
    signature_max: Positive = 10.0
    """Signatures of landmarks are uniform between 0 and this."""
    filter: dict[str, Any] = Field(default_factory=dict)
    """Configuration keys in which the filter departs from what is simulated."""
    plugins: Plugins = ()
    """Python files with models of your own.  This runs the code of those files."""

    _tree: Tree | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _is_one_world(self) -> World:
        if self.sight_robots and self.has_signatures:
            raise unexpected_value("sight_robots false where a sensor measures signatures: robots have none")
        if len({type(robot) for robot in self.robots.values()}) > 1:
            raise unexpected_value("robots that all move in the plane, or all in space")
        for robot in self.robots.values():
            for sensor in (name for name, sensing in robot.sensing.items() if sensing.images):
                of = self.world.gives_raw
                if not of:
                    worlds = " or ".join(entry_points_of("layouts"))
                    raise unexpected_value(f"images only in a world of one of these types: {worlds}")
                if (kind := robot.sensors[sensor].type) not in of:
                    raise unexpected_value(f"images of {' or '.join(of)}, not of {sensor!r}, a {kind}")
        scenery = self.world.scenery(np.random.default_rng(0))
        if self.dimensions == 2 and (scenery.of_space or (scenery.points.shape[1] == 3 and not self._sees_heights)):
            raise unexpected_value("robots of space, or a world of the plane: its landmarks are in space")
        return self

    @property
    def dimensions(self) -> int:
        """2 in the plane, 3 in space."""
        return 3 if isinstance(next(iter(self.robots.values())), SpaceSimulatedRobot) else 2

    @property
    def _sees_heights(self) -> bool:
        sensors = [sensor for robot in self.robots.values() for sensor in robot.sensors.values()]
        return any(PointHeight2D.kind in (sees_kinds(model_of(sensor)) or ()) for sensor in sensors)

    @property
    def has_signatures(self) -> bool:
        """True if any sensor measures signatures."""
        sensors = [sensor for robot in self.robots.values() for sensor in robot.sensors.values()]
        return any("signature" in model_of(sensor).columns for sensor in sensors)

    def class_names(self) -> list[tuple[str, ...]]:
        """Return the classes that each sensor reports, () of one that reports none."""
        sensors = [sensor for robot in self.robots.values() for sensor in robot.sensors.values()]
        return [() if sensor.classes is None else tuple(sensor.classes.names) for sensor in sensors]

    def times(self) -> tuple[int, ...]:
        """Return the times (ns) at which its steps end."""
        return tuple(round(k * self.dt_s * 1e9) for k in range(1, self.steps + 1))

    def config(self) -> Config:
        """Return the filter's configuration: the simulated models and noise, with `filter` laid over them.

        Raises ConfigError naming the place of a key in `filter` that a configuration does not have.
        """
        values = self._values()
        values["association"] = {"type": "identity" if self.ids else "nearest"}
        return validate(self._laid_over(values), Config)

    def models(self) -> Config:
        """Return the configuration of the simulated models, which may differ from the filter's."""
        return validate(Tree(values=self._values()), Config)

    def _values(self) -> dict[str, Any]:
        values: dict[str, Any] = {"plugins": [*self.plugins], "robots": {}}
        for name, robot in self.robots.items():
            values["robots"][name] = robot.model_dump(exclude={"route", "sensing"}, exclude_none=True)
        if self.has_signatures:
            values["landmarks"] = {"type": "point_signature"}
        return values

    def to_yaml(self) -> str:
        """Return the text of a file that describes this world, every default written out; `load_world` reads it."""
        yaml, out = YAML(), io.StringIO()
        yaml.default_flow_style = False
        yaml.dump(plain_value(self.model_dump(exclude_none=True)), out)
        return out.getvalue()

    def _laid_over(self, values: dict[str, Any]) -> Tree:
        """Return `values` with `filter` laid over, its keys remembering where they were written."""
        tree = Tree(values=merge_trees(values, deepcopy(self.filter)))
        of_map = tree.values.get("map")
        known = of_map.get("known") if isinstance(of_map, dict) else None
        if isinstance(known, str) and known != TRUTH and self._file is not None:  # beside the world, if it is there
            beside = self._file.resolve().parent / known
            tree.values["map"]["known"] = str(beside) if beside.exists() else known
        for table, source in ((tree.places, "places"), (tree.keys, "keys")):
            written: dict[tuple[str, ...], str] = getattr(self._tree, source, {})
            table |= {path[1:]: place for path, place in written.items() if path[:1] == ("filter",)}
        return tree


def shipped_worlds() -> dict[str, Path]:
    """Return the worlds that come with kalmark, by name.

    >>> from kalmark.simulate import shipped_worlds
    >>> list(shipped_worlds())[:3]
    ['arva', 'camera', 'cloister']
    """
    return shipped_configs("configs/worlds")


def load_world(path_or_name: str | Path, overrides: Sequence[str] = ()) -> World:
    """Return the world at a path or of a shipped name, with overrides like ``steps=200`` applied.

    ``robots.each`` in an override stands for every robot of the world.
    Raises ConfigError: ``file:line:column: key.path: got value, expected what``.

    >>> from kalmark.simulate import load_world
    >>> load_world("cloister", ["steps=100"]).steps
    100
    """
    path = resolve_name(path_or_name, shipped_worlds(), "world")
    tree = read_tree(path, overrides)
    run_plugins(tree, path)
    take_data_sheets(tree, path)
    world = validate(tree, World)
    world._file, world._tree = path, tree
    world.config()  # a mistake in `filter` shows now, not after the simulation
    return world
