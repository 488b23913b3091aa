"""Cost of a detector: processor time of a raw scan of Victoria Park, checks and covariances included.

KALMARK_DATA=... python benchmarks/detectors.py [--every 4]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from kalmark.config import load_config, open_config_log
from kalmark.detect import Corners, Trunks, Walls
from kalmark.events import Scan


def main() -> None:
    """Measure and print the median of each detector."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", type=int, default=4, help="take every so manieth scan")
    every = parser.parse_args().every
    scans = [event.y.T for event in open_config_log(load_config("victoria_park")) if isinstance(event, Scan)][::every]
    print(f"{len(scans)} scans of {scans[0].shape[1]} beams")
    for detector in (Trunks(), Walls(), Corners()):
        spent, found = [], 0
        detector.detect(*scans[0])  # loads the compiled code
        for beams in scans:
            begin = time.thread_time_ns()
            found += len(detector.detect(*beams))
            spent.append((time.thread_time_ns() - begin) * 1e-3)
        name = type(detector).__name__
        print(f"  {name:<10} median {np.median(spent):5.0f} us, mean {np.mean(spent):5.0f} us, {found} found")


if __name__ == "__main__":
    main()
