"""A laser among simulated walls: raw scans, the landmarks of their log, and the map that a filter makes of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.config.building import build_slam
from kalmark.logs import open_log
from kalmark.logs.native_writer import write_native
from kalmark.results.landmark_table import MapLandmarks
from kalmark.results.plot import draw_map
from kalmark.results.recording import Recording
from kalmark.simulate import World, simulate
from kalmark.simulate.laser import cast
from kalmark.simulate.layouts import wall_corners

WALLS = [[-4, -3, 5, -3], [5, -3, 5, 4], [5, 4, -4, 4], [-4, 4, -4, -3], [1, 4, 1, 2.5]]
LASER = {"type": "walls", "beams": 15, "sigma_range_m": 0.02, "range_max_m": 15.0}
ROOM: dict[str, Any] = {
    "world": {"type": "list", "walls_m": WALLS},
    "robots": {
        "robot": {
            "route": {"type": "constant", "u": [0.05, 0.0, 0.05]},
            "motion": {"type": "odometry_2d", "sigma_x_m": 0.005, "sigma_y_m": 0.005, "sigma_theta_rad": 0.005},
            "sensors": {
                "walls": {"type": "wall", "detector": LASER},
                "corners": {"type": "range_bearing", "detector": LASER | {"type": "corners"}},
            },
            "sensing": {"walls": {"every": 2, "beams": 361}, "corners": {"every": 2, "first": 1, "beams": 361}},
        }
    },
    "steps": 130,
    "noise_on": "robot",
    "ids": False,
}


def test_beams_end_at_the_nearest_wall() -> None:
    angles = np.array([0.0, 0.5 * np.pi, np.pi, np.arctan2(4.0, 5.0)])
    found = cast(np.zeros(3), angles, np.array([[5.0, -3, 5, 4], [2.0, 3, -2, 3], [7.0, -9, 7, 9]]))
    np.testing.assert_allclose(found, [5.0, 3.0, np.inf, np.hypot(5.0, 4.0)])


def test_corners_are_where_walls_meet() -> None:
    found = wall_corners(np.array(WALLS, dtype=np.float64))
    expected = [[-4, -3], [5, -3], [5, 4], [-4, 4], [1, 4]]
    assert sorted(found.tolist()) == sorted(map(list, expected))
    assert len(wall_corners(np.array([[0.0, 0, 1, 0], [1.0, 0, 2, 0]]))) == 0  # one line


def test_a_world_of_walls_without_ends_or_beside_tags_is_refused() -> None:
    for world, expected in (
        ({"walls_m": [[1, 2, 1, 2]]}, "two ends"),
        ({"walls_m": WALLS, "tags": [{}]}, "without anything of space"),
    ):
        with pytest.raises(ValueError, match=expected):
            World.model_validate(ROOM | {"world": {"type": "list"} | world})


def test_a_laser_gives_raw_scans_at_its_steps() -> None:
    log = simulate(World.model_validate(ROOM | {"steps": 6}), seed=1)
    scans = [event for event in log.events if isinstance(event, km.Scan)]
    assert [(s.sensor, round(s.t_s, 1)) for s in scans] == [
        ("corners", 0.1), ("walls", 0.2), ("corners", 0.3), ("walls", 0.4), ("corners", 0.5), ("walls", 0.6),
    ]  # fmt: skip
    assert all(s.y.shape == (361, 2) and s.ids is None for s in scans)
    assert log.sensor_columns["robot", "walls"] == ("range_m", "bearing_rad")
    assert [len(l) for l in log.landmarks.values()] == [2] * 5 + [4] * 5


def test_a_room_is_mapped_from_raw_scans_drawn_saved_and_read_again(tmp_path: Path) -> None:
    world = World.model_validate(ROOM)
    log = open_log(write_native(simulate(world, seed=2), tmp_path / "log"))
    np.testing.assert_array_equal([l for l in log.landmarks.values() if len(l) == 4], WALLS)
    run = km.record(build_slam(world.config(), log), log, progress=False, pictures=False)
    walls = [i for i, kind in enumerate(run.landmarks.kinds) if kind == "wall"]
    assert run.landmarks.kinds.count("point") == 5
    assert len(walls) in (5, 6)  # the northern one may not have been seen to pass behind the partition
    for i in walls:
        ends = run.landmarks.means[i].reshape(2, 2)
        gaps = [
            np.abs(((ends - a) @ [[-u[1]], [u[0]]]) / np.hypot(*u)).max()
            for a, u in ((np.array(w[:2]), np.subtract(w[2:], w[:2])) for w in WALLS)
        ]
        assert min(gaps) < 0.1
        assert (np.linalg.eigvalsh(run.landmarks.covariances[i])[1:] > 0).all()
    run.save(tmp_path / "run")
    again = Recording.load(tmp_path / "run")
    assert again.landmarks.kinds == run.landmarks.kinds
    for one, other in zip(run.landmarks.means, again.landmarks.means, strict=True):
        np.testing.assert_array_equal(one, other)
    assert run.evaluate()["landmarks_compared"] == 5
    labels = [text.get_text() for text in draw_map(again).legends[0].get_texts()]
    assert {"true walls, aligned", "walls, 3σ of their ends of the shape"} <= {*labels}
    assert '"trueLines"' in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert isinstance(MapLandmarks.read(tmp_path / "run" / "landmarks.csv"), MapLandmarks)


def test_walls_with_ids_are_scored_by_a_campaign() -> None:
    from kalmark.campaign.scoring import score
    from kalmark.simulate.robots import simulation

    sensor = {"laser": {"type": "wall", "sigma_distance_m": 0.02, "sigma_normal_rad": 0.01}}
    robot = {**ROOM["robots"]["robot"], "sensors": sensor, "sensing": {}}
    world = World.model_validate(ROOM | {"robots": {"robot": robot}, "ids": True, "steps": 60})
    nees, dof = [], []
    for seed in range(6):
        scores = score(build_slam(world.config()), simulation(world, seed), world.times())
        nees.append(np.nanmean(scores.series["landmarks"]))
        dof.append(np.nanmax(scores.series["landmarks_dof"]))
    assert {*dof} == {2.0}
    assert 0.5 < np.mean(nees) / 2 < 2.0
