"""Read a test of TagSLAM: corners of AprilTags in a ROS 1 bag, YAML files of the scene, and TagSLAM's own batch result.

Detections become scans of the cameras (four corners and the tag's size), odometry, where there is some, increments
from scan to scan.  The reference bag gives the path of the rig and the tags, to score against.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.errors import LogError
from kalmark.events import Event, Scan, order
from kalmark.logs.log import Array, Log
from kalmark.logs.rig import placed
from kalmark.logs.ros import find_bag, messages, stamp
from kalmark.logs.source import Format, Request, choice, quantity
from kalmark.logs.tagslam_odometry import Odometry, read_odometry
from kalmark.logs.tagslam_reference import Reference, read_reference
from kalmark.logs.tagslam_rig import Scene, described_camera, read_cameras, read_scene

ROBOT = "rig"
FILES = ("tagslam.yaml", "cameras.yaml", "camera_poses.yaml", "tag_detections.bag", "tag_detections.bag.bz2")
CORNERS = ("u1_px", "v1_px", "u2_px", "v2_px", "u3_px", "v3_px", "u4_px", "v4_px", "size_m")
INCREMENT = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")
MOTION = {"type": "constant_velocity_3d", "sigma_v_mps_per_sqrt_s": 0.3, "sigma_w_radps_per_sqrt_s": 0.3}
VELOCITY = {"sigma_v_mps": 0.5, "sigma_w_radps": 0.5}
MOUNT_SIGMAS = {"sigma_position_m": 0.05, "sigma_rotation_deg": 3.0}  # of a camera whose pose is not given
LATE_NS = 1_000_000_000
"""The log begins where the reference does, if that is within this time of the first detection."""


def find(path: Path) -> Path | None:
    """Return the folder of a test, given it or one of its files."""
    folder = path if path.is_dir() else path.parent
    if path.is_file() and path.name not in FILES:
        return None
    return folder if all((folder / name).is_file() for name in FILES[:2]) else None


@dataclass
class Detections:
    """Gather scans, and count by its reason what is left out of them."""

    scene: Scene
    left_out: Counter[str] = field(default_factory=Counter)

    def scans(self, received: list[tuple[str, Any]], cameras: dict[str, str]) -> list[Scan]:
        """Return the scans of the cameras, by topic, in order of time."""
        mine = ((cameras.get(topic.lstrip("/")), message) for topic, message in received)
        return sorted((self.scan(camera, message) for camera, message in mine if camera), key=order)

    def scan(self, camera: str, message: Any) -> Scan:
        """Return the scan of one message: corners in TagSLAM's order, and the size of each tag."""
        t_ns, y = stamp(message), []
        ids: list[int] = []
        for tag in message.apriltags:
            id_, size = int(tag.id), self.scene.size(int(tag.id))
            reason = self.refusal(tag, t_ns, size, ids)
            if reason:
                self.left_out[reason] += 1
                continue
            y.append([c for corner in tag.corners for c in (corner.x, corner.y)] + [size])
            ids.append(id_)
        return Scan(t_ns=t_ns, robot=ROBOT, sensor=camera, y=y, ids=ids)

    def refusal(self, tag: Any, t_ns: int, size: float | None, ids: list[int]) -> str:
        """Return why a detection is left out, "" if it is not."""
        if size is None:
            return f"detections of tag {tag.id}, which is of no body"
        if (t_ns, tag.id) in self.scene.squashed:
            return "detections that tagslam.yaml squashes"
        if tag.hamming > self.scene.max_hamming(tag.id):
            return f"detections with more than {self.scene.max_hamming(tag.id)} corrected bits"
        return f"detections of tag {tag.id} twice in one image" if tag.id in ids else ""


def read(
    path: Path, request: Request, tag_size_m: Any = None, cameras: Any = "all", odometry: Any = "auto",
    sigma_px: Any = None,
) -> Log:  # fmt: skip
    """Return the log of a test.

    `tag_size_m` is the size of the tags whose own size tagslam.yaml does not give (None: its default);
    `cameras="given"` leaves out those without a pose in camera_poses.yaml; `odometry="none"` does without it;
    `sigma_px` is the noise of a corner's coordinate (None: the `pixel_noise` of tagslam.yaml).
    """
    scene = read_scene(path / "tagslam.yaml")
    if tag_size_m is not None:
        scene.other_size = quantity(tag_size_m, "tag_size_m", 1e-6)
    if sigma_px is not None:
        scene.pixel_noise = quantity(sigma_px, "sigma_px", 1e-6)
    bag = find_bag(path, "tag_detections")
    if bag is None:
        raise LogError(f"{path}: no tag_detections.bag or tag_detections.bag.bz2, expected one of them")
    known, poses = read_cameras(path)
    reference = read_reference(path, scene, rig_body(path, known))
    guesses = reference.cameras if choice(cameras, "cameras", ("all", "given")) == "all" else {}
    mounts = {name: mount(name, poses, guesses) for name in known}
    for name in [name for name in known if mounts[name] is None]:
        request.skipped.append(f"{path / 'cameras.yaml'}: {name}, whose pose on the rig is not given")
    sections = {
        name: described_camera(known[name], where, scene.pixel_noise) for name, where in mounts.items() if where
    }
    received = messages(bag)
    detections = Detections(scene)
    scans = detections.scans(received, {str(known[name]["tagtopic"]).lstrip("/"): name for name in sections})
    for reason, count in sorted(detections.left_out.items()):
        request.leave_out(count, f"{bag}: {count} {reason}")
    moved = read_odometry(scene, received) if choice(odometry, "odometry", ("auto", "none")) == "auto" else None
    scans = begin(path, scans, reference, moved, request)
    events: list[Event] = [*scans, *(moved.controls(ROBOT, scans) if moved else [])]
    return Log(
        name=path.name,
        format="tagslam",
        path=path,
        robots=(ROBOT,),
        events=sorted(events, key=order),
        truth={ROBOT: reference.path} if reference.path is not None else {},
        landmarks=reference.tags,
        skipped=request.skipped,
        control_columns={ROBOT: INCREMENT} if moved else {},
        sensor_columns={(ROBOT, name): CORNERS for name in sections},
        describes={"robots": {ROBOT: robot(sections, reference, scans, moved)}, "landmarks": {"type": "tag"}},
    )


def rig_body(path: Path, cameras: dict[str, dict[str, Any]]) -> str:
    """Return the one body that carries the cameras."""
    bodies = sorted({str(camera["rig_body"]) for camera in cameras.values()})
    if len(bodies) != 1:
        raise LogError(f"{path / 'cameras.yaml'}: cameras on {', '.join(bodies) or 'no body'}, expected one body")
    return bodies[0]


def mount(name: str, poses: dict[str, Array], guesses: dict[str, Array]) -> dict[str, float] | None:
    """Return where a camera sits: as given, or at a guess, uncertain and so calibrated, or None."""
    if name in poses:
        return placed(poses[name])
    return placed(guesses[name]) | MOUNT_SIGMAS if name in guesses else None


def begin(path: Path, scans: list[Scan], reference: Reference, moved: Odometry | None, request: Request) -> list[Scan]:
    """Return the scans from the first that saw something, where the reference and the odometry have begun."""
    first = next((scan.t_ns for scan in scans if len(scan.y)), None)
    if first is None:
        raise LogError(f"{path}: no tag was seen, expected detections")
    low, high = first, scans[-1].t_ns
    if reference.path is not None and first < reference.path.t_ns[0] <= first + LATE_NS:
        low = int(reference.path.t_ns[0])
    if moved is not None:
        low, high = max(low, int(moved.t_ns[0])), min(high, int(moved.t_ns[-1]))
    kept = [scan for scan in scans if low <= scan.t_ns <= high]
    lost = sum(len(scan.y) > 0 for scan in scans) - sum(len(scan.y) > 0 for scan in kept)
    if lost:
        request.leave_out(lost, f"{path}: {lost} scans before the reference or outside the odometry")
    return kept


def robot(
    sections: dict[str, dict[str, Any]], reference: Reference, scans: list[Scan], moved: Odometry | None
) -> dict[str, Any]:
    """Return the section of the rig, which starts where the reference has it."""
    start: dict[str, Any] = {}
    if reference.path is not None:
        pose = reference.path.at(scans[0].t_ns)
        start = placed(pose) if np.isfinite(pose).all() else {}
    if moved is not None:
        return {"motion": {"type": "odometry_3d"}, "sensors": sections} | ({"start": start} if start else {})
    return {"motion": dict(MOTION), "start": start | VELOCITY, "sensors": sections}


TAGSLAM = Format("tagslam", "a folder with tagslam.yaml, cameras.yaml and tag_detections.bag", find, read,
                 options=("tag_size_m", "cameras", "odometry", "sigma_px"))  # fmt: skip
