"""Streams of events, many odd or wrong: what is refused leaves no trace, and what is taken leaves a covariance."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from state_digest import digest, digest_of_saved
from storm import ESTIMATORS, MAPS, robots

import kalmark as km
from event_streams import Told, streams
from kalmark.errors import DivergedError, KalmarkError


@pytest.mark.parametrize("space", [False, True])
@settings(max_examples=25, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(data=st.data())
def test_what_is_refused_leaves_no_trace(space: bool, data: Any) -> None:
    """Two filters, the second of which gets what the first one took, end in the same state to the last bit."""
    estimator, map_ = data.draw(st.sampled_from([*ESTIMATORS.values()])), data.draw(st.sampled_from(MAPS))
    told: list[Told] = data.draw(streams(space))
    one, two = (km.Slam(robots(space), estimator=estimator(), map=map_) for _ in range(2))
    now_ns = 0
    for each in told:
        before = digest(one)
        try:
            event = each.made(now_ns)
            one.process(event)
        except DivergedError:
            return
        except KalmarkError as error:
            assert "\n" not in str(error) and 0 < len(str(error)) < 1500
            assert digest(one) == before
            continue
        two.process(event)
        now_ns = max(now_ns, event.t_ns)
        for name in one.robots:
            P = one.covariance(name)
            assert np.isfinite(P).all()
            assert np.linalg.eigvalsh(P)[0] >= -1e-9 * max(1.0, float(np.abs(P).max()))
    assert digest_of_saved(one) == digest_of_saved(two)
