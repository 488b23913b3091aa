"""Does tuning find the noise and calibration of a log, and leave alone what is right?"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kalmark.cli.app import main
from kalmark.config import build_slam, open_run
from kalmark.diagnosis.tune import Change, Tuning, tune
from kalmark.diagnosis.tuned_file import new_config
from kalmark.errors import KalmarkError
from kalmark.events import Scan
from kalmark.logs import write_native
from kalmark.results.record import record
from kalmark.simulate import load_world, simulate

WORLD = ("world.count=25", "world.size_m=20", "steps=450", "robots.rover.start={x_m: 10, y_m: 10, theta_rad: 0}")
RIGHT = {"v": 0.05, "w": 0.05, "range": 0.1, "bearing": 0.02, "theta": 0.0, "scale": 1.0, "gate": "off"}
CONFIG = """\
# My robot.
log: {{path: log}}
robots:
  rover:
    motion: {{type: unicycle, sigma_v_mps: {v}, sigma_w_radps: {w}}}  # of the data sheet
    sensors:
      lidar:
        type: range_bearing
        sigma_range_m: {range}  # measured in the hall
        sigma_bearing_rad: {bearing}
        scale: {scale}
        mount: {{x_m: 0.3, theta_rad: {theta}}}
association: {{type: identity, gate: {gate}}}
# The end.
"""
SENSOR = "robots.rover.sensors.lidar."
MOTION = "robots.rover.motion."


def written(folder: Path, seed: int = 3, steps: int = 450, **wrong: Any) -> Path:
    """Return a configuration with the right values but for these, beside its log."""
    log = simulate(load_world("random_field", [*WORLD, f"steps={steps}"]), seed)
    write_native(log, folder / "log")
    path = folder / "mine.yaml"
    path.write_text(CONFIG.format(**(RIGHT | wrong)))
    return path


def change(tuning: Tuning, key: str) -> Change:
    return next(one for one in tuning.changes if one.key == key)


def within(one: Change, right: float) -> bool:
    """Return whether a noise is as large as it is right within three sigmas of its logarithm, and of the digits."""
    return bool(abs(math.log(one.after / right)) < 3 * one.sigma + 0.01)


def test_noise_stated_wrong_by_known_factors_is_found(tmp_path: Path) -> None:
    tuning = tune(written(tmp_path, range=0.04, bearing=0.05, w=0.12))
    for key, right in (("sigma_range_m", 0.1), ("sigma_bearing_rad", 0.02)):
        one = change(tuning, SENSOR + key)
        assert one.changed and one.gain is not None and one.gain > 0 and one.sigma < 0.1
        assert within(one, right), one
    assert within(change(tuning, MOTION + "sigma_w_radps"), 0.05)
    assert change(tuning, MOTION + "sigma_w_radps").changed
    (_, before), (_, after) = tuning.before, tuning.after
    assert after.likelihood > before.likelihood + 100
    assert after.nis == pytest.approx(1.0, abs=0.1)
    assert abs(before.nis - 1) > 0.3


def test_a_right_configuration_is_left_alone(tmp_path: Path) -> None:
    tuning = tune(written(tmp_path, 2))
    assert tuning.values == {}, tuning.changes
    assert tuning.after == tuning.before
    assert tuning.correlations == {} and tuning.sigma_factor == 1.0
    assert {"agrees with the log"} == {one.why for one in tuning.changes}


def test_a_mount_that_is_turned_is_found_and_its_noise_is_left(tmp_path: Path) -> None:
    tuning = tune(written(tmp_path, theta=0.05))
    one = change(tuning, SENSOR + "mount.theta_rad")
    assert one.after == pytest.approx(0.0, abs=3 * one.sigma + 1e-4) and one.changed
    assert {*tuning.values} == {one.path}


def test_a_scale_of_ranges_that_the_odometry_may_have_instead_is_left_and_it_is_said(tmp_path: Path) -> None:
    one = change(tune(written(tmp_path, scale=1.06)), SENSOR + "scale")
    assert not one.changed and "does not distinguish it from" in one.why


def test_a_key_that_does_not_help_the_second_part_is_left(tmp_path: Path) -> None:
    # the first half of this log has ranges twice as good as the second
    path = written(tmp_path)
    table = tmp_path / "log" / "scans.csv"
    log = simulate(load_world("random_field", WORLD), 3)
    half = log.events[len(log.events) // 2].t_ns
    rng = np.random.default_rng(0)
    for k, event in enumerate(log.events):
        if isinstance(event, Scan) and event.t_ns < half and len(event.y):
            true = event.y + 0.0
            pose = log.truth["rover"].at(event.t_ns)
            c, s = np.cos(pose[2]), np.sin(pose[2])
            at = pose[:2] + 0.3 * np.array([c, s])
            true[:, 0] = [np.linalg.norm(np.array(log.landmarks[i]) - at) for i in event.ids or ()]
            true[:, 0] += rng.normal(0.0, 0.04, len(true))
            log.events[k] = Scan(t_ns=event.t_ns, robot=event.robot, sensor=event.sensor, y=true, ids=event.ids)
    table.unlink()
    write_native(log, tmp_path / "log2")
    path.write_text(path.read_text().replace("path: log", "path: log2"))
    one = change(tune(path), SENSOR + "sigma_range_m")
    assert not one.changed and one.gain is not None and one.gain < 0 and "less likely" in one.why


def test_keys_to_keep_are_not_touched(tmp_path: Path) -> None:
    tuning = tune(written(tmp_path, steps=120, range=0.04), keep=[SENSOR + "sigma_range_m"])
    assert SENSOR + "sigma_range_m" not in {one.key for one in tuning.changes}


def correlated(folder: Path) -> Path:
    """Return a configuration whose log has ranges with errors that last: .95 from scan to scan."""
    log = simulate(load_world("random_field", WORLD), 3)
    rng, errors = np.random.default_rng(5), {}
    for k, event in enumerate(log.events):
        if isinstance(event, Scan) and len(event.y):
            y = event.y.copy()
            for row, name in enumerate(event.ids or ()):
                errors[name] = 0.95 * errors.get(name, 0.0) + rng.normal(0.0, 0.1)
                y[row, 0] += errors[name]
            log.events[k] = Scan(t_ns=event.t_ns, robot=event.robot, sensor=event.sensor, y=y, ids=event.ids)
    write_native(log, folder / "log")
    path = folder / "mine.yaml"
    path.write_text(CONFIG.format(**RIGHT))
    return path


def test_errors_that_last_are_said_and_a_noise_for_the_map_is_wider(tmp_path: Path) -> None:
    path = correlated(tmp_path)
    tuning, wide = tune(path), tune(path, aim="map")
    assert tuning.correlations["rover.lidar.range_m"] > 0.2 and tuning.sigma_factor > 1.02
    assert tuning.after[1].nis == pytest.approx(1.0, abs=0.12)
    key = SENSOR + "sigma_range_m"
    assert change(wide, key).after > 1.3 * change(tuning, key).after
    assert wide.after[1].nis < tuning.after[1].nis - 0.1
    text = new_config(path, tuning)
    assert "--aim map" in text and "--aim map" not in new_config(path, wide)


def test_the_new_file_keeps_the_users_comments_and_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = written(tmp_path, range=0.04), tmp_path / "new" / "tuned.yaml"
    assert main(["tune", str(path), "--out", str(out), "--set", "log.on_error=skip"]) == 0
    told = capsys.readouterr().out
    assert "the part that judges" in told and SENSOR + "sigma_range_m" in told
    assert out.with_suffix(".png").stat().st_size > 10_000
    text = out.read_text()
    for line in ("# My robot.", "# of the data sheet", "# The end.", "on_error: skip"):
        assert line in text
    assert "# tuned, was 0.04; measured in the hall" in text
    made, log = open_run(out)  # from another folder than the file of the user
    sigma = made.robots["rover"].sensors["lidar"].sigma_range_m
    assert sigma == float(f"{sigma:.3g}") and sigma == pytest.approx(0.1, rel=0.15)
    assert record(build_slam(made, log), log, progress=False, pictures=False).evaluate()[
        "nis_per_dof"
    ] == pytest.approx(1.0, abs=0.1)


def test_a_section_that_an_override_gave_keeps_its_other_keys(tmp_path: Path) -> None:
    lidar = "{type: range_bearing, sigma_range_m: 0.04, sigma_bearing_rad: 0.02, mount: {x_m: 0.3}}"
    path, overrides = written(tmp_path), [f"{SENSOR.removesuffix('.')}={lidar}"]
    tuning = tune(path, overrides=overrides)
    assert change(tuning, SENSOR + "sigma_range_m").changed
    (tmp_path / "tuned.yaml").write_text(new_config(path, tuning, overrides))
    sensor = open_run(tmp_path / "tuned.yaml")[0].robots["rover"].sensors["lidar"]
    assert sensor.sigma_range_m == pytest.approx(0.1, rel=0.15)
    assert (sensor.sigma_bearing_rad, sensor.mount.x_m) == (0.02, 0.3)


def test_what_cannot_be_tuned_is_refused_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, steps=120)
    with pytest.raises(KalmarkError, match=r"share 1\.5"):
        tune(path, share=1.5)
    with pytest.raises(KalmarkError, match="scans, expected 30"):
        tune(path, share=0.01)
    assert main(["tune", str(path), "--out", str(tmp_path / "folder")]) == 2
    assert "ends with .yaml" in capsys.readouterr().err
