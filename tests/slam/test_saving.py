"""Saved maps: they resume bit for bit, want a user's models again, and are refused when damaged."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import kalmark as km
from kalmark.errors import MapError
from kalmark.geometry.spaces import ERROR_SIZE, MEAN_SIZE
from kalmark.tracks.track import Track

CAMERA = {"camera": km.Mount(km.sensors.RangeBearing(0.05, 0.01))}
ESTIMATORS = [km.estimators.Ekf(), km.estimators.Invariant(iterations=3), km.estimators.Fej()]


def robots(**replaced: Any) -> list[km.Robot]:
    """Two robots, of which the second one is lost."""
    models: dict[str, Any] = {"motion": km.motion.Unicycle(), "sensors": CAMERA, **replaced}
    a = km.Robot("a", **models)
    return [a, km.Robot("b", start=(3, 0, 1), cov=np.diag([0.1, 0.1, 0.05]), **models)]


def head(slam: km.Slam, **scan: Any) -> km.Slam:
    """Stop in the middle of the interval of a held control, with landmarks removed and landmarks named u1, u2, ..."""
    for name in "ab":
        slam.process(km.Control(0.0, name, (0.5, 0.1)))
    slam.process(km.Scan(0.4, "a", "camera", [[3.0, 0.0], [2.0, 0.3], [3.0, -1.0], [4.0, 2.0]], ["b", 1, 2, 3]))
    slam.process(km.Scan(0.5, "b", "camera", [[2.0, 1.3], [5.0, -1.0]], ids=scan.get("ids")))
    for name in (3, 1):
        slam.remove(name)
    slam.add_landmark(np.int64(7), (8.0, 8.0), 0.01 * np.eye(2))
    slam.process(km.Scan(0.7, "a", "camera", [[2.9, -1.0]], [2]))
    return slam


def tail(slam: km.Slam) -> None:
    slam.process(km.Scan(1.3, "a", "camera", [[2.8, -1.0], [6.0, 2.5], [1.0, 0.5]], [2, 1, None]))
    slam.process(km.Control(2.0, "a", (0.1, 0.3)))
    slam.process(km.Scan(2.5, "b", "camera", [[1.9, 1.25], [9.0, 0.0]]))
    slam.process(km.Scan(2.5, "a", "camera", [[2.0, 2.25], [2.8, -0.9]], [4, "b"]))


def bits(slam: km.Slam) -> tuple[Any, ...]:
    table = slam.landmarks()
    joint = slam.covariance(*slam.robots, *table.ids)
    means = [slam.mean(name).tobytes() for name in (*slam.robots, *table.ids)]
    m = slam.map
    return means, joint.tobytes(), table.ids, table.observations, m.blocks.tolist(), m.atoms.tolist(), slam.t_ns


@pytest.mark.parametrize("map_", ["dense", "postponed"])
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_robots_in_mid_interval_removed_slots_and_new_names_resume_bit_for_bit(
    estimator: Any, map_: str, tmp_path: Path
) -> None:
    straight = head(
        km.Slam(robots(), km.association.NearestNeighbour(), estimator, map=map_, upkeep=km.Upkeep(confirm=1))
    )
    assert any(moving.error is not None for moving in straight.state.moving.values()), (
        "a held control's error is a block of the map"
    )
    assert straight.map._free, "a slot is free"
    straight.save(tmp_path / "map.kmk")
    resumed, again = km.Slam.load(tmp_path / "map.kmk"), km.Slam.load(tmp_path / "map.kmk", reversed(robots()))
    assert bits(resumed) == bits(straight)
    for slam in (straight, resumed, again):
        tail(slam)
    assert bits(resumed) == bits(again) == bits(straight)
    assert "u3" in straight.landmarks().ids
    assert (resumed.estimator, resumed.association) == (estimator, km.association.NearestNeighbour())


def test_limits_and_parameters_survive_whether_finite_or_not(tmp_path: Path) -> None:
    laser = km.sensors.RangeBearing(0.1, 0.02, sigma_range_rel=0.01, range_min_m=0.5, range_max_m=7.5, fov_rad=1.25)
    sensors = {
        "near": km.Mount(laser, at=(0.1, 0.2, 0.3)),
        "far": km.Mount(km.sensors.Range(np.float64(0.3), range_min_m=1.5)),
    }
    motion = km.motion.Ackermann(2.5, 0.4, sigma_along_m_per_sqrt_s=0.01)
    slam = km.Slam([km.Robot("car", motion, sensors=sensors)], estimator=km.estimators.Invariant(np.int64(2)))  # type: ignore[arg-type]
    slam.save(tmp_path / "map.kmk")
    back = km.Slam.load(tmp_path / "map.kmk")
    car = back.robots["car"]
    assert car.motion == motion
    assert {name: mount.sensor for name, mount in car.sensors.items()} == {n: m.sensor for n, m in sensors.items()}
    assert car.sensors["far"].sensor.range_max_m == float("inf")  # type: ignore[attr-defined]
    assert car.sensors["near"].at.tolist() == [0.1, 0.2, 0.3]
    assert back.estimator == km.estimators.Invariant(2)


# ---------------------------------------------------------------------- a user's own models
@dataclass(frozen=True)
class Tree(km.landmarks.Point2D):
    kind: ClassVar[str] = "tree"


@dataclass(frozen=True)
class Picky(km.association.ByIdentity):
    pass


@dataclass(frozen=True)
class Mine(km.estimators.Ekf):
    pass


@dataclass(frozen=True)
class Cart(km.motion.Unicycle):
    pass


def slam_of_trees(landmarks: Any) -> km.Slam:
    slam = km.Slam(robots(), landmarks=landmarks)
    return head(slam, ids=["oak", "elm"])


def test_the_type_of_landmark_is_restored(tmp_path: Path) -> None:
    sensor = km.pointwise(lambda v: v, np.eye(3), inverse=lambda y: y)
    rover = [km.Robot("rover", km.motion.Unicycle(), sensors={"nose": km.Mount(sensor)})]
    slam = km.Slam(rover, landmarks=km.landmarks.PointSignature2D())
    slam.save(tmp_path / "map.kmk")
    back = km.Slam.load(tmp_path / "map.kmk", rover)
    back.process(km.Scan(0, "rover", "nose", [[1.0, 2.0, 5.0]], [1]))
    assert back.landmarks().kinds == ["point_signature"]
    np.testing.assert_allclose(back.mean(1), [1, 2, 5])


def test_a_users_type_of_landmark_is_wanted_again_and_works(tmp_path: Path) -> None:
    straight = slam_of_trees(Tree())
    straight.save(tmp_path / "map.kmk")
    with pytest.raises(MapError, match=r"map\.kmk: landmarks is Tree, .* give the landmarks to load"):
        km.Slam.load(tmp_path / "map.kmk")
    with pytest.raises(MapError, match="landmarks is PointSignature2D, expected Tree"):
        km.Slam.load(tmp_path / "map.kmk", landmarks=km.landmarks.PointSignature2D())
    resumed = km.Slam.load(tmp_path / "map.kmk", landmarks=Tree())
    assert resumed.landmarks().kinds == ["tree"] * 4
    assert [m.kind for m in (channel.landmark for channel in resumed.state.channels.values())] == ["tree", "tree"]
    for slam in (straight, resumed):
        slam.process(km.Scan(1.3, "a", "camera", [[2.8, -1.0], [6.0, 2.5]], [2, 1]))
    assert bits(resumed) == bits(straight)


def test_a_single_landmark_of_a_users_type_is_wanted_again(tmp_path: Path) -> None:
    slam = km.Slam(robots())
    slam.add_landmark("oak", (1, 2), landmark=Tree())
    slam.save(tmp_path / "map.kmk")
    with pytest.raises(MapError, match=r"of_kind\.tree\.model is Tree, .* give the landmarks to load"):
        km.Slam.load(tmp_path / "map.kmk")
    assert km.Slam.load(tmp_path / "map.kmk", landmarks=Tree()).landmarks().kinds == ["tree"]


def test_a_mounts_own_type_of_landmark_comes_with_the_robots(tmp_path: Path) -> None:
    sensors = {"camera": km.Mount(km.sensors.RangeBearing(), landmark=Tree())}
    slam = km.Slam(robots(sensors=sensors))
    slam.process(km.Scan(0, "a", "camera", [[2.0, 0.3]], [1]))
    slam.save(tmp_path / "map.kmk")
    with pytest.raises(MapError, match=r"robots\.a\.sensors\.camera\.landmark is Tree, .* give the robots to load"):
        km.Slam.load(tmp_path / "map.kmk")
    assert km.Slam.load(tmp_path / "map.kmk", robots(sensors=sensors)).landmarks().kinds == ["tree"]


@pytest.mark.parametrize(("argument", "model"), [("association", Picky(0.5)), ("estimator", Mine())])
def test_a_users_association_or_estimator_is_wanted_again(argument: str, model: Any, tmp_path: Path) -> None:
    km.Slam(robots(), **{argument: model}).save(tmp_path / "map.kmk")
    with pytest.raises(MapError, match=f"{argument} is {type(model).__name__}, .* give the {argument} to load"):
        km.Slam.load(tmp_path / "map.kmk")
    given: dict[str, Any] = {argument: model}
    assert getattr(km.Slam.load(tmp_path / "map.kmk", **given), argument) is model


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (robots()[:1], r"robots are \['a'\], expected \['a', 'b'\]"),
        ([robots()[0], robots()[0]], r"robots are \['a', 'a'\], expected \['a', 'b'\]"),
        (["a", "b"], "robots holds 'a', expected nothing but robots"),
        ([], r"robots are \[\], expected"),
        (robots(motion=km.motion.Odometry2D()), "robot 'a': motion is odometry_2d, expected unicycle"),
        (robots(motion=Cart()), "robot 'a': motion is test_saving.py:Cart, expected unicycle"),
        (robots(sensors={}), r"robot 'a': sensors are \[\], expected \['camera'\]"),
    ],
)
def test_robots_that_are_not_those_saved_are_refused(given: list[Any], message: str, tmp_path: Path) -> None:
    km.Slam(robots()).save(tmp_path / "map.kmk")
    with pytest.raises(MapError, match=message):
        km.Slam.load(tmp_path / "map.kmk", given)


def test_a_users_motion_whose_control_has_changed_is_refused(tmp_path: Path) -> None:
    @dataclass(frozen=True)
    class Walker(km.motion.Unicycle):
        columns = ("v_mps", "w_radps", "hop_m")

        def control_noise(self, u: np.ndarray) -> np.ndarray:
            return np.eye(len(self.columns))

    km.Slam(robots(motion=Walker())).save(tmp_path / "map.kmk")
    Walker.columns = ("v_mps", "w_radps")  # type: ignore[misc, assignment]
    with pytest.raises(MapError, match=r"columns of the motions are .*, expected .*hop_m"):
        km.Slam.load(tmp_path / "map.kmk", robots(motion=Walker()))


# ---------------------------------------------------------------------- saving
def test_a_failed_save_leaves_what_was_there_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slam, path = head(km.Slam(robots())), tmp_path / "map.kmk"
    slam.save(path)
    before = path.read_bytes()

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(zipfile.ZipFile, "writestr", full)
        with pytest.raises(MapError, match="No space left on device"):
            slam.save(path)
    slam.tracks.enter(Track((1, 2), km.landmarks.Point2D(), slam.slot(7)))  # type: ignore[arg-type]
    with pytest.raises(MapError, match=r"confirmed.* is \(1, 2\), expected an id that is an integer or a text"):
        slam.save(path)
    assert [file.name for file in tmp_path.iterdir()] == ["map.kmk"]
    assert path.read_bytes() == before
    for nowhere in (tmp_path, tmp_path / "none" / "map.kmk", path / "map.kmk"):
        with pytest.raises(MapError, match="expected a file that can be written"):
            km.Slam(robots()).save(nowhere)


def test_ids_and_numbers_of_numpy_are_saved_as_pythons(tmp_path: Path) -> None:
    slam = km.Slam(robots())
    slam.add_landmark(np.int64(7), (1.0, 2.0))  # type: ignore[arg-type]
    slam.add_landmark(np.str_("oak"), (3.0, 4.0))
    slam.save(tmp_path / "map.kmk")
    ids = km.Slam.load(tmp_path / "map.kmk").landmarks().ids
    assert [(type(i), i) for i in ids] == [(int, 7), (str, "oak")]


# ---------------------------------------------------------------------- damage
@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "map.kmk"
    head(km.Slam(robots())).save(path)
    return path


def reseal(path: Path, changed: dict[str, bytes], source: Path) -> None:
    """Write a map with some members changed, and checksums that fit them."""
    with zipfile.ZipFile(source) as archive:
        members = {n: archive.read(n) for n in archive.namelist() if n != "sha256"} | changed
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
        archive.writestr("sha256", "".join(f"{hashlib.sha256(d).hexdigest()}  {n}\n" for n, d in members.items()))


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(8 * len(data)))
    return data[: at // 8] + bytes([data[at // 8] ^ 1 << at % 8]) + data[at // 8 + 1 :]


def assert_consistent(slam: km.Slam) -> None:
    """The rows of the tables lie one behind the other, inside the arrays."""
    m = slam.map
    assert len(m.x) == len(m.x_first) == len(m.P) == m.P.shape[1] >= max(m.n, m.x_n)
    assert len(m.spaces) == len(m.blocks)
    ends = np.cumsum(m.blocks[:, [1, 3, 5]], axis=0)
    np.testing.assert_array_equal(m.blocks[:, [0, 2, 4]], ends - m.blocks[:, [1, 3, 5]])
    assert ends[-1].tolist() == [m.x_n, m.n, len(m.atoms)]
    removed = [slot for slots in m._free.values() for slot in slots]
    assert sorted(removed) == [i for i, space in enumerate(m.spaces) if space is None]
    for (x_at, x_size, p_at, p_size, at, count), space in zip(m.blocks.tolist(), m.spaces, strict=True):
        atoms = m.atoms[at : at + count]
        if space is not None:
            assert tuple(atoms[:, 0]) == space.kinds
            assert sum(MEAN_SIZE[k] for k in space.kinds) == x_size
            assert sum(ERROR_SIZE[k] for k in space.kinds) == p_size
        assert (atoms[:, 1] >= x_at).all() and (atoms[:, 1] < x_at + x_size).all()
        assert (atoms[:, 2] >= p_at).all() and (atoms[:, 2] < p_at + p_size).all()
    owned = [*slam.tracks.slots.values()]
    owned += [moving.error for moving in slam.state.moving.values() if moving.error is not None]
    assert sorted(owned + removed) == list(range(len(m.blocks)))
    for name, robot in slam.robots.items():
        space = m.spaces[slam.tracks.slots[name]]
        assert space is not None and space.kinds == robot.motion.space.kinds
        held = slam.state.moving[name].held
        assert held.u is not None and held.N is not None
        assert held.N.shape == (*held.u.shape, len(robot.motion.columns))


def test_a_map_with_one_bit_flipped_is_refused_or_the_same(saved: Path, tmp_path: Path) -> None:
    rng, whole = np.random.default_rng(1), bits(km.Slam.load(saved))
    data, refused = saved.read_bytes(), 0
    for _ in range(400):
        (tmp_path / "map.kmk").write_bytes(flipped(data, rng))
        try:
            slam = km.Slam.load(tmp_path / "map.kmk")
        except MapError as error:
            assert "map.kmk: " in str(error) and "\n" not in str(error)
            refused += 1
        else:  # the bit was one of a date or an attribute of the zip
            assert bits(slam) == whole
    assert refused > 200


@pytest.mark.parametrize("cut", [0, 1, 30, 0.3, 0.9, 0.999])
def test_a_map_that_is_cut_off_is_refused(cut: float, saved: Path, tmp_path: Path) -> None:
    data = saved.read_bytes()
    (tmp_path / "map.kmk").write_bytes(data[: int(cut * len(data)) if cut < 1 else int(cut)])
    with pytest.raises(MapError, match="expected a map written by save"):
        km.Slam.load(tmp_path / "map.kmk")


@pytest.mark.parametrize("member", ["slam.json", "x.npy", "x_first.npy", "P.npy", "numbers.npy"])
def test_a_bit_flipped_before_the_checksums_were_made_cannot_break_the_tables(
    member: str, saved: Path, tmp_path: Path
) -> None:
    """Whatever is written in the file, compiled code stays inside its arrays."""
    rng, path = np.random.default_rng(2), tmp_path / "map.kmk"
    with zipfile.ZipFile(saved) as archive:
        data = archive.read(member)
    loaded = 0
    for _ in range(400 if member == "slam.json" else 60):
        reseal(path, {member: flipped(data, rng)}, saved)
        try:
            slam = km.Slam.load(path)
        except MapError as error:
            assert "map.kmk: " in str(error) and "\n" not in str(error)
        else:
            assert_consistent(slam)
            loaded += 1
    assert loaded > 0


TABLES: dict[str, tuple[Callable[[dict[str, Any], dict[str, Any]], object], str]] = {
    "a slot outside": (lambda d, _: d["tracks"]["slots"][0].__setitem__(1, 99), "not used once each"),
    "a landmark's slot outside": (
        lambda d, _: d["tracks"]["confirmed"][0][1].update(slot=99),
        "slot of 2 is 99, expected one of 7",
    ),
    "a negative slot": (lambda d, _: d["tracks"]["slots"][0].__setitem__(1, -1), "slot of 'a' is -1"),
    "two in one slot": (
        lambda d, _: d["tracks"]["slots"][0].__setitem__(1, d["tracks"]["slots"][1][1]),
        "not used once each",
    ),
    "a robot in a point's slot": (
        lambda d, _: (d["tracks"]["slots"].__setitem__(0, ["a", 5]), d["tracks"]["confirmed"][0][1].update(slot=0)),
        "its block in the map is",
    ),
    "a removed slot outside": (lambda d, _: d["map"]["free"].append(99), "removed slot is 99"),
    "a slot removed twice": (lambda d, _: d["map"]["free"].append(d["map"]["free"][0]), "removed slot is"),
    "a robot removed": (lambda d, _: d["map"]["free"].append(0), "not used once each"),
    "a bigger block": (lambda d, _: d["map"]["blocks"][0].__setitem__(1, [1, 1]), "x is an array"),
    "an unknown atom": (lambda d, _: d["map"]["blocks"][0].__setitem__(1, [77]), "expected a map written by save"),
    "no capacity": (lambda d, _: d["map"].update(capacity=3), "capacity is 3"),
    "endless capacity": (lambda d, _: d["map"].update(capacity=10**9), "capacity is 1000000000"),
    "a landmark called like a robot": (
        lambda d, _: d["tracks"]["confirmed"].append(["a", d["tracks"]["confirmed"][0][1] | {"id": "a"}]),
        "slots' names",
    ),
    "a landmark without a slot": (
        lambda d, _: d["tracks"]["confirmed"].append([50, d["tracks"]["confirmed"][0][1] | {"id": 50, "slot": -1}]),
        "slot of 50 is -1",
    ),
    "a negative count": (lambda d, _: d["tracks"]["confirmed"][0][1].update(hits=-1), r"2 has the counts .*-1"),
    "candidates of a sensor that is not there": (
        lambda d, _: d["tracks"]["candidates"].append([["a", "nose"], []]),
        "name sensors that no robot has",
    ),
    "no robots": (lambda _, s: s.update(robots=[]), "no attribute 'items', expected a map written by save"),
    "another model": (
        lambda _, s: s["estimator"].update(type="StochasticMap"),
        "estimator: type: got .*, expected one of ekf",
    ),
    "a time that is none": (lambda d, _: d.update(t_ns="now"), "t_ns is 'now'"),
    "a missing table": (lambda d, _: d["tracks"].pop("recent"), "KeyError: 'recent', expected a map written by save"),
}


@pytest.mark.parametrize("name", TABLES)
def test_tables_that_do_not_fit_each_other_are_refused(name: str, saved: Path, tmp_path: Path) -> None:
    spoil, message = TABLES[name]
    with zipfile.ZipFile(saved) as archive:
        description = json.loads(archive.read("slam.json"))
    spoil(description["state"], description["settings"])
    reseal(tmp_path / "map.kmk", {"slam.json": json.dumps(description).encode()}, saved)
    with pytest.raises(MapError, match=message):
        km.Slam.load(tmp_path / "map.kmk")


@pytest.mark.parametrize("version", [1, 8, 16, None])
def test_a_map_of_another_version_is_refused(version: int | None, saved: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        description = json.loads(archive.read("slam.json"))
    changed = json.dumps(description | {"kalmark": version}).encode()
    reseal(tmp_path / "map.kmk", {"slam.json": changed}, saved)
    with pytest.raises(MapError, match=f"version is {version}, expected 24"):
        km.Slam.load(tmp_path / "map.kmk")


def test_a_map_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"none\.kmk: No such file or directory, expected a map"):
        km.Slam.load(tmp_path / "none.kmk")


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 cut off"])
def test_a_file_that_is_no_map_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "map.kmk").write_bytes(content)
    with pytest.raises(MapError, match=r"map\.kmk: .*expected a map written by save"):
        km.Slam.load(tmp_path / "map.kmk")


def test_a_map_is_loaded_by_a_process_that_has_imported_kalmark_alone(tmp_path: Path) -> None:
    km.Slam([km.Robot("r", km.motion.Odometry2D(), sensors={"l": km.Mount(km.sensors.RangeBearing())})]).save(
        tmp_path / "map.kmk"
    )
    told = f"import kalmark as km; print(*km.Slam.load({str(tmp_path / 'map.kmk')!r}).robots)"
    assert subprocess.check_output([sys.executable, "-c", told], text=True).split() == ["r"]
