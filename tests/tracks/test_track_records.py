"""The records of landmarks: names, slots and kinds of blocks, landmarks that come, go and merge, invented names."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import MapError
from kalmark.tracks.channel import ROBOT, Channel
from kalmark.tracks.track import RECENT, Pending, Status, Track, Tracks

POINT, RAY, WALL = km.landmarks.Point2D(), km.landmarks.InverseDepth2D(), km.landmarks.Wall2D()


def tracks_of(*names: Any, model: Any = POINT) -> Tracks:
    """Return the records of a robot on slot 0 and of landmarks on slots from 1 on."""
    tracks = Tracks(["r"])
    tracks.enter_block("r", 0, robot=True)
    for slot, name in enumerate(names, 1):
        tracks.confirm(Track(name, model, slot))
    return tracks


def eye(sensor: Any, landmark: Any, *others: Any) -> Channel:
    return Channel(sensor, np.zeros(3), -1, landmark, lambda dof: 9.0, [landmark, *others])


def test_a_landmark_that_is_confirmed_is_found_by_name_slot_and_kind() -> None:
    tracks = tracks_of("a")
    tracks.confirm(Track("w", WALL, 2), observations=4)
    assert (tracks.slots, tracks.names) == ({"r": 0, "a": 1, "w": 2}, {1: "a", 2: "w"})
    assert [tracks.sort(name) for name in ("r", "a", "w", "z")] == [ROBOT, "point", WALL.kind, None]
    assert tracks.slots_of(["w", "r", "w"]).tolist() == [2, 0, 2]
    track = tracks.confirmed["w"]
    assert (track.status, track.observations, track.extent.tolist()) == (Status.CONFIRMED, 4, [*WALL.first_ends])
    assert tracks.changes == 2


def test_the_sort_of_each_slot_says_whether_it_is_of_some_kinds_beyond_the_last_slot_too() -> None:
    tracks = tracks_of("a")
    tracks.confirm(Track("w", WALL, 200))
    points, walls = frozenset(["point"]), frozenset([WALL.kind])
    for kinds, right in ((points, {1}), (walls, {200}), (points | walls, {1, 200}), (frozenset(["tag"]), set())):
        sorts, wanted = tracks.sorts_of(kinds, 300)
        assert len(sorts) >= 300
        assert {*np.flatnonzero(wanted[sorts]).tolist()} == right
    tracks.remove("w")
    sorts, wanted = tracks.sorts_of(walls, 300)
    assert not wanted[sorts].any()
    tracks.confirm(Track("t", RAY, 3))
    sorts, wanted = tracks.sorts_of(frozenset([RAY.kind]), 300)
    assert np.flatnonzero(wanted[sorts]).tolist() == [3], "of a kind that came after it was first asked"


def test_a_landmark_that_is_removed_is_nowhere_and_covisible_with_nothing() -> None:
    tracks = tracks_of("a", "b", "c")
    tracks.note_scan(["a", "b", "c"])
    tracks.remove("b")
    assert ([*tracks.confirmed], tracks.slots, tracks.names) == (["a", "c"], {"r": 0, "a": 1, "c": 3}, {1: "a", 3: "c"})
    assert tracks.confirmed["a"].covisible == {"a", "c"}
    assert (tracks.sort("b"), tracks.last_scan, tracks.changes) == (None, [], 4)


def test_a_landmark_with_another_block_and_model_leaves_its_old_slot() -> None:
    tracks = tracks_of("a", model=RAY)
    track = tracks.confirmed["a"]
    tracks.replace(track, 7, POINT)
    assert (tracks.slots["a"], tracks.names, tracks.sort("a")) == (7, {7: "a"}, "point")
    sorts, wanted = tracks.sorts_of(frozenset([RAY.kind, "point"]), 8)
    assert np.flatnonzero(wanted[sorts]).tolist() == [7]


def test_two_that_are_one_have_all_observations_of_both_and_the_fewer_misses_in_a_row() -> None:
    tracks = tracks_of("a", "b", "c", "d")
    tracks.note_scan(["a", "c"])
    tracks.note_scan(["b", "d"])
    kept, gone = tracks.confirmed["a"], tracks.confirmed["b"]
    kept.observations, kept.seen, kept.absent, kept.missed, kept.last = 10, 4, 1.5, 3.0, (7, "r")
    gone.observations, gone.seen, gone.absent, gone.missed, gone.last = 5, 2, 0.25, 0.5, (9, "r")
    tracks.merge(kept, gone)
    assert (kept.observations, kept.seen, kept.absent, kept.missed, kept.last) == (15, 6, 1.75, 0.5, (9, "r"))
    tracks.remove("b")
    assert kept.covisible == {"a", "c", "d"}
    assert tracks.confirmed["d"].covisible == {"a", "d"}


def test_observations_that_are_used_are_counted_of_landmarks_of_the_map_only() -> None:
    tracks = tracks_of("a", "b")
    tracks.count(["a", "r", "z", "a", "b"], [True, True, True, True, False], (5, "r"))
    assert {name: track.last for name, track in tracks.confirmed.items()} == {"a": (5, "r"), "b": (0, "")}
    assert {name: track.observations for name, track in tracks.confirmed.items()} == {"a": 3, "b": 1}


def test_landmarks_of_one_scan_are_covisible_and_the_most_recent_are_last() -> None:
    names = [f"l{k}" for k in range(20)]
    tracks = tracks_of(*names)
    tracks.note_scan(names[:2])
    tracks.note_scan(names[1:3])
    assert [tracks.confirmed[name].covisible for name in names[:3]] == [{*names[:2]}, {*names[:3]}, {*names[1:3]}]
    assert tracks.recent == ["l0", "l1", "l2"]
    for name in names[3:]:
        tracks.note_scan([name])
    assert tracks.recent == names[-RECENT - 1 :], "beside those of the last scan so many"


def test_what_was_learned_counts_nine_tenths_from_scan_to_scan() -> None:
    tracks = Tracks(["r"])
    for _ in range(200):
        tracks.count_reobserved(3.0)
    assert tracks.experience == pytest.approx(3.0 / (1 - 0.9))
    tracks.count_reobserved(0.0)
    assert tracks.experience == pytest.approx(30.0)


def test_invented_names_avoid_those_in_use_and_those_of_the_log() -> None:
    tracks = tracks_of("u1")
    tracks.tentative["u3"] = Track("u3", POINT)
    tracks.reserve(["u2", "x", None, 5, "u04"])
    tracks.known.add("u5", POINT, np.zeros(2))
    assert tracks.reserved == {"u2", "u04"}
    assert [tracks.new_name() for _ in range(3)] == ["u4", "u6", "u7"]
    told = {name: tracks.is_invented(name) for name in ("u1", "u2", "u9", "u", "ux", "x", 5)}
    assert told == {"u1": True, "u2": False, "u9": True, "u": False, "ux": False, "x": False, 5: False}


def test_a_tentative_landmark_gives_its_name_to_one_of_the_log() -> None:
    tracks = tracks_of()
    one, other = Track("u1", POINT), Track("u2", POINT)
    tracks.unnamed, tracks.tentative = 2, {"u1": one, "u2": other}
    tracks.rename_tentative(["u1", None])
    assert (one.id, other.id) == ("u3", "u2")
    assert tracks.tentative == {"u2": other, "u3": one}


def test_all_that_is_pending_is_told_with_ids_or_without() -> None:
    tracks, key = tracks_of(), ("r", "eye")
    named, loose = Pending(key, "a"), Pending(key)
    tracks.pending["a"], tracks.candidates[key] = Track("a", POINT, pending=named), [loose]
    tracks.pending["b"] = Track("b", POINT)
    assert [*tracks.waiting()] == [named, loose]


def test_names_are_grouped_by_the_model_that_observes_them_points_first() -> None:
    tracks, channel = tracks_of("a", "b"), eye(km.sensors.Bearing(0.01), RAY, POINT)
    tracks.confirm(Track("ray", RAY, 5))
    tracks.confirm(Track("wall", WALL, 6))
    tracks.enter_block("s", 7, robot=True)
    tracks.known.add("post", POINT, np.ones(2))
    names = ["ray", "a", "wall", "r", "b", "s", "post"]
    groups = tracks.by_model(channel, names, "r")
    found = {model.landmark.kind: which for model, which in groups}
    assert [*found.items()] == [("point", [1, 4, 5]), (RAY.kind, [0])], "neither a wall nor the robot itself"
    assert [which for _, which in tracks.known_by_model(channel, names)] == [[6]]
    assert {i for _, which in tracks.any_by_model(channel, names[:1] + names[-1:]) for i in which} == {0, 1}
    assert tracks.by_model(channel, ["wall"]) == []
    assert tracks.observable(channel) == ["a", "b", "ray"]
    assert tracks.only_model(channel) is None
    assert tracks_of("a").only_model(channel) is channel.models["point"]


def test_a_channel_has_the_gate_of_its_innovations_and_what_its_sensor_finds() -> None:
    quantiles = {1: 6.6, 2: 9.2}
    ranging = Channel(km.sensors.RangeBearing(0.1, 0.02), np.zeros(3), -1, POINT, quantiles.__getitem__, [POINT])
    assert (ranging.dof, ranging.gate, ranging.gives_places, ranging.starts_landmarks) == (2, 9.2, True, True)
    bearing = Channel(km.sensors.Bearing(0.02), np.zeros(3), -1, RAY, quantiles.__getitem__, [RAY])
    assert (bearing.dof, bearing.gate, bearing.gives_places, bearing.starts_landmarks) == (1, 6.6, False, True)
    radio = Channel(km.sensors.Range(0.1), np.zeros(3), -1, POINT, quantiles.__getitem__, [POINT])
    assert (radio.dof, radio.gives_places, radio.starts_landmarks) == (1, False, False)
    assert math.isinf(Channel(radio.sensor, np.zeros(3), -1, POINT, lambda dof: math.inf, [POINT]).gate)


def test_what_follows_from_the_records_of_a_file_is_computed_anew() -> None:
    right = tracks_of("a", "b")
    right.confirm(Track("w", WALL, 3))
    again = Tracks(["r"])
    again.confirmed, again.slots, again.changes = right.confirmed, dict(right.slots), 7
    again.number()
    assert (again.names, again.sorts, again.slots, again.changes) == (right.names, right.sorts, right.slots, 7)


def test_a_record_of_a_file_is_refused_for_its_counts_and_its_extent_alone() -> None:
    for track in (Track("a", POINT, 1), Track("w", WALL, 1, extent=np.zeros(2))):
        track.restored()
    for broken in (Track("a", POINT, 1, observations=-1), Track("w", WALL, 1, extent=np.zeros(3))):
        with pytest.raises(MapError, match="has the counts"):
            broken.restored()
