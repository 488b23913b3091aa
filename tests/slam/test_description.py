"""Every declared option goes from Python to a run's configuration and a saved map, and back, to the last bit.

The options are those that are declared: fields of `Robot`, `Mount` and `Settings`, parameters of registered models.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

import kalmark as km
from kalmark.cli import main
from kalmark.config import build_slam, load_config, open_run
from kalmark.config.sections import Choice, model_of
from kalmark.declare import (
    Parameter,
    built_in,
    class_of,
    declared_options,
    missing_models,
    parameters,
    roles,
    world_of_class,
)
from kalmark.errors import ConfigError, KalmarkError, MapError, ModelError
from kalmark.geometry.rotations import from_euler
from kalmark.geometry.spaces import ROTATION
from kalmark.models.landmark_views import Raised
from kalmark.results.filter_description import configuration
from kalmark.results.recording import config_yaml
from kalmark.slam.description import describe, describe_model
from kalmark.slam.saving import members_of
from kalmark.slam.state import Settings

missing_models()  # of all plug-ins, whatever was imported before
ROLES = [role for role in roles() if role not in ("picture", "topic")]  # which are of a simulator and of a converter
WORLDS: dict[str, tuple[Any, Any]] = {
    "plane": (km.motion.Unicycle(), (0, 0, 0)),
    "space": (km.motion.Odometry3D(), (0, 0, 0, 0, 0, 0, 1)),
}
"""A motion of each world, and a mount at the origin."""
MODELS = [(role, each) for role in ROLES for each in built_in(role)]
KINDS = (km.Robot, km.Mount, Settings)
OPTIONS = [(kind, option.name) for kind in KINDS for option in declared_options(kind) if option.role != "motion"]
SENSORS = (km.sensors.RangeBearing(), km.sensors.Bearing(), km.sensors.Range())
PLACES = np.array([(1.0, -2.0), (4.0, -1.0), (3.0, 1.0)])  # by increasing bearing
AT_3D = (0.1, -0.2, 0.3, *from_euler(np.array([0.3, -0.4, 2.0]))[0])


def values(own: Parameter) -> Iterator[Any]:
    """Yield values that a parameter may have and that are not its default."""
    numbers = (0.25, 0.75, 1.5, 3.0, 7.0, 20.0) if own.type is float else (1, 2, 3, 5, 9)
    texts = get_args(own.type)[:1] == (str,)
    one = own.default if isinstance(own.default, tuple) and not texts else ()
    several = [tuple(v + step for v in one) for step in (1, 0.125)] + [(0.125, 0.25), (0.125,) * 4]
    for value in (None, *own.words, False, True, *numbers, *several):
        if value != own.default and type(value) is not type(own.default is None) and not own.refused(value):
            yield value
    if own.type is bool:
        yield not own.default
    if texts:
        yield ("red", "green")
    if own.name == "confusion":
        yield (0.75, 0.25, 0.125, 0.875)


def changed(kind: Any, name: str) -> Any:
    """Return a model with another value of a parameter than its default; where it needs one, of another one, too."""
    declared = {own.name: own for own in parameters(kind)}
    others = [()] + [((own.name, value),) for own in declared.values() if own.name != name for value in values(own)]
    for value, more in itertools.product(values(declared[name]), others):
        try:
            return kind(**{name: value}, **dict(more))
        except ModelError:
            continue
    raise AssertionError(f"{kind.__name__}: no other value of {name} is taken")


def candidates(option: Parameter) -> Iterator[Any]:
    """Yield what an option may be: models of its role, or values."""
    if option.role:
        fitting = Choice(option.role, "plane", type(SENSORS[0]) if option.role == "detector" else None)
        kinds = [class_of(option.role, name, "plane") for name in fitting.names()]
        yield from (changed(kind, own.name) for kind in kinds for own in parameters(kind))
    else:
        yield from values(option)


def built(kind: Any, given: dict[str, Any]) -> km.Slam:
    """Return a Slam of one robot with one sensor, which has these options of the robot, the mount or the Slam."""
    options = {each: given if each is kind else {} for each in KINDS}
    for sensor in SENSORS:
        try:
            mount = km.Mount(sensor, **options[km.Mount])
            return km.Slam(
                [km.Robot("r", km.motion.Unicycle(), None, {"s": mount}, **options[km.Robot])], **options[Settings]
            )
        except ModelError as error:
            failed = error
    raise failed


def with_option(kind: Any, name: str) -> tuple[km.Slam, Any]:
    """Return a Slam with another value of an option than its default, and this value."""
    option = next(each for each in declared_options(kind) if each.name == name)
    for value in candidates(option):
        if value != option.default:
            try:
                return built(kind, {name: value}), value
            except (KalmarkError, TypeError):
                continue
    raise AssertionError(f"{kind.__name__}: no other value of {name} is taken")


def assert_same(one: km.Slam, other: km.Slam) -> None:
    """Assert that two filters are constructed alike, to the last bit."""
    assert describe(one) == describe(other)
    for name in (each.name for each in fields(Settings)):
        assert vars(one.state.settings)[name] == vars(other.state.settings)[name], name
    for a, b in zip(one.robots.values(), other.robots.values(), strict=True):
        pairs = [(a, b), *((a.sensors[key], b.sensors[key]) for key in a.sensors)]
        for x, y in pairs:
            for field in (each.name for each in fields(x) if each.name != "sensors"):
                mine, again = vars(x)[field], vars(y)[field]
                is_array = isinstance(mine, np.ndarray | list)
                assert np.array_equal(mine, again) if is_array else mine == again, (a.name, field)


def read_again(slam: km.Slam, folder: Path) -> list[km.Slam]:
    """Return the filters that the configuration of a run and the saved map of a filter make."""
    log = km.log_from(controls={"t_s": [0.0], "robot": ["r"], "v_mps": [0.0], "w_radps": [0.0]})
    (folder / "config.yaml").write_text(config_yaml(configuration(slam, log)))
    slam.save(folder / "map.kmk")
    return [km.Slam.from_config(folder / "config.yaml"), km.Slam.load(folder / "map.kmk")]


@pytest.mark.parametrize(("role", "kind"), MODELS, ids=[f"{role}-{kind.__name__}" for role, kind in MODELS])
def test_every_parameter_of_every_model_is_read_again(role: str, kind: Any) -> None:
    world = world_of_class(kind) or "plane"
    for own in parameters(kind):
        made = changed(kind, own.name)
        said = describe_model(made)
        if isinstance(made, Raised) and said.pop("height_m"):  # it is `mount.z_m`
            continue
        section = Choice(role, world_of_class(kind)).validated(said)
        assert model_of(section, world) == made, own.name


@pytest.mark.parametrize(("kind", "name"), OPTIONS, ids=[f"{kind.__name__}-{name}" for kind, name in OPTIONS])
def test_every_option_is_read_again_from_a_configuration_and_from_a_map(kind: Any, name: str, tmp_path: Path) -> None:
    slam, _ = with_option(kind, name)
    for again in read_again(slam, tmp_path):
        assert_same(again, slam)


def random_covariance(size: int) -> np.ndarray:
    A = 0.1 * np.random.default_rng(size).normal(size=(size, size))
    return A @ A.T


def test_poses_states_and_covariances_are_read_again_to_the_last_bit(tmp_path: Path) -> None:
    eye = km.Mount(km.sensors.Range(height_m=0.7), at=(0.1, 0.2, 0.3), cov=random_covariance(3))
    moving = km.motion.ConstantVelocity3D()
    start = (*AT_3D, *np.arange(1, moving.space.size - 6) / 7)
    camera = km.Mount(km.sensors.TagPose(), at=AT_3D, cov=random_covariance(6))
    slams = [
        km.Slam([km.Robot("r", km.motion.Unicycle(), (1, 2, 0.1), {"s": eye}, random_covariance(3))]),
        km.Slam([km.Robot("r", km.motion.Unicycle(), cov=np.diag([0.01, 0.02, 0.03]))]),
        km.Slam([km.Robot("r", moving, start, {"s": camera}, random_covariance(moving.space.dof))]),
        km.Slam([km.Robot("r", moving, start, {"s": replace(camera, cov=np.zeros((6, 6)))})]),
    ]
    for slam in slams:
        for again in read_again(slam, tmp_path):
            assert_same(again, slam)


def test_a_readable_key_that_does_not_fit_the_exact_one_is_refused(tmp_path: Path) -> None:
    slam = km.Slam([km.Robot("r", km.motion.Odometry3D(), AT_3D, cov=random_covariance(6))])
    read_again(slam, tmp_path)
    path = tmp_path / "config.yaml"
    text = path.read_text().replace("x_m: 0.1", "x_m: 0.5")
    path.write_text(text)
    assert km.Slam.from_config(path).mean("r")[0] == 0.5
    for key, what in (("yaw_deg", "quaternion"), ("sigma_position_m", "cov")):
        with pytest.raises(
            ConfigError, match=rf"robots.r.start.{key}: got 7.0, expected .* by its .*{what}.*, or none"
        ):
            build_slam(load_config(path, [f"robots.r.start.{key}=7.0"]))


def write_log(folder: Path, robots: dict[str, list[str]], columns: dict[str, tuple[str, ...]]) -> None:
    """Write what robots measure of three landmarks on an arc, at rest at first."""
    sensed = sorted({column for each in columns.values() for column in each})
    controls, scans = ["t_s,robot,v_mps,w_radps"], [",".join(("t_s,robot,sensor,id", *sensed))]
    for k, (name, sensors) in itertools.product(range(12), robots.items()):
        t = 0.2 * k
        controls.append(f"{t:.1f},{name},{0.5 if k > 1 else 0.0},0.1")
        for sensor, (i, p) in itertools.product(sensors, enumerate(PLACES - (0.1 * max(k - 2, 0), 0.0))):
            y = {"range_m": np.hypot(*p), "bearing_rad": np.arctan2(p[1], p[0])}
            cells = [f"{y[c]:.4f}" if c in columns[sensor] else "" for c in sensed]
            scans.append(",".join((f"{t:.1f},{name},{sensor},{i}", *cells)))
    folder.mkdir()
    for table, rows in (("controls", controls), ("scans", scans)):
        (folder / f"{table}.csv").write_text("\n".join(rows) + "\n")


def test_a_run_with_every_option_is_the_same_map_by_the_command_line_and_after_loading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = {(kind, name): with_option(kind, name) for kind, name in OPTIONS}
    settings = {name: value for (kind, name), (_, value) in found.items() if kind is Settings}
    mounts = {name: slam.robots["r"].sensors["s"] for (kind, name), (slam, _) in found.items() if kind is km.Mount}
    place = {"start": (0.01, 0.02, 0.03), "cov": random_covariance(3)}
    point, mounted = km.landmarks.Point2D(), {"at": (0.1, 0.2, 0.1), "cov": random_covariance(3)}
    eyes = {name: replace(each, landmark=each.landmark or point, **mounted) for name, each in mounts.items()}
    eyes["landmarks"] = found[Settings, "landmarks"][0].robots["r"].sensors["s"]
    robots = [km.Robot("carrier", km.motion.Unicycle(), sensors=eyes, **place)]
    for (kind, name), (slam, _) in found.items():
        if kind is km.Robot:
            robots.append(
                replace(slam.robots["r"], name=name, sensors={"s": km.Mount(SENSORS[0], landmark=point)}, **place)
            )
    slam = km.Slam(robots, **settings)
    carried = {robot.name: [*robot.sensors] for robot in robots}
    columns = {key: tuple(each.sensor.columns) for robot in robots for key, each in robot.sensors.items()}
    write_log(tmp_path / "log", carried, columns)
    recorded = km.record(slam, km.open_log(tmp_path / "log"), progress=False, pictures=False)
    assert len(slam.landmarks()) >= 3
    recorded.save(tmp_path / "run")
    monkeypatch.setattr("kalmark.compiled.say_compiling", lambda: None)
    monkeypatch.setattr("kalmark.cli.run.judge", lambda run: None)  # a verdict needs hundreds of runs, changes no map
    assert main(["run", str(tmp_path / "run" / "config.yaml"), "--out", str(tmp_path / "again")]) == 0
    names = (*slam.robots, *slam.landmarks().ids)
    for folder in ("run", "again"):
        other = km.Slam.load(tmp_path / folder / "map.kmk")
        assert_same(other, slam)
        assert other.landmarks().ids == slam.landmarks().ids
        np.testing.assert_array_equal(other.covariance(*names), slam.covariance(*names), folder)
        for name in names:
            np.testing.assert_array_equal(other.mean(name), slam.mean(name), folder)


def test_options_of_a_log_are_in_the_configuration_of_the_run(tmp_path: Path) -> None:
    write_log(tmp_path / "log", {"r": ["s"]}, {"s": ("range_m", "bearing_rad")})
    options = {"from_s": 0.3, "to_s": 1.9, "factors": {"v_mps": 1.1}, "shift_s": {"s": 0.01}}
    log = km.open_log(tmp_path / "log", **options)  # type: ignore[arg-type]
    assert log.options == options | {"on_error": "raise", "ids": "given", "increments": "recorded"}
    slam = km.Slam([km.Robot("r", km.motion.Unicycle(), sensors={"s": km.Mount(SENSORS[0])})])
    km.record(slam, log, progress=False, pictures=False).save(tmp_path / "run")
    km.Run.load(tmp_path / "run").save(tmp_path / "copy")
    again = km.record(*run_again(tmp_path / "copy"), progress=False, pictures=False).slam
    assert_same_state(again, slam)


def write_drive(folder: Path, motion: Any, robots: dict[str, Any], ids: tuple[str, ...]) -> None:
    """Write a log of robots with one control, whose sensor "s" sees the first landmark, and the others later on."""
    controls, scans = [",".join(("t_s,robot", *motion.columns))], list[str]()
    for k, (name, sensor) in itertools.product(range(8), robots.items()):
        controls.append(f"{0.1 * k:.1f},{name}{',0.1' * len(motion.columns)}")
        y = ",".join(("2.5", "0.3", "0.2")[: len(sensor.columns)])
        scans = scans or [",".join(("t_s,robot,sensor,id", *sensor.columns))]
        scans += [f"{0.1 * k:.1f},{name},s,{id_},{y}" for id_ in ids[: 1 + (k > 3)]]
    folder.mkdir()
    for table, rows in (("controls", controls), ("scans", scans)):
        (folder / f"{table}.csv").write_text("\n".join(rows) + "\n")


PARTS = ("landmark", "association", "detector", "initialization", "attention", "upkeep", "classes")  # of a mount


def robots_with(role: str, kind: Any, world: str) -> Iterator[km.Robot]:
    """Yield, for each parameter of a model, a robot of a world that has a model with another value of it."""
    moves, at = WORLDS[world]
    for own in parameters(kind):
        made, name = changed(kind, own.name), f"{role}.{kind.__name__}.{own.name}"
        if role == "motion":
            yield km.Robot(name, made)
        sensors = [made] if role == "sensor" else [each() for each in built_in("sensor") if role in PARTS]
        for sensor in sensors:
            part = {role: made} if role in PARTS else {}
            try:
                robot = km.Robot(name, moves, sensors={"s": km.Mount(sensor, at, **part)})
                km.Slam([robot])
            except (KalmarkError, TypeError):
                continue
            yield robot
            break


@pytest.mark.parametrize("world", ["plane", "space"])
def test_a_run_with_every_parameter_of_every_model_is_the_same_from_its_folder(world: str, tmp_path: Path) -> None:
    motion, at = WORLDS[world]
    sensor = class_of("sensor", {"plane": "range_bearing", "space": "range_bearing_3d"}[world])()
    models = [(role, kind) for role, kind in MODELS if world_of_class(kind) in (world, "")]
    robots = [robot for role, kind in models for robot in robots_with(role, kind, world)]
    had = {robot.name.rpartition(".")[0] for robot in robots}
    lacking = {f"{role}.{kind.__name__}" for role, kind in models if parameters(kind)} - had
    assert all(name.startswith(("estimator", "detector")) for name in lacking)  # these are of the other world
    seen = {"first": sensor, "last": sensor}
    mounted = [km.Robot(name, motion, sensors={"s": km.Mount(sensor, at)}) for name in seen]
    slam = km.Slam([mounted[0], *robots, mounted[1]], estimator=changed(km.estimators.Invariant, "iterations"))
    write_drive(tmp_path / "log", motion, {"last": sensor, "first": sensor}, ("a", "b"))
    run = km.record(slam, km.open_log(tmp_path / "log"), progress=False, pictures=False)
    assert run.notes == []
    run.save(tmp_path / "run")
    again, log = run_again(tmp_path / "run")
    assert_same(again, slam)
    assert_same_state(km.record(again, log, progress=False, pictures=False).slam, slam)


# ---------------------------------------------------------------------- the configuration lacks something
def test_a_robot_without_events_is_in_the_run_again_in_its_place(tmp_path: Path) -> None:
    sensor = km.sensors.RangeBearing()
    robots = [km.Robot(name, km.motion.Unicycle(), sensors={"s": km.Mount(sensor)}) for name in ("parked", "rover")]
    robots[0] = replace(robots[0], start=(2.0, 1.0, 0.5), cov=random_covariance(3))
    write_drive(tmp_path / "log", km.motion.Unicycle(), {"rover": sensor}, ("a", "parked"))
    slam = km.Slam(robots)
    run = km.record(slam, km.open_log(tmp_path / "log"), progress=False, pictures=False)
    assert run.config["log"]["without_events"] == ["parked"]
    assert slam.covariance("rover", "parked")[:3, 3:].any()  # it was observed
    run.save(tmp_path / "run")
    assert_same_state(km.record(*run_again(tmp_path / "run"), progress=False, pictures=False).slam, slam)


def test_a_run_notes_what_its_configuration_lacks(tmp_path: Path) -> None:
    def find(scan: km.Scan) -> km.Scan:
        return scan

    rover = km.Robot("r", km.motion.Unicycle(), sensors={"s": km.Mount(SENSORS[0], detector=find)})
    slam, events = km.Slam([rover]), [km.Control(t_s=0.1 * k, robot="r", u=(0.5, 0.1)) for k in range(4)]
    slam.process(events[0])
    run = km.record(slam, events[1:], progress=False)
    assert run.notes == [
        "config.yaml has no log, because this one has no file: `kalmark run` of it requires --log",
        "config.yaml lacks the events that the filter had before this log: `kalmark run` makes another map",
        f"config.yaml cannot have {Path(__file__).name}:{find.__qualname__}: "
        "`kalmark run` requires a registered class, or an object, of a file",
    ]
    run.save(tmp_path / "run")
    assert km.Run.load(tmp_path / "run").evaluate()["notes"][:3] == run.notes
    with pytest.raises(ConfigError, match=r"detector\.type: got '.*lacks.*, expected one of"):
        load_config(tmp_path / "run" / "config.yaml")


@pytest.mark.parametrize(
    ("sensor", "name", "lacking"),
    [
        (
            km.pointwise(lambda v: v, np.eye(2)),
            "s",
            "pointwise.py:PointwiseSensor: `kalmark run` requires a registered",
        ),
        (km.factor(lambda a, b: a - b, np.eye(2)), "s", "blocks.py:BlockSensor: `kalmark run` requires a registered"),
        (SENSORS[0], "each", "a robot or a sensor called each, which stands for all of them there"),
    ],
)
def test_a_run_notes_a_sensor_that_its_configuration_cannot_have(sensor: Any, name: str, lacking: str) -> None:
    slam = km.Slam([km.Robot("r", km.motion.Unicycle(), sensors={name: km.Mount(sensor)})])
    run = km.record(slam, [km.Control(t_s=0.0, robot="r", u=(0.5, 0.1))], progress=False)
    assert run.notes[1:] and run.notes[1].startswith(f"config.yaml cannot have {lacking}")


CONSTRUCTORS = """
class Own:
    def __init__(self, limit=3.0):
        self.limit = limit

    def threshold(self, dof, default):
        return self.limit**2

    def associate(self, query):
        return [(i, "") for i in query.ids]

class Hidden(Own):
    def __init__(self, gate=3.0):
        super().__init__(gate)
"""


def test_a_plain_class_of_a_file_is_made_again_with_its_arguments_or_noted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_classes.py").write_text(CONSTRUCTORS)
    monkeypatch.syspath_prepend(tmp_path)
    mine: Any = import_module("my_classes")
    write_log(tmp_path / "log", {"r": ["s"]}, {"s": ("range_m", "bearing_rad")})
    robot = km.Robot("r", km.motion.Unicycle(), sensors={"s": km.Mount(SENSORS[0])})
    runs = []
    for association in (mine.Own(2.0), mine.Hidden(2.0)):
        log = km.open_log(tmp_path / "log")
        runs.append(km.record(km.Slam(robot, association=association), log, progress=False, pictures=False))
    runs[0].save(tmp_path / "run")
    again, log = run_again(tmp_path / "run")
    assert type(again.association) is mine.Own and again.association.limit == 2.0
    assert_same_state(km.record(again, log, progress=False, pictures=False).slam, runs[0].slam)
    assert runs[0].notes == []
    lacks = "config.yaml cannot have gate of my_classes.py:Hidden: `kalmark run` requires an attribute of that name"
    assert runs[1].notes == [lacks]
    del sys.modules["my_classes"]


@pytest.mark.parametrize("value", [0.0, None])
def test_a_linearity_index_of_zero_or_none_is_read_again(value: float | None, tmp_path: Path) -> None:
    slam = km.Slam([km.Robot("r", km.motion.Unicycle())], reparametrize=value)
    for again in read_again(slam, tmp_path):
        assert_same(again, slam)


FUNCTIONS = """
import numpy as np
import kalmark as km

def place(y):
    return [y[0] * np.cos(y[1]), y[0] * np.sin(y[1])]

sonar = km.pointwise(
    lambda v: [np.hypot(*v), np.arctan2(v[1], v[0])], [[0.01, 0.001], [0.001, 0.004]], inverse=place,
    columns=("range_m", "bearing_rad"), angular=(False, True),
)
tape = km.factor(lambda a, b: np.linalg.norm(a - b), [[0.01]], columns=("distance_m",))
"""


def test_sensors_of_functions_in_a_file_are_the_same_from_the_folder_of_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_functions.py").write_text(FUNCTIONS)
    monkeypatch.syspath_prepend(tmp_path)
    mine: Any = import_module("my_functions")
    sensors = {"s": km.Mount(mine.sonar), "tape": km.Mount(mine.tape)}
    slam = km.Slam([km.Robot("r", km.motion.Unicycle(), sensors=sensors)])
    write_log(tmp_path / "log", {"r": ["s"]}, {"s": mine.sonar.columns})
    run = km.record(slam, km.open_log(tmp_path / "log"), progress=False, pictures=False)
    assert run.notes == [] and run.config["plugins"] == [str(tmp_path / "my_functions.py")]
    assert run.config["robots"]["r"]["sensors"]["s"]["type"] == "my_functions.py:sonar"
    run.save(tmp_path / "run")
    again, log = run_again(tmp_path / "run")
    assert all(hasattr(model, "columns") for model in built_in("sensor"))  # it is none of kalmark's own
    assert {name: mount.sensor for name, mount in again.robots["r"].sensors.items()} == {
        "s": mine.sonar, "tape": mine.tape
    }  # fmt: skip
    assert_same_state(km.record(again, log, progress=False, pictures=False).slam, slam)
    assert len(slam.landmarks()) == len(PLACES)
    del sys.modules["my_functions"]


def test_numbers_of_numpy_are_those_that_a_configuration_has(tmp_path: Path) -> None:
    motion = km.motion.Unicycle(sigma_v_mps=np.float32(0.3))  # squared as a float32 it is another variance
    slam = km.Slam([km.Robot("r", motion, max_speed_mps=np.float64(2.0))])
    for again in read_again(slam, tmp_path):
        assert_same(again, slam)
        np.testing.assert_array_equal(
            again.robots["r"].motion.control_noise(np.ones(2)), motion.control_noise(np.ones(2))
        )


def test_a_detector_of_what_its_sensor_does_not_measure_is_refused() -> None:
    said = r"Mount: detector is a Walls, expected one for the bearing_rad of a Bearing"
    with pytest.raises(ModelError, match=said):
        km.Mount(km.sensors.Bearing(), detector=km.detect.Walls())


# ---------------------------------------------------------------------- landmarks known beforehand
def run_again(folder: Path) -> tuple[km.Slam, km.Log]:
    """Return the filter and the log that `kalmark run` makes of the configuration in a run folder."""
    config, log = open_run(folder / "config.yaml")
    return build_slam(config, log), log


def assert_same_state(one: km.Slam | None, other: km.Slam) -> None:
    """Assert that all that events have made of two filters is the same, to the last bit."""
    assert one is not None
    assert members_of(one.state, {}) == members_of(other.state, {})


def mean_of(space: Any) -> np.ndarray:
    """Return numbers of a space that have no short digits, and of a quaternion the length 1."""
    mean = np.arange(1, space.size + 1) / 7.0
    for kind, at, _ in space.atoms:
        if kind == ROTATION:
            mean[at : at + 4] /= np.linalg.norm(mean[at : at + 4])
    return mean


def add_to(slam: km.Slam, model: Any, name: Any) -> None:
    """Add a landmark of a type three times: with a covariance, with one of zero, and known exactly."""
    space = model.space
    for k, cov in enumerate((random_covariance(space.dof), np.zeros((space.dof, space.dof)), None)):
        slam.add_landmark(name if k == 0 else f"{name}, {k}", mean_of(space), cov, model)


@pytest.mark.parametrize("kind", built_in("landmark"), ids=[kind.__name__ for kind in built_in("landmark")])
def test_landmarks_of_every_type_are_read_again_with_all_parameters(kind: Any, tmp_path: Path) -> None:
    moves, _ = WORLDS[world_of_class(kind)]
    slam = km.Slam([km.Robot("r", moves, cov=random_covariance(moves.space.dof))])
    for n, model in enumerate([kind(), *(changed(kind, own.name) for own in parameters(kind))]):
        add_to(slam, model, n)
    again = read_again(slam, tmp_path)
    for other in again:
        assert_same_state(other, slam)
        assert [*map(other.landmark_model, other.landmarks().ids)] == [*map(slam.landmark_model, slam.landmarks().ids)]


TEXTS = (
    "0",
    "007",
    "1e3",
    "0x1F",
    "1_0",
    "true",
    "~",
    "null",
    "-",
    "a, b: 'c' #d",
    " led",
    "{b}",
    "*c",
    "u3",
    "\u3000é",
)


def test_ids_that_are_numbers_or_texts_are_read_again_as_they_are(tmp_path: Path) -> None:
    slam = km.Slam([km.Robot("r", km.motion.Unicycle())])
    for k, name in enumerate((0, -7, 10**20, *TEXTS)):
        slam.add_landmark(name, (k, 1.0 / 3.0), None if k % 2 else random_covariance(2))
    for again in read_again(slam, tmp_path):
        assert_same_state(again, slam)
        assert [type(name) for name in again.landmarks().ids] == [type(name) for name in slam.landmarks().ids]


@pytest.mark.parametrize("map_", ["dense", "postponed"])
@pytest.mark.parametrize("estimator", [km.estimators.Ekf(), km.estimators.Invariant()])
def test_the_joint_covariance_of_landmarks_fused_before_the_first_event_is_read_again(
    estimator: Any, map_: str, tmp_path: Path
) -> None:
    robot = km.Robot("r", km.motion.Unicycle(), (0.3, 0.4, 0.5), cov=random_covariance(3))
    slam = km.Slam([robot], estimator=estimator, map=map_)
    for name, place in zip("abc", PLACES, strict=True):
        slam.add_landmark(name, place, random_covariance(2))
    slam.fuse(["a", "b"], lambda a, b: np.linalg.norm(a - b), 3.2, 0.01)  # a tape measure
    slam.fuse(["b", "c"], lambda b, c: np.linalg.norm(b - c), 2.2, 0.01)
    assert slam.covariance("a", "c")[2:, :2].any()
    again = read_again(slam, tmp_path)[0]
    np.testing.assert_array_equal(again.covariance(*"rabc"), slam.covariance(*"rabc"))
    for name in "rabc":
        np.testing.assert_array_equal(again.mean(name), slam.mean(name))


def test_a_joint_covariance_that_is_none_is_refused(tmp_path: Path) -> None:
    place = "{id: a, mean: [4, 1], cov: [[0.01, 0], [0, 0.01]]}"
    file = tmp_path / "c.yaml"
    for shared, said in (
        ("0.02", "has the eigenvalue -0.01, expected a positive semidefinite"),
        ("", r"has shape \(3, 5\), expected \(5, 5\)"),
    ):
        rows = [[0.0] * 5] * 3 + [[0, 0, 0, 0.01, float(shared or 0)], [0, 0, 0, float(shared or 0), 0.01]]
        file.write_text(f"map:\n  landmarks: [{place}]\n  cov: {rows if shared else rows[:3]}\n")
        with pytest.raises(ConfigError, match=rf"c.yaml:3:\d+: map.cov: cov of all that is in the map {said}"):
            km.Slam.from_config(file)


def test_a_tag_whose_quaternion_is_of_another_length_than_1_is_refused() -> None:
    slam = km.Slam([km.Robot("r", km.motion.Odometry3D())])
    with pytest.raises(MapError, match=r"landmark 'k': quaternion has length 0\.547723, expected 1 up to 0.001"):
        slam.add_landmark("k", (5, 1, 0.3, 0.1, 0.2, 0.3, 0.4), None, km.landmarks.Tag())
    slam.add_landmark("k", (5, 1, 0.3, 0.0, 0.0, 0.6001, 0.8), None, km.landmarks.Tag())
    assert np.linalg.norm(slam.mean("k")[3:]) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("world", ["plane", "space"])
def test_a_run_with_landmarks_of_every_type_is_the_same_map_by_the_command_line(
    world: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kalmark.compiled.say_compiling", lambda: None)
    monkeypatch.setattr("kalmark.cli.run.judge", lambda run: None)
    motion, at = WORLDS[world]
    sensor = class_of("sensor", {"plane": "range_bearing", "space": "range_bearing_3d"}[world])()
    slam = km.Slam([km.Robot("r", motion, None, {"s": km.Mount(sensor, at)})])
    for kind in built_in("landmark"):
        if world_of_class(kind) == world:
            add_to(slam, kind(), kind.__name__)
    write_drive(tmp_path / "log", motion, {"r": sensor}, ("new", "Point2D" if world == "plane" else "Point3D"))
    km.record(slam, km.open_log(tmp_path / "log"), progress=False).save(tmp_path / "run")
    assert main(["run", str(tmp_path / "run" / "config.yaml"), "--out", str(tmp_path / "again")]) == 0
    assert_same_state(km.Slam.load(tmp_path / "again" / "map.kmk"), km.Slam.load(tmp_path / "run" / "map.kmk"))
    for table in ("landmarks.csv", "associations.csv"):
        assert (tmp_path / "run" / table).read_text() == (tmp_path / "again" / table).read_text()
