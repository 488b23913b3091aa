"""Ready sensors: each number of theirs that is no default names its source."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

import kalmark as km
from kalmark import presets
from kalmark.config.building import build_slam, config_dict
from kalmark.config.reading import load_config
from kalmark.errors import ConfigError


def yaml_text(content: dict[str, Any]) -> str:
    out = io.StringIO()
    YAML().dump(content, out)
    return out.getvalue()


@pytest.mark.parametrize("name", presets.ALL)
def test_every_number_of_a_preset_names_its_source(name: str) -> None:
    preset = presets.ALL[name]
    plain = type(preset.sensor)()
    own = {f.name for f in dataclasses.fields(plain) if getattr(preset.sensor, f.name) != getattr(plain, f.name)}
    assert set(preset.sources) >= (own | {"rate_hz"}) - {"sigma_range_m"}
    assert all(len(source) > 20 for source in preset.sources.values())
    assert ("sigma_range_m" in preset.sources) == (getattr(preset.sensor, "sigma_range_m", 0.0) > 0)
    km.Slam([km.Robot("r", km.motion.Odometry2D(), sensors={"s": km.Mount(preset.sensor)})])


def test_a_configuration_takes_what_it_does_not_say_from_a_preset(tmp_path: Path) -> None:
    path = tmp_path / "preset.yaml"
    path.write_text("robots: {each: {sensors: {s: {type: range_bearing, preset: sonar, range_max_m: 3.0}}}}\n")
    config = load_config(path)
    sensor = build_slam(config).robots["robot"].sensors["s"].sensor
    assert sensor == dataclasses.replace(presets.SONAR.sensor, range_max_m=3.0)
    (tmp_path / "again.yaml").write_text(yaml_text(config_dict(config)))
    assert build_slam(load_config(tmp_path / "again.yaml")).robots["robot"].sensors["s"].sensor == sensor


def test_a_preset_of_another_type_of_sensor_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "preset.yaml"
    path.write_text("robots: {each: {sensors: {s: {type: bearing, preset: sonar}}}}\n")
    with pytest.raises(ConfigError, match=r"preset.yaml:1:.*sonar is a range_bearing"):
        load_config(path)
