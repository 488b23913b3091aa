"""How much time and memory a long native log takes to read.

    python benchmarks/tables.py [--rows 1000000] [--parquet] [--stream]

Half of the rows are controls, half observations, five a scan.  Memory is the growth of the largest resident set while
`open_log` reads: the events of the log; a file is read row by row.  --stream: `stream_log` yields them and keeps none.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from kalmark.logs import open_log, stream_log, write_native


def most_mb() -> float:
    """Return the largest resident set that this process has had, as Linux tells it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024 / 1e6


def write(folder: Path, rows: int) -> None:
    """Write a log of so many rows."""
    random = np.random.default_rng(0)
    with (folder / "controls.csv").open("w") as file:
        file.write("t_s,robot,v_mps,w_radps\n")
        file.writelines(f"{k / 100},rover,{v!r},{w!r}\n" for k, (v, w) in enumerate(numbers(random, rows // 2)))
    with (folder / "scans.csv").open("w") as file:
        file.write("t_s,robot,sensor,id,range_m,bearing_rad\n")
        seen = enumerate(numbers(random, rows // 2))
        file.writelines(f"{k // 5 / 20},rover,lidar,{k % 5},{abs(v)!r},{w!r}\n" for k, (v, w) in seen)


def numbers(random: np.random.Generator, rows: int) -> list[list[float]]:
    """Return pairs of numbers."""
    found: list[list[float]] = random.normal(size=(rows, 2)).tolist()
    return found


def main() -> None:
    """Write and read a log."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--parquet", action="store_true")
    parser.add_argument("--stream", action="store_true")
    parser.add_argument("--read", type=Path, help="read this log only")
    asked = parser.parse_args()
    if asked.read is not None:
        read(asked.read, asked.rows, asked.stream)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "csv"
        folder.mkdir()
        write(folder, asked.rows)
        if asked.parquet:
            folder = write_native(open_log(folder), Path(name) / "parquet", parquet=True)
        read_alone(folder, asked.rows, asked.stream)


def read_alone(folder: Path, rows: int, streamed: bool) -> None:
    """Read in a process of its own, whose memory nothing else has grown."""
    import subprocess

    how = ["--stream"] if streamed else []
    subprocess.run([sys.executable, __file__, "--read", folder, "--rows", str(rows), *how], check=True)


def read(folder: Path, rows: int, streamed: bool) -> None:
    """Read a log, and print what that took."""
    size = sum(file.stat().st_size for file in folder.iterdir()) / 1e6
    before, begin = most_mb(), time.perf_counter()
    count = sum(1 for _ in stream_log(folder, progress=True)) if streamed else len(open_log(folder, progress=True))
    took = time.perf_counter() - begin
    grown = most_mb() - before
    print(f"{rows} rows, {size:.0f} MB of files, {count} events: {took:.1f} s, {grown:.0f} MB, ", end="")
    print(f"{grown * 1e6 / rows:.0f} bytes a row")


if __name__ == "__main__":
    main()
