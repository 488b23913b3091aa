"""Where the landmarks of a user's own types are, in tables and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import kalmark as km
from kalmark.geometry.spaces import HEADING, SCALAR, VECTOR, Space
from kalmark.results.landmark_table import MapLandmarks
from kalmark.results.plot import draw_map
from kalmark.results.record import record
from kalmark.results.run import Run
from results_world import circle, slam_for


class Wall:
    """A wall: the direction alpha of its normal and its distance rho from the origin, without saying where it is."""

    kind: ClassVar[str] = "wall"
    space: ClassVar[Space] = Space("wall", (HEADING, SCALAR))

    def seen_from(self, T: np.ndarray, l: np.ndarray) -> Any:
        raise NotImplementedError

    def from_view(self, T: np.ndarray, v: np.ndarray) -> Any:
        raise NotImplementedError


class PlacedWall(Wall):
    """A wall that is at the foot of its perpendicular from the origin."""

    def place(self, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        c, s, rho = np.cos(l[:, 0]), np.sin(l[:, 0]), l[:, 1]
        return np.stack([rho * c, rho * s], 1), np.stack([np.stack([-rho * s, c], 1), np.stack([rho * c, s], 1)], 1)


class Ball(Wall):
    """A ball: where it is, and its size."""

    kind: ClassVar[str] = "ball"
    space: ClassVar[Space] = Space("ball", (VECTOR, SCALAR))


@pytest.mark.parametrize(
    ("model", "mean", "place"),
    [
        (PlacedWall(), (np.pi / 2, 3.0), (0.0, 3.0)),
        (Wall(), (np.pi / 2, 3.0), (np.nan, np.nan)),
        (Ball(), (1.0, 2.0, 0.5), (1.0, 2.0)),
    ],
    ids=["placed", "nowhere", "of a vector and more"],
)
def test_an_own_landmark_is_written_and_drawn_where_it_is(model: Any, mean: Any, place: Any, tmp_path: Path) -> None:
    log = circle(steps=5)
    slam = slam_for(log)
    P = np.diag(np.square([0.1, 0.2, 0.3][: len(mean)]))
    slam.add_landmark("own", mean, P, landmark=model)
    run = record(slam, log, progress=False)
    k = run.landmarks.ids.index("own")
    np.testing.assert_allclose(run.landmarks.means[k], place, atol=1e-12)
    if isinstance(model, PlacedWall):
        np.testing.assert_allclose(run.landmarks.covariances[k], np.diag([0.09, 0.04]), atol=1e-12)
    run.save(tmp_path)
    rows = (tmp_path / "landmarks.csv").read_text().splitlines()
    assert rows[0].split(",")[:4] == ["id", "kind", "x_m", "y_m"]
    assert "z_m" not in rows[0]
    loaded = Run.load(tmp_path)
    np.testing.assert_array_equal(loaded.landmarks.means[k], run.landmarks.means[k])
    (axes,) = draw_map(loaded).axes
    assert np.isfinite(axes.get_xlim()).all()
    assert loaded.evaluate() == run.evaluate()


def test_the_likeliest_class_of_a_landmark_is_in_its_row_and_in_the_picture(tmp_path: Path) -> None:
    lidar = km.Mount(km.sensors.RangeBearing(), classes=km.Classes(("blue", "yellow"), error=0.1))
    slam = km.Slam(km.Robot("r", km.motion.Unicycle(), sensors={"lidar": lidar}))
    slam.process(
        km.Scan(0.0, "r", "lidar", [[4.0, 0.3], [2.0, -1.0], [3.0, 0.0]], [7, 8, 9], classes=["blue", "yellow", None])
    )
    landmarks = MapLandmarks.of(slam)
    (tmp_path / "landmarks.csv").write_text(landmarks.to_csv())
    back = MapLandmarks.read(tmp_path / "landmarks.csv")
    assert back.classes == {7: ("blue", pytest.approx(0.9)), 8: ("yellow", pytest.approx(0.9))}
    assert back.to_csv() == landmarks.to_csv()
    labels = km.draw(slam).get_legend_handles_labels()[1]
    assert {"blue", "yellow"} <= {*labels}
