"""Damages to the cache of compiled code, which must not change a map: `fuzz.py --caches N`."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fuzz_parts import report
from state_digest import digest_of_saved
from storm import events, robots

import kalmark as km

DAMAGES: dict[str, Callable[[bytes, np.random.Generator, bytes], bytes]] = {
    "empty": lambda code, random, other: b"",
    "cut": lambda code, random, other: code[: random.integers(len(code))],
    "cut by one": lambda code, random, other: code[:-1],
    "a bit": lambda code, random, other: flipped(code, int(random.integers(len(code)))),
    "a bit of the head": lambda code, random, other: flipped(code, int(random.integers(min(64, len(code))))),
    "a hole": lambda code, random, other: code[: len(code) // 3] + bytes(len(code) // 3) + code[2 * len(code) // 3 :],
    "zeros": lambda code, random, other: bytes(len(code)),
    "noise": lambda code, random, other: random.bytes(len(code)),
    "twice": lambda code, random, other: code + code,
    "a text": lambda code, random, other: b"not code\n",
    "another file": lambda code, random, other: other,
    "half of another file": lambda code, random, other: code[: len(code) // 2] + other[len(other) // 2 :],
}
GONE = "gone", "a folder"


def flipped(code: bytes, at: int) -> bytes:
    """Return a file with one bit changed."""
    return code[:at] + bytes([code[at] ^ 1 << at % 8]) + code[at + 1 :]


def damage(files: list[Path], random: np.random.Generator) -> str:
    """Damage one of these files, or one in ten times a third of them; return how."""
    how = str(random.choice([*DAMAGES, *GONE]))
    count = len(files) // 3 if random.random() < 0.1 else 1
    for k in random.choice(len(files), count, replace=False):
        file, other = files[k], files[int(random.integers(len(files)))]
        code = file.read_bytes() or b"0"
        if how in GONE:
            file.unlink()
            if how == "a folder":
                file.mkdir()
        else:
            file.write_bytes(DAMAGES[how](code, random, other.read_bytes() if other.exists() else b""))
    return f"{how}, {count} of {len(files)} files"


def small_map() -> str:
    """Return the digest of a small map in the plane."""
    slam = km.Slam(robots(False))
    for told in itertools.islice(events(False, np.random.default_rng(0)), 24):
        slam.process(told.made())
    return digest_of_saved(slam)


def forked() -> str:
    """Return the digest of the small map, from a process of its own, or how that ended."""
    out, into = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            os.write(into, small_map().encode())
        except BaseException as error:
            os.write(into, f"{type(error).__name__}: {error}"[:500].encode())
        os._exit(0)
    os.close(into)
    with os.fdopen(out) as file:
        told = file.read()
    status = os.waitpid(child, 0)[1]
    return f"ended by signal {status}" if status else told


def damaged(count: int, seed: int) -> tuple[int, int]:
    """Return how many damages there were to the cache that this process begins with, and how many broke something."""
    random, root, broken = np.random.default_rng(seed), Path(os.environ["KALMARK_CACHE"]), 0
    right = forked()
    for _ in range(count):
        told = damage([path for path in sorted(root.rglob("*")) if path.is_file()], random)
        if (found := forked()) != right:
            broken += report(told, found)
        for folder in root.rglob("*.nb*"):
            if folder.is_dir():
                folder.rmdir()
    return count, broken


def damaged_caches(count: int, seed: int) -> tuple[int, int, int]:
    """Return how many damages there were to a cache, how many of them kept the map, and how many broke something."""
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"KALMARK_CACHE": cache, "OPENBLAS_NUM_THREADS": "1"}
        command = [
            sys.executable,
            str(Path(__file__).with_name("fuzz.py")),
            "--alone",
            "--caches",
            str(count),
            "--seed",
            str(seed),
        ]
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    *lines, last = done.stdout.splitlines()
    print("\n".join(lines))
    damages, broken = map(int, last.split())
    return damages, damages - broken, broken
