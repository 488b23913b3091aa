"""How large the pages of long runs are, and how long a browser takes to open one.

    KALMARK_DATA=... python benchmarks/pages.py                          # the longest shipped logs
    KALMARK_DATA=... python benchmarks/pages.py victoria_park --browser chromium

A line a run: its events, the size of report.html, and the time until a new headless browser has loaded and drawn it,
less that of an empty page; best of three.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LOGS = ("mrclam", "victoria_park", "lost_in_the_woods", "kitti")
EMPTY = "<!doctype html><title>empty</title>"


def opened(browser: str, page: Path) -> float:
    """Return the wall time in s of a new headless browser that draws a page and ends, best of three."""
    picture = page.with_suffix(".png")
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--screenshot={picture}", page.as_uri()]
    spent = []
    for _ in range(3):
        start = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        spent.append(time.perf_counter() - start)
    return min(spent)


def main() -> None:
    """Map the logs and open their pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", default=LOGS, help="shipped configurations")
    parser.add_argument("--browser", default="chromium")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        blank = Path(folder, "empty.html")
        blank.write_text(EMPTY)
        empty, largest, slowest = opened(args.browser, blank), 0.0, 0.0
        for name in args.logs:
            out = Path(folder, name)
            subprocess.run(
                [sys.executable, "-m", "kalmark", "run", name, "--out", str(out)], check=True, stdout=subprocess.DEVNULL
            )
            page = out / "report.html"
            size, took = page.stat().st_size / 1e6, opened(args.browser, page) - empty
            largest, slowest = max(largest, size), max(slowest, took)
            print(f"{name}: {size:.1f} MB, opens in {took:.1f} s, an empty page in {empty:.1f} s", flush=True)
    print(f"pages: largest {largest:.1f} MB, slowest {slowest:.1f} s")


if __name__ == "__main__":
    main()
