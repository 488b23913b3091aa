"""Ways to take one and the same step of a log, and how they are timed: what the benchmarks share.

A way starts from what is known (nothing, or a map that kalmark has made and the log of it) and takes steps of one
control and one scan of landmarks that are known by their ids.  Times are processor time, so that other work on the
machine counts less, on one core and with one thread.
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from field import ODOMETRY, REACH_M, SIGHT, Step, new_slam

import kalmark as km
from kalmark.filter import kernels
from kalmark.filter.textbook import TextbookSlam
from kalmark.geometry.angles import wrap
from kalmark.geometry.frames import move, observe

METHODS = {"naive": 0, "davison": 1}  # of MRPT, TKFMethod: its default, and one number at a time
Array = Any


@dataclass
class Known:
    """What is known before the first step that is timed: where the robot started, a log and the map that it made."""

    start: Array
    slam: km.Slam
    log: list[Step] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)

    @classmethod
    def by_mapping(cls, start: Array, log: list[Step]) -> Known:
        """Make the map of a log with kalmark."""
        known = cls(start, new_slam(start), log)
        for control, scan in log:
            known.slam.process(control)
            known.slam.process(scan)
            known.poses.append(known.slam.mean("r"))
        return known

    def state(self) -> tuple[Array, Array, dict[Any, int]]:
        """Return x (3 + 2 n), P and the numbers of the landmarks in them."""
        table = self.slam.landmarks()
        x = np.concatenate([self.slam.mean("r"), *table.means])
        return x, self.slam.covariance("r", *table.ids), {id_: i for i, id_ in enumerate(table.ids)}


class Way:
    """A way to take a step."""

    def step(self, control: km.Control, scan: km.Scan) -> None:
        """Take one."""
        raise NotImplementedError

    def pose(self) -> Array:
        """Return the estimate of the pose."""
        raise NotImplementedError

    def take(self, steps: Iterable[Step]) -> list[float]:
        """Take steps; return the microseconds of each."""
        spent = []
        for control, scan in steps:
            begin = time.process_time_ns()
            self.step(control, scan)
            spent.append((time.process_time_ns() - begin) * 1e-3)
        return spent


class Process(Way):
    """The public door, every outcome read."""

    def __init__(self, known: Known, map_: str = "auto") -> None:
        self.slam = known.slam
        if map_ != "auto":
            self.slam = new_slam(known.start, map_)
            self.take(known.log)

    def step(self, control: km.Control, scan: km.Scan) -> None:
        self.slam.process(control)
        for observation in self.slam.process(scan).observations:
            assert observation.outcome in ("associated", "new")

    def pose(self) -> Array:
        return self.slam.mean("r")


class Floor(Way):
    """The bare update of a dense covariance, P <- P - V' V, that no dense filter can do without; estimates nothing."""

    def __init__(self, known: Known) -> None:
        self.P = np.eye(3 + 2 * len(known.slam.landmarks()))

    def step(self, control: km.Control, scan: km.Scan) -> None:
        kernels.downdate(self.P, np.full((scan.y.size, len(self.P)), 1e-6))

    def pose(self) -> Array:
        return np.full(3, np.nan)


class Textbook(Way):
    """The guide's filter as printed: full F and H, landmark by landmark, P - K Z K'."""

    Filter: type[TextbookSlam] = TextbookSlam

    def __init__(self, known: Known) -> None:
        x, P, self.number = known.state()
        self.book = self.Filter(x, np.diag(ODOMETRY[[0, 2]] ** 2), np.diag(SIGHT**2), P)

    def step(self, control: km.Control, scan: km.Scan) -> None:
        self.book.predict(control.u[[0, 2]])
        for y, i in zip(scan.y, scan.ids or (), strict=True):
            if i in self.number:
                self.book.correct(self.number[i], y, np.inf)
            else:
                self.number[i] = self.book.initialize(y)

    def pose(self) -> Array:
        return self.book.x[:3]


class FullProducts(TextbookSlam):
    """The textbook filter as most who write one do: P <- (I - K H) P, a full product for every landmark."""

    def correct(self, i: int, y: Any, gate: float = np.inf) -> bool:
        """Correct with the observation y = (range, bearing) of landmark i."""
        e, H = self.expect(i)
        z = np.asarray(y) - e
        z[1] = wrap(z[1])
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + self.R)
        self.x = self.x + K @ z
        self.x[2] = wrap(self.x[2])
        self.P = (np.eye(len(self.x)) - K @ H) @ self.P
        return True


class SparseProducts(TextbookSlam):
    """The textbook filter with products of what is not zero only: the blocks of [S] (10) and (20)-(23)."""

    def predict(self, u: Any) -> None:
        """Move the robot by u = (forward, turn)."""
        self.x[:3], F_r, F_n = move(self.x[:3], u, np.zeros(2))
        self.P[:3, :3] = F_r @ self.P[:3, :3] @ F_r.T + F_n @ self.Q @ F_n.T
        self.P[:3, 3:] = F_r @ self.P[:3, 3:]
        self.P[3:, :3] = self.P[:3, 3:].T

    def correct(self, i: int, y: Any, gate: float = np.inf) -> bool:
        """Correct with the observation y = (range, bearing) of landmark i."""
        seen = np.array([0, 1, 2, 3 + 2 * i, 4 + 2 * i])
        e, E_r, E_l = observe(self.x[:3], self.x[seen[3:]])
        E = np.hstack([E_r, E_l])
        z = np.asarray(y) - e
        z[1] = wrap(z[1])
        PE = self.P[:, seen] @ E.T
        Z = E @ PE[seen] + self.R
        K = PE @ np.linalg.inv(Z)
        self.x += K @ z
        self.x[2] = wrap(self.x[2])
        self.P -= K @ Z @ K.T
        return True


class TextbookFull(Textbook):
    """(I - K H) P."""

    Filter = FullProducts


class TextbookSparse(Textbook):
    """Only what is not zero."""

    Filter = SparseProducts


class Isam2(Way):
    """GTSAM's iSAM2 on the same numbers: update, the pose's estimate and the marginals that association needs.

    These are the joint covariance of the pose and the landmarks in view.  A map that is known enters in few large
    updates with kalmark's estimates as initial values.
    """

    BATCH = 1000

    def __init__(self, known: Known) -> None:
        import gtsam

        self.gtsam, self.isam, self.t = gtsam, gtsam.ISAM2(), 0
        self.motion = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(ODOMETRY, 1e-3))  # with less it is indeterminate
        self.sight = gtsam.noiseModel.Diagonal.Sigmas(SIGHT[::-1].copy())  # bearing first
        self.landmarks: dict[Any, Any] = {}
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.last = gtsam.Pose2(*known.start)
        exactly = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
        self.graph.add(gtsam.PriorFactorPose2(self.key(0), self.last, exactly))
        self.values.insert(self.key(0), self.last)
        means = {id_: known.slam.mean(id_) for id_ in known.slam.landmarks().ids} if known.log else {}
        for (control, scan), pose in zip(known.log, known.poses, strict=True):
            self.add(control, scan, gtsam.Pose2(*pose), means)
            if self.t % self.BATCH == 0:
                self.update()
        for _ in range(3):  # relinearises
            self.update()
        self.last = self.isam.calculateEstimatePose2(self.key(self.t))

    def key(self, t: int) -> int:
        """Return the key of a pose."""
        return self.gtsam.symbol("x", t)

    def add(self, control: km.Control, scan: km.Scan, pose: Any, means: dict[Any, Array]) -> list[int]:
        """Add a step's factors and initial values; return the keys of what it saw."""
        gtsam, keys = self.gtsam, []
        before, self.t = self.key(self.t), self.t + 1
        now, self.last = self.key(self.t), pose
        self.graph.add(gtsam.BetweenFactorPose2(before, now, gtsam.Pose2(*control.u), self.motion))
        self.values.insert(now, pose)
        for (r, b), i in zip(scan.y, scan.ids or (), strict=True):
            keys.append(gtsam.symbol("l", i))
            self.graph.add(gtsam.BearingRangeFactor2D(now, keys[-1], gtsam.Rot2(b), r, self.sight))
            if i not in self.landmarks:
                self.landmarks[i] = keys[-1]
                there = r * np.array([np.cos(b), np.sin(b)])
                self.values.insert(keys[-1], means[i] if i in means else pose.transformFrom(there))
        return keys

    def update(self) -> None:
        """Hand what was added to iSAM2."""
        self.isam.update(self.graph, self.values)
        self.graph, self.values = self.gtsam.NonlinearFactorGraph(), self.gtsam.Values()

    def step(self, control: km.Control, scan: km.Scan) -> None:
        keys = self.add(control, scan, self.last.compose(self.gtsam.Pose2(*control.u)), {})
        self.update()
        self.last = self.isam.calculateEstimatePose2(self.key(self.t))
        self.marginals(keys)

    def marginals(self, keys: list[int]) -> None:
        """Compute the joint covariance of the pose and the landmarks in view: one call costs less than one for each."""
        self.isam.jointMarginalCovariance([self.key(self.t), *keys]).fullMatrix()

    def pose(self) -> Array:
        return np.array([self.last.x(), self.last.y(), self.last.theta()])


class Mrpt(Way):
    """MRPT's kf-slam, range-bearing in the plane, driven by a small program that is compiled when first needed."""

    LIBRARIES = "slam obs maps poses math system rtti serialization core config opengl containers"

    def __init__(self, known: Known, method: str = "davison", program: Path = Path("out/mrpt_slam")) -> None:
        x, P, self.number = known.state()
        self.program = subprocess.Popen([self.built(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        head = [len(self.number), METHODS[method], 3 * REACH_M, *ODOMETRY[[0, 2]], *SIGHT]
        self.last = x[:3]
        self.send(head, x, P)

    @classmethod
    def built(cls, program: Path) -> str:
        """Return the program, compiled if it was not yet; raise `OSError` or `CalledProcessError` where MRPT is not."""
        source = Path(__file__).with_name("mrpt_slam.cpp")
        if not program.exists() or program.stat().st_mtime < source.stat().st_mtime:
            program.parent.mkdir(parents=True, exist_ok=True)
            folders = ["-I/usr/include/eigen3", *(f"-I{one}" for one in Path("/usr/include/mrpt").glob("*/include"))]
            libraries = [f"-lmrpt-{name}" for name in cls.LIBRARIES.split()]
            command = ["g++", "-O2", "-DNDEBUG", "-std=c++17", "-w", *folders, str(source), "-o", str(program)]
            subprocess.run([*command, *libraries], check=True, capture_output=True)
        return str(program.resolve())

    def send(self, *numbers: Any) -> None:
        """Write numbers to the program."""
        assert self.program.stdin is not None
        for one in numbers:
            self.program.stdin.write(np.asarray(one, dtype=np.float64).tobytes())
        self.program.stdin.flush()

    def take(self, steps: Iterable[Step]) -> list[float]:
        steps = list(steps)
        numbers = [float(len(steps))]
        for control, scan in steps:
            numbers += [*control.u, len(scan.y)]
            for (r, b), i in zip(scan.y, scan.ids or (), strict=True):
                numbers += [r, b, self.number[i]]
        self.send(numbers)
        assert self.program.stdout is not None
        answer = np.frombuffer(self.program.stdout.read(8 * (len(steps) + 3)))
        self.last = answer[-3:]
        return answer[:-3].tolist()

    def pose(self) -> Array:
        return self.last

    def __del__(self) -> None:
        if hasattr(self, "program"):
            self.program.kill()
            self.program.wait()


def pin() -> int:
    """Keep this process and what it starts to one core; return its number.  (BLAS: `kernels.one_thread`.)"""
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return core


def conditions() -> dict[str, Any]:
    """Return processor, load and versions."""
    rows = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    cpu = next((row.split(":")[1].strip() for row in rows if "model name" in row), platform.processor())
    versions = {"python": platform.python_version()}
    for name in ("kalmark", "numpy", "scipy", "numba", "gtsam"):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    mrpt = Path("/usr/include/mrpt/version.h")
    found = re.search(r'"MRPT ([\d.]+)"', mrpt.read_text()) if mrpt.exists() else None
    versions["mrpt"] = found[1] if found else "not installed"
    said = ", ".join(f"{name} {value}" for name, value in versions.items())
    print(f"{cpu}, {os.cpu_count()} cores, one used, load {os.getloadavg()[0]:.1f}; {said}", flush=True)
    return {"cpu": cpu, "cores": os.cpu_count(), "load": os.getloadavg()[0], "versions": versions}


def in_turns(ways: dict[str, Way], steps: Sequence[Step], block: int = 25, most_s: float = np.inf) -> dict[str, Array]:
    """Return the microseconds of each step, the ways taking turns block by block, each with its own data in the cache.

    A way that has spent `most_s` seconds takes no further steps.
    """
    spent: dict[str, list[float]] = {name: [] for name in ways}
    for at in range(0, len(steps), block):
        for name, way in ways.items():
            if sum(spent[name]) < 1e6 * most_s:
                spent[name] += way.take(steps[at : at + block])
    return {name: np.array(values) for name, values in spent.items()}
