"""Files of others: their plug-ins, their escapes, their ids, their archives."""

from __future__ import annotations

import json
import re
import shutil
import zipfile
from pathlib import Path

import pytest

import kalmark
import kalmark as km
from command_line import Kalmark
from kalmark.errors import EventError, MapError, ModelError
from kalmark.results.run import Run

CLEAR = "\x1b[2J"
ODD = ["a\nb", "a\0b", "a\rb", f"a{CLEAR}b", "\ud800", "\x85"]
TEXTS = ["a,b", 'a"b', "ä \N{NO-BREAK SPACE} \N{SNOWMAN}", "\N{FAMILY}\N{ZERO WIDTH JOINER}", " a ", "=1+1"]


def a_run(*ids: str) -> Run:
    robot = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
    y = [[3.0 + 0.1 * k, 0.3 * k] for k in range(len(ids))]
    scans = [km.Scan(float(t), "rover", "lidar", y, ids) for t in range(4)]
    return km.record(km.Slam([robot]), scans, progress=False)


def test_plug_ins_of_a_run_folder_are_run_only_if_it_is_trusted(kalmark: Kalmark, tmp_path: Path) -> None:
    out = a_run("a", "b").save(tmp_path / "out")
    (tmp_path / "theirs.py").write_text("from pathlib import Path\nPath('was_run').touch()\n")
    text = (out / "config.yaml").read_text()
    (out / "config.yaml").write_text(f"plugins: [{tmp_path / 'theirs.py'}]\n{text}")
    for verb in (["diagnose", out], ["convert", out, "out.mcap"]):
        done = kalmark(*verb)
        assert done.status == 2
        said = r"kalmark: .*config\.yaml names plug-ins, .*, whose code would be run: expected --trust, .*\n"
        assert re.fullmatch(said, done.err)
    assert kalmark("evaluate", out).status == 0
    assert kalmark("report", out).status == 0
    assert not (tmp_path / "was_run").exists()
    assert "--trust" not in kalmark("diagnose", out, "--trust").err
    assert (tmp_path / "was_run").exists()


def test_no_escape_reaches_the_terminal(kalmark: Kalmark, tmp_path: Path) -> None:
    folder = a_run("a", "b").save(tmp_path / f"out{CLEAR}")
    summary = json.loads((folder / "summary.json").read_text())
    summary["warnings"] = [f"warned{CLEAR}"]
    (folder / "summary.json").write_text(json.dumps(summary))
    for done in (kalmark("evaluate", folder), kalmark("report", folder), kalmark("evaluate", tmp_path / f"no{CLEAR}")):
        assert "\x1b" not in done.out + done.err
        assert "\\x1b[2J" in done.out + done.err


def test_all_text_for_a_terminal_is_made_in_one_place() -> None:
    for path in (Path(kalmark.__file__).parent / "cli").glob("*.py"):
        found = re.findall(r"typer\.echo\(|\bprint\(|console\.print\(|secho\(", path.read_text(encoding="utf-8"))
        assert found == (["typer.echo(", "console.print(", "console.print("] if path.name == "shared.py" else []), path


@pytest.mark.parametrize("odd", ODD)
def test_a_name_that_cannot_be_written_is_refused_at_the_door_in_one_line(odd: str) -> None:
    with pytest.raises(EventError, match=r"an id is .*, expected a text without control characters") as refused:
        km.Scan(1.0, "rover", "lidar", [[3.0, 0.1]], [odd])
    assert str(refused.value).isprintable()
    for name, sensor in ((odd, "lidar"), ("rover", odd)):
        with pytest.raises(ModelError, match="has control characters or surrogates, expected none"):
            km.Robot(name, km.motion.Unicycle(), sensors={sensor: km.Mount(km.sensors.RangeBearing())})


def test_ids_of_any_other_text_come_back_from_all_files(tmp_path: Path) -> None:
    run = a_run(*TEXTS)
    out = run.save(tmp_path / "out")
    again = Run.load(out)
    assert sorted(map(str, again.landmarks.ids)) == sorted(TEXTS)
    assert {row.id for row in km.Slam.load(out / "map.kmk").landmarks()} == {*TEXTS}


def test_a_saved_map_that_says_that_it_is_huge_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "map.kmk"
    a_run("a").slam.save(path)  # type: ignore[union-attr]
    whole = tmp_path / "whole"
    with zipfile.ZipFile(path) as archive:
        archive.extractall(whole)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for member in whole.iterdir():
            archive.write(member, member.name)
        archive.writestr("more", bytes(100_000_000))
    shutil.rmtree(whole)
    with pytest.raises(MapError, match=r"map\.kmk: \d+ bytes in a file of \d+, expected at most"):
        km.Slam.load(path)
