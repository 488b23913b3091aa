"""Calibrations of cameras, as OpenCV, Kalibr, ROS, EuRoC and ORB-SLAM write them in YAML.

=========  ================================================================  =======================================
from       intrinsics                                                        distortion, mount
=========  ================================================================  =======================================
OpenCV     `camera_matrix`, an `!!opencv-matrix`; the head `%YAML:1.0`       `distortion_coefficients`, `fisheye_model`
ROS        `camera_matrix`: {data: 9 numbers}                                `distortion_model`, {data: ...}
Kalibr     `cam0`: {`intrinsics`: [fu, fv, pu, pv]}                          `distortion_coeffs`, `T_cam_imu`
EuRoC      `intrinsics`: [fu, fv, cu, cv]                                    `distortion_coefficients`, `T_BS`
ORB-SLAM   `Camera.fx`, `Camera.fy`, ...; or FX, FY, CX, CY at any depth     `Camera.k1`, ...; with a DX: Tsai's
=========  ================================================================  =======================================
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kalmark.arrays import Array
from kalmark.errors import LogError
from kalmark.events import short_text
from kalmark.geometry.named_poses import describe_pose
from kalmark.logs.log import Section
from kalmark.logs.source import frame, number_of_text, read_mapping, spelling_hint

INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px")
LENSES = {
    "radtan": "radtan", "radial-tangential": "radtan", "plumb_bob": "radtan", "rational_polynomial": "radtan",
    "pinhole": "radtan", "equidistant": "equidistant", "fisheye": "equidistant", "kannalabrandt8": "equidistant",
    "fov": "fov", "none": "radtan",
}  # fmt: skip
"""By the names that the programs have for them, in small letters."""
COEFFICIENTS = {"radtan": 5, "equidistant": 4, "fov": 1}
PINHOLES = (None, "pinhole", "kannalabrandt8")  # of `camera_model` and `Camera.type`
DEEPEST = 3


def lens(model: str, coefficients: Sequence[float]) -> Section:
    """Return the keys of a lens, by the name that programs have for it.  Raises ValueError: value and expectation."""
    name, d = LENSES.get(model.lower()), [float(each) for each in coefficients]
    if name is None:
        raise ValueError(f"distortion_model is {short_text(model)}, expected one of {', '.join(LENSES)}")
    most = COEFFICIENTS[name]
    if any(d[most:]):
        raise ValueError(f"distortion is {short_text(d)}, expected at most the {most} coefficients of {name}")
    d = d[:most]
    return {"lens": name, "distortion": d + [0.0] * (4 - len(d)) if name == "radtan" and any(d) else d}


def read_calibration(path: Path, camera: str | None = None) -> Section:
    """Return a calibration as the keys of a `pinhole`: intrinsics, size, lens, distortion and, if known, the mount.

    `camera` names one of several in the file.  Raises LogError: file, key, value and what was expected.
    """
    found = dict(_cameras(read_mapping(path), ""))
    if camera is not None and camera not in found:
        hint = spelling_hint(camera, found)
        raise LogError(
            f"{path}: no camera {camera!r}, expected one of {', '.join(filter(None, found)) or 'none'}{hint}"
        )
    if not found:
        raise LogError(
            f"{path}: no calibration of a camera, expected camera_matrix, intrinsics, or fx, fy, cx, cy of OpenCV, "
            "ROS, Kalibr or EuRoC"
        )
    if camera is None and len(found) > 1:
        raise LogError(f"{path}: the cameras {', '.join(found)}, expected the name of one of them")
    return _Calibration(path, found[next(iter(found)) if camera is None else camera]).section()


def _cameras(content: Section, name: str, depth: int = 0) -> Iterator[tuple[str, Section]]:
    """Yield the cameras of a file by their names; keys are in small letters, without ORB-SLAM's `Camera.`."""
    own = {str(key).lower().removeprefix("camera.").removeprefix("camera1."): value for key, value in content.items()}
    if {"camera_matrix", "intrinsics", "fx"} & own.keys():
        yield name, own
        return
    for key, below in content.items() if depth < DEEPEST else ():
        if isinstance(below, dict):
            yield from _cameras(below, str(key), depth + 1)


class _Calibration:
    """One camera of a file."""

    def __init__(self, path: Path, content: Section) -> None:
        self.path, self.content = path, content

    def section(self) -> Section:
        """Return the keys of the camera."""
        model = self.word("camera_model") or self.word("type")
        if model not in PINHOLES:
            raise self.error("camera_model", model, "pinhole")
        k = self.intrinsics()
        section: Section = dict(zip(INTRINSICS, k, strict=True)) | self.size() | self.lens(k)
        mount = self.mount()
        return section if mount is None else section | {"mount": describe_pose(mount)}

    def intrinsics(self) -> list[float]:
        """Return fx, fy, cx, cy."""
        if "camera_matrix" in self.content:
            K = self.numbers("camera_matrix", (9,))
            if K[1] or K[3] or K[6:] != [0, 0, 1]:
                raise self.error("camera_matrix", K, "fx 0 cx, 0 fy cy, 0 0 1")
            k = [K[0], K[4], K[2], K[5]]
        elif "intrinsics" in self.content:
            k = self.numbers("intrinsics", (4,))
        else:
            k = [self.one(name) for name in ("fx", "fy", "cx", "cy")]
        if not (k[0] > 0 and k[1] > 0):
            raise self.error("focal lengths", k[:2], "numbers > 0")
        return k

    def size(self) -> dict[str, int]:
        """Return width and height, {} if the file does not have them."""
        if "resolution" in self.content:
            pair = self.numbers("resolution", (2,))
        else:
            names = (("image_width", "image_height"), ("width", "height"), ("pixelsx", "pixelsy"))
            there = next((n for n in names if {*n} <= self.content.keys()), None)
            pair = [self.one(name) for name in there] if there else []
        if any(value != int(value) or value < 1 for value in pair):
            raise self.error("image size", pair, "whole numbers above 0")
        return dict(zip(("width_px", "height_px"), map(int, pair), strict=False))

    def lens(self, k: list[float]) -> Section:
        """Return the lens and its distortion."""
        given = self.word("distortion_model") or self.word("type") or ("fisheye" if self.fisheye() else "radtan")
        name = next((n for n in ("distortion_coefficients", "distortion_coeffs") if n in self.content), None)
        if given == "none":
            d = []
        elif name is not None:
            d = self.numbers(name, range(15))
        else:
            names = ("k1", "k2", "k3", "k4") if LENSES.get(given) == "equidistant" else ("k1", "k2", "p1", "p2", "k3")
            d = [self.one(n) if n in self.content else 0.0 for n in names]
        if "dx" in self.content:  # Tsai: coefficients in powers of mm
            f2 = k[0] * self.one("dx") * k[1] * self.one("dy")
            return {"lens": "tsai", "distortion": [d[0] * f2, d[1] * f2 * f2]}
        try:
            return lens(given, d)
        except ValueError as error:
            raise LogError(f"{self.path}: {error}") from None

    def fisheye(self) -> bool:
        """Return whether OpenCV's flag states a fish-eye lens."""
        return "fisheye_model" in self.content and self.one("fisheye_model") != 0

    def mount(self) -> Array | None:
        """Return the pose (7,) of the camera in the body's frame, None if the file does not have it."""
        for name, inverted in (("t_bs", False), ("t_imu_cam", False), ("t_cam_imu", True)):
            if name not in self.content:
                continue
            T = np.array(self.numbers(name, (16,))).reshape(4, 4)
            R, t = T[:3, :3], T[:3, 3]
            if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0 or T[3].tolist() != [0, 0, 0, 1]:
                raise self.error(name, T.tolist(), "a rigid transformation")
            return frame(-R.T @ t, R.T) if inverted else frame(t, R)
        return None

    def word(self, key: str) -> str | None:
        """Return a text in small letters."""
        value = self.content.get(key)
        return None if value is None else str(value).lower()

    def one(self, key: str) -> float:
        """Return a number, quoted or not."""
        value = self.content.get(key)
        try:
            return number_of_text(str(value))
        except ValueError:
            raise self.error(key, value, "a finite number") from None

    def numbers(self, key: str, sizes: Sequence[int]) -> list[float]:
        """Return so many numbers: a list, the `data` of a matrix, or its rows."""
        given = self.content[key]
        given = given.get("data") if isinstance(given, dict) else given
        flat = (
            [v for row in given for v in (row if isinstance(row, list) else [row])] if isinstance(given, list) else []
        )
        try:
            out = [number_of_text(str(value)) for value in flat]
        except ValueError:
            out = []
        if not isinstance(given, list) or len(out) != len(flat) or len(out) not in sizes:
            raise self.error(key, given, f"{sizes[0]} finite numbers" if len(sizes) == 1 else "finite numbers")
        return out

    def error(self, key: str, value: Any, wanted: str) -> LogError:
        """Return the error of a value that should have been something else."""
        return LogError(f"{self.path}: {key} is {short_text(value)}, expected {wanted}")
