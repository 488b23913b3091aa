"""Replay equals the live loop, bit for bit: events fed one by one, and the same events written, read and recorded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import kalmark as km
from kalmark.config import build_slam
from kalmark.logs import write_native
from kalmark.simulate import load_world, simulate


@pytest.mark.parametrize("name", ["cloister", "two_robots"])
def test_a_replayed_log_gives_the_numbers_of_the_live_loop(name: str, tmp_path: Path) -> None:
    world = load_world(name, ["steps=60"])
    log = simulate(world, seed=5)
    live = build_slam(world.config(), log)
    for event in log.events:
        live.process(event)

    write_native(log, tmp_path)
    read = km.open_log(tmp_path)
    run = km.record(build_slam(world.config(), read), read, progress=False)
    replayed = run.final_slam()

    ids = live.landmarks().ids
    assert replayed.landmarks().ids == ids
    assert len(ids) > 5
    names = [*live.robots, *ids]
    assert replayed.covariance(*names).tobytes() == live.covariance(*names).tobytes()
    for name_ in names:
        np.testing.assert_array_equal(replayed.mean(name_), live.mean(name_))
