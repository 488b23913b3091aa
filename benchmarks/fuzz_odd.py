"""Odd files and configurations, each a whole run: `fuzz.py --odd`."""

from __future__ import annotations

import gzip
import itertools
import json
import re
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from fuzz_parts import CONFIG, CONTROLS, SCANS, TABLES, Broken, plain, report, written
from state_digest import digest_of_saved

import kalmark as km
from kalmark.config import build_slam, config_dict, open_run
from kalmark.errors import KalmarkError

CONFIG_NAME = "my.yaml"
VALUES = (b"", b"nan", b"-inf", b"1e999", b"1e999990", b"1e155", b"-1e300", b"9" * 5000, b"0x10", b"x\0y",
          b"\xe2\x85\xa7", b'"', b"<b>&", b"[[1]]")  # fmt: skip
LAUGHS = "\n".join(["a0: &a0 [x, x]", *(f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10))])
DIGITS = "9" * 5000
ODD_CONFIGS = (
    "robots: 5", "robots: {robot: 5}", "robots: {rover: 5}", "robots: [1]", "robots: {5: 5}", "a: &a {b: *a}",
    "robots: &r {rover: *r}", "a: &a [*a, *a]", "? [1, 2]\n: 3", "? [[1]]\n: 3", "? {a: 1}\n: 3", f"x: {DIGITS}",
    f"seed: {DIGITS}", "seed: 1e300", f"upkeep: {{confirm: {DIGITS}}}", f"association: {{gate: {DIGITS[:400]}}}",
    "plugins: [[1]]", "a: 2001-99-99", "a: !!int x", "robots: {rover: {motion: {type: [1]}}}", f"a: {'[' * 2000}",
    "robots: {rover: {sensors: {lidar: {preset: [1], type: range_bearing}}}}", LAUGHS,
    "robots: {rover: {motion: {type: unicycle}, sensors: {lidar: {type: [[1]], sigma_range_m: 1}}}}",
)  # fmt: skip
ODD_RIGS = (
    "robots: 5", "robots: [1]", "robots: {rover: 5}", "robots: {rover: {motion: [1]}}", "[1, 2]", "5: 5",
    "? {a: 1} : 2", "a: &a {b: *a}", "robots: &r {rover: *r}", f"x: {DIGITS}", "a: 2001-99-99", "landmarks: 5",
    LAUGHS, "robots: {rover: {sensors: 5}}", "a: !!python/object:os.system x",
)  # fmt: skip
EQUAL: dict[str, Callable[[bytes], bytes]] = {
    "a mark of the byte order": lambda text: b"\xef\xbb\xbf" + text,
    "ends of lines of Windows": lambda text: text.replace(b"\n", b"\r\n"),
    "no last end of line": lambda text: text.rstrip(b"\n"),
    "semicolons": lambda text: text.replace(b",", b";"),
    "spaces beside the cells": lambda text: text.replace(b",", b" , "),
}
"""Changes of a table that must not change the map, if they are taken."""
WHOLE: dict[str, Callable[[bytes], bytes]] = EQUAL | {
    "empty": lambda text: b"",
    "a header alone": lambda text: text.split(b"\n")[0],
    "two headers": lambda text: text.split(b"\n")[0] + b"\n" + text,
    "a column twice": lambda text: text.replace(b"\n", b",1\n").replace(b",1\n", b",t_s\n", 1),
    "cut in a row": lambda text: text[: -len(text) // 5],
    "zeros": lambda text: bytes(len(text)),
    "UTF-16": lambda text: text.decode().encode("utf-16"),
    "compressed": gzip.compress,
    "a picture": lambda text: b"\x89PNG\r\n\x1a\n" + text,
    "one long line": lambda text: text.replace(b"\n", b",") * 2000,
    "backwards": lambda text: b"\n".join([text.split(b"\n")[0], *text.split(b"\n")[:0:-1]]),
}


def odd_files() -> Iterator[tuple[str, dict[str, bytes], bool]]:
    """Yield what is odd, the odd files, and whether the map must be that of the right ones."""
    for name, texts in TABLES.items():
        if not name.endswith(".csv"):
            continue
        for k, text in enumerate(texts):
            *above, last = text.rstrip(b"\n").split(b"\n")
            comma = b";" if b";" in last else b","
            for column, value in itertools.product(range(last.count(comma) + 1), VALUES):
                cells = last.split(comma)
                cells[column] = value
                rows = b"\n".join([*above, comma.join(cells), b""])
                yield f"{name}, {k}: column {column} is {value[:20]!r}", {name: rows}, False
        yield from ((f"{name}: {told}", {name: change(texts[0])}, told in EQUAL) for told, change in WHOLE.items())
    for at in re.finditer(rb"(?<=: )[^,{}\[\]\n]+", CONFIG):
        for value in VALUES:
            changed = CONFIG[: at.start()] + value + CONFIG[at.end() :]
            yield f"config: {at[0]!r} is {value[:20]!r}", {CONFIG_NAME: changed}, False
    for odd in ODD_CONFIGS:
        yield f"config: {odd[:40]}", {CONFIG_NAME: b"log: {path: log}\n" + odd.encode()}, False
    for odd in ODD_RIGS:
        yield f"rig: {odd[:40]}", {CONFIG_NAME: b"log: {path: log}\n", "rig.yaml": odd.encode()}, False


def saved_run(folder: Path, odd: dict[str, bytes]) -> str:
    """Run a log of which some files are odd, and save the run; return the digest of the map."""
    files = {"controls.csv": CONTROLS, "scans.csv": SCANS, CONFIG_NAME: CONFIG.replace(b"skip", b"raise")} | odd
    config_text = files.pop(CONFIG_NAME)
    written(folder / "log", files)
    (folder / CONFIG_NAME).write_bytes(config_text)
    made, log = open_run(folder / CONFIG_NAME)
    slam = build_slam(made, log)
    run = km.record(slam, log, progress=False, on_error=made.log.on_error, config=config_dict(made))
    run.evaluate()
    out = run.save(folder / "out")
    json.loads((out / "summary.json").read_text())
    if not (out / "map.png").stat().st_size or b"<b>&" in (out / "report.html").read_bytes():
        raise Broken("an empty picture, or an id that is not escaped")
    names = [*slam.robots, *slam.tracks.confirmed]
    P = slam.covariance(*names)
    if not np.isfinite(P).all() or np.linalg.eigvalsh(P)[0] < -1e-9 * max(1.0, float(np.abs(P).max())):
        raise Broken(f"covariance {np.linalg.eigvalsh(P)}")
    return digest_of_saved(slam)


def odd_ones() -> tuple[int, int, int]:
    """Return how many odd files and configurations there were, were taken and broke something."""
    counts = [0, 0, 0]
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        right = saved_run(Path(name), {})
        for told, files, equal in odd_files():
            counts[0] += 1
            try:
                map_ = saved_run(Path(name), files)
                if equal and {*files} <= {"controls.csv", "scans.csv"} and map_ != right:
                    raise Broken("another map")
                counts[1] += 1
            except KalmarkError as error:
                try:
                    plain(error)
                except Broken as broken:
                    counts[2] += report(told, broken)
            except Exception as error:
                counts[2] += report(told, error)
    return counts[0], counts[1], counts[2]
