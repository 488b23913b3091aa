"""The mean over one matching is the correction by it: errors of an inertial unit turn as they do there."""

import numpy as np

import kalmark as km
from kalmark.filter.estimators import Update

START = np.array([0.0, 0, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0])


def test_one_matching_averaged_is_the_correction_by_it_with_a_heading_that_is_found() -> None:
    cov = np.diag([0.01, 0.01, 0.01, 1e-4, 1e-4, 0.25, 0.01, 0.01, 0.01, *[1e-6] * 3, *[1e-3] * 3])
    cov[3, 13], cov[13, 3] = 3e-4, 3e-4
    found = []
    for averaged in (False, True):
        laser = km.Mount(km.sensors.RangeBearing3D(0.01, 0.001, 0.001), at=np.eye(7)[6])
        slam = km.Slam(km.Robot("r", km.motion.Inertial(), START, {"laser": laser}, cov))
        for name, at in ((1, (5.0, 1.0, 0.5)), (2, (4.0, -3.0, 0.2))):
            slam.add_landmark(name, mean=at, cov=1e-4 * np.eye(3))
        channel, tracks = slam.state.channels["r", "laser"], slam.state.tracks
        model = channel.models[tracks.sorts[1]]
        y = np.array([[5.12, 0.6, 0.09], [5.0, -0.24, 0.04]])
        R = np.tile(np.diag([1e-4, 1e-6, 1e-6]), (2, 1, 1))
        slots = tracks.slots_of([1, 2])
        update = Update(model.model, slam.state.moving["r"].slot, -1, slots, model.d, y, R)
        if averaged:
            slam.state.estimator.average(slam.state.map, update, np.array([[0, 1]]), np.ones(1))
        else:
            slam.state.estimator.correct(slam.state.map, update)
        found.append((slam.mean("r"), slam.covariance("r")))
    assert abs(2 * np.arctan2(found[0][0][5], found[0][0][6])) > 0.3
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-9)
    np.testing.assert_allclose(found[1][1], found[0][1], atol=1e-12)
