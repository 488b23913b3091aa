"""Where the processor time of a warm command goes: what it adds to the filter's own time.

    python benchmarks/warm.py                  # parts of `demo`, `evaluate`, `explain` and of `run` on a real log
    python benchmarks/warm.py 9ae1bee          # in turn with those of a commit, checked out below out/, or a folder

The medians of five new processes each; the first ones, which compile, do not count.  A part's time is without that of
parts inside it.  `log` is the simulation of the demo, which other verbs read from a file; it is not counted as added.
The real log is Lost in the Woods, 61,086 observations in 21 minutes; `KALMARK_DATA` names its folder.
"""

from __future__ import annotations

import argparse
import builtins
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from paired import HERE, checkout

RUNS = 5
WATCHED = {  # the functions of a module, or of a class in it, and the part of the time that is theirs
    ("numba.core.caching", "Cache", "load_overload"): "compiled code",
    ("kalmark.slam.slam", "Slam", "process"): "filter",
    ("kalmark.simulate", "", "simulate"): "log",
    ("kalmark.results.record", "", "record"): "recording",
    ("kalmark.results.unmeasured", "ExpectationRecorder", "_ask"): "recording",
    ("kalmark.cli.run", "", "judge"): "verdict",
    ("kalmark.results.run", "Run", "save"): "files",
    ("kalmark.results.run_page", "", "report_html"): "page",
    ("kalmark.results.report", "", "report_html"): "page",  # of older commits
    ("kalmark.results.plot", "", "save_map"): "pictures",
}
NAMED = "start", "imports", "compiled code", "page", "pictures"  # what has to be done whatever the log
PARTS = ("start", "imports", "compiled code", "filter", "log", "recording", "verdict", "files", "page", "pictures")


class Parts:
    """The processor time that parts of a program take, each without the parts inside it."""

    def __init__(self) -> None:
        self.spent: Counter[str] = Counter()
        self.open, self.last = ["start"], 0.0

    def lap(self) -> None:
        """Count the time since the last lap to the part that is open."""
        now = time.process_time()
        self.spent[self.open[-1]] += now - self.last
        self.last = now

    def timed(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that does the same and counts its time to a part."""

        def counted(*arguments: Any, **named: Any) -> Any:
            self.lap()
            self.open.append(part)
            try:
                return call(*arguments, **named)
            finally:
                self.lap()
                self.open.pop()

        return counted


def command(arguments: list[str]) -> dict[str, float]:
    """Run a command of kalmark in this process and return the parts of its time in seconds."""
    parts, watched, plain = Parts(), dict(WATCHED), builtins.__import__

    def importing(*given: Any, **named: Any) -> Any:
        found = plain(*given, **named)
        for (module, owner, name), part in list(watched.items()):
            home = vars(sys.modules[module]).get(owner) if owner and module in sys.modules else sys.modules.get(module)
            if home is not None and name in vars(home):
                setattr(home, name, parts.timed(part, vars(home)[name]))
                del watched[module, owner, name]
        return found

    builtins.__import__ = parts.timed("imports", importing)
    from kalmark.cli.app import main

    if main(arguments):
        raise SystemExit(f"kalmark {' '.join(arguments)} has failed")
    parts.lap()
    return dict(parts.spent)


def measured(place: Path, arguments: list[str]) -> dict[str, float]:
    """Return the parts of a command of a checkout, in a process of its own."""
    environment = os.environ | {"PYTHONPATH": str(place / "src"), "OPENBLAS_NUM_THREADS": "1"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # a warm command finds its modules compiled
    with tempfile.NamedTemporaryFile() as file:
        call = [sys.executable, str(Path(__file__).resolve()), "--into", file.name, *arguments]
        subprocess.run(call, env=environment, capture_output=True, check=True)
        found: dict[str, float] = json.loads(file.read())
    return found


def main() -> None:
    """Measure and print a table a command."""
    if "--into" in sys.argv:
        Path(sys.argv[2]).write_text(json.dumps(command(sys.argv[3:])))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", nargs="?", help="a commit, or the folder of another checkout")
    other = parser.parse_args().other
    places = [HERE, *([checkout(other)] if other else [])]
    with tempfile.TemporaryDirectory() as folder:
        verbs = [["demo", "--out"], ["evaluate"], ["explain", "--scan", "20"]]
        verbs += [["run", "lost_in_the_woods", "--out"]] if "KALMARK_DATA" in os.environ else []
        for verb in verbs:
            spent: list[list[dict[str, float]]] = [[] for _ in places]
            for _ in range(RUNS + 1):
                for k, place in enumerate(places):
                    spent[k].append(measured(place, [*verb, f"{folder}/{k}"]))
            medians = [{p: float(np.median([s.get(p, 0.0) for s in runs[1:]])) for p in PARTS} for runs in spent]
            print(f"\nkalmark {verb[0]}, processor time, ms" + (f": here, {other}" if other else ""))
            for part in PARTS:
                if any(m[part] for m in medians):
                    print(f"  {part:<16}" + "".join(f"{1e3 * m[part]:>8.0f}" for m in medians))
            added = [sum(m.values()) - m["filter"] - m["log"] for m in medians]
            there = f", {added[1]:.2f} s there, ratio {added[0] / added[1]:.2f}" if other else ""
            named = sum(medians[0][part] for part in NAMED)
            print(f"{verb[0]}, added: {added[0]:.2f} s here{there}")
            print(f"{verb[0]}, imports, cache, pictures and page: {named:.2f} s", flush=True)


if __name__ == "__main__":
    main()
