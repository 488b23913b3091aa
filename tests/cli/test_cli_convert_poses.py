"""A run as poses of TUM and KITTI, and as a graph of g2o."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from command_line import Kalmark, write_log, write_log_of_space
from kalmark.config import build_slam, open_run
from kalmark.logs.log import poses_of_size
from kalmark.logs.poses import read_path
from kalmark.logs.source import Request, raise_refusal
from kalmark.results.record import record
from kalmark.results.run import Run

REQUEST = Request(None, raise_refusal, [])
OWN = (
    "log: {path: log}\nrobots: {each: {sensors: {lidar: {type: range_bearing, mount: {x_m: 0.1, theta_rad: 0.2}}}}}\n",
    "log: {path: log}\nrobots: {each: {motion: {type: odometry_3d}, sensors: {lidar: {type: range_bearing_3d, "
    "mount: {z_m: 0.5}}}}}\n",
)


def test_a_run_s_path_is_written_and_scored_by_files_of_poses(kalmark: Kalmark, tmp_path: Path) -> None:
    write_log(tmp_path / "log")
    text = (tmp_path / "config.yaml").write_text
    assert kalmark("convert", "log", "truth.kitti").status == 0
    text("log: {path: log, truth: truth.kitti}\nrobots: {each: {sensors: {lidar: {type: range_bearing}}}}\n")
    done = kalmark("run", "config.yaml", "--out", "run")
    assert done.status == 0, done.err
    for name in ("path.tum", "path.kitti"):
        assert kalmark("convert", "run", name).status == 0
        found = read_path(tmp_path / name, REQUEST)
        history = Run.load(tmp_path / "run").history
        np.testing.assert_allclose(found.poses[:, :3], poses_of_size(history.poses, 7)[:, :3], atol=1e-8)
    assert (tmp_path / "path.tum").read_text() == (tmp_path / "run" / "trajectory_rover.tum").read_text()
    scored = kalmark("evaluate", "run", "--truth", "path.tum")
    assert scored.status == 0 and "0.000" in scored.out
    again = kalmark("convert", "run", "path.tum")
    assert again.status == 2 and "exists already" in again.err
    assert "expected one, or --robot" in kalmark("convert", "run", "b.tum", "--robot", "nobody").err
    alone = kalmark("run", "native", "--log", "path.tum", "--set", "log.format=tum")
    assert alone.status == 2 and "true poses alone, expected a log with events" in alone.err


@pytest.mark.parametrize("space", [False, True])
def test_a_run_comes_back_from_its_graph_with_the_same_map(space: bool, kalmark: Kalmark, tmp_path: Path) -> None:
    """Fused again, increments and observations give nearly the same: steps are joined, polar noise linearised."""
    (write_log_of_space if space else write_log)(tmp_path / "log")
    (tmp_path / "own.yaml").write_text(OWN[space])
    assert kalmark("run", "own.yaml", "--out", "run").status == 0
    done = kalmark("convert", "run", "run.g2o")
    assert done.status == 0, done.err
    before = Run.load(tmp_path / "run")
    (tmp_path / "config.yaml").write_text("log: {path: run.g2o, vertices: truth}\nestimator: {type: ekf}\n")
    config, graph = open_run(tmp_path / "config.yaml")
    run = record(build_slam(config, graph), graph, progress=False)
    assert len(run.landmarks) == len(before.landmarks) == len(graph.landmarks) > 0
    lines = [line.split() for line in (tmp_path / "run.g2o").read_text().splitlines() if line.startswith("# landmark")]
    names = {int(cells[2]): cells[4] for cells in lines}
    own = {
        str(i): (mean, P)
        for i, mean, P in zip(before.landmarks.ids, before.landmarks.means, before.landmarks.covariances, strict=True)
    }
    for number, mean, P in zip(run.landmarks.ids, run.landmarks.means, run.landmarks.covariances, strict=True):
        true, spread = own[names[number]]
        np.testing.assert_allclose(graph.landmarks[number], true)
        sigma = np.sqrt(np.linalg.eigvalsh(spread)[-1])
        np.testing.assert_allclose(mean, true, atol=0.5 * sigma + 1e-3)
        np.testing.assert_allclose(np.linalg.eigvalsh(P)[-1], sigma**2, rtol=0.3)
    refused = kalmark("convert", "log", "log.g2o")
    assert refused.status == 2 and "no run to write, expected the folder of one" in refused.err


def test_edges_of_a_graph_are_of_distances_where_ranges_have_a_scale_and_a_bias(
    kalmark: Kalmark, tmp_path: Path
) -> None:
    scans = write_log(tmp_path / "log") / "scans.csv"

    def edges(sensor: str) -> np.ndarray:
        (tmp_path / "own.yaml").write_text(f"log: {{path: log}}\nrobots: {{each: {{sensors: {{lidar: {sensor}}}}}}}\n")
        assert kalmark("run", "own.yaml", "--out", "run").status == 0
        (tmp_path / "run.g2o").unlink(missing_ok=True)
        assert kalmark("convert", "run", "run.g2o").status == 0
        lines = [line.split() for line in (tmp_path / "run.g2o").read_text().splitlines()]
        return np.array([cells[3:] for cells in lines if cells[0] == "EDGE_SE2_XY"], dtype=np.float64)

    plain = edges("{type: range_bearing}")
    header, *rows = scans.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    rows = [",".join([*row[:4], repr(1.25 * float(row[4]) + 0.5), row[5]]) for row in cells]
    scans.write_text("\n".join([header, *rows]) + "\n")
    scaled = edges("{type: range_bearing, scale: 1.25, bias_m: 0.5}")
    np.testing.assert_allclose(scaled[:, :2], plain[:, :2], atol=1e-9)
    information = [xx * yy - xy**2 for xx, xy, yy in (plain[:, 2:].T, scaled[:, 2:].T)]
    np.testing.assert_allclose(information[1], 1.25**2 * information[0], rtol=1e-6)  # a metre is .8 m of distance


def test_a_run_without_scans_has_no_graph(kalmark: Kalmark, tmp_path: Path) -> None:
    write_log(tmp_path / "log")
    (tmp_path / "log" / "scans.csv").unlink()
    (tmp_path / "own.yaml").write_text("log: {path: log}\n")
    done = kalmark("run", "own.yaml", "--out", "run")
    assert done.status == 0, done.err
    refused = kalmark("convert", "run", "run.g2o")
    assert refused.status == 2 and "the run has no scan, expected some" in refused.err
    assert not (tmp_path / "run.g2o").exists()
