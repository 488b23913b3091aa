"""Picture: the options of all drawings of a map, as a section of a configuration and as arguments of `km.draw`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Literal

from kalmark.declare import Positive, Values, Within, refuse, register

COLOURED = (
    *("landmarks", "others", "lines", "truth", "measured"),
    *("landmarks_used", "others_used", "landmarks_predicted", "others_predicted"),
)


@register("picture", "picture")
class Picture:
    """Content and view of the drawings of a map: map.png, the page, videos, `km.draw` and `kalmark view`."""

    view: Annotated[
        Literal["normal", "top", "side", "front", "self", "orbit"] | tuple[float, float],
        Within(),
        "Of space: in perspective, from above, along y, along x, from behind the robot, turning in videos and on the "
        "page; or [elevation, azimuth] of the eye, deg.",
    ] = "normal"
    limits_m: Annotated[
        tuple[float, ...] | None,
        Within(),
        "Box to draw: [x_min, x_max, y_min, y_max], in space with z_min, z_max; all of the map if absent.",
    ] = None
    width_px: Annotated[
        float | None,
        Within(gt=0),
        "Width of map.png, of the figure of `km.draw` and of rerun's window; by default their own.",
    ] = None
    sensor_width_px: Annotated[
        float | None, Within(gt=0), "Width of the pictures of sensors, on the page too; by default their own."
    ] = None
    format: Annotated[
        Literal["png", "svg", "pdf"], Within(), "Map and pictures of sensors are also written in this format."
    ] = "png"
    robot: Annotated[
        Literal["dart", "box", "disc"], Within(), "Shape of the drawn robots; in space their cameras are drawn, too."
    ] = "dart"
    ellipses: Annotated[
        Literal["shape", "world", "off"],
        "Ellipses of the shape of the map, in the world with the start's uncertainty, or none.",
    ] = "shape"
    sigmas: Annotated[Positive, "Size of the ellipses."] = 3.0
    labels: Annotated[bool | None, "Names at the landmarks; in space, of up to 40 of them, if absent."] = None
    truth: Annotated[bool, "Draw the true robots, paths and landmarks, where they are known."] = True
    sensors: Annotated[bool, "Draw the cameras of the robots, and the last scan."] = True
    colours: Annotated[
        Mapping[str, str] | None,
        Values(),
        "Colours, as matplotlib names them, of a robot by its name, and of `landmarks`, `others` (landmarks of space "
        "that are not Euclidean), `lines` and `truth`; in pictures of sensors of `measured`, and of the expectations "
        "`landmarks_used`, `others_used`, `landmarks_predicted` and `others_predicted`.",
    ] = None

    def __post_init__(self) -> None:
        limits = self.limits_m
        if limits is not None and (
            len(limits) not in (4, 6) or any(a >= b for a, b in zip(limits[::2], limits[1::2], strict=True))
        ):
            raise refuse(self, "limits_m", "4 or 6 numbers, each minimum below its maximum")
        if self.colours:
            from matplotlib.colors import is_color_like  # matplotlib is slow to import

            if odd := [name for name, colour in self.colours.items() if not is_color_like(colour)]:
                raise refuse(self, "colours", f"a colour of matplotlib for {odd[0]}: red, tab:blue, #1f5fa8, ...")

    def check_colours(self, robots: Iterable[str]) -> None:
        """Raise ModelError if a colour is of nothing that is drawn: neither of a kind of things nor of these robots."""
        known = (*COLOURED, *robots)
        if odd := [name for name in self.colours or () if name not in known]:
            raise refuse(self, "colours", f"colours of {', '.join(known)}, not of {odd[0]}")

    def colour(self, what: str, usual: str) -> str:
        """Return the colour of a robot or of a kind of things, by default the usual one."""
        return (self.colours or {}).get(what, usual)


USUAL = Picture()
