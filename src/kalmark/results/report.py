"""``report.html``: one file that shows a run, with everything it needs inside."""

from __future__ import annotations

import html
import json
from importlib import resources
from typing import Any

from kalmark.results.calibration import MOUNT_COLUMNS, mount_rows
from kalmark.results.evaluate import headline, summary_of
from kalmark.results.files import config_yaml
from kalmark.results.recording import Recording
from kalmark.results.series import change_rows, reasons, series
from kalmark.results.words import BATCH, MORE, ROBOT, TOTALS, header, in_words

_ROBOT = (
    ("scans", "scans", ""),
    ("path_m", "path", "m"),
    *ROBOT,
    ("pose_nees_world", "in world coordinates", ""),
    *(row for row in TOTALS if row[0] in ("fix_median_m", "fix_rms_10m", "fix_within_10m")),
    ("diverged", "diverged", ""),
)


_HINTS = {
    False: "3-sigma ellipses; drag the slider through time",
    True: "3-sigma ellipsoids; drag to turn, scroll to come closer, drag the slider through time",
}


def report_html(run: Recording) -> str:
    """Return the page: the map over time, errors, NEES and NIS, associations, figures and configuration."""
    title, figures = headline(run)
    summary = summary_of(run)
    return _resource("report.html").format(
        title=html.escape(title),
        style=_resource("report.css"),
        figures="".join(f"<span>{html.escape(figure)}</span>" for figure in figures),
        robots=robot_table(summary),
        summary=summary_table(summary),
        warnings="".join(f"<li>{html.escape(line)}</li>" for line in summary.get("warnings", ())),
        advice="".join(f"<li>{html.escape(line)}</li>" for line in summary.get("advice", ())),
        mounts=_mounts(summary),
        reasons=_table(reasons(run), ("outcome", "reason", "observations")),
        changes=_changes(run),
        skipped=_skipped(run, summary),
        config=html.escape(config_yaml(run.config)),
        plotly=_plotly(),
        data=json.dumps(series(run), allow_nan=False, separators=(",", ":")).replace("</", "<\\/"),
        scene=_resource("scene.js"),
        script=_resource("report.js"),
        hint=_HINTS[run.history.in_space],
    )


def robot_table(summary: dict[str, Any]) -> str:
    """Return the table of the figures of each robot."""
    robots = summary["robots"]
    columns = [row for row in _ROBOT if any(row[0] in figures for figures in robots.values())]
    rows = [(name, *(show(f.get(key), unit) for key, _, unit in columns)) for name, f in robots.items()]
    return _table(rows, ("robot", *(header(label, unit) for _, label, unit in columns)))


def summary_table(summary: dict[str, Any]) -> str:
    """Return the table of all other figures in words; under the mouse, each tells its key in ``summary.json``."""
    figures = dict(_flat(summary))
    words = [*TOTALS, *MORE, *((f"batch.{key}", f"batch solution: {label}", unit) for key, label, unit in BATCH)]
    others = [name for name, value in summary.items() if isinstance(value, dict) and "ate_raw_m" in value]
    words += [(f"{name}.{key}", f"{name}: {label}", unit) for name in others for key, label, unit in ROBOT]
    rows = "".join(
        f'<tr title="{html.escape(key)}"><td{" class=part" if label.startswith(" ") else ""}>'
        f"{html.escape(label.strip())}</td><td>{html.escape(show(value, unit))}</td><td>{unit}</td></tr>"
        for key, label, value, unit in in_words(figures, tuple(words))
    )
    return f"<table>{rows}</table>"


def show(value: Any, unit: str = "") -> str:
    """Return a figure as it is printed: four significant digits, a dash for what is not there; a share in per cent."""
    if value is None:
        return "–"  # noqa: RUF001 - a dash
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        value = 100.0 * value if unit == "%" else value
        return f"{value:,.4g}" if 1e-3 <= abs(value) < 1e5 or value == 0 else f"{value:.3e}"
    if isinstance(value, list):
        return ", ".join(show(item, unit) for item in value)
    return str(value)


def _flat(summary: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = []
    for key, value in summary.items():
        if (key in ("robots", "warnings", "advice") and not prefix) or key == "directions":
            continue
        out += _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(prefix + key, value)]
    return out


def _table(rows: list[Any], head: tuple[str, ...] = ()) -> str:
    if not rows:
        return ""
    top = "<tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in head) + "</tr>" if head else ""
    body = "".join("<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table>{top}{body}</table>"


def _mounts(summary: dict[str, Any]) -> str:
    rows = mount_rows(summary)
    return f"<h2>Mounts that calibrate themselves</h2>{_table(rows, MOUNT_COLUMNS)}" if rows else ""


def _changes(run: Recording) -> str:
    rows = [*change_rows(run)]
    head = ("t (s)", "landmark", "", "why")
    return f"<h2>Landmarks merged and removed</h2>{_table(rows, head)}" if rows else ""


def _skipped(run: Recording, summary: dict[str, Any]) -> str:
    lines = ([f"stopped: {run.stopped}"] if run.stopped else []) + run.skipped
    if not lines:
        return ""
    shown = "\n".join(html.escape(line) for line in lines[:200])
    return f"<h2>Left out <small>{summary['skipped']}</small></h2><pre>{shown}</pre>"


def _resource(name: str) -> str:
    return (resources.files("kalmark.results") / "page" / name).read_text(encoding="utf-8")


def _plotly() -> str:
    from plotly.offline import get_plotlyjs  # slow to import

    return str(get_plotlyjs())
