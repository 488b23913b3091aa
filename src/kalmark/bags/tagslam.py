"""Read a test of TagSLAM: corners of AprilTags in a ROS 1 bag, YAML files of the scene, and TagSLAM's own batch result.

Detections become scans of the cameras (four corners and the tag's size), odometry, where there is some, increments
from scan to scan.  The reference bag gives the path of the rig and the tags, to score against.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.bags import messages
from kalmark.bags.bag_opening import Bag, header_time
from kalmark.declare import Within
from kalmark.errors import LogError
from kalmark.events import Control, Event, Scan, sort_key
from kalmark.geometry.frames3d import compose, inverse
from kalmark.geometry.named_poses import describe_pose
from kalmark.geometry.pose_frames import ORIGIN
from kalmark.geometry.rotations import exp, matrix
from kalmark.logs.increments import increment_between
from kalmark.logs.known_map import TAG, KnownLandmark
from kalmark.logs.log import LandmarkPlaces, Log, Section, Trajectory
from kalmark.logs.source import (
    Format,
    Request,
    folder_of,
    nanoseconds_of_text,
    one_robot,
    read_mapping,
)
from kalmark.logs.table_columns import CORNERS, INCREMENT3
from kalmark.vision.camera_calibration import INTRINSICS, lens

ROBOT = "rig"
FILES = ("tagslam.yaml", "cameras.yaml", "camera_poses.yaml", "tag_detections.bag", "tag_detections.bag.bz2")
MOTION = {"type": "constant_velocity_3d", "sigma_v_mps_per_sqrt_s": 0.3, "sigma_w_radps_per_sqrt_s": 0.3}
VELOCITY = {"sigma_v_mps": 0.5, "sigma_w_radps": 0.5}
MOUNT_SIGMAS = {"sigma_position_m": 0.05, "sigma_rotation_deg": 3.0}  # of a camera whose pose is not given
MAX_HAMMING = 2
SIGMA = 0.005
"""Of odometry, m and rad per square root of a second, where none is given: that of test 21 is 0.003."""
Messages = list[tuple[str, Any]]  # topic, message
LATE_NS = 1_000_000_000
"""The log begins where the reference does, if that is within this time of the first detection."""


def find(path: Path) -> Path | None:
    """Return the folder of a test, given it or one of its files."""
    folder = folder_of(path, FILES)
    return folder if folder and all((folder / name).is_file() for name in FILES[:2]) else None


# ------------------------------------------------------------------ the scene
@dataclass
class TagSetup:
    """Content of tagslam.yaml: sizes (m) of tags, that of all others (None: they are ignored), the names of bodies.

    `squashed` are (time in ns, tag) of detections to leave out, `hamming` the most corrected bits by body.
    """

    sizes: dict[int, float] = field(default_factory=dict)
    other_size: float | None = None
    static: dict[str, bool] = field(default_factory=dict)
    body_of: dict[int, str] = field(default_factory=dict)
    default_body: str = ""
    hamming: dict[str, int] = field(default_factory=dict)
    ignored: set[int] = field(default_factory=set)
    squashed: set[tuple[int, int]] = field(default_factory=set)
    odometry: dict[str, Section] = field(default_factory=dict)
    pixel_noise: float = 1.0

    def size(self, tag: int) -> float | None:
        """Return the size (m) of a tag, None if it is not to be used."""
        return None if tag in self.ignored else self.sizes.get(tag, self.other_size)

    def refusal(self, tag: Any, t_ns: int) -> str:
        """Return the reason to leave out a detection, "" without one."""
        if self.size(int(tag.id)) is None:
            return f"detections of tag {tag.id}, which is of no body"
        if (t_ns, tag.id) in self.squashed:
            return "detections that tagslam.yaml squashes"
        most = self.hamming.get(self.body_of.get(tag.id, self.default_body), MAX_HAMMING)
        return f"detections with more than {most} corrected bits" if tag.hamming > most else ""


def read_scene(path: Path) -> TagSetup:
    """Return the scene in tagslam.yaml.  Raises LogError if it does not have the form of TagSLAM."""
    content = read_mapping(path)
    try:
        scene = TagSetup(default_body=content.get("default_body", ""))
        scene.pixel_noise = float(content.get("tagslam_parameters", {}).get("pixel_noise", 1.0))
        for entry in content["bodies"]:
            for name, body in entry.items():
                add_body(scene, name, body)
        for entry in content.get("squash", []):
            t_ns = nanoseconds_of_text(str(entry["time"]))
            scene.squashed.update((t_ns, int(tag)) for tag in entry["tags"])
    except KeyError as error:
        raise LogError(f"{path}: no {error.args[0]!r} where it is needed, expected a file of TagSLAM") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise LogError(f"{path}: {error}, expected a file of TagSLAM") from None
    return scene


def add_body(scene: TagSetup, name: str, body: Section) -> None:
    """Add one body: its own tags, those of its board, the size of all others if it is the default body."""
    scene.static[name] = bool(body["is_static"])
    if "max_hamming_distance" in body:
        scene.hamming[name] = int(body["max_hamming_distance"])
    scene.ignored.update(map(int, body.get("ignore_tags", [])))
    tags = {int(tag["id"]): float(tag.get("size", body.get("default_tag_size"))) for tag in body.get("tags", [])}
    if body.get("type") == "board":
        board = body["board"]
        first, count = int(board["tag_start_id"]), int(board["tag_rows"]) * int(board["tag_columns"])
        tags |= dict.fromkeys(range(first, first + count), float(board["tag_size"]))
    scene.sizes |= tags
    scene.body_of |= dict.fromkeys(tags, name)
    if name == scene.default_body:
        scene.other_size = float(body["default_tag_size"])
    if "odom_topic" in body:
        scene.odometry[name] = body


def frame_of(pose: Section) -> Array:
    """Return the frame (7,) of a pose as TagSLAM writes it: position and rotation vector, child in parent."""
    place, turn = (np.array([float(pose[part][axis]) for axis in "xyz"]) for part in ("position", "rotation"))
    return np.append(place, exp(turn))


def read_cameras(folder: Path) -> tuple[dict[str, Section], dict[str, Array]]:
    """Return the cameras of cameras.yaml, and the poses in their body of those in camera_poses.yaml."""
    path = folder / "cameras.yaml"
    cameras, poses_path = read_mapping(path), folder / "camera_poses.yaml"
    poses = read_mapping(poses_path) if poses_path.is_file() else {}
    for name, camera in cameras.items():
        for key in ("intrinsics", "distortion_model", "distortion_coeffs", "resolution", "tagtopic", "rig_body"):
            if key not in camera:
                raise LogError(f"{path}: {name} has no {key}, expected a camera of TagSLAM")
        try:
            lens(str(camera["distortion_model"]), camera["distortion_coeffs"])
        except (TypeError, ValueError) as error:
            raise LogError(f"{path}: {name}: {error}") from None
    try:
        return cameras, {name: frame_of(entry["pose"]) for name, entry in poses.items()}
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"{poses_path}: {error!r}, expected poses with position and rotation") from None


def described_camera(camera: Section, mount: dict[str, float], pixel_noise: float) -> Section:
    """Return the section of one camera that sees tags."""
    section: Section = {"type": "tag_corners"}
    section |= dict(zip(INTRINSICS, map(float, camera["intrinsics"]), strict=True))
    section |= dict(zip(("width_px", "height_px"), map(int, camera["resolution"]), strict=True))
    section |= lens(camera["distortion_model"], camera["distortion_coeffs"])
    return section | {"sigma_px": pixel_noise, "mount": mount}


# ------------------------------------------------------------------ the survey
def surveyed_tags(path: Path, exact: bool = False) -> list[KnownLandmark]:
    """Return the tags of a tagslam.yaml that have a pose on a static body with a pose, as a known map.

    Their covariances (6, 6) are those of `position_noise` (m) and `rotation_noise` (rad), standard deviations along and
    about the axes of the pose itself: P = T_b P_b T_b' + T_t P_t T_t' for the tag t on the body b.  The correlation of
    tags on one body is not kept.  Those without noise, and with `exact` all, are known exactly.  Raises LogError.
    """
    read_scene(path)
    try:
        bodies = [body for entry in read_mapping(path)["bodies"] for body in entry.values()]
        placed = [(b["pose"], tag) for b in bodies if b["is_static"] and "pose" in b for tag in b.get("tags", [])]
        tags = [
            (int(tag["id"]), frame_of(b), covariance_of_pose(b), frame_of(tag["pose"]), covariance_of_pose(tag["pose"]))
            for b, tag in placed
            if "pose" in tag
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"{path}: {error!r}, expected poses with position and rotation") from None
    if not tags:
        raise LogError(f"{path}: no tag has a pose on a static body with a pose, expected one for a known map")
    found = []
    for name, b, P_b, t, P_t in tags:
        T, T_b, T_t = compose(b, t)
        P = T_b @ P_b @ T_b.T + T_t @ P_t @ T_t.T
        found.append(KnownLandmark(name, T, P if P.any() and not exact else None, TAG))
    return found


def covariance_of_pose(pose: Section) -> Array:
    """Return the covariance (6, 6) of a pose as TagSLAM writes it, of errors in the frame that it is in."""
    none = dict.fromkeys("xyz", 0.0)
    sigmas = [[float(pose.get(f"{part}_noise", none)[axis]) for axis in "xyz"] for part in ("position", "rotation")]
    R, P = matrix(frame_of(pose)[3:]), np.zeros((6, 6))
    P[:3, :3], P[3:, 3:] = (R @ np.diag(np.square(each)) @ R.T for each in sigmas)
    return P


# ------------------------------------------------------------------ the bags
def find_bag(folder: Path, name: str) -> Path | None:
    """Return the bag NAME.bag or NAME.bag.bz2 in a folder; a small text file in its place is a link to another."""
    for path in (folder / f"{name}.bag.bz2", folder / f"{name}.bag"):
        if path.is_file() and (path.suffix == ".bz2" or path.read_bytes()[:9] == b"#ROSBAG V"):
            return path
    link = folder / f"{name}.bag"
    if link.is_file() and link.stat().st_size < 256:
        target = folder / link.read_text(encoding="utf-8", errors="replace").strip()
        if target.parent.resolve() != folder.resolve():
            return find_bag(target.parent, target.name.removesuffix(".bag"))
    return None


def recorded_frame(pose: Any) -> Array:
    """Return the frame (7,) of a geometry_msgs/Pose.  Raises LogError."""
    return messages.frame_of(pose.position, pose.orientation, LogError)


def messages_of_bag(path: Path) -> Messages:
    """Return (topic, message) of everything in a bag, as recorded.  Raises LogError if it cannot be read."""
    with Bag(path) as bag:
        return [(received.topic, received.message) for received in bag.messages(bag.topics)]


# ------------------------------------------------------------------ TagSLAM's own result
class Reference(NamedTuple):
    """Hold the reference in the world: `path` of the rig (None if there is no bag), `tags` and `cameras` by name."""

    path: Trajectory | None
    tags: LandmarkPlaces
    cameras: dict[str, Array]


def read_reference(folder: Path, scene: TagSetup, rig: str) -> Reference:
    """Return the result in reference.bag, in the map's frame; that of the body with the tags if the rig stands still.

    Tags and cameras are taken from the last transforms in the bag.
    """
    bag = find_bag(folder, "reference")
    if bag is None:
        return Reference(None, {}, {})
    world = scene.default_body if scene.static.get(rig) and not scene.static.get(scene.default_body, True) else "map"
    moving = rig if world == "map" else world
    last: dict[tuple[str, str], Array] = {("map", "map"): ORIGIN[7]}
    track: list[tuple[int, Array]] = []
    for topic, message in messages_of_bag(bag):
        if topic == f"/tagslam/odom/body_{moving}":
            track.append((header_time(message), recorded_frame(message.pose.pose)))
        elif topic == "/tf":
            for one in message.transforms:
                frame = messages.frame_of(one.transform.translation, one.transform.rotation, LogError)
                last[one.header.frame_id, one.child_frame_id] = frame
    if world != "map":
        track = [(t_ns, compose(inverse(pose)[0], last["map", rig])[0]) for t_ns, pose in track]
    tags: LandmarkPlaces = {
        int(child.removeprefix("tag_")): pose if parent == world else compose(last["map", parent], pose)[0]
        for (parent, child), pose in last.items()
        if child.startswith("tag_") and (parent == world or (world == "map" and ("map", parent) in last))
    }
    cameras = {child: pose for (parent, child), pose in last.items() if parent == rig and not child.startswith("tag_")}
    path = Trajectory(*map(np.array, zip(*track, strict=True))) if track else None
    return Reference(path, tags, cameras)


# ------------------------------------------------------------------ odometry
class Odometry(NamedTuple):
    """Hold the odometry's `path`, its frame `T` on the rig, and its noise per square root of a second."""

    path: Trajectory
    T: Array
    sigma_m: float
    sigma_rad: float


def read_odometry(scene: TagSetup, received: Messages) -> Odometry | None:
    """Return the odometry of the rig, None if there is none in the bag."""
    for body in scene.odometry.values():
        rows = [(header_time(m), m.pose.pose) for topic, m in received if topic == body["odom_topic"]]
        if rows:
            poses = np.array([recorded_frame(pose) for _, pose in rows])
            sigmas = (float(body.get(f"odom_{what}_noise", SIGMA)) for what in ("translation", "rotation"))
            return Odometry(Trajectory(np.array([t for t, _ in rows]), poses), frame_of(body["T_body_odom"]), *sigmas)
    return None


def rig_increments(moved: Odometry, scans: Sequence[Scan]) -> list[Control]:
    """Return the rig's increments between the times of the scans, on the interpolated path.

    The odometry's frame O moves by D in its own frame, the rig by T D T^-1.  The noise grows with the time.
    """
    t_ns = np.unique([scan.t_ns for scan in scans])
    rig = [compose(pose, inverse(moved.T)[0])[0] for pose in moved.path.at(t_ns, max_gap_s=1e9)]
    u = [increment_between(*pair) for pair in pairwise(rig)]
    N = np.diag(np.square(3 * [moved.sigma_m] + 3 * [moved.sigma_rad]))
    covs = N * (np.diff(t_ns) * 1e-9)[:, None, None]
    return [Control(t_ns=int(t), robot=ROBOT, u=d, cov=cov) for t, d, cov in zip(t_ns[1:], u, covs, strict=True)]


# ------------------------------------------------------------------ the log
def scans_of(received: Messages, cameras: dict[str, str], scene: TagSetup, bag: Path, request: Request) -> list[Scan]:
    """Return the scans of the cameras, by topic, in order of time: corners in TagSLAM's order and the size of each tag.

    Frames that are left out are counted by their reason.
    """
    left_out: Counter[str] = Counter()
    scans = []
    for topic, message in received:
        if topic.lstrip("/") not in cameras:
            continue
        t_ns, seen = header_time(message), dict[int, list[float]]()
        for tag in message.apriltags:
            id_, size = int(tag.id), scene.size(int(tag.id))
            reason = scene.refusal(tag, t_ns)
            if id_ in seen and not reason:
                reason = f"detections of tag {tag.id} twice in one image"
            if reason or size is None:
                left_out[reason] += 1
            else:
                seen[id_] = [c for corner in tag.corners for c in (corner.x, corner.y)] + [size]
        camera = cameras[topic.lstrip("/")]
        scans.append(Scan(t_ns=t_ns, robot=ROBOT, sensor=camera, y=[*seen.values()], ids=[*seen]))
    for reason, count in sorted(left_out.items()):
        request.leave_out(count, f"{bag}: {count} {reason}")
    return sorted(scans, key=sort_key)


def read(
    path: Path,
    request: Request,
    tag_size_m: Annotated[
        float | None, Within(ge=1e-6), "Size of the tags that tagslam.yaml gives none of their own."
    ] = None,
    cameras: Annotated[Literal["all", "given"], "All, or those with a pose in camera_poses.yaml."] = "all",
    odometry: Annotated[Literal["auto", "none"], "Use the odometry of the bag, if it has one."] = "auto",
    sigma_px: Annotated[
        float | None, Within(ge=1e-6), "Noise of a corner's coordinate; the pixel_noise of tagslam.yaml if absent."
    ] = None,
) -> Log:
    """Return the log of a test."""
    scene = read_scene(path / "tagslam.yaml")
    if tag_size_m is not None:
        scene.other_size = tag_size_m
    if sigma_px is not None:
        scene.pixel_noise = sigma_px
    bag = find_bag(path, "tag_detections")
    if bag is None:
        raise LogError(f"{path}: no tag_detections.bag or tag_detections.bag.bz2, expected one of them")
    known, poses = read_cameras(path)
    reference = read_reference(path, scene, rig_body(path, known))
    guesses = reference.cameras if cameras == "all" else {}
    sections = {}
    for name, camera in known.items():
        if name in poses or name in guesses:
            guess = {} if name in poses else MOUNT_SIGMAS  # so calibrated
            where = describe_pose(poses[name] if name in poses else guesses[name]) | guess
            sections[name] = described_camera(camera, where, scene.pixel_noise)
        else:
            request.skipped.append(f"{path / 'cameras.yaml'}: {name}, whose pose on the rig is not given")
    received = messages_of_bag(bag)
    topics = {str(known[name]["tagtopic"]).lstrip("/"): name for name in sections}
    scans = scans_of(received, topics, scene, bag, request)
    moved = read_odometry(scene, received) if odometry == "auto" else None
    scans = begin(path, scans, reference, moved, request)
    events: list[Event] = [*scans, *(rig_increments(moved, scans) if moved else [])]
    rig = {"robots": {ROBOT: robot(sections, reference, scans, moved)}, "landmarks": {"type": "tag"}}
    truth = {ROBOT: reference.path} if reference.path is not None else {}
    columns = dict.fromkeys(sections, CORNERS)
    return one_robot("tagslam", path, request, ROBOT, events, INCREMENT3 if moved else (), columns,
                     name=path.name, truth=truth, landmarks=reference.tags, describes=rig)  # fmt: skip


def rig_body(path: Path, cameras: dict[str, Section]) -> str:
    """Return the one body that carries the cameras."""
    bodies = sorted({str(camera["rig_body"]) for camera in cameras.values()})
    if len(bodies) != 1:
        raise LogError(f"{path / 'cameras.yaml'}: cameras on {', '.join(bodies) or 'no body'}, expected one body")
    return bodies[0]


def begin(path: Path, scans: list[Scan], reference: Reference, moved: Odometry | None, request: Request) -> list[Scan]:
    """Return the scans from the first that saw something, where the reference and the odometry have begun."""
    first = next((scan.t_ns for scan in scans if len(scan.y)), None)
    if first is None:
        raise LogError(f"{path}: no tag was seen, expected detections")
    low, high = first, scans[-1].t_ns
    if reference.path is not None and first < reference.path.t_ns[0] <= first + LATE_NS:
        low = int(reference.path.t_ns[0])
    if moved is not None:
        low, high = max(low, int(moved.path.t_ns[0])), min(high, int(moved.path.t_ns[-1]))
    kept = [scan for scan in scans if low <= scan.t_ns <= high]
    lost = sum(len(scan.y) > 0 for scan in scans) - sum(len(scan.y) > 0 for scan in kept)
    if lost:
        request.leave_out(lost, f"{path}: {lost} scans before the reference or outside the odometry")
    return kept


def robot(sections: dict[str, Section], reference: Reference, scans: list[Scan], moved: Odometry | None) -> Section:
    """Return the section of the rig, which starts where the reference has it."""
    pose = None if reference.path is None else reference.path.at(scans[0].t_ns)
    start: Section = describe_pose(pose) if pose is not None and np.isfinite(pose).all() else {}
    if moved is not None:
        return {"motion": {"type": "odometry_3d"}, "sensors": sections} | ({"start": start} if start else {})
    return {"motion": dict(MOTION), "start": start | VELOCITY, "sensors": sections}


TAGSLAM = Format(
    "tagslam",
    "a folder with tagslam.yaml, cameras.yaml and tag_detections.bag",
    find,
    read,
    known_maps={".yaml": surveyed_tags, ".yml": surveyed_tags},
)
