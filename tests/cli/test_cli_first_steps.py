"""What a newcomer types first: the examples' own commands, and refusals that say what to type next."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numba
import pytest

from command_line import Kalmark, write_log
from kalmark.compiled import COMPILING, say_compiling
from kalmark.config import load_config, shipped_configs
from kalmark.logs import list_data
from kalmark.simulate import load_world, shipped_worlds

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_the_example_of_an_own_sensor_passes_the_check_that_it_names(kalmark: Kalmark) -> None:
    done = kalmark("check", f"{EXAMPLES / '03_own_sensor.py'}:sonar")
    assert (done.status, done.err) == (0, "")
    assert "expect(invert(y)) = y" in done.out


@pytest.mark.filterwarnings("error")
def test_a_check_finds_a_wrong_inverse_without_a_warning(kalmark: Kalmark, tmp_path: Path) -> None:
    text = (EXAMPLES / "03_own_sensor.py").read_text().replace("np.arcsin(y[1])", "2 * np.arcsin(y[1])")
    (tmp_path / "wrong.py").write_text(text)
    done = kalmark("check", "wrong.py:sonar")
    assert done.status == 2
    assert "expect(invert(y)) = y differs by" in done.err


def test_compiling_is_announced_once_and_what_is_compiled_already_is_not(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def own(x: float) -> float:
        return x + 1

    def others(x: float) -> float:
        return x + 2

    own.__module__ = "kalmark.own"
    kernel = numba.njit(own)
    say_compiling.cache_clear()
    numba.njit(others)(1.0)
    assert capsys.readouterr().err == ""
    kernel(1.0)
    assert capsys.readouterr().err == COMPILING
    kernel(1.0)
    kernel(1)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("world", ["two_robots", "loop_b2"])
def test_what_simulate_leaves_runs_with_the_command_it_prints(
    kalmark: Kalmark,
    tmp_path: Path,
    world: str,
) -> None:
    done = kalmark("simulate", world, "--out", "a log", "--seed", "2", "--set", "steps=40")
    assert done.status == 0
    command = shlex.split(done.out.splitlines()[-1])
    assert command == ["kalmark", "run", "a log/config.yaml"]
    assert kalmark(*command[1:]).status == 0
    assert kalmark(*command[1:], "--set", "estimator.type=ekf", "--out", "ekf").status == 0
    config = load_config(tmp_path / "a log" / "config.yaml")
    fitting = load_world(world).config()
    assert (config.robots, config.association, config.estimator) == (
        fitting.robots,
        fitting.association,
        fitting.estimator,
    )
    assert (config.log.path, config.seed) == (".", 2)
    summary = json.loads((tmp_path / "out" / "config" / "summary.json").read_text())
    assert summary["landmarks"] > 0
    assert set(summary["robots"]) == set(fitting.robots)


def test_config_prints_a_shipped_configuration_to_start_from(kalmark: Kalmark, tmp_path: Path) -> None:
    done = kalmark("config", "native")
    assert (done.status, done.err) == (0, "")
    (tmp_path / "mine.yaml").write_text(done.out)
    assert load_config(tmp_path / "mine.yaml").model_dump() == load_config("native").model_dump()
    assert done.out == shipped_configs()["native"].read_text()
    assert kalmark("worlds", "cloister").out == shipped_worlds()["cloister"].read_text()
    for verb, shipped in (("config", shipped_configs()), ("worlds", shipped_worlds())):
        listed = kalmark(verb)
        assert (listed.status, listed.err) == (0, "")
        rows = [line.split(maxsplit=1) for line in listed.out.splitlines()]
        assert {*shipped} <= {row[0] for row in rows if len(row) == 2}
    refused = kalmark("config", "nativ")
    assert (refused.status, refused.out) == (2, "")
    assert refused.err.endswith("did you mean native?\n")


def test_a_truth_of_other_columns_is_told_both_poses(kalmark: Kalmark, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log")
    truth = (log / "truth.csv").read_text()
    (log / "truth.csv").write_text(truth.replace("theta_rad", "thta_rad", 1))
    assert kalmark("run", "native", "--log", "log").err == (
        "kalmark: log/truth.csv:1: columns x_m, y_m, thta_rad, expected either x_m, y_m, theta_rad or "
        "x_m, y_m, z_m, qx, qy, qz, qw; did you mean 'theta_rad'?\n"
    ).replace("log/", f"{log}/")


def test_names_of_datasets_are_whole_in_a_narrow_terminal(
    kalmark: Kalmark,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    done = kalmark("data", "list")
    assert max(len(line) for line in re.sub(r"\x1b\[[0-9;]*m", "", done.out).splitlines()) == 80
    for dataset in list_data():
        assert dataset.name in done.out
