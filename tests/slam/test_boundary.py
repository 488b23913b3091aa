"""What is refused where events, robots and mounts are made: one line with the value and what was expected."""

from __future__ import annotations

import pickle
import warnings
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import kalmark as km
from kalmark.errors import EventError, KalmarkError, MapError, ModelError
from kalmark.events import checked_id, seconds_text
from kalmark.geometry.spaces import Rn
from kalmark.slam.checks import check_covariance, measurements

NAN, INF = float("nan"), float("inf")
LIDAR = km.sensors.RangeBearing()


def scan(y: Any = ((1.0, 0.0),), ids: Any = None, cov: Any = None) -> km.Scan:
    return km.Scan(2.0, "rover", "lidar", y, ids, cov)


def refusal(make: Any, error: type[KalmarkError]) -> str:
    """Return the message of a refusal, which is one short line and comes with no warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(error) as refused:
            make()
    message = str(refused.value)
    assert type(refused.value) is error
    assert "\n" not in message
    assert len(message) < 300
    return message


# ---------------------------------------------------------------------- ids
@pytest.mark.parametrize(
    ("given", "id_"),
    [
        (7, 7), (-1, -1), ("oak", "oak"), ("7", "7"), (7.0, 7), (np.int32(7), 7), (np.uint8(7), 7),
        (np.float32(7), 7), (np.str_("oak"), "oak"), (10**30, 10**30),
    ],
)  # fmt: skip
def test_an_id_is_an_int_or_a_str(given: Any, id_: Any) -> None:
    assert checked_id(given, "id") == id_
    assert type(checked_id(given, "id")) is type(id_)
    (kept,) = scan(ids=[given]).ids or ()
    assert (kept, type(kept)) == (id_, type(id_))


@pytest.mark.parametrize(
    "bad",
    ["", np.str_(""), True, np.True_, NAN, INF, 1.5, np.float32(1.5), 1j, b"oak", (1, 2), [7], {7}, object(),
     np.timedelta64(5, "ns"), np.datetime64(5, "ns"), np.array([1, 2]), Fraction(3)],
)  # fmt: skip
def test_an_id_that_is_neither_is_refused_with_its_value(bad: Any) -> None:
    message = refusal(lambda: checked_id(bad, "landmark"), EventError)
    assert message.startswith("landmark is ")
    assert message.endswith("expected a whole number or a text that is not empty")
    assert "at t=2 s: an id is " in refusal(lambda: scan(ids=[bad]), EventError)


def test_none_is_an_id_inside_a_scan_only() -> None:
    assert scan([[1, 0], [2, 0]], [None, None]).ids == (None, None)
    assert "landmark is None" in refusal(lambda: checked_id(None, "landmark"), EventError)


@pytest.mark.parametrize("bad", [7, "ab", "a", b"ab", {7: 1, 8: 2}, {7, 8}, np.array(7), NAN, True])
def test_ids_that_are_no_list_are_refused(bad: Any) -> None:
    assert "expected a list with one id for each observation" in refusal(
        lambda: scan([[1, 0], [2, 0]], bad), EventError
    )


def test_ids_come_as_any_list() -> None:
    y = [[1, 0], [2, 0]]
    for ids in ([3, 4], (3, 4), np.array([3, 4]), np.array([3.0, 4.0]), iter([3, 4]), range(3, 5)):
        assert scan(y, ids).ids == (3, 4)
    assert scan(y, np.array([3, None], dtype=object)).ids == (3, None)
    assert "an id is [3]" in refusal(lambda: scan(y, [[3], [4]]), EventError)
    assert "an id is [3]" in refusal(lambda: scan(y, np.array([[3], [4]])), EventError)


def test_one_landmark_under_two_spellings_is_a_duplicate() -> None:
    for twice in ([1, 1.0], [1, np.int8(1)], ["a", np.str_("a")]):
        assert "appears twice" in refusal(lambda: scan([[1, 0], [2, 0]], twice), EventError)
    assert "an id is True" in refusal(lambda: scan([[1, 0], [2, 0]], [1, True]), EventError)


# ---------------------------------------------------------------------- times
@given(st.integers(-(2**63) + 1, 2**63 - 1))
def test_a_time_in_a_message_is_exact(t_ns: int) -> None:
    text = seconds_text(t_ns)
    assert Fraction(text) == Fraction(t_ns, 10**9)
    assert "e" not in text
    assert not text.endswith(".")
    assert "." not in text or not text.endswith("0")


def test_the_time_of_a_real_log_can_be_found_again() -> None:
    assert seconds_text(1288971842_161000000) == "1288971842.161"
    assert [seconds_text(t) for t in (0, 10**10, -1, -1_500_000_000)] == ["0", "10", "-0.000000001", "-1.5"]
    make = lambda: km.Control(t_ns=1288971842_161000000, robot="r", u=(NAN, 0))  # noqa: E731
    assert refusal(make, EventError) == "control of 'r' at t=1288971842.161 s: u holds nan, expected finite numbers"
    event = km.Scan(t_ns=1288971842_161000000, robot="r", sensor="s", y=[[1, 0, 0]])
    assert "scan at t=1288971842.161 s: y has 3 columns" in refusal(lambda: measurements(event, LIDAR), EventError)


EVENTS: dict[str, Any] = {
    "control": lambda **time: km.Control(robot="r", u=(1, 0), **time),
    "scan": lambda **time: km.Scan(robot="r", sensor="s", **time),
    "fix": lambda **time: km.Fix(robot="r", y=(1, 0), cov=np.eye(2), **time),
}


@pytest.mark.parametrize("kind", EVENTS)
def test_a_time_is_a_number_in_the_range_of_int64(kind: str) -> None:
    make = EVENTS[kind]
    for bad in (
        NAN,
        INF,
        True,
        np.True_,
        "2.5",
        b"2",
        None,
        1e20,
        -1e20,
        9223372037,
        1j,
        [2.0],
        np.timedelta64(2, "s"),
    ):
        message = refusal(lambda: make(t_s=bad), EventError)
        assert message.startswith(f"{kind} of 'r': ")
        assert bad is None or "t_s is " in message
    for bad in (
        NAN,
        "abc",
        "5",
        True,
        np.True_,
        2e9 + 0.7,
        2e9,
        2**63,
        -(2**63),
        10**5000,
        [2],
        np.timedelta64(2, "s"),
    ):
        message = refusal(lambda: make(t_ns=bad), EventError)
        assert message.startswith(f"{kind} of 'r': t_ns is ")
    assert "exactly one of" in refusal(lambda: make(t_s=1.0, t_ns=1), EventError)


@pytest.mark.parametrize("kind", EVENTS)
def test_a_time_becomes_integer_nanoseconds(kind: str) -> None:
    make = EVENTS[kind]
    for t_s in (2, 2.0, np.float64(2), np.float32(2), np.int64(2), Fraction(2)):
        assert (make(t_s=t_s).t_ns, type(make(t_s=t_s).t_ns)) == (2_000_000_000, int)
    for t_ns in (2**63 - 1, -(2**63) + 1):
        assert make(t_ns=t_ns).t_ns == t_ns
    assert type(make(t_ns=np.int64(5)).t_ns) is int


# ---------------------------------------------------------------------- numbers and names
@pytest.mark.parametrize("bad", [["a"], 7, None, b"rover", True])
def test_robots_and_sensors_are_named_by_texts(bad: Any) -> None:
    for make, what in (
        (lambda: km.Control(2, bad, (1, 0)), "robot"),
        (lambda: km.Scan(2, bad, "lidar"), "robot"),
        (lambda: km.Scan(2, "rover", bad), "sensor"),
        (lambda: km.Fix(2, bad, (1, 0), np.eye(2)), "robot"),
    ):
        assert f"at t=2 s: {what} is {bad!r}, expected a text" in refusal(make, EventError)


@pytest.mark.parametrize("bad", ["far", ("1", "2"), (True, False), (1, None), (1, 2j), {1: 2}, [[1], [1, 2]], object()])
def test_what_is_no_number_is_refused(bad: Any) -> None:
    assert "u is " in refusal(lambda: km.Control(2, "r", bad), EventError)
    assert "y is " in refusal(lambda: scan(bad), EventError)
    assert "cov is " in refusal(lambda: scan(cov=bad), EventError)
    assert "cov is " in refusal(lambda: km.Fix(2, "r", (1, 0), bad), EventError)


def test_a_long_value_is_cut_and_stays_on_one_line() -> None:
    message = refusal(lambda: scan(np.full((300, 2), "far")), EventError)
    assert message.endswith("..., expected numbers")


def test_numbers_of_any_width_are_taken_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for y in ([[1e9, -1e9]], [[1e12, 0.0]], np.array([[1, 2]], ">f4"), np.array([[1, 2]], np.uint8)):
            event = scan(y)
            assert event.y.dtype == np.float64
            np.testing.assert_array_equal(event.y, y)
    for y in ([[1e308, INF]], [[INF, -INF]], [[1e308, NAN]], np.array([["1e400", "0"]]).astype(np.longdouble)):
        assert "expected finite numbers" in refusal(lambda: scan(y), EventError)
    for y in ([[1e13, 0.0]], [[1e155, -1e155]], [[1.7e308, 1.7e308]]):
        assert "expected at most 1e+12" in refusal(lambda: scan(y), EventError)


@pytest.mark.parametrize(
    ("event", "message"),
    [
        (km.Control(2.0, "rover", [1.1e6, 0]), "control at t=2 s: v_mps is 1.1e+06, expected at most 1e+06 m/s"),
        (km.Control(2.0, "rover", [0, -2e6]), "control at t=2 s: w_radps is 2e+06, expected at most 1e+06 rad/s"),
        (km.Control(2.0, "rover", [0, 0], np.eye(2) * 1e13), "cov: sigma_v_mps is 3.16e+06, expected at most 1e+06 m"),
        (scan([[1, 0], [2e9, 0]]), "scan at t=2 s: range_m is 2e+09, expected at most 1e+09 m"),
        (scan([[1, -1e7]]), "scan at t=2 s: bearing_rad is 1e+07, expected at most 1e+06 rad"),
        (scan([[1, 0]], cov=np.eye(2) * 1e13), "cov: sigma_bearing_rad is 3.16e+06, expected at most 1e+06 rad"),
        (scan([[1, 0]], ["rover.lidar"]), "id 'rover.lidar' names a robot's bias or mount, expected another"),
        (scan([[1, 0]], ["rover bias"]), "id 'rover bias' names a robot's bias or mount, expected another"),
    ],
)
def test_an_event_beyond_what_means_anything_is_refused_with_its_column_and_bound(event: Any, message: str) -> None:
    slam = km.Slam([km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(LIDAR)})])
    assert message in refusal(lambda: slam.process(event), EventError)
    slam.process(km.Scan(1.0, "rover", "lidar", [[1e9, 1e6]], [1]))
    assert slam.t_ns == 1_000_000_000


def test_a_fix_and_a_landmark_are_at_most_a_million_kilometres_away() -> None:
    assert "y holds 1e+10, expected at most 1e+09" in refusal(lambda: km.Fix(1, "r", (1e10, 0), np.eye(2)), EventError)
    assert "cov holds 1e+19" in refusal(lambda: km.Fix(1, "r", (1, 0), np.eye(2) * 1e19), EventError)
    slam = km.Slam([km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(LIDAR)})])
    assert "mean holds 1e+10" in refusal(lambda: slam.add_landmark(1, (1e10, 0)), MapError)
    for name in ("rover bias", "rover.lidar"):
        assert "names a robot's bias or mount" in refusal(lambda: slam.add_landmark(name, (1, 0)), MapError)
    for make in (
        lambda: km.Robot("r", km.motion.Unicycle(), start=(1e10, 0, 0)),
        lambda: km.Robot("r", km.motion.Unicycle(), cov=np.eye(3) * 1e19),
        lambda: km.Mount(LIDAR, at=(0, 1e10, 0)),
        lambda: km.sensors.RangeBearing(sigma_range_m=1e300),
        lambda: km.sensors.RangeBearing(sigma_range_m=10**400),
    ):
        assert "expected" in refusal(make, ModelError)


def test_ids_have_at_most_200_digits_or_characters() -> None:
    assert checked_id(10**199, "id") == 10**199
    for long in (10**200, -(10**5000), "7" * 201):
        assert refusal(lambda: checked_id(long, "id"), EventError).endswith(("200 digits", "200 characters"))


def test_events_keep_their_numbers_when_the_callers_change() -> None:
    u, y, cov, ids = np.ones(2), np.ones((1, 2)), np.eye(2), [1]
    control, seen, fix = km.Control(0, "r", u, cov), scan(y, ids, cov), km.Fix(0, "r", u, cov)
    for array in (u, y, cov):
        array[...] = 7
    ids[0] = 7
    for kept in (control.u, seen.y, fix.y):
        assert (kept == 1).all()
    for event in (control, seen, fix):
        np.testing.assert_array_equal(event.cov, np.eye(2))
        assert event.cov.flags.writeable, "a compiled kernel has one variant for writable arrays"
    assert seen.ids == (1,)


# ---------------------------------------------------------------------- empty scans
def test_a_scan_that_saw_nothing_has_no_rows() -> None:
    for y in ((), [], np.zeros((0, 2))):
        for cov in (None, np.eye(2), np.zeros((0, 2, 2))):
            event = scan(y, [], cov)
            assert event.y.shape == (0, 0)
            assert measurements(event, LIDAR).shape == (0, 2, 2)
            assert pickle.loads(pickle.dumps(event)).width == event.width


def test_a_noise_of_whole_numbers_is_one_of_floats() -> None:
    for sensor in (km.sensors.PinHole(sigma_px=5), km.sensors.Segments(sigma_px=2)):
        y = 100.0 + np.arange(len(sensor.columns))
        assert measurements(scan([y]), sensor).dtype == np.float64


def test_what_only_looks_empty_is_refused() -> None:
    for y in ([[], []], [[]], np.zeros((0, 2, 2)), np.zeros((2, 0))):
        assert "expected (K, m): one row an observation" in refusal(lambda: scan(y), EventError)
    assert "y has 5 columns, expected 2" in refusal(lambda: measurements(scan(np.zeros((0, 5))), LIDAR), EventError)
    for cov, message in (
        (-np.eye(2), "positive definite"),
        (-np.eye(7), "shape (7, 7)"),
        (np.ones((1, 2, 2)), "shape"),
    ):
        assert message in refusal(lambda: measurements(scan((), cov=cov), LIDAR), EventError)


# ---------------------------------------------------------------------- covariances
def test_a_covariance_is_a_copy() -> None:
    given = np.eye(3)
    robot, checked = km.Robot("r", km.motion.Unicycle(), cov=given), check_covariance(given, 3, "cov", definite=True)
    given[0, 0] = -5
    np.testing.assert_array_equal(robot.cov, np.eye(3))
    np.testing.assert_array_equal(checked, np.eye(3))


@pytest.mark.parametrize("error", [EventError, ModelError, MapError])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("x", "cov is 'x', expected numbers"),
        ([["a"]], "expected numbers"),
        ([[1, 2], [3]], "expected numbers"),
        (np.eye(3), "has shape (3, 3), expected (2, 2)"),
        (NAN, "expected finite numbers"),
        ([[1, NAN], [NAN, 1]], "expected finite numbers"),
        ([[1, 0.5], [0, 1]], "symmetric"),
        ([[1e17, 1e17], [-1e17, 1e17]], "symmetric"),
        ([[1, 0], [0, -1]], "eigenvalue -1"),
        ([[1, 2], [2, 1]], "eigenvalue -1"),
    ],
)
def test_a_covariance_is_refused_with_the_error_asked_for(error: Any, value: Any, message: str) -> None:
    assert message in refusal(lambda: check_covariance(value, 2, "cov", definite=False, error=error), error)


def test_one_bad_covariance_of_many_is_found_and_shown() -> None:
    covs = np.tile(1e6 * np.eye(2), (3, 1, 1))
    covs[0, 0, 1] += 1e-5  # rounding, beside 1e6
    covs[2] = [[1, 1e-6], [0, 1]]
    event = scan(np.ones((3, 2)), cov=covs)
    assert "[[1.0, 1e-06], [0.0, 1.0]], expected a symmetric" in refusal(lambda: measurements(event, LIDAR), EventError)
    assert measurements(scan(np.ones((3, 2)), cov=np.eye(2)), LIDAR).shape == (3, 2, 2)


# ---------------------------------------------------------------------- robots and mounts
@dataclass(frozen=True)
class Drone(km.motion.Unicycle):
    space = Rn(4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda m: km.Robot("r", m, sensors={"l": LIDAR}), "sensor 'l' is RangeBearing("),
        (lambda m: km.Robot("r", m, sensors={"l": LIDAR}), "expected a Mount: Mount(sensor"),
        (lambda m: km.Robot("r", m, sensors={"l": km.sensors.RangeBearing}), "expected a Mount"),
        (lambda m: km.Robot("r", m, sensors={"l": km.Mount}), "expected a Mount"),
        (lambda m: km.Robot("r", m, sensors=km.Mount(LIDAR)), "expected a mapping of names to Mounts"),
        (lambda m: km.Robot("r", m, sensors={3: km.Mount(LIDAR)}), "the name of a sensor is 3"),
        (lambda m: km.Robot("r", m, sensors={"": km.Mount(LIDAR)}), "the name of a sensor is ''"),
        (lambda m: km.Robot("r", type(m)), "robot 'r': motion is the class Unicycle, expected an instance: U"),
        (lambda m: km.Robot("r", LIDAR), "expected a motion model"),
        (lambda m: km.Robot(7, m), "Robot: name is 7"),
        (lambda m: km.Robot("r", m, cov="x"), "robot 'r': cov is 'x', expected numbers"),
        (lambda m: km.Robot("r", m, cov=np.eye(2)), "expected (3, 3)"),
        (lambda m: km.Robot("r", m, cov=NAN * np.eye(3)), "finite"),
        (lambda m: km.Robot("r", m, start="here"), "start is 'here', expected three finite numbers"),
        (lambda m: km.Robot("r", m, start=("0", "0", "0")), "expected three finite numbers"),
        (lambda m: km.Robot("r", Drone(), start=(0, 0, 0)), "motion is in R4, expected SE2, SE3 or more"),
        (lambda m: km.Mount(km.sensors.RangeBearing), "Mount: sensor is the class RangeBearing, expected an instance"),
        (lambda m: km.Mount(LIDAR, at=(0, 0)), "Mount: at is (0, 0), expected three"),
        (lambda m: km.Mount(LIDAR, landmark=km.landmarks.Point2D), "landmark is the class Point2D"),
        (lambda m: km.Mount(LIDAR, landmark="point"), "landmark is 'point', expected a landmark model"),
    ],
)  # fmt: skip
def test_a_robot_that_cannot_work_is_refused_when_it_is_made(make: Any, message: str) -> None:
    assert message in refusal(lambda: make(km.motion.Unicycle()), ModelError)


def test_a_robot_keeps_its_sensors_when_the_callers_mapping_changes() -> None:
    sensors = {"lidar": km.Mount(LIDAR)}
    robot = km.Robot("r", km.motion.Unicycle(), sensors=sensors)
    sensors.clear()
    assert list(robot.sensors) == ["lidar"]
