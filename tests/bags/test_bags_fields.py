"""Bags: fields of messages of other types, as a configuration names them and as definitions show them."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kalmark.config import load_config
from kalmark.errors import LogError
from kalmark.events import Scan
from kalmark.logs import open_log

pytest.importorskip("rosbags", reason="rosbags is not installed: no bag can be read")

import ros_bags
from kalmark.bags.first_config import first_config
from kalmark.bags.survey import survey
from ros_bags import KINDS, T0, TOPICS, Outgoing, bag_of, header_fields, odometry, pose

OWN = {
    "uwb_msgs/msg/Range": "std_msgs/Header header\nuint8 anchor_id\nuint16 distance\n",
    "cone_msgs/msg/Cone": "uint32 id\ngeometry_msgs/Vector3 velocity\ngeometry_msgs/Point position\nfloat32 radius\n",
    "cone_msgs/msg/ConeArray": "std_msgs/Header header\ncone_msgs/Cone[] cones\n",
    "cone_msgs/msg/Lists": "std_msgs/Header header\nint32[] ids\nfloat64[] ranges\nfloat64[] bearings\n",
    "car_msgs/msg/Speed": "std_msgs/Header header\nfloat64 speed\nfloat64 yaw_rate\n",
    "car_msgs/msg/Place": "std_msgs/Header header\nfloat64 north\nfloat64 east\n",
}
UWB = {"type": "scan", "fields": {"range_mm": "msg.distance", "id": "msg.anchor_id"}}
CONES = [(3, (4.0, 1.0)), (9, (5.0, -2.0))]


@pytest.fixture(autouse=True)
def _own_types(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_bags, "EXTRA", ros_bags.EXTRA | OWN)


def messages() -> list[Outgoing]:
    """Return odometry, and at each of its poses one message of each of the other types."""
    out = []
    for k in range(3):
        t, head = T0 + k * 10**9, {"header": header_fields(T0 + k * 10**9, "sensor")}
        cones = [{"id": i, "position": {"x": x - k, "y": y, "z": 0.0}} for i, (x, y) in CONES]
        x, y = np.array([p for _, p in CONES]).T - [[k], [0]]
        lists = {"ids": [i for i, _ in CONES], "ranges": np.hypot(x, y), "bearings": np.arctan2(y, x)}
        out += [
            odometry(t, pose(k, 0, 0)),
            Outgoing("/uwb", "uwb_msgs/msg/Range", t, head | {"anchor_id": 7, "distance": 2500 + k}),
            Outgoing("/cones", "cone_msgs/msg/ConeArray", t, head | {"cones": cones}),
            Outgoing("/lists", "cone_msgs/msg/Lists", t, head | lists),
            Outgoing("/speed", "car_msgs/msg/Speed", t, head | {"speed": 0.5, "yaw_rate": 0.1}),
            Outgoing("/place", "car_msgs/msg/Place", t, head | {"north": 3.0, "east": 0.0 + k}),
        ]
    return out


def scan_of(path: Path, topic: str, section: Any, **options: Any) -> Scan:
    log = open_log(path, topics={"/odom": TOPICS["/odom"], topic: section}, **options)
    return next(event for event in log.events if isinstance(event, Scan))


@pytest.mark.parametrize("kind", KINDS)
def test_fields_of_another_type_are_read_by_their_names(kind: str, tmp_path: Path) -> None:
    path = bag_of(tmp_path, messages(), kind)
    scan = scan_of(path, "/uwb", UWB)
    assert (scan.y.tolist(), scan.ids) == ([[2.5]], (7,))
    for section in ({"type": "scan"}, {"type": "scan", "fields": {"id": "cones[].id", "x_m": "cones[].position.x",
                                                                  "y_m": "cones[].position.y"}}):  # fmt: skip
        scan = scan_of(path, "/cones", section)
        assert (scan.y.tolist(), scan.ids) == ([[4, 1], [5, -2]], (3, 9))
    scan = scan_of(path, "/lists", {"type": "scan"})
    np.testing.assert_allclose(scan.y, [[17**0.5, np.arctan2(1, 4)], [29**0.5, np.arctan2(-2, 5)]])


def test_fields_are_controls_and_fixes_and_truth_too(tmp_path: Path) -> None:
    place = {"fields": {"x_m": "east", "y_m": "north"}}
    log = open_log(bag_of(tmp_path, messages()), topics={
        "/speed": {"type": "unicycle", "fields": {"v_mps": "speed", "w_radps": "yaw_rate"}},
        "/place": {"type": "fix", "sigma_m": 0.1} | place,
        "true": {"topic": "/place", "type": "truth", "fields": place["fields"] | {"theta_rad": "north"}},
    })  # fmt: skip
    assert log.events[0].u.tolist() == [0.5, 0.1] and log.events[-1].y.tolist() == [2.0, 3.0]
    np.testing.assert_allclose(log.truth["robot"].poses[1], [1.0, 3.0, 3.0])


@pytest.mark.parametrize(("section", "said"), [
    ({"type": "scan", "fields": 3}, "fields is 3, expected a mapping of columns"),
    ({"type": "scan", "fields": {"range_m": "distnce"}}, "no field 'distnce'"),
    ({"type": "scan", "fields": {"range_m": "header"}}, "the field of range_m is 'std_msgs/msg/Header'"),
    ({"type": "unicycle", "fields": {"range_m": "distance"}}, "fields has 'range_m', expected some of"),
    ({"type": "ackermann"}, "or `fields` of anchor_id, distance"),
])  # fmt: skip
def test_fields_that_are_not_there_get_one_line(section: dict[str, Any], said: str, tmp_path: Path) -> None:
    topics = {"/uwb": section} | ({"/odom": TOPICS["/odom"]} if section["type"] == "scan" else {})
    with pytest.raises(LogError, match=said) as error:
        open_log(bag_of(tmp_path, messages()), topics=topics)
    assert "\n" not in str(error.value)


def test_arrays_of_different_lengths_get_one_line(tmp_path: Path) -> None:
    odd = {"ids": [1, 2], "ranges": np.ones(3), "bearings": np.ones(3)}
    bag = bag_of(tmp_path, [*messages()[:1], Outgoing("/lists", "cone_msgs/msg/Lists", T0, odd)])
    with pytest.raises(LogError, match="3 of range_m, 3 of bearing_rad, 2 of id, expected as many of each"):
        scan_of(bag, "/lists", {"type": "scan", "time": "recorded"})


def test_a_definition_may_be_given_where_the_bag_has_none(tmp_path: Path) -> None:
    """As older ROS 2 bags in sqlite3 are."""
    path = bag_of(tmp_path, messages(), "sqlite3")
    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        database.execute("delete from message_definitions")
    with pytest.raises(LogError, match=r"type uwb_msgs/Range, which the bag does not define, expected its \.msg file"):
        scan_of(path, "/uwb", {"type": "scan"})
    (tmp_path / "Range.msg").write_text(OWN["uwb_msgs/msg/Range"])
    for given in (OWN["uwb_msgs/msg/Range"], str(tmp_path / "Range.msg")):
        assert scan_of(path, "/uwb", UWB, definitions={"uwb_msgs/Range": given}).y.tolist() == [[2.5]]
    with pytest.raises(LogError, match=r"definitions: uwb_msgs/Range is 'float32', expected a \.msg file"):
        scan_of(path, "/uwb", UWB, definitions={"uwb_msgs/Range": "float32"})
    text = first_config(survey(path, {"uwb_msgs/Range": str(tmp_path / "Range.msg")}))
    assert "fields: {id: anchor_id, range_m: distance}" in text and "# not used: /cones" in text
    (tmp_path / "config.yaml").write_text(text)
    assert load_config(tmp_path / "config.yaml").log.definitions == {"uwb_msgs/Range": str(tmp_path / "Range.msg")}


def test_landmarks_are_told_by_their_fields_and_not_by_the_name_of_the_type(tmp_path: Path) -> None:
    text = first_config(survey(bag_of(tmp_path, messages())))
    assert "cones: {type: position, mount" in text and "lists: {type: range_bearing, mount" in text
    assert "x_m: 'cones[].position.x', y_m: 'cones[].position.y'" in text  # and not the velocity
    assert "# not used: /speed" in text and "# not used: /place" in text
    (tmp_path / "config.yaml").write_text(text)
    load_config(tmp_path / "config.yaml")
