"""A storm of bad events leaves no trace, whatever the estimator, the map and the world."""

from __future__ import annotations

import pytest
from storm import ESTIMATORS, MAPS, WORLDS, storm


@pytest.mark.parametrize("map_", MAPS)
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("world", WORLDS)
def test_a_storm_of_bad_events_leaves_the_map_of_the_stream_without_them(world: str, estimator: str, map_: str) -> None:
    done = storm(ESTIMATORS[estimator](), world == "space", map_, 2000, seed=2)
    assert done.refused > 60
    assert not done.taken, "each is refused"
    assert not done.changed, "the state is what it was"
    assert not done.errors, "with a plain line"
    assert done.equal
