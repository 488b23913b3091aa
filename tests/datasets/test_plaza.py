"""The Plaza logs: odometry, ranges in pieces, truth; and the whole run on the real ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from kalmark.config import build_slam, load_config
from kalmark.errors import LogError
from kalmark.events import Control, Scan
from kalmark.logs import open_log

Data = Callable[[str], Path]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "Plaza1_DR.txt").write_text("10.0 0.2 0.0\n10.2 0.3 0.1\n10.4 0.2 -0.1\n")
    (tmp_path / "Plaza1_TD.txt").write_text("10.1 2 5 30.5\n10.3 2 6 20.0\n10.1 2 0 12.0\n10.1 2 5 31.0\n")
    return tmp_path


def test_ranges_in_pieces_are_sorted_and_a_second_answer_at_one_time_is_listed(folder: Path) -> None:
    log = open_log(folder)
    assert (log.format, log.name, log.robots) == ("plaza", "plaza1", ("robot",))
    assert [type(e).__name__ for e in log] == ["Control", "Scan", "Control", "Scan", "Control"]
    first = next(e for e in log if isinstance(e, Scan))
    assert (first.ids, first.y.ravel().tolist()) == ((5, 0), [30.5, 12.0])
    assert log.skipped == [f"{folder / 'Plaza1_TD.txt'}:4: beacon 5 twice at one time, expected it once"]
    u = [e.u for e in log if isinstance(e, Control)][1]
    np.testing.assert_allclose(u, [0.3 * np.cos(0.05), 0.3 * np.sin(0.05), 0.1])
    assert log.truth == {} and log.landmarks == {}


@pytest.mark.parametrize("row", ["10.1 2 5 -3.0", "10.1 2 5", "10.1 2 five 30.0", "10.1 2 5 nan"])
def test_a_bad_range_is_refused_with_its_line(row: str, folder: Path) -> None:
    with (folder / "Plaza1_TD.txt").open("a") as file:
        file.write(row + "\n")
    with pytest.raises(LogError, match=r"Plaza1_TD\.txt:5: .*expected time, receiver, beacon and a range"):
        open_log(folder)
    assert len(open_log(folder, on_error="skip").skipped) == 2


def test_a_log_without_its_ranges_is_refused(folder: Path) -> None:
    (folder / "Plaza1_TD.txt").unlink()
    with pytest.raises(LogError, match=r"Plaza1_TD\.txt: no such file"):
        open_log(folder)


def test_plaza1_has_its_counts_and_its_truth(data: Data) -> None:
    log = open_log(data("plaza1"))
    scans = [e for e in log if isinstance(e, Scan)]
    assert Counter(i for s in scans for i in s.ids) == {0: 900, 1: 893, 5: 848, 6: 886}
    assert len(log.events) - len(scans) == 9657 and len(log.skipped) == 2
    beacons = np.array([log.landmarks[s.ids[0]] for s in scans])
    away = np.hypot(*(log.truth["robot"].at(np.array([s.t_ns for s in scans]))[:, :2] - beacons).T)
    ratio = np.array([s.y[0, 0] for s in scans]) @ away / (away @ away)
    assert ratio == pytest.approx(1.0701, abs=5e-4)


def test_the_beacons_of_plaza1_and_the_scale_of_its_ranges_are_found(data: Data) -> None:
    log = open_log(data("plaza1"), to_s=400)
    slam = build_slam(load_config("plaza"), log)
    for event in log:
        slam.process(event)
    assert sorted(slam.landmarks().ids) == [0, 1, 5, 6]
    assert 1 / slam.mean("robot.radio")[3] == pytest.approx(1.069, rel=0.01)
    true = log.truth["robot"].at(log.events[-1].t_ns)
    assert np.hypot(*(slam.mean("robot")[:2] - true[:2])) < 1.5
