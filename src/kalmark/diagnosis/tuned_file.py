"""The new configuration of a tuning: the file of the user with other values, its comments and keys as they were."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.scalarfloat import ScalarFloat

from kalmark.config.opening import find_log
from kalmark.config.reading import load_config, resolve_config, shipped_configs
from kalmark.config.tree import parse_value, put, value_at
from kalmark.diagnosis.tune import AIMS, Change, Tuning
from kalmark.results.figure_texts import figure

WIDTH = 120


def new_config(config: str | Path, tuning: Tuning, overrides: Sequence[str] = (), log: Path | None = None) -> str:
    """Return the text of the file of a configuration with the new values, and what each was and by what evidence.

    Overrides are in it, and the path of the log if one is given, or if it is not one that is found by its name.
    """
    source = resolve_config(config)
    shipped = source in shipped_configs().values()
    made = load_config(config, overrides)
    if log is not None or (made.log.path is not None and (not shipped or made.overridden("log", "path"))):
        log = find_log(made, log)
    yaml = YAML(typ="rt", pure=True)
    yaml.width, yaml.preserve_quotes = WIDTH, True
    content = yaml.load(source.read_text(encoding="utf-8"))
    for override in overrides:
        dotted, _, text = override.partition("=")
        path = tuple(part.strip() for part in dotted.split("."))
        _put(content, path, parse_value(text, override))
    if log is not None:
        _put(content, ("log", "path"), str(log))
    beside = source.resolve().parent
    for n, plugin in enumerate(content.get("plugins") or ()):
        content["plugins"][n] = str((beside / str(plugin)).resolve())
    for change in tuning.changes:
        if change.changed:
            owner = _put(content, change.path, change.after)
            _note(owner, change)
    dumped = io.StringIO()
    yaml.dump(content, dumped)
    return _head(source, tuning) + dumped.getvalue()


def _put(content: CommentedMap, path: Sequence[str], value: Any) -> Any:
    """Put a value where it belongs, and return the mapping that has it.  Another type replaces its section."""
    if path[-1] == "type" and (value_at(content, path) or value) != value:
        section = value_at(content, path[:-1])
        for key in [key for key in section if key != "mount"]:
            del section[key]
    return put(content, path, float(value) if isinstance(value, ScalarFloat) else value)


def _note(owner: Any, change: Change) -> None:
    """Add the comment that a value was tuned, before its old comment."""
    key, told = change.path[-1], f"tuned, was {_text(change.before)}"
    if not isinstance(owner, CommentedMap) or owner.fa.flow_style():
        return  # a comment would end the line of a mapping in braces; the head of the file has it
    token = (owner.ca.items.get(key) or [None] * 4)[2]
    if token is None:
        owner.yaml_add_eol_comment(told, key)
        return
    first, newline, rest = token.value.partition("\n")
    old = first.strip().removeprefix("#").strip()
    token.value = f"# {told}{'; ' if old else ''}{old}{newline}{rest}"


def _head(source: Path, tuning: Tuning) -> str:
    """Return the comment that begins the file: how the values came to be."""
    name = source.stem if source in shipped_configs().values() else source.name
    (_, before), (_, after) = tuning.before, tuning.after
    lines = [
        f"{name}, tuned by kalmark by the first {figure(tuning.split_s)} s of the log and judged by the rest:",
        f"NIS per degree of freedom {figure(before.nis)} before, {figure(after.nis)} after; log-likelihood of the"
        f" innovations {after.likelihood - before.likelihood:+.0f}.",
        *(f"  {line}" for line in evidence(tuning)),
        *correlation_lines(tuning),
    ]
    return "".join(f"# {line}\n" for line in lines)


def cells(change: Change) -> tuple[str, ...]:
    """Return a key as the row of a table: key, before, after, known to, gain, why."""
    noise, bound = change.path[-1].startswith("sigma_"), change.why in ("at most", "at least")
    known = f"{figure(100 * change.sigma, 2)} %" if noise else figure(change.sigma, 2)
    sure = known if change.sigma and not bound else ""
    gain = "" if change.gain is None else f"{change.gain:+.0f}"
    return change.key, _text(change.before), _text(change.after), sure, gain, change.why


def evidence(tuning: Tuning) -> list[str]:
    """Return of each key what became of it and why, those that changed first."""
    out = []
    for change in sorted(tuning.changes, key=lambda change: not change.changed):
        key, before, after, sure, gain, why = cells(change)
        if change.changed:
            parts = [why, sure and f"known to {sure}", gain and f"log-likelihood of the rest {gain}"]
            out.append(f"{key}: {before} -> {after} ({'; '.join(filter(None, parts))})")
        else:
            out.append(f"{key}: {before} as it was ({why})")
    return out


def correlation_lines(tuning: Tuning) -> list[str]:
    """Return lines about errors that are correlated from observation to observation."""
    if not tuning.correlations:
        return []
    told = ", ".join(f"{name} {figure(rho, 2)}" for name, rho in tuning.correlations.items())
    first = f"Errors are correlated from one observation to the next ({told})."
    if tuning.aim == AIMS[1]:
        return [first, "The noise is increased until it carries as little information; the innovations are smaller."]
    factor = figure(tuning.sigma_factor, 2)
    return [first, f"This noise fits the innovations; the sigmas of the map are {factor} times as large as it states.",
            "kalmark tune --aim map finds a noise without this."]  # fmt: skip


def _text(value: Any) -> str:
    return repr(value) if isinstance(value, float) else str(value)
