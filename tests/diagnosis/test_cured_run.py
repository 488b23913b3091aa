"""Does `kalmark diagnose --apply` run a log again with its cure, beside the first run, and show both?"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kalmark.cli.app import main
from kalmark.diagnosis.trials import is_configured, options_of


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cured") / "log"
    settings = ("steps=160", "world.count=16", "world.size_m=16", "robots.rover.start={x_m: 8, y_m: 8}")
    assert main(["simulate", "random_field", "--out", str(folder), *(f"--set={each}" for each in settings)]) == 0
    return folder


def run(log: Path, out: Path, *options: str) -> None:
    assert main(["run", str(log / "config.yaml"), "--log", str(log), "--out", str(out), *options]) == 0


def test_a_mirrored_log_is_cured_in_a_folder_beside_its_own(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(log, tmp_path / "run", "--set", "log.factors.rover.lidar.bearing_rad=-1")
    capsys.readouterr()
    assert main(["diagnose", str(tmp_path / "run"), "--apply", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["map"], told["causes"][0]["name"]) == ("wrong", "bearing_sign")
    cured, folder = told["cured"], tmp_path / "run_cured"
    assert cured["options"] == ["log.factors.rover.lidar.bearing_rad=1"]
    assert (cured["verdict"]["map"], cured["folder"]) == ("ok", str(folder))
    assert cured["gain"] > 100.0
    assert (folder / "cured.png").stat().st_size > 10_000
    assert json.loads((folder / "summary.json").read_text())["verdict"]["map"] == "ok"
    assert "the map is ok" in (folder / "report.html").read_text()


def test_a_map_without_a_cause_has_nothing_to_cure(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(log, tmp_path / "run")
    capsys.readouterr()
    assert main(["diagnose", str(tmp_path / "run"), "--apply"]) == 0
    assert "no cause has a cure that options of kalmark run can express" in capsys.readouterr().out
    assert not (tmp_path / "run_cured").exists()


@pytest.mark.parametrize(
    ("cure", "options"),
    [
        ("", []),
        ("leave out every second of them", []),
        ("swap the columns range_m and bearing_rad; or: --set a.b=1", []),
        ("--set a.b=1 --set 'robots.r.start={x_m: 1, y_m: 2}'", ["a.b=1", "robots.r.start={x_m: 1, y_m: 2}"]),
        ("--set a.b=1; or: --set c=2", ["a.b=1"]),
    ],
)
def test_options_of_a_cure(cure: str, options: list[str]) -> None:
    assert options_of(cure) == options


@pytest.mark.parametrize(
    ("cure", "expected"),
    [
        ("--set upkeep.repeats=merge", True),
        ("--set upkeep.repeats=off", False),
        ("--set robots.car.gaps=widen", True),
        ("--set robots.car.gaps=widen --set upkeep.repeats=warn", False),
        ("look at the log", False),
    ],
)
def test_a_cure_that_is_configured_is_none(cure: str, expected: bool) -> None:
    assert is_configured({"robots": {"each": {"gaps": "widen"}}, "upkeep": {"repeats": "merge"}}, cure) is expected


def test_an_interrupted_verdict_loses_nothing_of_a_run(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(_run: object) -> None:
        assert (tmp_path / "run" / "history.npz").is_file()
        raise KeyboardInterrupt

    monkeypatch.setattr("kalmark.cli.run.judge", interrupted)
    run(log, tmp_path / "run")
    assert f"no verdict, as it was interrupted: kalmark diagnose {tmp_path / 'run'} makes it" in capsys.readouterr().err
    assert {"map.png", "report.html", "summary.json"} <= {file.name for file in (tmp_path / "run").iterdir()}
