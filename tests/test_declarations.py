"""A model is declared once: what is written in Python or in a plugin is recorded, saved and read again as it was."""

from __future__ import annotations

import inspect
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.campaign.running import run_campaign
from kalmark.config import build_slam, config_dict, load_config
from kalmark.config.opening import open_run
from kalmark.declare import built_in, parameters
from kalmark.errors import ConfigError, KalmarkError, ModelError
from kalmark.logs import FORMATS, formats
from kalmark.results.recording import config_yaml
from kalmark.simulate.robots import simulate
from kalmark.simulate.worlds import load_world
from kalmark.slam.description import describe

PLUGIN = '''
from typing import Annotated, ClassVar

import numpy as np

import kalmark as km
from kalmark.declare import Within
from kalmark.geometry.spaces import HEADING, VECTOR, Space


@km.register("sensor", "ball")
class Ball:
    """A ball's squared distance and bearing."""

    sigma_range_m: Annotated[float, Within(gt=0), "Noise of the distance."] = 0.1
    sigma_bearing_rad: Annotated[float, Within(gt=0), "Noise of the bearing."] = 0.02
    range_max_m: Annotated[float, Within(gt=0), "Farthest ball."] = 9.0

    columns: ClassVar = ("distance_m", "bearing_rad")
    angular: ClassVar = (False, True)
    world: ClassVar = "plane"

    def expect(self, v):
        d = np.hypot(v[:, 0], v[:, 1])
        e = np.column_stack([d, np.arctan2(v[:, 1], v[:, 0])])
        E_v = np.zeros((len(v), 2, v.shape[1]))
        E_v[:, 0, 0], E_v[:, 0, 1] = v[:, 0] / d, v[:, 1] / d
        E_v[:, 1, 0], E_v[:, 1, 1] = -v[:, 1] / d**2, v[:, 0] / d**2
        return e, E_v

    def noise(self, y):
        return np.tile(np.diag([self.sigma_range_m**2, self.sigma_bearing_rad**2]), (len(y), 1, 1))

    def invert(self, y):
        c, s = np.cos(y[:, 1]), np.sin(y[:, 1])
        v = y[:, :1] * np.column_stack([c, s])
        return v, np.stack([np.column_stack([c, s]), y[:, :1] * np.column_stack([-s, c])], axis=2)

    def sees(self, v):
        return np.hypot(v[:, 0], v[:, 1]) <= self.range_max_m


@km.register("landmark", "post")
class Post(km.landmarks.Point2D):
    """A point of a user's own."""

    kind: ClassVar = "post"


class Unnamed(Ball):
    """A sensor without a name in configurations."""
'''
FORMAT = """
from kalmark.events import Control
from kalmark.logs import FORMATS, Log
from kalmark.logs.source import Format


def find(path):
    return path if path.suffix == ".mine" else None


def read(path, request):
    rows = [[float(value) for value in line.split()] for line in path.read_text().splitlines()]
    events = [Control(t_s, "r", (v, w)) for t_s, v, w in rows]
    return Log(name=path.stem, format="mine", path=path, robots=("r",), events=events, skipped=request.skipped)


FORMATS["mine"] = Format("mine", "a file that ends in .mine", find, read)
"""
DETECTOR = '''

@km.register("detector", "every_other")
class EveryOther:
    """Every other observation of a scan."""

    def __call__(self, scan):
        return km.Scan(t_ns=scan.t_ns, robot=scan.robot, sensor=scan.sensor, y=scan.y[::2], ids=scan.ids[::2])
'''
WORLD = """
plugins: [my_models.py]
world: {type: random_field, count: 40, size_m: 30.0}
robots:
  r:
    route: {type: constant, u: [1.0, 0.1]}
    sensors: {eye: {type: ball, sigma_range_m: 0.05}}
steps: 30
filter: {landmarks: {type: post}}
"""


@pytest.fixture
def plugin(tmp_path: Path) -> Path:
    path = tmp_path / "my_models.py"
    path.write_text(PLUGIN)
    return path


def again(slam: km.Slam, folder: Path) -> km.Slam:
    """Return the filter that the recorded configuration of a filter describes."""
    path = folder / "config.yaml"
    path.write_text(config_yaml(describe(slam)))
    return build_slam(load_config(path))


def test_a_filter_built_in_python_is_recorded_with_its_landmarks_and_map(tmp_path: Path) -> None:
    robot = km.Robot("r", km.motion.Unicycle(), sensors={"eye": km.Mount(km.sensors.Bearing())})
    own = km.landmarks.InverseDepth2D(prior_rho_per_m=0.2)
    slam = km.Slam([robot], landmarks=own, map="postponed", numbers="float32", reparametrize=0.1)
    restored = again(slam, tmp_path)
    assert restored.state.settings.landmarks == own
    settings = restored.state.settings
    assert (settings.map, settings.numbers, settings.reparametrize) == ("postponed", "float32", 0.1)
    assert again(km.Slam([robot], reparametrize=None), tmp_path).state.settings.reparametrize is None


@pytest.mark.parametrize("way", [km.initialization.Trilateration(poses=30), km.initialization.Hypotheses(count=9)])
def test_a_way_to_start_from_ranges_is_read_again(way: Any, tmp_path: Path) -> None:
    mount = km.Mount(km.sensors.Range(), initialization=way)
    restored = again(km.Slam([km.Robot("r", km.motion.Unicycle(), sensors={"eye": mount})]), tmp_path)
    assert restored.robots["r"].sensors["eye"].initialization == way


def test_a_model_of_a_plugin_works_from_the_world_to_the_reloaded_map(plugin: Path, tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(WORLD)
    world = load_world(tmp_path / "own.yaml")
    log = simulate(world, seed=1)
    slam = build_slam(world.config(), log)
    run = km.record(slam, log, progress=False)
    assert len(slam.landmarks()) == 4
    assert {track.model.kind for track in slam.tracks.confirmed.values()} == {"post"}

    run.save(tmp_path / "run")
    config = load_config(tmp_path / "run" / "config.yaml")
    assert config.plugins == (str(plugin),)
    assert config.robots["r"].sensors["eye"].sigma_range_m == 0.05
    assert build_slam(config, log).robots["r"].sensors["eye"].sensor == slam.robots["r"].sensors["eye"].sensor

    slam.save(tmp_path / "map.zip")
    restored = km.Slam.load(tmp_path / "map.zip")
    assert restored.robots["r"].sensors["eye"].sensor == slam.robots["r"].sensors["eye"].sensor
    np.testing.assert_array_equal(restored.mean("r"), slam.mean("r"))


def test_a_plugin_adds_a_log_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kalmark.logs.formats.FORMATS", FORMATS.copy())
    monkeypatch.setattr("kalmark.logs.FORMATS", formats.FORMATS)
    (tmp_path / "format.py").write_text(FORMAT)
    (tmp_path / "log.mine").write_text("0.0 1.0 0.1\n1.0 1.0 0.2\n")
    (tmp_path / "mine.yaml").write_text("plugins: [format.py]\nlog: {path: log.mine}\nrobots: {r: {sensors: {}}}\n")
    config, log = open_run(tmp_path / "mine.yaml")
    assert (log.format, len(log.events), tuple(config.robots)) == ("mine", 2, ("r",))


def test_a_package_adds_a_verb(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("def hello(name: str) -> None:\n    print('hello', name)\n")
    (tmp_path / "own-1.dist-info").mkdir()
    (tmp_path / "own-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: own\nVersion: 1\n")
    (tmp_path / "own-1.dist-info" / "entry_points.txt").write_text("[kalmark.verbs]\nhello = own:hello\n")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from kalmark.cli import main; sys.exit(main())"
    done = subprocess.run([sys.executable, "-c", code, "hello", "you"], capture_output=True, text=True, check=True)
    assert done.stdout == "hello you\n"
    (tmp_path / "own.py").unlink()
    for arguments in (["--version"], ["--help"], ["hello", "you"]):
        command = [sys.executable, "-c", code, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        refused = "'hello' of own:hello cannot be loaded: No module named 'own'" in done.stderr
        assert (done.returncode, refused) == ((2, True) if "hello" in arguments else (0, False))


def test_a_campaign_s_workers_run_the_plugin(plugin: Path, tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(WORLD)
    alone = run_campaign(tmp_path / "own.yaml", 2, jobs=1, progress=False)
    both = run_campaign(tmp_path / "own.yaml", 2, jobs=2, progress=False)
    assert alone.scores.keys() == both.scores.keys()
    config = load_world(tmp_path / "own.yaml").config()
    code = f"import pickle, sys; print(pickle.loads(bytes.fromhex('{pickle.dumps(config).hex()}')).robots['r'].sensors)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "sigma_range_m=0.05" in done.stdout


def test_a_detector_of_a_plugin_needs_no_parameter_of_kalmark_s(plugin: Path, tmp_path: Path) -> None:
    plugin.write_text(plugin.read_text() + DETECTOR)
    sensor = "{type: range_bearing, detector: {type: every_other}}"
    path = tmp_path / "mine.yaml"
    path.write_text(f"plugins: [{plugin}]\nrobots: {{each: {{sensors: {{eye: {sensor}}}}}}}")
    slam = build_slam(load_config(path))
    report = slam.process(km.Scan(0.0, "robot", "eye", [[1.0, 0.0], [2.0, 0.1], [3.0, 0.2]], [1, 2, 3]))
    assert [seen.id for seen in report.observations] == [1, 3]


def test_a_class_without_a_name_is_read_again_by_its_file(plugin: Path, tmp_path: Path) -> None:
    text = f"plugins: [{plugin}]\nrobots: {{each: {{sensors: {{eye: {{type: 'my_models.py:Unnamed'}}}}}}}}"
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    slam = build_slam(load_config(path))
    sensor = slam.robots["robot"].sensors["eye"].sensor
    assert type(sensor).__name__ == "Unnamed"
    assert describe(slam)["robots"]["robot"]["sensors"]["eye"]["type"] == "my_models.py:Unnamed"


def test_what_a_plugin_registers_is_checked_as_kalmark_s_own(plugin: Path, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    text = "plugins: [my_models.py]\nrobots:\n  each:\n    sensors:\n      eye: {type: ball, "
    path.write_text(text + "sigma_range_m: -1}\n")
    with pytest.raises(ConfigError, match=r"mine.yaml:5:40: .*sigma_range_m: got -1, expected a positive number"):
        load_config(path)
    path.write_text(text + "sigma_rang_m: 1}\n")
    with pytest.raises(ConfigError, match="did you mean sigma_range_m"):
        load_config(path)


def test_a_plugin_that_cannot_be_run_is_refused_at_its_place(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text("x = 1\ny = 1 / 0\n")
    (tmp_path / "mine.yaml").write_text("plugins: [bad.py]\n")
    with pytest.raises(ConfigError, match=r"mine.yaml:1:11: plugins: .*ZeroDivisionError.*bad.py:2\)"):
        load_config(tmp_path / "mine.yaml")
    (tmp_path / "mine.yaml").write_text("plugins: [none.py]\n")
    with pytest.raises(ConfigError, match=r"none\.py: no such file"):
        load_config(tmp_path / "mine.yaml")


def test_a_name_of_kalmark_s_cannot_be_taken() -> None:
    with pytest.raises(ModelError, match="'range' is a sensor of kalmark"):
        km.register("sensor", "range")(type("Mine", (), {"__module__": "mine"}))


def test_every_registered_model_has_a_section_that_makes_it_again(tmp_path: Path) -> None:
    from kalmark.config.sections import model_of, section_of
    from kalmark.declare import built_in, registered_name, world_of_class

    for role in ("motion", "sensor", "landmark", "association", "estimator", "detector", "initialization"):
        for model in built_in(role):
            name = registered_name(model)
            assert name is not None
            section = section_of(role, name, world_of_class(model))()
            assert model_of(section, world_of_class(model) or "plane") == model(), name
            assert pickle.loads(pickle.dumps(section)) == section


def test_a_saved_configuration_is_the_same_configuration(tmp_path: Path) -> None:
    config = load_config("mrclam")
    path = tmp_path / "config.yaml"
    path.write_text(config_yaml(config_dict(config)))
    with pytest.raises(KalmarkError, match="no_such"):
        load_config(path, ["log.no_such=1"])
    saved_by = {"version": km.__version__, "seed": None}
    assert config_dict(load_config(path)) == config_dict(config) | saved_by


def test_help_of_a_declared_class_is_readable() -> None:
    for role in ("motion", "sensor", "landmark", "association", "estimator", "detector", "initialization"):
        for model in built_in(role):
            signature = str(inspect.signature(model))
            assert "Annotated" not in signature + str(inspect.signature(model.__init__))
            assert ": '" not in signature
            told = inspect.getdoc(model)
            assert all(f"\n    {each.on_a_line}" in told for each in parameters(model) if each.text)

    class Wider(km.sensors.RangeBearing):
        pass

    assert inspect.signature(Wider) == inspect.signature(km.sensors.RangeBearing)
    line = "sigma_bearing_rad = 0.02 [rad]: Noise of the bearing.  Expected: a positive number."
    assert line in km.sensors.RangeBearing.__doc__ and "`type: range_bearing`" in km.sensors.RangeBearing(0.2).__doc__
