"""A known map in files, configurations and worlds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import kalmark as km
from kalmark.config.building import build_slam
from kalmark.config.opening import open_run
from kalmark.errors import ConfigError, LogError
from kalmark.logs.known_map import read_known
from kalmark.logs.native_writer import write_native
from kalmark.results.landmark_table import MapLandmarks
from kalmark.results.run import Run
from kalmark.simulate import load_world, simulate


def table(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_a_file_is_read_with_and_without_covariances(tmp_path: Path) -> None:
    path = table(tmp_path / "map.csv", "id,kind,x_m,y_m,cov_xx,cov_xy,cov_yy\n7,point,1,2,0.04,0.01,0.09\nb,,3,4,,,\n")
    one, other = read_known(path)
    assert (one.id, one.mean.tolist()) == (7, [1.0, 2.0])
    assert one.cov is not None
    assert one.cov.tolist() == [[0.04, 0.01], [0.01, 0.09]]
    assert (other.id, other.cov) == ("b", None)
    assert all(landmark.cov is None for landmark in read_known(path, exact=True))
    tag = table(tmp_path / "tags.csv", "id,x_m,y_m,z_m,qx,qy,qz,qw\n1,1,2,3,0,0,0,1\n")
    assert read_known(tag)[0].mean.shape == (7,)


def test_a_map_with_all_that_a_run_writes_of_its_landmarks_is_a_known_map(tmp_path: Path) -> None:
    places, cov = [np.array([1.0, 2.0]), np.array([3.0, 4.0]), np.array([5.0, 6.0])], 0.01 * np.eye(2)
    landmarks = MapLandmarks(
        [1, "b", 3], ["point"] * 3, places, [cov, np.zeros((2, 2)), cov], [5, 6, 7], exact=frozenset({"b"}),
        log_odds={1: 3.0, 3: -1.0}, unseen=frozenset({3}), classes={1: ("cone", 0.98)},
    )  # fmt: skip
    one, other = read_known(table(tmp_path / "landmarks.csv", landmarks.to_csv()))
    assert (one.id, one.mean.tolist(), other.id, other.cov) == (1, [1.0, 2.0], "b", None)
    assert one.cov is not None and one.cov.tolist() == cov.tolist()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("id,x_m,y_m\n1,0,0\n1,2,2\n", r":3: id 1 is in this file already"),
        ("id,x_m,y_m\n,0,0\n", r":2: id is empty"),
        ("id,x_m,y_m\n1,0,here\n", r":2: y_m is 'here', expected a finite number"),
        (
            "id,x_m,y_m,cov_xx,cov_xy,cov_yy\n1,0,0,1,,1\n",
            r":2: cov_xy is empty, expected all of cov_xx, cov_xy, cov_yy",
        ),
        ("id,x_m,y_m,z_m,qx\n1,0,0,0,1\n", r":2: x_m, y_m, z_m, qx, expected the place of a point"),
        ("id,x_m\n1,0\n", r"no column y_m"),
        ("id,x_m,y_m\n", r"no rows after the header"),
    ],
)
def test_a_bad_file_is_refused_with_its_line(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=said):
        read_known(table(tmp_path / "map.csv", text))


def test_a_configuration_localises_in_a_known_map_and_says_so(tmp_path: Path) -> None:
    world = load_world("localization", ["steps=30", "filter.map.known=null"])
    log = simulate(world, 3)
    write_native(replace(log, path=None), tmp_path / "log")
    rows = [f"{i},{x!r},{y!r}" for i, (x, y) in ((i, p.tolist()) for i, p in log.landmarks.items()) if i != 2]
    table(tmp_path / "map.csv", "id,x_m,y_m\n" + "\n".join(rows) + "\n")
    text = (
        "log: {path: log}\nmap: {known: map.csv}\nrobots:\n  robot:\n    start: {x_m: 15, y_m: 10, sigma_xy_m: 0.5}\n"
    )
    (tmp_path / "run.yaml").write_text(text + "    sensors: {laser: {type: range_bearing, range_max_m: 6.0}}\n")
    config, log = open_run(tmp_path / "run.yaml")
    assert config.map.known == str(tmp_path / "map.csv")
    slam = build_slam(config, log)
    assert len(slam.landmarks()) == 59
    run = km.record(slam, log, progress=False)
    again = Run.load(run.save(tmp_path / "out"))
    assert len(again.landmarks.exact) == 59
    assert again.landmarks.exact == run.landmarks.exact
    assert "exactly" in (tmp_path / "out" / "landmarks.csv").read_text()
    assert run.summary["landmarks_compared"] == len(run.landmarks) - 59
    assert [row.id for row in read_known(tmp_path / "out" / "landmarks.csv", exact=True)] == run.landmarks.ids
    assert not any(set(kept.ids) & run.landmarks.exact for kept in run.history.maps)


def test_a_world_may_give_its_truth(tmp_path: Path) -> None:
    world = load_world("localization", ["steps=5"])
    log = simulate(world, 0)
    slam = build_slam(world.config(), log)
    assert [slam.mean(i).tolist() for i in log.landmarks] == [p.tolist() for p in log.landmarks.values()]
    assert all(map(slam.is_known, log.landmarks))
    with pytest.raises(ConfigError, match=r"map\.known: got truth, expected a log that has true landmarks"):
        build_slam(world.config())


def test_a_missing_or_indefinite_map_is_refused(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("map: {known: none.csv}\n")
    with pytest.raises(ConfigError, match=r"c\.yaml:1:\d+: map\.known: log 'none\.csv' not found"):
        km.Slam.from_config(tmp_path / "c.yaml")
    table(tmp_path / "bad.csv", "id,x_m,y_m,cov_xx,cov_xy,cov_yy\n1,0,0,1,2,1\n")
    (tmp_path / "c.yaml").write_text("map: {known: bad.csv}\n")
    with pytest.raises(ConfigError, match="landmark 1: cov has the eigenvalue -1"):
        km.Slam.from_config(tmp_path / "c.yaml")
    np.testing.assert_array_equal(read_known(tmp_path / "bad.csv", exact=True)[0].mean, [0, 0])


SURVEY = """
default_body: rig
bodies:
 - rig: {is_static: false, default_tag_size: 0.1}
 - wall:
    is_static: true
    pose:
      position: {x: 1, y: 0, z: 0}
      rotation: {x: 0, y: 0, z: 1.5707963267948966}
      position_noise: {x: 0.1, y: 0, z: 0}
      rotation_noise: {x: 0, y: 0, z: 0.02}
    tags:
     - id: 4
       size: 0.1
       pose:
         position: {x: 2, y: 0, z: 0}
         rotation: {x: 0, y: 0, z: 0}
         position_noise: {x: 0.3, y: 0, z: 0.2}
         rotation_noise: {x: 0.03, y: 0, z: 0}
     - {id: 5, size: 0.1}
"""


def test_the_surveyed_tags_of_tagslam_are_known_with_the_noise_of_their_body_and_their_own(tmp_path: Path) -> None:
    (tmp_path / "tagslam.yaml").write_text(SURVEY)
    (tmp_path / "c.yaml").write_text(
        "map: {known: tagslam.yaml}\nlandmarks: {type: tag}\n"
        "robots: {each: {motion: {type: odometry_3d}, sensors: {cam: {type: tag_pose}}}}\n"
    )
    slam = km.Slam.from_config(tmp_path / "c.yaml")
    assert slam.landmarks().ids == [4]
    np.testing.assert_allclose(slam.mean(4), [1, 2, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)
    # the body's x axis is y of the map; its turn about z moves the tag, 2 m away along y, along x
    expected = np.diag([0.04**2, 0.1**2 + 0.3**2, 0.2**2, 0.0, 0.03**2, 0.02**2])
    expected[0, 5] = expected[5, 0] = -2 * 0.02**2
    np.testing.assert_allclose(slam.covariance(4), expected, atol=1e-12)
    (tmp_path / "tagslam.yaml").write_text(SURVEY.replace("is_static: true", "is_static: false"))
    with pytest.raises(ConfigError, match=r"no tag has a pose on a static body with a pose"):
        km.Slam.from_config(tmp_path / "c.yaml")
    (tmp_path / "tagslam.yaml").write_text(SURVEY.replace("x: 0.3", "x: far"))
    with pytest.raises(ConfigError, match=r"tagslam\.yaml: .*far.*, expected poses with position and rotation"):
        km.Slam.from_config(tmp_path / "c.yaml")
