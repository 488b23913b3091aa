"""The page ``docs/configuration.md``, made from the model: ``python -m kalmark.config.documentation > FILE``."""

from __future__ import annotations

import ast
import inspect
import math
import sys
import textwrap
from collections.abc import Collection, Iterable
from itertools import pairwise
from typing import Any

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from kalmark.config import detectors, landmarks, models, mounting, schema
from kalmark.config.sections import LATER, Section, members

UNITS = {
    "_mps_per_sqrt_s": "m/s/sqrt(s)",
    "_radps_per_sqrt_s": "rad/s/sqrt(s)",
    "_m_per_sqrt_s": "m/sqrt(s)",
    "_rad_per_sqrt_s": "rad/sqrt(s)",
    "_per_m": "1/m",
    "_mps": "m/s",
    "_radps": "rad/s",
    "_rad": "rad",
    "_deg": "deg",
    "_px": "px",
    "_m": "m",
    "_s": "s",
    "r_max": "m",
}

HEAD = """\
# Configuration

*Made from the model by `python -m kalmark.config.documentation`; a test keeps it in step.*

A configuration is a YAML 1.2 file.  `kalmark run CONFIG` takes a path or one of the shipped names ({names}).  A key
that is left out has the default given here; an unknown key or a bad value is refused with file, line, column, the
value, what was expected and the nearest key.  `--set a.b=value` overrides one key from the command line, `--log PATH`
the log; another `type` replaces its whole section, but for a mount; what no robot of the log takes is refused.
The `config.yaml` that a run leaves in its folder holds everything that was in force, and can be run again;
its title is then the folder's name.
`kalmark config native > mine.yaml` prints a shipped one to start from.

```yaml
log: {{path: my_log}}
robots:
  each:
    motion: {{type: unicycle, sigma_v_mps: 0.05, sigma_w_radps: 0.1}}
    sensors:
      lidar: {{type: range_bearing, sigma_range_m: 0.1, sigma_bearing_rad: 0.02, mount: {{x_m: 0.3}}}}
association: {{type: identity}}
estimator: {{type: invariant}}
```

A log may describe its own rig: a recording its camera, a data set its calibration and the noise of its sensors.  Then
a key that is left out, in any section here, has the log's value, and a section may hold single keys without its `type`;
another `type` than the log's drops what the log says of that section, but for a mount.  `each` here stands for the
robots that have no entry of their own.

Lengths are metres, angles radians (degrees in keys that end in `_deg`), times seconds.  Robots move in the plane or in
space, as their `motion` says, all robots of a log in the same; mounts and starts have other keys in each.  A control's
noise is either the error of the control held over its interval (`sigma_v_mps`: the displacement's error is sigma times
the duration) or a random walk (`..._per_sqrt_s`), which acts while the robot is told to move.  A gate is the
probability with which a right observation is let through:
0.9973 is the 3 sigma of one dimension; `default` is the estimator's own (`ekf`: squared distance below 9; the others:
no gate).
"""


def page() -> str:
    """Return the page as Markdown."""
    names = ", ".join(f"`{name}`" for name in _shipped())
    parts = [HEAD.format(names=names), _section("The file", schema.Config)]
    parts += [_section("`log`", schema.LogConfig), _section("`robots.NAME`", schema.RobotConfig)]
    parts += [_section("`robots.NAME.start`, in the plane", mounting.StartConfig)]
    parts += [_section("`robots.NAME.start`, in space", mounting.SpaceStartConfig)]
    parts += [_choice("`robots.NAME.motion`", models.Motion, "motion")]
    parts += [_section("`robots.NAME.sensors.SENSOR`", mounting.Mounted)]
    parts += [_choice("`robots.NAME.sensors.SENSOR`, in the plane", models.PlaneSensor, None, mounting.PlaneMounted)]
    parts += [_choice("`robots.NAME.sensors.SENSOR`, in space", models.SpaceSensor, "sensor", mounting.SpaceMounted)]
    parts += [_choice("`robots.NAME.sensors.SENSOR.detector`", detectors.Detector, None)]
    parts += [_section("`robots.NAME.sensors.SENSOR.mount`, in the plane", mounting.MountConfig)]
    parts += [_choice("`robots.NAME.sensors.SENSOR.initialization`, in the plane", mounting.Initialization, None)]
    parts += [_section("`robots.NAME.sensors.SENSOR.mount`, in space", mounting.SpaceMountConfig)]
    parts += [_choice("`landmarks`, and `landmark` of a sensor", landmarks.Landmark, "landmark")]
    parts += [_choice("`association`, also of a sensor", landmarks.Association, "association")]
    parts += [_section("`upkeep`, also of a sensor", mounting.UpkeepConfig)]
    parts += [_choice("`estimator`", schema.Estimator, "estimator")]
    parts += [_section("`map`", schema.MapConfig) + _later("map")]
    return "\n".join(parts)


def _shipped() -> list[str]:
    from kalmark.config.reading import shipped_configs

    return [*shipped_configs()]


def _section(title: str, model: type[BaseModel]) -> str:
    return f"## {title}\n\n{inspect.getdoc(model)}\n\n{_table(model)}\n"


def _choice(title: str, choice: Any, kind: str | None, common: type[BaseModel] = Section) -> str:
    """Return the sections of a choice; keys that all have by inheritance from `common` are left out."""
    parts = [f"## {title}\n"]
    for name, model in members(choice).items():
        table = _table(model, without=set(common.model_fields))
        parts.append(f"**`type: {name}`**  {inspect.getdoc(model)}\n" + (f"\n{table}\n" if table else ""))
    return "\n".join(parts) + (_later(kind) if kind else "")


def _later(kind: str) -> str:
    names = ", ".join(f"`{name}`" for name in LATER[kind])
    return f"\nNot available yet: {names}.\n" if names else ""


def _table(model: type[BaseModel], without: Collection[str] = ()) -> str:
    rows = [
        f"| `{name}` | {_default(field)} | {_unit(name)} | {text} |"
        for name, field, text in ((n, f, _texts(model).get(n, "")) for n, f in model.model_fields.items())
        if text and name not in without
    ]
    return "\n".join(["| key | default | unit | meaning |", "|---|---|---|---|", *rows]) if rows else ""


def _default(field: Any) -> str:
    value = field.get_default(call_default_factory=True)
    if value is None or value is PydanticUndefined:
        return ""
    if isinstance(value, BaseModel):
        kind = getattr(value, "type", None)
        return f"`{{type: {kind}}}`" if kind else "see below"
    if isinstance(value, dict):
        return "`{" + ", ".join(f"{key}: {{}}" for key in value) + "}`"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    if isinstance(value, float):
        return "`.inf`" if math.isinf(value) else "2 pi" if value == 2 * math.pi else f"`{value:g}`"
    return f"`{value}`"


def _unit(name: str) -> str:
    return next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")


def _texts(model: type[BaseModel]) -> dict[str, str]:
    """Return the text that stands below each field in the source, inherited ones included."""
    out: dict[str, str] = {}
    for cls in reversed([c for c in model.__mro__ if issubclass(c, BaseModel) and c.__module__.startswith("kalmark")]):
        body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
        assert isinstance(body, ast.ClassDef)
        out |= dict(_pairs(body.body))
    return out


def _pairs(body: list[ast.stmt]) -> Iterable[tuple[str, str]]:
    for field, text in pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            assert isinstance(text.value, ast.Constant)
            yield field.target.id, str(text.value.value)


if __name__ == "__main__":
    sys.stdout.write(page())
