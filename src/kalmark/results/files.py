"""The plain files of a run folder: TUM trajectories, ``associations.csv``, ``changes.csv``, ``config.yaml``."""

from __future__ import annotations

import csv
import io
import math
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from kalmark.errors import RunError
from kalmark.results.describe import plain
from kalmark.results.history import History
from kalmark.results.truth import fitted

ASSOCIATIONS = ("t_s", "robot", "sensor", "index", "id", "outcome", "landmark", "d2", "reason")
CHANGES = ("t_s", "robot", "landmark", "change", "into", "reason")


def seconds(t_ns: int) -> str:
    """Return nanoseconds as seconds with nine decimals, exactly (a float would lose up to 256 ns)."""
    whole, rest = divmod(abs(int(t_ns)), 1_000_000_000)
    return f"{'-' if t_ns < 0 else ''}{whole}.{rest:09d}"


def tum(history: History, robot: str) -> str:
    """Return a robot's path after each of its scans as TUM lines: t x y z qx qy qz qw."""
    mine = history.robot == robot
    lines = ["# t_s x_m y_m z_m qx qy qz qw"]
    poses = fitted(history.poses[mine], 7).tolist()
    for t_ns, (x, y, z, *q) in zip(history.t_ns[mine].tolist(), poses, strict=True):
        lines.append(f"{seconds(t_ns)} {x:.9f} {y:.9f} {z:.9f} " + " ".join(f"{value:.12f}" for value in q))
    return "\n".join(lines) + "\n"


def associations_csv(history: History) -> str:
    """Return one row an observation: when, who, with what, and what became of it.

    Of an observation that was averaged over landmarks, one row each with its weight, which is then a column more.
    """
    times, robots = [seconds(t_ns) for t_ns in history.t_ns.tolist()], history.robot.tolist()
    shares, soft = (
        defaultdict(list),
        (history.share_row.tolist(), history.share_landmark, history.share_weight.tolist()),
    )
    for row, name, weight in zip(*soft, strict=True):
        shares[row].append((name, weight))
    columns = (history.step, history.sensor, history.index, history.id, history.outcome, history.landmark)
    told = zip(*(column.tolist() for column in (*columns, history.d2, history.reason)), strict=True)
    rows = []
    for k, (step, *seen, landmark, d2, reason) in enumerate(told):
        for name, weight in shares.get(k, [(landmark, 1.0)]):
            number = "" if math.isnan(d2) or name != landmark else repr(d2)
            rows.append([times[step], robots[step], *seen, name, number, reason, repr(weight)])
    return _csv((*ASSOCIATIONS, "weight"), rows) if shares else _csv(ASSOCIATIONS, [row[:-1] for row in rows])


def changes_csv(history: History) -> str:
    """Return one row for each landmark that was removed or merged with another: after which scan, and why."""
    rows = [
        [seconds(history.t_ns[c.step]), history.robot[c.step], c.landmark, c.what, c.into, c.reason]
        for c in history.changes
    ]
    return _csv(CHANGES, rows)


def _csv(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([header, *rows])
    return out.getvalue()


def config_yaml(config: dict[str, Any]) -> str:
    """Return the text of ``config.yaml``: everything that was in force, headed by version and seed."""
    out = io.StringIO()
    head = {"version": version("kalmark"), "seed": config.get("seed")}
    _yaml().dump(plain(head | {key: value for key, value in config.items() if key not in head}), out)
    return out.getvalue()


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a saved configuration.  Raises RunError if it is not a mapping."""
    config = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    if not isinstance(config, dict):
        raise RunError(f"{path}: got {type(config).__name__}, expected a mapping of keys")
    return config


def _yaml() -> YAML:
    yaml = YAML()
    yaml.default_flow_style = False
    yaml.representer.add_representer(
        type(None), lambda representer, _: representer.represent_scalar("tag:yaml.org,2002:null", "null")
    )
    return yaml


def file_name(robot: str) -> str:
    """Return a robot's name as part of a file's name."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in robot)


def write(path: Path, text: str) -> None:
    """Write a text file so that it is there completely or not at all."""
    replace_file(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def replace_file(path: Path, writer: Callable[[Path], Any]) -> None:
    """Let `writer` write a temporary file beside `path`, then put it in its place."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        writer(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
