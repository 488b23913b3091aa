"""The campaign's statistics against the chi-square distribution they rest on."""

from __future__ import annotations

import numpy as np
import pytest

from kalmark.campaign.campaign import Anees, figures
from kalmark.campaign.scoring import SERIES, Scores
from kalmark.results.measures import anees_interval

STEPS = 2000


def scores(rng: np.random.Generator, scale: float = 1.0, joint_dof: float = 7.0, diverged: bool = False) -> Scores:
    """Return independent chi-square draws at each step, times `scale`."""
    dof = {"pose": 3, "heading": 1, "landmarks": 2, "joint": joint_dof}
    shape = (1, STEPS)
    series = {key: np.full(shape, np.nan) for key in SERIES}
    for name, n in dof.items():
        for key in (name, f"{name}_world"):
            series[key] = scale * rng.chisquare(n, shape)
        series[f"{name}_dof"] = np.full(shape, float(n))
    for key in ("position_m", "heading_rad"):
        series[key] = np.abs(rng.standard_normal(shape))
    return Scores(series, 0.3, 0.4, 5, 20.0, 10, diverged, "")


def test_a_consistent_estimator_is_inside_its_bands_95_percent_of_the_time() -> None:
    rng = np.random.default_rng(0)
    f = figures([scores(rng) for _ in range(20)])
    for name, ideal in (("pose", 3), ("heading", 1), ("landmarks", 2), ("joint", 1)):
        assert f[f"{name}_anees"] == pytest.approx(ideal, rel=0.03)
        assert f[f"{name}_inside"] == pytest.approx(0.95, abs=0.02)
    assert f["position_rmse_m"] == pytest.approx(1.0, rel=0.02)
    assert (f["landmark_rmse_m"], f["landmark_rmse_raw_m"], f["nis_per_dof"]) == pytest.approx((0.3, 0.4, 2.0))


def test_an_overconfident_estimator_is_outside_its_bands() -> None:
    rng = np.random.default_rng(0)
    f = figures([scores(rng, scale=3.0) for _ in range(20)])
    assert f["pose_anees"] == pytest.approx(9.0, rel=0.03)
    assert f["pose_inside"] < 0.02 and f["joint_inside"] < 0.001


def test_the_joint_band_adds_up_the_dimensions_of_maps_of_different_sizes() -> None:
    rng = np.random.default_rng(0)
    mixed = [scores(rng, joint_dof=float(dof)) for dof in (3, 5, 31, 75)]
    anees = Anees("joint", mixed)
    assert anees.average == pytest.approx(1.0, rel=0.02)
    assert anees.inside == pytest.approx(0.95, abs=0.02)
    low, high = anees_interval(114)
    assert (anees.low[0, 0], anees.high[0, 0]) == pytest.approx((low / 114, high / 114))


def test_runs_without_a_value_at_a_step_widen_its_band_and_an_empty_step_counts_nowhere() -> None:
    rng = np.random.default_rng(0)
    few = [scores(rng) for _ in range(4)]
    for s in few[1:]:
        s.series["pose"][0, 0] = np.nan
    for s in few:
        s.series["pose"][0, 1] = np.nan
    anees = Anees("pose", few)
    assert anees.runs[0, :3].tolist() == [1, 0, 4]
    assert (anees.low[0, 0], anees.high[0, 0]) == pytest.approx(anees_interval(3, 1))
    assert (anees.low[0, 2], anees.high[0, 2]) == pytest.approx(anees_interval(3, 4))
    assert np.isnan([anees.mean[0, 1], anees.low[0, 1], anees.high[0, 1]]).all()
    assert anees.average == pytest.approx(np.nanmean(anees.mean))


def test_divergences_are_counted_and_their_reasons_kept() -> None:
    rng = np.random.default_rng(0)
    f = figures([scores(rng), scores(rng, diverged=True), scores(rng, diverged=True)])
    assert (f["runs"], f["diverged"]) == (3, 2)
    assert "stopped" not in f


def test_the_standard_error_of_the_anees_is_that_of_runs_not_of_steps() -> None:
    rng = np.random.default_rng(0)
    runs = [scores(rng) for _ in range(400)]
    assert figures(runs)["pose_anees_sigma"] == pytest.approx(np.sqrt(6 / 400 / STEPS), rel=0.1)
    for s in runs:  # an error that lasts: all steps of a run have one NEES
        s.series["pose"][:] = rng.chisquare(3)
    assert figures(runs)["pose_anees_sigma"] == pytest.approx(np.sqrt(6 / 400), rel=0.1)
    assert np.isnan(figures(runs[:1])["pose_anees_sigma"])


def test_the_first_steps_can_be_left_out_of_the_averages() -> None:
    rng = np.random.default_rng(0)
    runs = [scores(rng) for _ in range(4)]
    for s in runs:
        s.series["pose"][0, :100] = 1e6
    assert figures(runs)["pose_anees"] > 1e4
    f = figures(runs, skip=100)
    assert f["pose_anees"] == pytest.approx(3.0, rel=0.05)
    assert f["pose_inside"] == pytest.approx(0.95, abs=0.02)


def test_mounts_are_judged_by_how_the_runs_end() -> None:
    rng = np.random.default_rng(0)
    runs = [scores(rng) for _ in range(3)]
    for s, nees_at_end, error in zip(runs, (5.0, 30.0, 6.0), (0.001, 0.002, 0.003), strict=True):
        s.series["mount"][0, [9, 19]] = 100.0, nees_at_end
        s.series["mount_dof"][0, [9, 19]] = 6.0
        s.series["mount_m"][0, [9, 19]] = s.series["mount_rad"][0, [9, 19]] = 1.0, error
    f = figures(runs)
    assert f["mount_sure"] == 2
    assert f["mount_m"] == pytest.approx(np.sqrt(14 / 3) * 1e-3)
    assert f["mount_deg"] == pytest.approx(np.degrees(np.sqrt(14 / 3) * 1e-3))
    assert "mount_m" not in figures([scores(rng)])
