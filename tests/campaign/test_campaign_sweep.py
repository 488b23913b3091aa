"""Sweeps over configuration keys, and campaigns that go on after they were stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow.parquet import read_table

from kalmark.campaign import Sweep, open_cells, run_campaign, run_sweep
from kalmark.campaign.finished_runs import Kept
from kalmark.campaign.running import Plan
from kalmark.campaign.sweep import figure_over_runs, run_figures
from kalmark.cli import main
from kalmark.errors import ConfigError, KalmarkError
from kalmark.simulate import load_world

WORLD = """\
world: {type: list, points_m: [[3, 1], [3, -1], [5, 2], [-1, -2]]}
robots:
  rover:
    start: {sigma_xy_m: 0.2, sigma_theta_rad: 0.05}
    route: {type: constant, u: [0.05, 0.0, 0.0]}
    motion: {type: odometry_2d, sigma_x_m: 0.05, sigma_y_m: 0.05, sigma_theta_rad: 0.01}
    sensors: {tracker: {type: position, sigma_x_m: 0.1, sigma_y_m: 0.05}}
steps: 20
"""
SWEEPS = ("filter.estimator.type=ekf,invariant", "robots.each.sensors.tracker.sigma_x_m=.05,.2")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sweep") / "field.yaml"
    path.write_text(WORLD)
    return path


@pytest.fixture(scope="module")
def sweep(file: Path) -> Sweep:
    return run_sweep(open_cells(file, SWEEPS), 4, seed=2, jobs=1, progress=False)


def test_a_sweep_runs_every_combination_each_as_a_campaign_of_its_own_would(file: Path, sweep: Sweep) -> None:
    key = "robots.each.sensors.tracker.sigma_x_m"
    settings = [("ekf", 0.05), ("ekf", 0.2), ("invariant", 0.05), ("invariant", 0.2)]
    assert [tuple(cell.settings.values()) for cell in sweep.cells] == settings
    alone = run_campaign(load_world(file, ["filter.estimator.type=ekf", f"{key}=.2"]), 4, seed=2, jobs=1)
    assert json.dumps(sweep.campaigns[1].summary()) == json.dumps(alone.summary())
    assert json.dumps(sweep.campaigns[0].summary()) != json.dumps(alone.summary())


def test_a_saved_sweep_has_a_row_a_run_a_page_a_picture_and_each_cell(sweep: Sweep, tmp_path: Path) -> None:
    folder = sweep.save(tmp_path / "out")
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["sweep"]["robots.each.sensors.tracker.sigma_x_m"] == [0.05, 0.2]
    assert [cell["settings"] for cell in summary["cells"]] == [cell.settings for cell in sweep.cells]
    rows = read_table(folder / "runs.parquet").to_pylist()
    assert len(rows) == 4 * 4
    last = rows[-1]
    assert (last["estimator"], last["run"], last["robots.each.sensors.tracker.sigma_x_m"]) == ("invariant", 3, 0.2)
    of_cell = [row["position_rmse_m"] for row in rows[-4:]]
    figures = sweep.campaigns[-1].summary()["estimators"]["invariant"]
    assert np.sqrt(np.mean(np.square(of_cell))) == pytest.approx(figures["position_rmse_m"])
    page = (folder / "report.html").read_text()
    assert page.count("<tr>") == 1 + 4 and "data:image/png;base64," in page and "campaign of 4 runs in 4 cells" in page
    assert (folder / "sweep.png").read_bytes().startswith(b"\x89PNG")
    assert len((folder / "cells" / "004" / "anees.csv").read_text().splitlines()) == 1 + 20


def test_the_interval_of_an_rmse_covers_the_true_value_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    truth, inside = np.sqrt(1.0 / 2.0 + 1.0), 0
    for _ in range(400):
        runs = np.sqrt(rng.exponential(1.0, 200) * 0.5 + 1.0)
        value, half = figure_over_runs("position_rmse_m", runs)
        inside += abs(value - truth) < half
    assert 0.91 < inside / 400 < 0.98
    assert figure_over_runs("pose_nees", np.array([2.0, np.nan, 4.0]))[0] == 3.0


def test_the_figures_of_one_run_leave_out_the_first_steps(sweep: Sweep) -> None:
    score = sweep.campaigns[0].scores["ekf"][0]
    figures = run_figures(score, ["pose", "joint"], 5)
    assert figures["pose_nees"] == pytest.approx(np.nanmean(score.series["pose"][:, 5:]))
    assert figures["position_rmse_m"] == pytest.approx(np.sqrt(np.nanmean(score.series["position_m"] ** 2)))


@pytest.mark.parametrize(
    ("sweeps", "said"),
    [
        (["robots.each.sensors.tracker.sigma_z_m=.1,.2"], "sigma_z_m"),
        (["filter.estimator.type=ekf,efk"], "--sweep filter.estimator.type=.*did you mean"),
        (["steps=10,many"], "--sweep steps=.*got 'many', expected a whole"),
        (["steps"], "--sweep steps: got no key and values, expected key.path=value,value"),
        (["steps=1,1"], "got a value twice"),
        (["steps=1", "steps=2"], "steps is given twice"),
        (["steps=[1"], "--sweep steps"),
    ],
)
def test_a_wrong_sweep_is_refused_in_one_line_before_anything_runs(file: Path, sweeps: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said) as error:
        open_cells(file, sweeps)
    assert "\n" not in str(error.value)


def test_values_of_a_sweep_may_be_sections_and_lists(file: Path) -> None:
    cells = open_cells(file, ["filter.estimator={type: ekf},{type: invariant, iterations: 2}", "ids=true,false"])
    assert [(c.scene.config().estimator.type, c.scene.ids) for c in cells] == [
        ("ekf", True), ("ekf", False), ("invariant", True), ("invariant", False),
    ]  # fmt: skip
    assert cells[2].scene.config().estimator.iterations == 2


def test_estimators_and_a_sweep_over_them_do_not_go_together(file: Path) -> None:
    with pytest.raises(ConfigError, match="got estimators and a sweep"):
        run_sweep(open_cells(file, ["filter.estimator.type=ekf,fej"]), 1, ["ekf"])


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Return the steps of the world and the number of each run that was run."""
    done: list[tuple[int, int]] = []
    some = Plan.some

    def counted(plan: Plan, numbers: Sequence[int]) -> Any:
        done.extend((len(plan.world.times()), number) for number in numbers)
        return some(plan, numbers)

    monkeypatch.setattr(Plan, "some", counted)
    return done


def test_finished_runs_are_kept_and_not_run_again(file: Path, tmp_path: Path, ran: list[tuple[int, int]]) -> None:
    whole = run_campaign(file, 5, seed=2, jobs=1, progress=False)
    ran.clear()
    some = run_campaign(file, 3, seed=2, jobs=1, progress=False, folder=tmp_path)
    assert ran == [(20, 0), (20, 1), (20, 2)] and some.runs == 3
    (kept,) = (tmp_path / "runs").iterdir()
    (kept / "000001.npz").write_bytes(b"half a file")
    ran.clear()
    resumed = run_campaign(file, 5, seed=2, jobs=1, progress=False, folder=tmp_path)
    assert ran == [(20, 1), (20, 3), (20, 4)], "only what was missing or damaged"
    assert json.dumps(resumed.summary()) == json.dumps(whole.summary())
    for a, b in zip(resumed.scores["invariant"], whole.scores["invariant"], strict=True):
        assert all(a.series[name].tobytes() == b.series[name].tobytes() for name in b.series)
    ran.clear()
    run_campaign(file, 2, seed=2, jobs=1, progress=False, folder=tmp_path, resume=False)
    assert ran == [(20, 0), (20, 1)]


def test_more_values_of_a_sweep_join_those_that_are_finished(
    file: Path, tmp_path: Path, ran: list[tuple[int, int]]
) -> None:
    run_sweep(open_cells(file, ["steps=5,6"]), 2, jobs=1, progress=False, folder=tmp_path)
    ran.clear()
    run_sweep(open_cells(file, ["steps=5,6,7"]), 2, jobs=1, progress=False, folder=tmp_path)
    assert ran == [(7, 0), (7, 1)]


@pytest.mark.parametrize(
    ("change", "said"),
    [({"seed": 3}, "seed"), ({"map_every": 5}, "map_every"), ({"estimators": ["ekf"]}, "description")],
)
def test_another_campaign_does_not_mix_with_the_one_in_a_folder(
    file: Path, tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    run_campaign(file, 1, seed=2, jobs=1, progress=False, folder=tmp_path)
    with pytest.raises(KalmarkError, match=rf"got runs of another campaign \({said} differs\), expected") as error:
        run_campaign(file, 1, **({"seed": 2} | change), jobs=1, progress=False, folder=tmp_path)
    assert "\n" not in str(error.value)
    run_campaign(file, 1, **({"seed": 2} | change), jobs=1, progress=False, folder=tmp_path, resume=False)


def test_runs_of_other_code_do_not_mix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Kept(tmp_path, {"seed": 1}, {"": "a"})
    monkeypatch.setattr("kalmark.campaign.finished_runs.code_digest", lambda: "another")
    with pytest.raises(KalmarkError, match="code differs"):
        Kept(tmp_path, {"seed": 1}, {"": "a"})


def test_a_campaign_that_is_killed_goes_on_where_it_was(file: Path, tmp_path: Path) -> None:
    out, whole = tmp_path / "out", tmp_path / "whole"
    options = ["campaign", str(file), "--runs", "25", "--set", "steps=100", "--jobs", "1"]
    code = "import sys; from kalmark.cli import main; sys.exit(main())"
    process = subprocess.Popen([sys.executable, "-c", code, *options, "--out", str(out)], stderr=subprocess.DEVNULL)
    while process.poll() is None and len([*out.glob("runs/*/0*.npz")]) < 2:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    kept = {path: path.stat().st_mtime_ns for path in out.glob("runs/*/0*.npz")}
    assert 2 <= len(kept) < 25 and not (out / "summary.json").exists()
    assert main([*options, "--out", str(out)]) == main([*options, "--out", str(whole)]) == 0
    assert (out / "summary.json").read_text() == (whole / "summary.json").read_text()
    assert (out / "anees.csv").read_text() == (whole / "anees.csv").read_text()
    assert {path: path.stat().st_mtime_ns for path in kept} == kept


def test_a_sweep_prints_a_row_a_cell(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--runs", "2", "--jobs", "1", "--sweep", "steps=5,8", "--out", str(tmp_path / "out")]
    assert main(["campaign", str(file), *options]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.split()[1:2] == ["invariant"]]
    assert [row[0] for row in rows] == ["5", "8"]
    assert main(["campaign", str(file), *options, "--address", "tcp://nowhere:1"]) == 2
    assert "address is 'tcp://nowhere:1', expected none with loky" in capsys.readouterr().err
