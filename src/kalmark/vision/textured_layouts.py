"""Layouts of worlds for cameras that give images: planes with random textures, of which these are rendered."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.random import Generator
from pydantic import Field

from kalmark.arrays import Array
from kalmark.declare import Positive, Within
from kalmark.events import Frame
from kalmark.geometry.frames3d import from_euler_pose, from_frame
from kalmark.models.observe import sensor_pose
from kalmark.models.sensors import PixelDepth, Stereo
from kalmark.simulate.layouts import LayoutSection, Scenery, ViewerPose, pose_at_wall
from kalmark.vision.rendering import Rectangle, Renderer, render, rendered_depth, texture

PANEL_M = 0.4, 1.0  # width and height of a panel


def camera_of(planes: list[Rectangle], model: Any, sensing: Any) -> Callable[[Array, int, str, str, int], Frame]:
    """Return what takes the frames of a camera of planes, rendered when their pixels are needed."""
    renderer = Renderer(planes, model)
    sigma = model.sigma_rho_per_m if isinstance(model, PixelDepth) else 0.0

    def frame_at(T: Array, t_ns: int, robot: str, sensor: str, seed: int) -> Frame:
        image = partial(render, renderer, T, seed, sensing.noise_grey, sensing.blur_px)
        depth = partial(rendered_depth, renderer, T, seed + 1, sigma) if sensing.depth else None
        right = None
        if isinstance(model, Stereo):
            beside = sensor_pose(T, np.array([model.baseline_m, 0, 0, 0, 0, 0, 1.0]))[0]
            right = partial(render, renderer, beside, seed + 2, sensing.noise_grey, sensing.blur_px)
        return Frame(t_ns=t_ns, robot=robot, sensor=sensor, image=image, depth=depth, right=right)

    return frame_at


class ListedPlane(ViewerPose):
    """A rectangle with a random texture; its axes are those of a tag."""

    width_m: Positive = 1.0
    """Along x."""
    height_m: Positive = 1.0
    """Along y."""


class _Textured(LayoutSection):
    """Planes with random textures."""

    gives_raw: ClassVar[tuple[str, ...]] = ("pinhole", "pixel_depth", "stereo", "omnidirectional")

    pixel_m: Positive = 0.005
    """A pixel of the textures."""
    per_m2: Positive = 60.0
    """Quadrangles of random grey values in a square metre, 2 to 40 cm wide."""

    def scenery(self, rng: Generator) -> Scenery:
        """Return the planes with random textures."""
        planes = self.textured(rng)
        return Scenery(corners=np.concatenate([p.corners() for p in planes]), raw_of=partial(camera_of, planes))

    def textured(self, rng: Generator) -> list[Rectangle]:
        """Return the planes with random textures."""
        out = []
        for middle, width, height in self.placed(rng):
            drawn = texture(width, height, self.pixel_m, rng, self.per_m2)
            rows, columns = drawn.shape
            corner = np.array([-0.5 * columns * self.pixel_m, -0.5 * rows * self.pixel_m, 0.0])
            pose = middle.copy()
            pose[:3] = from_frame(middle, corner)[0]
            out.append(Rectangle(pose, drawn, self.pixel_m))
        return out

    def placed(self, rng: Generator) -> Iterable[tuple[Array, float, float]]:
        """Return the middles (7,), widths and heights [m] of the planes."""
        raise NotImplementedError


class TexturedPlanes(_Textured):
    """Planes with random textures, for cameras whose images are rendered."""

    type: Literal["textured_planes"] = "textured_planes"
    planes: Annotated[tuple[ListedPlane, ...], Field(strict=False, min_length=1)]
    """Their middles and sizes."""

    def placed(self, rng: Generator) -> Iterable[tuple[Array, float, float]]:
        """Return the middles (7,), widths and heights [m] of the planes."""
        return [(plane.pose(), plane.width_m, plane.height_m) for plane in self.planes]


class TexturedRoom(_Textured):
    """A room with random textures on floor, walls and panels, for cameras whose images are rendered.

    Its south-western corner is the origin.
    """

    type: Literal["textured_room"] = "textured_room"
    length_m: Positive = 6.0
    """From west to east."""
    width_m: Positive = 5.0
    """From south to north."""
    height_m: Positive = 3.0
    """Of the walls."""
    panels: Annotated[int, Within(ge=0)] = 8
    """Upright panels of 0.4 to 1 m, turned at random, up to `panel_depth_m` before a random wall."""
    panel_depth_m: Positive = 1.0
    """The largest distance of a panel from its wall."""

    def placed(self, rng: Generator) -> Iterable[tuple[Array, float, float]]:
        """Return the middles (7,), widths and heights [m] of the floor, the walls and the panels."""
        size, top = (self.length_m, self.width_m), self.height_m
        floor = from_euler_pose(np.array([size[0] / 2, size[1] / 2, 0.0, math.pi, 0.0, 0.0]))[0]
        planes = [(floor, *size)]
        planes += [(pose_at_wall(size, wall, 0.0, 0.0, top / 2), size[1 - wall % 2], top) for wall in range(4)]
        for wall in rng.integers(0, 4, self.panels).tolist():
            width, height = rng.uniform(*PANEL_M, 2).tolist()
            z = rng.uniform(height / 2, max(height, top - height / 2))
            off, y, turned = rng.uniform((0.3, -0.8, -0.6), (1.0, 0.8, 0.6)).tolist()
            planes.append((pose_at_wall(size, wall, self.panel_depth_m * off, y, z, turned), width, height))
        return planes
