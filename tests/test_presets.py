"""Ready sensors: each number of theirs that is no default names its source."""

from __future__ import annotations

import dataclasses

import pytest

import kalmark as km
from kalmark import presets


@pytest.mark.parametrize("name", presets.ALL)
def test_every_number_of_a_preset_names_its_source(name: str) -> None:
    preset = presets.ALL[name]
    plain = type(preset.sensor)()
    own = {f.name for f in dataclasses.fields(plain) if getattr(preset.sensor, f.name) != getattr(plain, f.name)}
    assert set(preset.sources) >= (own | {"rate_hz"}) - {"sigma_range_m"}
    assert all(len(source) > 20 for source in preset.sources.values())
    assert ("sigma_range_m" in preset.sources) == (getattr(preset.sensor, "sigma_range_m", 0.0) > 0)
    km.Slam([km.Robot("r", km.motion.Odometry2D(), sensors={"s": km.Mount(preset.sensor)})])
