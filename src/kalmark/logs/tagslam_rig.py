"""TagSLAM's files of the scene: bodies and their tags (tagslam.yaml), cameras and where they sit."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from kalmark.errors import LogError
from kalmark.logs.log import Array
from kalmark.logs.rig import mapping, vector_frame
from kalmark.logs.text import nanoseconds

LENSES = {"equidistant": "equidistant", "radtan": "radtan", "plumb_bob": "radtan"}
COEFFICIENTS = {"equidistant": 4, "radtan": 5}
MAX_HAMMING = 2


@dataclass
class Scene:
    """Hold what tagslam.yaml says: sizes (m) of tags, that of all others (None: they are ignored), which body is which.

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
    odometry: dict[str, dict[str, Any]] = field(default_factory=dict)
    pixel_noise: float = 1.0

    def size(self, tag: int) -> float | None:
        """Return the size (m) of a tag, None if it is not to be used."""
        return None if tag in self.ignored else self.sizes.get(tag, self.other_size)

    def max_hamming(self, tag: int) -> int:
        """Return how many corrected bits a detection of this tag may have."""
        return self.hamming.get(self.body_of.get(tag, self.default_body), MAX_HAMMING)


def read_scene(path: Path) -> Scene:
    """Return the scene in tagslam.yaml.  Raises LogError if something in it is not as TagSLAM wants it."""
    content = mapping(path)
    try:
        scene = Scene(default_body=content.get("default_body", ""))
        scene.pixel_noise = float(content.get("tagslam_parameters", {}).get("pixel_noise", 1.0))
        for entry in content["bodies"]:
            for name, body in entry.items():
                add_body(scene, name, body)
        for entry in content.get("squash", []):
            t_ns = nanoseconds(str(entry["time"]))
            scene.squashed.update((t_ns, int(tag)) for tag in entry["tags"])
    except KeyError as error:
        raise LogError(f"{path}: no {error.args[0]!r} where it is needed, expected a file of TagSLAM") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise LogError(f"{path}: {error}, expected a file of TagSLAM") from None
    return scene


def add_body(scene: Scene, name: str, body: dict[str, Any]) -> None:
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


def frame_of(pose: dict[str, Any]) -> Array:
    """Return the frame (7,) of a pose as TagSLAM writes it: position and rotation vector, child in parent."""
    parts = [[float(pose[part][axis]) for axis in "xyz"] for part in ("position", "rotation")]
    return vector_frame(*parts)


def read_cameras(folder: Path) -> tuple[dict[str, dict[str, Any]], dict[str, Array]]:
    """Return the cameras of cameras.yaml, and the poses in their body of those in camera_poses.yaml."""
    path = folder / "cameras.yaml"
    cameras, poses_path = mapping(path), folder / "camera_poses.yaml"
    poses = mapping(poses_path) if poses_path.is_file() else {}
    for name, camera in cameras.items():
        for key in ("intrinsics", "distortion_model", "distortion_coeffs", "resolution", "tagtopic", "rig_body"):
            if key not in camera:
                raise LogError(f"{path}: {name} has no {key}, expected a camera of TagSLAM")
        if camera["distortion_model"] not in LENSES:
            known = ", ".join(LENSES)
            raise LogError(f"{path}: {name}: distortion_model is {camera['distortion_model']!r}, expected {known}")
    try:
        return cameras, {name: frame_of(entry["pose"]) for name, entry in poses.items()}
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"{poses_path}: {error!r}, expected poses with position and rotation") from None


def described_camera(camera: dict[str, Any], mount: dict[str, float], pixel_noise: float) -> dict[str, Any]:
    """Return the section of one camera that sees tags."""
    fx, fy, cx, cy = map(float, camera["intrinsics"])
    lens = LENSES[camera["distortion_model"]]
    coefficients = [float(c) for c in camera["distortion_coeffs"]]
    width, height = map(int, camera["resolution"])
    return {
        "type": "tag_corners",
        "fx_px": fx,
        "fy_px": fy,
        "cx_px": cx,
        "cy_px": cy,
        "width_px": width,
        "height_px": height,
        "lens": lens,
        "distortion": coefficients + [0.0] * (COEFFICIENTS[lens] - len(coefficients)),
        "sigma_px": pixel_noise,
        "mount": mount,
    }
