"""Recording a log, the figures of the run, and the run folder."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam, load_config
from kalmark.errors import DivergedError, EventError, LogError, RunError
from kalmark.events import Control, Fix, Scan, sort_key
from kalmark.files import replace_file
from kalmark.filter.estimators import Ekf
from kalmark.geometry import wrap
from kalmark.logs import Trajectory, open_log, write_native
from kalmark.results.record import record
from kalmark.results.recording import file_name
from kalmark.results.run import Run
from kalmark.simulate import load_world, simulate
from results_world import STEP_NS, circle, slam_for

OUTCOMES = ("associated", "new", "rejected", "ignored", "deferred", "tentative")


@pytest.fixture(scope="module")
def run() -> Run:
    log = circle()
    return record(slam_for(log), log, progress=False)


def test_recording_leaves_the_filter_exactly_as_processing_alone_does(run: Run) -> None:
    log = circle()
    slam = slam_for(log)
    for event in log:
        slam.process(event)
    assert run.slam is not None
    assert np.array_equal(slam.mean("rover"), run.slam.mean("rover"))
    assert np.array_equal(run.history.mean[-1], slam.mean("rover"))
    assert np.array_equal(run.history.covariance[-1], slam.covariance("rover"))
    assert run.landmarks.ids == slam.landmarks().ids


def test_candidates_of_a_robot_of_the_plane_with_a_velocity_have_places_in_the_plane() -> None:
    robot = km.Robot("r", km.motion.ConstantVelocity(), sensors={"eye": km.Mount(km.sensors.RangeBearing())})
    slam = km.Slam([robot], association=km.association.Automatic())
    scans = [Scan(t_s=k / 10, robot="r", sensor="eye", y=[[3.0, 0.1], [4.0, 1.0], [5.0, -1.0]]) for k in range(15)]
    history = record(slam, scans, progress=False).history
    assert history.candidate_place.shape == (len(history.candidate_row), 2) and len(history.candidate_row) > 0


def test_every_scan_is_a_step_and_every_observation_has_its_row(run: Run) -> None:
    log = circle()
    scans = [event for event in log if isinstance(event, Scan)]
    history = run.history
    assert history.t_ns.tolist() == [scan.t_ns for scan in scans]
    assert np.array_equal(history.y, np.concatenate([scan.y for scan in scans]))
    assert history.id.tolist() == [str(i) for scan in scans for i in scan.ids or ()]
    assert np.bincount(history.step).tolist() == [len(scan.y) for scan in scans]
    known = history.outcome == "associated"
    expected = history.y[known] - history.z[known]
    assert np.allclose(history.e[known][:, 0], expected[:, 0])
    assert np.allclose(wrap(history.e[known][:, 1] - expected[:, 1]), 0.0)
    assert np.isnan(history.z[history.outcome == "new"]).all()


def test_the_counts_of_the_summary_add_up(run: Run) -> None:
    summary = run.evaluate()
    assert summary["events"] == summary["controls"] + summary["scans"] + summary["fixes"] == 240
    assert summary["observations"] == sum(summary[name] for name in OUTCOMES) == len(run.history.step)
    assert summary["new"] == summary["landmarks"] == len(run.landmarks)


def test_the_summary_of_a_consistent_run_says_so(run: Run) -> None:
    summary = run.evaluate()
    figures = summary["robots"]["rover"]
    assert summary["frame"] == "truth"
    assert summary["coordinates"] == "log"
    assert figures["ate_m"] <= figures["ate_raw_m"] < 0.2
    assert figures["heading_rmse_deg"] < 2.0
    assert 0.5 < figures["pose_nees"] < 9.0
    assert 0.8 < summary["nis_per_dof"] < 1.2
    assert summary["landmark_rmse_m"] <= summary["landmark_rmse_raw_m"] < 0.3
    assert not summary["diverged"]


def test_each_robot_is_judged_by_its_own_truth() -> None:
    log = circle(robots=("a", "b"), steps=60)
    summary = record(slam_for(log), log, progress=False).evaluate()
    assert set(summary["robots"]) == {"a", "b"}
    assert all(figures["scans"] == 60 and figures["ate_raw_m"] < 0.2 for figures in summary["robots"].values())


def test_a_run_that_starts_in_a_frame_of_its_own_has_the_same_errors(run: Run) -> None:
    """Starting elsewhere turns and shifts the whole map; seen through the start pose nothing else changes."""
    log = circle()
    elsewhere = record(slam_for(log, start=(7.0, -3.0, 1.2)), log, progress=False)
    there, here = elsewhere.evaluate(), run.evaluate()
    assert there["frame"] == "start"
    for key in ("ate_m", "ate_raw_m", "heading_rmse_deg", "pose_nees", "pose_nees_world"):
        assert there["robots"]["rover"][key] == pytest.approx(here["robots"]["rover"][key], rel=1e-6)
    assert there["landmark_rmse_raw_m"] == pytest.approx(here["landmark_rmse_raw_m"], rel=1e-6)


def test_a_run_in_a_frame_of_its_own_whose_truth_begins_later_is_scored_there() -> None:
    log = circle(steps=40)
    truth = {name: Trajectory(path.t_ns[15:], path.poses[15:]) for name, path in log.truth.items()}
    summary = record(slam_for(log, start=(7.0, -3.0, 1.2)), replace(log, truth=truth), progress=False).evaluate()
    assert summary["frame"] == "start" and not summary["diverged"]
    assert summary["robots"]["rover"]["ate_raw_m"] < 0.3


def test_a_wrong_start_with_known_landmarks_is_an_error_and_not_another_frame() -> None:
    log = circle(steps=30)
    slam = slam_for(log, start=(0.5, 0.0, 0.0))
    slam.add_landmark(1, log.landmarks[1])
    run = record(slam, log, progress=False)
    assert run.truth.frame == "truth"
    assert run.evaluate()["robots"]["rover"]["ate_raw_m"] > 0.1


def test_position_fixes_score_a_run_without_truth() -> None:
    log = circle(truth=False, gps=True)
    summary = record(slam_for(log), log, progress=False).evaluate()
    assert summary["fix_median_m"] < 0.1
    assert summary["fix_rms_10m"] < 0.1
    assert summary["fix_within_10m"] == 1.0
    assert "landmark_rmse_m" not in summary
    assert "ate_m" not in summary["robots"]["rover"]
    with_truth = circle(gps=True)
    assert "fix_median_m" not in record(slam_for(with_truth), with_truth, progress=False).evaluate()


def test_a_bad_event_is_refused_or_left_out_and_listed() -> None:
    log = circle(steps=20)
    bad = Scan(t_ns=5 * STEP_NS, robot="rover", sensor="sonar", y=[[1.0, 0.0]])
    events = [*log.events[:10], bad, *log.events[10:]]
    with pytest.raises(EventError, match="sonar"):
        record(slam_for(log), events, progress=False)
    run = record(slam_for(log), events, progress=False, on_error="skip")
    assert len(run.skipped) == 1
    assert "sonar" in run.skipped[0]
    assert run.evaluate()["skipped"] == 1
    assert run.evaluate()["scans"] == 20
    with pytest.raises(ValueError, match="'raise' or 'skip'"):
        record(slam_for(log), events, on_error="ignore")  # type: ignore[arg-type]


def test_a_filter_that_refuses_to_go_on_ends_the_run_as_diverged(monkeypatch: pytest.MonkeyPatch) -> None:
    log = circle(steps=20)
    slam = slam_for(log)
    process = slam.process

    def refuse(event: object) -> object:
        if slam.t_ns is not None and slam.t_ns >= 10 * STEP_NS:
            raise DivergedError("the innovation's covariance is not positive definite")
        return process(event)  # type: ignore[arg-type]

    monkeypatch.setattr(slam, "process", refuse)
    summary = record(slam, log, progress=False).evaluate()
    assert summary["diverged"]
    assert "positive definite" in summary["stopped"]
    assert 0 < summary["scans"] < 20


def test_fixes_are_counted_and_are_no_steps() -> None:
    log = circle(steps=10)
    events = [*log.events, Fix(t_ns=10 * STEP_NS, robot="rover", y=(1.0, 0.1), cov=np.eye(2))]
    summary = record(slam_for(log), events, progress=False).evaluate()
    assert (summary["fixes"], summary["fixes_rejected"], summary["scans"]) == (1, 0, 10)


def test_a_log_without_scans_gives_a_run_that_can_be_saved(tmp_path: Path) -> None:
    log = circle(steps=2)
    run = record(slam_for(log), [Control(t_ns=0, robot="rover", u=(1.0, 0.0))], progress=False)
    run.save(tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["scans"] == summary["landmarks"] == 0
    assert summary["step_us_median"] is None
    assert Run.load(tmp_path).evaluate()["scans"] == 0


def test_the_folder_holds_the_files_of_the_contract(run: Run, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    run.save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "summary.json", "config.yaml", "trajectory_rover.tum", "landmarks.csv", "associations.csv", "history.npz",
        "map.png", "report.html", "map.kmk", "notes.txt", "sensor_rover_lidar.png",
    }  # fmt: skip
    with np.load(tmp_path / "history.npz", allow_pickle=False) as arrays:
        assert {"t", "robot", "mean", "covariance", "y", "e", "z", "Z", "landmark"} <= set(arrays.files)
        assert np.array_equal(arrays["mean"], run.history.mean)
    with (tmp_path / "associations.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["t_s", "robot", "sensor", "index", "id", "outcome", "landmark", "d2", "reason"]
    assert len(rows) == len(run.history.step)
    assert rows[0]["t_s"] == "0.100000000"
    header = (tmp_path / "landmarks.csv").read_text().splitlines()[0]
    assert header == "id,kind,x_m,y_m,cov_xx,cov_xy,cov_yy,observations"


def test_the_saved_configuration_is_one_that_can_be_read(run: Run, tmp_path: Path) -> None:
    run.save(tmp_path)
    config = load_config(tmp_path / "config.yaml")
    assert config.version is not None
    assert config.estimator.type == "invariant"
    assert config.robots["rover"].motion.sigma_v_mps == 0.05  # type: ignore[union-attr]


def test_a_loaded_run_has_the_same_figures_and_can_be_saved_again(run: Run, tmp_path: Path) -> None:
    run.save(tmp_path / "one")
    loaded = Run.load(tmp_path / "one")
    assert loaded.evaluate() == run.evaluate()
    assert loaded.final_slam().landmarks().ids == run.landmarks.ids
    loaded.save(tmp_path / "two")
    for name in ("summary.json", "config.yaml", "trajectory_rover.tum", "landmarks.csv", "associations.csv", "map.kmk"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), name


def test_a_loaded_run_can_be_judged_by_other_truth(run: Run, tmp_path: Path) -> None:
    run.save(tmp_path)
    loaded = Run.load(tmp_path)
    assert loaded.with_truth(circle()).evaluate() == run.evaluate()
    assert "ate_m" not in loaded.with_truth(circle(truth=False)).evaluate()["robots"]["rover"]


def test_a_folder_that_is_no_run_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"summary\.json: no such file"):
        Run.load(tmp_path)


def test_an_interrupted_save_leaves_the_old_run_and_no_temporary_file(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = run.save(tmp_path / "out")
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    def interrupt(_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("kalmark.results.recording.associations_csv", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run.save(out)
    with pytest.raises(OSError, match="full"):
        replace_file(out / "map.png", _half_written)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert list(tmp_path.iterdir()) == [out]


def _half_written(path: Path) -> None:
    path.write_text("half")
    raise OSError("disk full")


def test_times_in_files_are_exact_to_the_nanosecond(tmp_path: Path) -> None:
    log = circle(steps=3)
    offset = 1_248_272_263_123_456_789
    events = [
        Scan(t_ns=offset + e.t_ns, robot="rover", sensor="lidar", y=e.y, ids=e.ids) for e in log if isinstance(e, Scan)
    ]
    run = record(slam_for(log, estimator=Ekf()), events, progress=False)
    run.save(tmp_path)
    lines = (tmp_path / "trajectory_rover.tum").read_text().splitlines()
    assert lines[1].split()[0] == "1248272263.223456789"
    assert len(lines[1].split()) == 8


def test_evo_reads_the_trajectory_and_finds_the_same_error(run: Run, tmp_path: Path) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory = pytest.importorskip("evo.core.trajectory")
    file_interface = pytest.importorskip("evo.tools.file_interface")
    run.save(tmp_path)
    path = file_interface.read_tum_trajectory_file(str(tmp_path / "trajectory_rover.tum"))
    truth = run.truth.poses
    reference = trajectory.PoseTrajectory3D(
        positions_xyz=np.column_stack([truth[:, :2], np.zeros(len(truth))]),
        orientations_quat_wxyz=np.column_stack(
            [np.cos(truth[:, 2] / 2), np.zeros((len(truth), 2)), np.sin(truth[:, 2] / 2)]
        ),
        timestamps=path.timestamps,
    )
    figures = run.evaluate()["robots"]["rover"]
    for key, align in (("ate_raw_m", False), ("ate_m", True)):
        if align:
            path.align(reference)
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data((reference, path))
        assert figures[key] == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)


@pytest.mark.parametrize(
    ("name", "column", "misspelt", "told"),
    [
        (
            "scans.csv",
            "range_m",
            "rage_m",
            "scans of rover by lidar have the columns bearing_rad, rage_m, expected range_m, bearing_rad of",
        ),
        (
            "controls.csv",
            "v_mps",
            "v_mp",
            "controls of rover have the columns w_radps, v_mp, expected v_mps, w_radps of",
        ),
    ],
)
def test_a_misspelt_column_is_no_other_number_of_a_filter_built_in_python(
    name: str, column: str, misspelt: str, told: str, tmp_path: Path
) -> None:
    log = replace(circle(steps=5), control_columns={"rover": ("v_mps", "w_radps")})
    log = replace(log, sensor_columns={("rover", "lidar"): ("range_m", "bearing_rad")})
    write_native(log, tmp_path)
    assert record(slam_for(log), open_log(tmp_path), progress=False).landmarks.ids
    text = (tmp_path / name).read_text()
    (tmp_path / name).write_text(text.replace(column, misspelt, 1))
    with pytest.raises(LogError, match=rf"{name}:1: the {told}.*; did you mean '{column}'\?"):
        record(slam_for(log), open_log(tmp_path), progress=False)


def test_ids_and_names_that_look_like_a_page_are_shown_as_they_are(tmp_path: Path) -> None:
    odd, name = "<b>&'\"</b><script>", "<i>a/b</i>"
    log = circle(robots=(name, name.replace("/", "_")), steps=30)
    events = [
        replace(event, ids=tuple(odd if i == 3 else i for i in event.ids))
        if isinstance(event, km.Scan) and event.ids
        else event
        for event in log
    ]
    run = record(slam_for(log), replace(log, events=events), progress=False)
    run.evaluate()
    run.save(tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert odd in run.landmarks.ids and odd not in page and name not in page
    assert len(list(tmp_path.glob("trajectory_*.tum"))) == 2, "a file a robot, though both names are alike in files"
    assert Run.load(tmp_path).landmarks.ids == run.landmarks.ids


def test_the_name_of_a_robot_may_be_longer_than_that_of_a_file() -> None:
    assert file_name("rover-1.b") == "rover-1.b"
    assert len({file_name(name) for name in ("a/b", "a_b", "a b", "x" * 300, "x" * 301)}) == 5
    assert len(file_name("\u6f22" * 300).encode()) <= 100


def test_a_run_without_pictures_is_the_same_but_for_what_these_show() -> None:
    world = load_world("random_field", ["steps=60"])
    log = simulate(world, 0)
    whole, bare = (
        km.record(build_slam(world.config(), log), log, progress=False, pictures=pictures) for pictures in (True, False)
    )
    for name in ("mean", "covariance", "z", "d2", "outcome"):
        np.testing.assert_array_equal(getattr(whole.history, name), getattr(bare.history, name))
    np.testing.assert_array_equal(whole.landmarks.positions()[0], bare.landmarks.positions()[0])
    assert len(whole.history.maps) > len(bare.history.maps) == 1
    assert len(whole.history.unmeasured_step) > len(bare.history.unmeasured_step) == 0


def test_stamps_of_scans_in_another_unit_of_time_are_refused_before_anything_is_filtered() -> None:
    def events(unit: float) -> list[km.Control | km.Scan]:
        controls = [km.Control(t_s=0.1 * k, robot="a", u=(1.0, 0.0)) for k in range(20)]
        scans = [km.Scan(t_s=0.1 * k * unit, robot="a", sensor="lidar", y=[[4.0, 0.1]], ids=[1]) for k in range(20)]
        return sorted([*controls, *scans], key=sort_key)

    def slam() -> km.Slam:
        return km.Slam(km.Robot("a", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())}))

    for unit in (1e-3, 1e3, 1e6):
        with pytest.raises(LogError, match=r"controls of a span 1.9 s, its scans .* s, expected one unit of time: t_s"):
            km.record(slam(), events(unit), progress=False)
    assert len(km.record(slam(), events(3.0), progress=False).history.t_ns) == 20
