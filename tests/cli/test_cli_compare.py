"""`kalmark compare` and `kalmark view`: runs side by side, and the page of one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from matplotlib.image import imread

from command_line import Kalmark, refused, write_log, write_log_of_space
from kalmark.errors import PluginError
from kalmark.results.compare import compare, draw_comparison
from kalmark.results.run import Run


@pytest.fixture
def runs(kalmark: Kalmark, log: Path) -> list[str]:
    """Return two runs of one log, with other noise and another estimator."""
    for name, changed in (("a", "estimator.type=ekf"), ("b", "robots.each.motion.sigma_v_mps=0.2")):
        assert kalmark("run", "native", "--log", log, "--out", name, "--set", changed).status == 0
    return ["a", "b"]


def test_runs_are_put_side_by_side(kalmark: Kalmark, runs: list[str]) -> None:
    done = kalmark("compare", *runs)
    lines = {tuple(line.split()) for line in done.out.splitlines()}
    assert done.status == 0 and Path("out/compare.png").stat().st_size > 20_000
    assert ("associated", "57", "57") in lines and ("estimator.type", "'ekf'", "'invariant'") in lines
    assert any(line[:1] == ("robots.each.motion.sigma_v_mps",) and line[-1] == "0.2" for line in lines)
    assert any(" ".join(line).startswith("path off the first run's, aligned (m) - ") for line in lines)
    figures = json.loads(kalmark("compare", *runs, "--json", "--out", "both.png").out)
    assert figures["a"]["run"]["observations"] == 60 and figures["b"]["rover"]["path_difference_m"] < 0.01
    assert Path("both.png").is_file()


def test_runs_of_several_robots_and_of_space_are_compared(kalmark: Kalmark, tmp_path: Path) -> None:
    write_log_of_space(tmp_path / "space")
    for name in ("a", "b"):
        config = "robots: {drone: {motion: {type: odometry_3d}, sensors: {lidar: {type: range_bearing_3d}}}}\n"
        (tmp_path / f"{name}.yaml").write_text(f"log: {{path: space}}\n{config}")
        assert kalmark("run", f"{name}.yaml", "--out", name).status == 0
    told = compare({name: Run.load(tmp_path / name) for name in "ab"})
    assert told.figures["b"]["drone"]["path_difference_m"] == pytest.approx(0, abs=1e-12) and not told.differing
    assert len(draw_comparison(told).axes) == 3
    write_log(tmp_path / "plane")
    assert kalmark("run", "native", "--log", "plane", "--out", "c").status == 0
    assert refused(kalmark("compare", "c", "a")).startswith("a is a run in space and c one in the plane")


def test_fewer_than_two_runs_are_refused(kalmark: Kalmark, runs: list[str]) -> None:
    assert refused(kalmark("compare", "a")) == "1 run, expected two or more different ones to compare"
    assert refused(kalmark("compare", "a", "a")).startswith("1 run")
    assert "none" in refused(kalmark("compare", "a", "none"))


def without_viewer(*names: str) -> None:
    raise PluginError("no viewer is installed")


def test_the_page_of_a_run_is_opened(kalmark: Kalmark, runs: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []

    def browse(url: str) -> bool:
        opened.append(url)
        return len(opened) < 2

    monkeypatch.setattr("webbrowser.open", browse)
    Path("a/report.html").unlink()
    assert kalmark("view", "a", "--page").out == "a/report.html\n"
    assert opened == [Path("a/report.html").resolve().as_uri()] and 'id="play"' in Path("a/report.html").read_text()
    monkeypatch.setattr("kalmark.plugins.load", without_viewer)
    shown = kalmark("view", "a")
    assert shown.out == "a/report.html: no browser was found, open it yourself\n"
    assert shown.err == "no viewer is installed; this is the page\n"
    assert refused(kalmark("view", "a", "--save", "a.rrd")) == "no viewer is installed"
    assert kalmark("view", "a", "--no-open").out == "a/report.html\n" and len(opened) == 2
    assert "none" in refused(kalmark("view", "none"))


def test_a_run_is_drawn_again_with_other_options(kalmark: Kalmark, runs: list[str]) -> None:
    before = Path("a/report.html").read_text()
    assert kalmark("report", "a", "--set", "picture.width_px=400", "--set", "picture.sigmas=1").status == 0
    assert imread("a/map.png").shape[1] == 400
    assert '"sigmas":3' in before and '"sigmas":1' in Path("a/report.html").read_text()
    for given, wanted in {
        "picture.view=below": "picture.view: got 'below', expected",
        "picture.colours.rover=reddish": "a colour of matplotlib for rover",
        "map.type=dense": "--set map changes no picture of a run, expected picture.KEY=VALUE",
    }.items():
        assert wanted in refused(kalmark("report", "a", "--set", given))
