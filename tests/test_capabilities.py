"""Where landmarks are, and names of capabilities that are misspelt."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from kalmark.errors import ModelError
from kalmark.geometry.spaces import HEADING, RHO, VECTOR, Space
from kalmark.models import landmarks
from kalmark.models.model_check import check_model
from kalmark.models.pointwise import jacobian
from kalmark.models.protocols import HasPlace, place_of
from kalmark.models.sensors import RangeBearing
from kalmark.slam.robot import Mount


@pytest.mark.parametrize(
    "kind", [kind for kind in landmarks.BUILT_IN if hasattr(kind, "place")], ids=lambda kind: kind.__name__
)
def test_the_jacobian_of_a_place_is_that_of_differences(kind: Any) -> None:
    rng = np.random.default_rng(3)
    model = kind()
    space = model.space
    for _ in range(20):
        l = space.plus(
            np.zeros(space.size) + (np.arange(space.size) == 6) * (kind is landmarks.Tag), rng.normal(size=space.dof)
        )
        p, P_l = model.place(l[None])
        assert p.shape == (1, 2 if space.world == "plane" else 3)
        expected = jacobian(lambda d: model.place(space.plus(l, d)[None])[0][0], np.zeros(space.dof))
        np.testing.assert_allclose(P_l[0], expected, rtol=1e-4, atol=1e-4 * (1 + np.abs(expected).max()))


def test_a_line_is_at_its_point_nearest_to_the_anchor() -> None:
    rng = np.random.default_rng(4)
    for kind in landmarks.LINES:
        line = kind()
        l = rng.normal(size=(5, line.space.size))
        p, _ = line.place(l)
        ends, _ = line.endpoints(l, np.tile([0.0, 1.0], (5, 1)))
        along = ends[:, 1] - ends[:, 0]
        off = p - (l[:, :3] if line.anchored else 0.0)
        np.testing.assert_allclose(np.sum(along * off, axis=1), 0.0, atol=1e-7 * np.abs(along).max() ** 2)


class _Post:
    kind, space = "post", Space("post", (VECTOR, HEADING))

    def seen_from(self, T: Any, l: Any) -> Any: ...
    def from_view(self, T: Any, v: Any) -> Any: ...


def test_a_users_landmark_is_at_the_vector_it_begins_with() -> None:
    placed = place_of(_Post(), np.array([[1.0, 2.0, 0.5]]))
    assert placed is not None
    assert placed[0].tolist() == [[1.0, 2.0]]
    assert placed[1].tolist() == [[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]
    anchored = _Post()
    anchored.space = Space("anchored", (VECTOR, HEADING, RHO))
    assert place_of(anchored, np.ones((1, 4))) is None


def test_a_misspelt_capability_is_refused_with_both_names() -> None:
    class Short(RangeBearing):
        def see(self, v: Any) -> Any: ...

    class Deaf:
        columns, angular, find_depth = ("y",), (False,), False

        def expect(self, v: Any) -> Any: ...
        def noise(self, y: Any) -> Any: ...

    Mount(Short())  # it has `sees`, by inheritance
    with pytest.raises(ModelError, match="Deaf has 'find_depth', expected 'finds_depth'"):
        Mount(Deaf())


def test_a_sensor_of_the_state_that_would_be_taken_for_one_of_landmarks_is_refused() -> None:
    class Compass:
        columns, angular, views, pass_share = ("north_rad",), (True,), "pose", 0.999

        def expect(self, v: Any) -> Any:
            return v[:, 2:3], np.tile([[[0.0, 0.0, 1.0]]], (len(v), 1, 1))

        def noise(self, y: Any) -> Any:
            return np.tile([[0.01]], (len(y), 1, 1))

    Mount(Compass())
    assert all(finding.ok for finding in check_model(Compass(), np.random.default_rng(0)))
    Compass.views = "poze"
    with pytest.raises(ModelError, match=r"Compass\.views is 'poze', expected one of 'pose', 'change', 'twist'"):
        Mount(Compass())
    with pytest.raises(ModelError, match=r"Compass\.views is 'poze'"):
        check_model(Compass(), np.random.default_rng(0))
    Compass.views = "pose"
    del Compass.pass_share
    with pytest.raises(ModelError, match="Compass has views and no pass_share"):
        Mount(Compass())
    with pytest.raises(ModelError, match="Compass has views and no pass_share"):
        check_model(Compass(), np.random.default_rng(0))


class _Limited(RangeBearing):
    def __init__(self, far: bool) -> None:
        super().__init__()
        if far:
            self.__dict__["place"] = lambda l: l


def test_instances_of_one_class_may_have_other_capabilities() -> None:
    found = [isinstance(_Limited(far), HasPlace) for far in (False, True, False)]
    assert found == [False, True, False]
    assert not isinstance(_Limited, HasPlace) and isinstance(landmarks.Tag, HasPlace) is hasattr(landmarks.Tag, "place")
