"""Is the batch solution of a map with walls the one that its filter is near to?"""

from __future__ import annotations

import numpy as np

import kalmark as km
from kalmark.batch.data import replay_events
from kalmark.batch.wall_anchors import anchors
from kalmark.config import build_slam
from kalmark.geometry.spaces import SE2
from kalmark.models.landmarks import Wall2D
from kalmark.results.batch import batch_input, compare_with_filter, solve_batch
from kalmark.simulate import load_world, simulate

WALLS = (
    "steps=300",
    "ids=true",
    "robots.robot.sensing={walls: {every: 2}}",
    "robots.robot.sensors={walls: {type: wall, range_max_m: 20.0, mount: {x_m: 0.2}}}",
)


def test_the_batch_solution_of_walls_is_that_of_the_filter_and_fits_the_noise() -> None:
    world = load_world("hall_of_walls", WALLS)
    log = simulate(world, 1)
    run = km.record(build_slam(world.config(), log), log, progress=False, pictures=False)
    found = compare_with_filter(run, solve_batch(run, log))
    assert found["landmarks"] == 15
    assert 0.95 < found["sigma_ratio"] < 1.1
    assert found["map_difference_sigma"] < 0.2
    assert 0.9 < found["chi2_per_dof"] < 1.1


def test_walls_and_corners_are_solved_for_together() -> None:
    world = load_world("hall_of_walls", ("steps=120",))
    log = simulate(world, 1)
    run = km.record(build_slam(world.config(), log), log, progress=False, pictures=False)
    problem = replay_events(batch_input(run), log)
    held = ~problem.free[problem.start.columns(1, np.arange(len(problem.ids))) + 2]
    sizes = {name: len(run.final_slam().mean(name)) for name in problem.ids}
    assert {2, 3} == {*sizes.values()}
    assert held.tolist() == [sizes[name] == 2 for name in problem.ids]  # a point has no direction
    assert 0.9 < compare_with_filter(run, solve_batch(run, log))["chi2_per_dof"] < 1.1


def test_where_a_wall_is_anchored_has_its_derivatives() -> None:
    rng, h = np.random.default_rng(0), 1e-6
    poses, walls, mount = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    rows, t, normal = np.arange(4), rng.normal(size=4), rng.normal(size=4)
    factor = anchors(rows, rows, Wall2D().space, mount, normal, t, np.ones((4, 1, 1)))
    assert factor.term.blocks[0].space is SE2
    x = np.concatenate([poses, walls], axis=1)
    _, E = factor.term.residuals(poses, walls)
    for j in range(6):
        step = h * np.eye(6)[j]
        more, less = (factor.term.residuals(y[:, :3], y[:, 3:])[0] for y in (x + step, x - step))
        np.testing.assert_allclose(-(more - less) / (2 * h), E[:, :, j], atol=1e-8)
