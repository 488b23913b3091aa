"""The page ``docs/configuration.md``, made from the model: ``python -m kalmark.config.documentation > FILE``."""

from __future__ import annotations

import ast
import inspect
import itertools
import math
import sys
import textwrap
from contextlib import suppress
from functools import cache
from typing import Any

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from kalmark.config import schema
from kalmark.config.reading import shipped_configs
from kalmark.config.sections import BASES, Section, section_of
from kalmark.declare import classes, is_own, unit_of
from kalmark.logs import known_formats
from kalmark.plugins import entry_points_of, load

HEAD = """\
# Configuration

*Made from the model by `python -m kalmark.config.documentation`; a test keeps it in step.*

A configuration is a YAML 1.2 file.  `kalmark run CONFIG` takes a path or one of the shipped names ({names}).  A key
that is left out has the default given here; an unknown key or a bad value is refused with file, line, column, the
value, what was expected and the nearest key.  `--set a.b=value` overrides one key from the command line, `--log PATH`
the log; another `type` replaces its whole section, but for a mount; what no robot of the log takes is refused.
Models of your own, registered in a Python file by `kalmark.register`, are types like kalmark's own once that file is
among the `plugins`: a path beside the configuration.  **This runs the code of that file**, each time the configuration
is read: name only files that you trust.  A class without a name is named by its file, `mine:Class`,
and so is an object, such as a sensor of `km.pointwise`: `mine:sonar`.
The keys of a class that is no dataclass are the arguments of its constructor; a run keeps those that it stores
under their names.
A section that is a `type` alone may be written as that: `estimator: ekf`.
The `config.yaml` that a run leaves in its folder holds everything that was in force, and can be run again;
its title is then the folder's name.  The notes of a run recorded in Python state
everything that its `config.yaml` lacks, as a log without a file.
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
another `type` than the log's drops the log's values of that section, but for a mount.

`robots.each` holds for every robot, `sensors.each` for every sensor of the log.  An entry with a name beside it is laid
over it, key by key; so is `--set` of a name that has no entry, and `--set` of `each` is set for all of them.

Lengths are metres, angles radians (degrees in keys that end in `_deg`), times seconds.  Robots move in the plane or in
space, by their `motion`, all robots of a log in the same; mounts and starts have other keys in each.  A control's
noise is either the error of the control held over its interval (`sigma_v_mps`: the displacement's error is sigma times
the duration) or a random walk (`..._per_sqrt_s`), which acts while the control is not zero.  A gate is the
probability with which a right observation is let through:
0.9973 is the 3 sigma of one dimension; `default` is the estimator's own (`ekf`: squared distance below 9; the others:
no gate).
"""


def page() -> str:
    """Return the page as Markdown."""
    of_sensor = "`robots.NAME.sensors.SENSOR"
    keys = (f"| `{key}` | {load('keys', key).__doc__} |" for key in entry_points_of("keys"))
    parts = [
        HEAD.format(names=", ".join(f"`{n}`" for n in shipped_configs())),
        _section("The file", schema.Config),
        _section("`log`", schema.LogConfig),
        _options(),
        _choice("`log.topics.TOPIC`, of a bag", "topic"),
        _section("`robots.NAME`", schema.RobotConfig),
        _section("`robots.NAME.start`, in the plane", schema.StartConfig),
        _section("`robots.NAME.start`, in space", schema.SpaceStartConfig),
        _choice("`robots.NAME.motion`", "motion"),
        _section(f"{of_sensor}`", schema.Mounted),
        "\n".join(("Keys of plug-ins:\n\n| key | meaning |\n|---|---|", *keys, "")),
        _section(f"{of_sensor}`, in the plane, too", schema.PlaneMounted, schema.Mounted),
        _section(f"{of_sensor}`, in space, too", schema.SpaceMounted, schema.Mounted),
        _choice(f"{of_sensor}`, in the plane", "sensor", "plane"),
        _choice(f"{of_sensor}`, in space", "sensor", "space"),
        _choice(f"{of_sensor}.detector`", "detector"),
        _section(f"{of_sensor}.mount`, in the plane", schema.MountConfig),
        _choice(f"{of_sensor}.initialization`", "initialization"),
        _section(f"{of_sensor}.mount`, in space", schema.SpaceMountConfig),
        _section(f"{of_sensor}.attention`", section_of("attention", "attention")),
        _choice("`landmarks`, and `landmark` of a sensor", "landmark"),
        _choice("`association`, also of a sensor", "association"),
        _section("`upkeep`, also of a sensor", section_of("upkeep", "upkeep")),
        _section(f"{of_sensor}.classes`", section_of("classes", "classes")),
        _choice("`estimator`", "estimator"),
        _section("`map`", schema.MapConfig),
        _section("`map.landmarks`, each", schema.KnownConfig),
        _section("`picture`", section_of("picture", "picture")),
    ]
    return "\n".join(parts)


def _section(title: str, model: type[BaseModel], common: type[BaseModel] = Section) -> str:
    prose = str(inspect.getdoc(model)).partition("\n\n>>>")[0]
    return f"## {title}\n\n{prose}\n\n{_table(model, common)}\n"


def _options() -> str:
    """Return the options of the formats of logs, each beside the defaults of its reader."""
    declared = [(entry.name, option) for entry in known_formats().values() for option in entry.options.values()]
    rows = [f"| `{o.name}` | {name} | {_value(o.default)} | {o.unit} | {o.text} |" for name, o in declared]
    head = "## `log`, by format\n\nOptions of one format each.\n\n| key | format | default | unit | meaning |\n"
    return head + "\n".join(["|---|---|---|---|---|", *rows, ""])


def _choice(title: str, role: str, world: str = "") -> str:
    """Return the sections of a role; keys that all have are left out."""
    parts = [f"## {title}\n"]
    for name, models in classes(role, world).items():
        if any(map(is_own, models)):
            model = section_of(role, name, world)
            table = _table(model, BASES.get((role, world), Section))
            parts.append(f"**`type: {name}`**  {inspect.getdoc(model)}\n" + (f"\n{table}\n" if table else ""))
    return "\n".join(parts)


def _table(model: type[BaseModel], common: type[BaseModel] = Section) -> str:
    said = {name: field.description for name, field in model.model_fields.items()} | _texts(model)
    rows = [
        f"| `{name}` | {_value(field.get_default(call_default_factory=True))} | {unit_of(name)} | {said[name]} |"
        for name, field in model.model_fields.items()
        if said[name] and name not in common.model_fields
    ]
    return "\n".join(["| key | default | unit | meaning |", "|---|---|---|---|", *rows]) if rows else ""


@cache
def _texts(section: type) -> dict[str, str]:
    """Return the text below each key in the source of a section: pydantic would read it each time kalmark starts."""
    texts = {key: text for base in reversed(section.__bases__) for key, text in _texts(base).items()}
    with suppress(OSError, TypeError):  # it has no source: made of a declaration
        body = ast.parse(textwrap.dedent(inspect.getsource(section))).body[0].body  # type: ignore[attr-defined]
        for key, text in itertools.pairwise(body):
            if isinstance(key, ast.AnnAssign) and isinstance(text, ast.Expr):
                texts[key.target.id] = inspect.cleandoc(text.value.value)  # type: ignore[attr-defined, union-attr]
    return texts


def _value(value: Any) -> str:
    if value is None or value is PydanticUndefined:
        return ""
    if isinstance(value, BaseModel):
        kind = value.model_dump().get("type")
        return f"`{{type: {kind}}}`" if kind else "see below"
    if isinstance(value, dict):
        return "`{" + ", ".join(f"{key}: {{}}" for key in value) + "}`"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    if isinstance(value, float):
        return "`.inf`" if math.isinf(value) else "2 pi" if value == 2 * math.pi else f"`{value:g}`"
    return f"`{value}`"


if __name__ == "__main__":
    sys.stdout.write(page())
