"""The page of sliders has the runs of its noises, and needs neither network nor truth."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kalmark.cli.app import main
from kalmark.config import Config, build_slam
from kalmark.diagnosis.sliders import Sliders, sliders
from kalmark.errors import KalmarkError
from kalmark.logs.log import Log
from kalmark.results.evaluate import evaluate
from kalmark.results.record import record
from kalmark.simulate import load_world, simulate

WORLD, FACTORS = ["world.count=25", "world.size_m=20", "steps=120"], (0.25, 1.0, 4.0)
START = "robots.rover.start={x_m: 10, y_m: 10, theta_rad: 0}"
KEY = "filter.robots.rover."


def data_of(page: Sliders) -> Any:
    found = re.search(r"^const DATA = (.*);$", page.html, re.M)
    assert found
    return json.loads(found[1])


@pytest.fixture(scope="module")
def simulated() -> tuple[Config, Log]:
    world = load_world("random_field", [*WORLD, START])
    return world.config(), simulate(world, seed=3)


@pytest.fixture(scope="module")
def data(simulated: tuple[Config, Log]) -> Any:
    return data_of(sliders(*simulated, factors=FACTORS))


def test_each_cell_is_the_run_with_its_noises(simulated: tuple[Config, Log], data: Any) -> None:
    log = simulated[1]
    assert data["keys"]["q"] == {"robots.rover.motion.sigma_v_mps": 0.05, "robots.rover.motion.sigma_w_radps": 0.05}
    assert data["keys"]["r"]["robots.rover.sensors.lidar.sigma_bearing_rad"] == 0.02
    for (q, r), cell in (((1.0, 1.0), data["cells"][4]), ((0.25, 4.0), data["cells"][2])):
        sigmas = {"motion.sigma_v_mps": 0.05 * q, "motion.sigma_w_radps": 0.05 * q}
        sigmas |= {"sensors.lidar.sigma_range_m": 0.1 * r, "sensors.lidar.sigma_bearing_rad": 0.02 * r}
        said = [f"{KEY}{key}={value}" for key, value in sigmas.items()]
        run = record(build_slam(load_world("random_field", [*WORLD, START, *said]).config(), log), log, progress=False)
        told = evaluate(run)
        assert cell["meanNis"] == pytest.approx(told["nis_per_dof"], rel=1e-3)
        assert cell["meanNees"] == pytest.approx(told["robots"]["rover"]["pose_nees"], rel=1e-3)
        np.testing.assert_allclose(cell["paths"][0][-1], run.history.poses[-1, :2], rtol=0, atol=1e-4)
        means, P = run.landmarks.positions()
        np.testing.assert_allclose(np.array(cell["ellipses"])[:, :2], means, rtol=1e-2, atol=1e-4)
        np.testing.assert_allclose(np.array(cell["ellipses"])[:, [2, 4]], np.diagonal(P, axis1=1, axis2=2), rtol=1e-2)


def test_the_right_noise_is_the_likeliest_and_larger_noise_of_sensors_lowers_the_nis(data: Any) -> None:
    likelihood = [cell["likelihood"] for cell in data["cells"]]
    assert np.argmax(likelihood) == 4
    nis = np.array([cell["meanNis"] for cell in data["cells"]]).reshape(3, 3)
    assert (np.diff(nis, axis=1) < 0).all() and 0.7 < nis[1, 1] < 1.4
    bounds = np.array(data["cells"][4]["nisBounds"])
    inside = np.array(data["cells"][4]["nis"])
    assert ((bounds[:, 0] < inside) & (inside < bounds[:, 1])).mean() > 0.85


def test_the_truth_decides_nothing(simulated: tuple[Config, Log], data: Any) -> None:
    config, log = simulated
    blind = data_of(sliders(config, replace(log, truth={}, landmarks={}), factors=FACTORS))
    for one, other in zip(blind["cells"], data["cells"], strict=True):
        assert one["meanNees"] is None and set(one["nees"][0]) == {None}
        assert [one[key] for key in ("likelihood", "nis", "paths")] == [
            other[key] for key in ("likelihood", "nis", "paths")
        ]


def test_the_page_needs_no_other_file_and_is_shown_in_a_notebook(simulated: tuple[Config, Log]) -> None:
    page = sliders(*simulated, seconds=4.0, factors=(1.0,))
    assert not re.search(r"https?:|src=|@import|\{title\}|\{data\}", page.html)
    assert page._repr_html_().startswith("<iframe") and "20 scans" in data_of(page)["log"]


def test_the_command_writes_the_page_and_refuses_what_makes_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    told = [word for each in (*WORLD, START) for word in ("--set", each)]
    assert main(["simulate", "random_field", *told, "--out", "sim"]) == 0
    monkeypatch.setattr("kalmark.diagnosis.sliders.FACTORS", (1.0,))
    assert main(["tune", "sim/config.yaml", "--page", "a/page.html", "--seconds", "5"]) == 0
    assert "robots.rover.motion.sigma_v_mps" in Path("a/page.html").read_text()
    capsys.readouterr()
    still = ["--set", "robots.rover.motion={type: unicycle, sigma_v_mps: 0, sigma_w_radps: 0}"]
    for more, said in (
        (["--page", "page.txt"], "--page page.txt: expected a path that ends with .html"),
        (["--page", "b.html", "--seconds", "0"], "this part of the log has 0 scans, expected at least 10"),
        (["--page", "b.html", *still], "no sigma above 0 of any robot's motion, expected one to be multiplied"),
    ):
        assert main(["tune", "sim/config.yaml", *more]) == 2
        assert said in capsys.readouterr().err
    assert not Path("b.html").exists()


def test_a_part_without_scans_is_refused(simulated: tuple[Config, Log]) -> None:
    with pytest.raises(KalmarkError, match="0 scans, expected at least 10"):
        sliders(simulated[0], replace(simulated[1], events=[]))
