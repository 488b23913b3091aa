"""`World`: what is simulated, in one frozen model, read from YAML; and the configuration its filter runs with."""

from __future__ import annotations

import io
from collections.abc import Sequence
from copy import deepcopy
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr, model_validator
from ruamel.yaml import YAML

from kalmark.config.merging import merged
from kalmark.config.models import Motion, RangeBearingSignatureSensor, Sensor
from kalmark.config.mounting import StartConfig
from kalmark.config.reading import resolve_name, validate
from kalmark.config.schema import Config
from kalmark.config.sections import Positive, Section, expected
from kalmark.config.tree import Tree, read_tree
from kalmark.simulate.layouts import Layout
from kalmark.simulate.routes import Constant, Route

Count = Annotated[int, Field(ge=1)]

_COLUMNS = {"odometry_2d": 3, "unicycle": 2, "ackermann": 2}


class SimulatedRobot(Section):
    """One robot: how it truly moves and measures, noise included, and where it goes."""

    motion: Motion
    """Motion model and its noise."""
    route: Route
    """Where it is told to go."""
    start: StartConfig = StartConfig()
    """Start; with sigmas, the true start is drawn around it."""
    sensors: dict[str, Sensor] = Field(default_factory=dict)
    """Sensors by name, and their noise."""

    @model_validator(mode="after")
    def _control_fits(self) -> SimulatedRobot:
        size = _COLUMNS[self.motion.type]
        if isinstance(self.route, Constant) and len(self.route.u) != size:
            raise expected(f"a route whose u has the {size} numbers of {self.motion.type}, not {len(self.route.u)}")
        return self


class World(Section):
    """A world to simulate: landmarks, robots, noise, and how long."""

    world: Layout
    """Where the landmarks are."""
    robots: Annotated[dict[str, SimulatedRobot], Field(min_length=1)]
    """Robots by name."""
    steps: Count = 1000
    """Steps: one motion and one scan of every sensor each."""
    dt_s: Positive = 0.1
    """Duration of a step."""
    noise_on: Literal["control", "robot"] = "control"
    """Disturb the control that the filter is given, or the robot."""
    ids: bool = True
    """Tell the filter which landmark is which."""
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

    _file: Path | None = PrivateAttr(None)
    _tree: Tree | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _signatures_fit(self) -> World:
        if self.sight_robots and self.has_signatures:
            raise expected("sight_robots false where a sensor measures signatures: robots have none")
        return self

    @property
    def file(self) -> Path | None:
        """The file this was read from, or None."""
        return self._file

    @property
    def name(self) -> str:
        """The file's name without its ending, or "world"."""
        return self._file.stem if self._file else "world"

    @property
    def has_signatures(self) -> bool:
        """Whether any sensor measures signatures."""
        sensors = [sensor for robot in self.robots.values() for sensor in robot.sensors.values()]
        return any(isinstance(sensor, RangeBearingSignatureSensor) for sensor in sensors)

    def config(self) -> Config:
        """Return the filter's configuration: the simulated models and noise, with `filter` laid over them.

        Raises ConfigError naming the place of a key in `filter` that a configuration does not have.
        """
        values: dict[str, Any] = {"robots": {}}
        for name, robot in self.robots.items():
            values["robots"][name] = robot.model_dump(exclude={"route"}, exclude_none=True)
        values["association"] = {"type": "identity" if self.ids else "nearest"}
        values["landmarks"] = {"type": "point_signature" if self.has_signatures else "point"}
        return validate(self._laid_over(values), Config)

    def to_yaml(self) -> str:
        """Return the text of a file that describes this world, every default written out; `load_world` reads it."""
        yaml, out = YAML(), io.StringIO()
        yaml.default_flow_style = False
        yaml.dump(self.model_dump(mode="json", exclude_none=True), out)
        return out.getvalue()

    def _laid_over(self, values: dict[str, Any]) -> Tree:
        """Return `values` with `filter` laid over, its keys remembering where they were written."""
        tree = Tree(values=merged(values, deepcopy(self.filter)))
        for table, source in ((tree.places, "places"), (tree.keys, "keys")):
            written: dict[tuple[str, ...], str] = getattr(self._tree, source, {})
            table |= {path[1:]: place for path, place in written.items() if path[:1] == ("filter",)}
        return tree


def shipped_worlds() -> dict[str, Path]:
    """Return the worlds that come with kalmark, by name."""
    folder = Path(str(resources.files("kalmark"))) / "configs" / "worlds"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def load_world(path_or_name: str | Path, overrides: Sequence[str] = ()) -> World:
    """Return the world at a path or of a shipped name, with overrides like ``steps=200`` applied.

    Raises ConfigError: ``file:line:column: key.path: got value, expected what``.
    """
    path = resolve_name(path_or_name, shipped_worlds(), "world")
    tree = read_tree(path, overrides)
    world = validate(tree, World)
    world._file, world._tree = path, tree
    world.config()  # a mistake in `filter` shows now, not after the simulation
    return world
