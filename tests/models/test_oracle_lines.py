"""Recorded runs of the SLAM toolbox with lines: new lines, innovations and visibility, each from the recorded state."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kalmark.geometry import frames3d, rotations
from kalmark.models import cameras, lines
from toolbox import Array, frame, k_of, recorded
from toolbox_lines import ORDER, line

RUNS = {"c_idpLin_small": "inverse_depth_line", "c_plkLin_small": "pluecker", "c_hmgLin_small": "homogeneous_line"}


def listed(x: Any) -> list[Any]:
    return x if isinstance(x, list) else [x]


def camera_pose(robot: Any, mount: Any) -> Array:
    r = frame(np.array(robot))
    r[3:] = rotations.normalize(r[3:])
    return frames3d.compose(r, frame(np.array(mount, dtype=float)))[0]


@pytest.mark.parametrize(("run", "name"), RUNS.items())
def test_lines_start_and_are_seen_and_measured_as_recorded(run: str, name: str, oracle: Callable[[str], Path]) -> None:
    log: Any = recorded(oracle(f"{run}.json.gz"))
    X = np.load(oracle(f"{run}.npz"))["X"]
    mount, sensor = np.ravel(log["cfg"]["SenFrame"])[:7], listed(log["cfg"]["SenPar"])[0]
    k, size = k_of(np.array(sensor["k"], dtype=float)), np.array(sensor["imSize"], dtype=float)
    prior, least = ([[0.1, 0.0]], 1.0) if name == "pluecker" else ([[0.1, 0.1]], 10.0)
    started = measured = looked = 0
    for before, now in zip([None, *log["frames"]], log["frames"], strict=False):
        robot, seen = listed(now["rob"])[0], listed(listed(now["rob"])[0]["sen"])[0]
        for new in listed(seen["log"]["init"]):
            ends = cameras.back_project_pinhole(np.reshape(new["y"], (2, 2)), k, np.zeros(0))[0].reshape(1, 6)
            l = line(name).of(camera_pose(seen["x_corr"], mount), ends, np.array(prior))[0]
            np.testing.assert_allclose(l[0, ORDER[name]], new["l"], atol=1e-11)
            started += 1
        if before is None:
            continue
        T, ids = camera_pose(robot["x_pred"], mount), np.atleast_1d(before["lmks"]["lmk"])
        at, t = np.reshape(before["lmks"]["range"], (len(ids), -1)), np.reshape(before["lmks"]["t"], (len(ids), 2))
        l = X[at - 1, now["frame"] - 2][:, ORDER[name]]
        p = line(name).endpoints(l, t.astype(float))[0]
        visible = lines.visible_segment(T, p[:, 0].copy(), p[:, 1].copy(), k, size, least)[0]
        np.testing.assert_array_equal(np.sort(ids[visible]), np.sort(np.atleast_1d(seen["log"]["vis"])))
        first = listed(seen["log"]["corr"])[0]  # the others are taken at states that are not recorded
        v = line(name).seen_from(T, l[ids == first["lmk"]])[0]
        z = lines.segment_innovation(v, np.array(first["y"])[None], k)[1][0]
        np.testing.assert_allclose(-z, first["z"], atol=1e-11)
        measured, looked = measured + 1, looked + len(ids)
    assert (started, measured, looked) == (6, 49, 279)
