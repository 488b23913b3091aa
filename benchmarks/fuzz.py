"""Attack every reader, the configuration, the saved map and `process` with inputs that are nearly right.

    python benchmarks/fuzz.py --seconds 600                   # each target so long, guided by coverage (atheris)
    python benchmarks/fuzz.py --seconds 60 native config      # some of them
    python benchmarks/fuzz.py --inputs 1000                   # so many mutated inputs a target, without atheris
    python benchmarks/fuzz.py --again native crash-0123abc    # one input that was found
    python benchmarks/fuzz.py --odd                           # each column and key with odd values, odd files
    python benchmarks/fuzz.py --caches 240                    # so many damages to the cache of compiled code

An input is refused with one line (`KalmarkError`) or taken.  Broken is everything else: another exception, a message of
several lines or of more than 1,500 characters, a state that an error has changed, a covariance that is none; guided by
coverage also what takes longer than 25 s, alone of processor time, or more than 2 GB.  A line a target: inputs, those
that were taken, broken ones.  --odd also saves the run of what is taken, with its pictures and its page, and a table
with other ends of lines, or with semicolons, must give the same map.  So must a damaged cache.  What is broken is kept
as `fuzz/TARGET/crash-...`, seeds for later runs in `fuzz/TARGET/corpus`.
"""

from __future__ import annotations

import argparse
import itertools
import math
import subprocess
import sys
import tempfile
import time
import types
import warnings
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_caches import damaged, damaged_caches
from fuzz_odd import odd_ones
from fuzz_parts import CONFIG, CONTROLS, SCANS, TABLES, Broken, Target, plain, written
from state_digest import digest
from storm import ESTIMATORS, MAPS, robots

import kalmark as km
from kalmark.config import build_slam, open_run
from kalmark.errors import DivergedError, KalmarkError
from kalmark.logs import open_log, write_native

TIMEOUT_S, RSS_MB, LONGEST_STREAM = 25, 2048, 400
GUIDED = ("kalmark.logs", "kalmark.config", "kalmark.events", "kalmark.slam.slam", "kalmark.slam.state",
          "kalmark.slam.checks", "kalmark.declare")  # fmt: skip
"""Whose coverage guides.  Compiled functions are left alone: their byte code must stay as it is."""


# ------------------------------------------------------------------ files
MRCLAM = {
    "Barcodes.dat": b"1 5\n2 14\n6 72\n", "Landmark_Groundtruth.dat": b"6 1.0 2.0 0.1 0.1\n",
    "Robot1_Odometry.dat": b"10.0 0.1 0.2\n10.5 0.1 0.2\n",
    "Robot1_Measurement.dat": b"10.1 72 2.5 0.1\n10.1 14 3.5 0\n",
    "Robot1_Groundtruth.dat": b"10.0 0 0 0\n10.5 0 0 0\n",
}  # fmt: skip
TEXTS: dict[str, tuple[str, tuple[bytes, ...]]] = {
    "g2o": ("a.g2o", (
        b"VERTEX_SE2 0 0 0 0\nVERTEX_XY 9 3 3\nFIX 0\nEDGE_SE2 0 3 1 0 0.5 100 0 0 400 0 1\n"
        b"EDGE_SE2_XY 0 9 3 3 25 0 1\n",
        b"PARAMS_SE3OFFSET 0 0.1 0 0 0 0 0 1\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nEDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 "
        b"1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\nEDGE_SE3_TRACKXYZ 1 5 0 1 2 3 4 0 0 4 0 4\n")),
    "carmen": ("a.log", (
        b"PARAM robot_frontlaser_offset 0.3\nODOM 0 0 0 0.1 0 0 10.0 host 0.0\n"
        b"FLASER 3 1.0 2.0 81.9 0.3 0 0 0.2 0 0 10.5 host 0.5\n"
        b"ROBOTLASER1 0 -0.5 1.0 0.5 80 0.01 0 3 1 2 90 0 0 0 0 0.4 0.2 1.5 0 0 0 0 0 12.0 host 2.0\n",)),
    "tum": ("a.tum", (b"# t x\n1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0.6 0.8\n",)),
    "kitti": ("a.kitti", (b"1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 1 1 0 0 0 0 0 1 2\n",)),
    "freiburg": ("sensor_data.dat", (b"ODOMETRY 0.1 1 0\nSENSOR 1 2 0.1\nODOMETRY 0 1 0\nSENSOR 2 3 0\n",)),
    "dlr": ("map.circles", (
        b"STEP a.jpg 0.1 0.2 0.3 1 0 1 0 0 1\nLANDMARK_C 1 2 0.5 1 0 1 7\nSTEP b 0 0 0 1 0 1 0 0 1\n",)),
    "plaza": ("Plaza1_DR.txt", (b"1.0 0.1 0.01\n1.2 0.1 0.01\n",)),
}  # fmt: skip
BESIDE = {"kitti": {"times.txt": b"0\n1\n"}, "freiburg": {"world.dat": b"1 2 3\n"}, "plaza": {
    "Plaza1_TD.txt": b"1.0 1 0 5.5\n1.2 1 1 6.5\n"}}  # fmt: skip


def read(path: Path, skip: bool, **options: Any) -> None:
    """Read a log."""
    open_log(path, on_error="skip" if skip else "raise", **options)


def tables(data: bytes, folder: Path) -> None:
    """Read a native log of which one file is the input; its first byte says which."""
    names = [*TABLES]
    name = names[data[0] % len(names)] if data else names[0]
    files = {"controls.csv": CONTROLS, "scans.csv": SCANS} | {name: data[1:]}
    read(written(folder / "log", files), bool(data) and data[0] > 127)


def mrclam(data: bytes, folder: Path) -> None:
    """Read a log of MRCLAM of which one file is the input."""
    names = [*MRCLAM]
    name = names[data[0] % len(names)] if data else names[0]
    read(written(folder / "log", MRCLAM | {name: data[1:]}), bool(data) and data[0] > 127)


def text(kind: str) -> Callable[[bytes, Path], None]:
    """Return what reads a log of one text file."""
    name = TEXTS[kind][0]

    def take(data: bytes, folder: Path) -> None:
        where = written(folder / "log", BESIDE.get(kind, {}) | {name: data[1:]})
        read(where if kind == "plaza" else where / name, bool(data) and data[0] > 127)

    return take


def parquet(data: bytes, folder: Path) -> None:
    """Read a native log whose scans are a file of Parquet."""
    read(written(folder / "log", {"controls.csv": CONTROLS, "scans.parquet": data[1:]}), bool(data) and data[0] > 127)


def mcap(data: bytes, folder: Path) -> None:
    """Read a bag that kalmark wrote."""
    read(written(folder / "log", {"a.mcap": data}) / "a.mcap", False)


def bag(name: str) -> Callable[[bytes, Path], None]:
    """Return what reads a bag by topic, and what makes its first configuration."""

    def take(data: bytes, folder: Path) -> None:
        from kalmark.bags.first_config import first_config
        from kalmark.bags.survey import survey

        path = written(folder / "log", {name: data}) / name
        first_config(survey(path))
        read(path, True, topics={"/odom": {"type": "odometry_2d", "own_noise": True}, "/imu": {"type": "imu"}})

    return take


def matlab(data: bytes, folder: Path) -> None:
    """Read a log in a file of MATLAB."""
    read(written(folder / "log", {"dataset2.mat": data}), False)


def config(data: bytes, folder: Path) -> None:
    """Open a configuration and its log, and run it."""
    written(folder / "log", {"controls.csv": CONTROLS, "scans.csv": SCANS})
    (folder / "my.yaml").write_bytes(data)
    made, log = open_run(folder / "my.yaml")
    if "plugins" in made.model_fields_set:
        return
    slam = build_slam(made, log)
    for event in log.events:
        slam.process(event)


def saved(data: bytes, folder: Path) -> None:
    """Load a saved map, and go on with it."""
    path = folder / "map.kmk"
    path.write_bytes(data)
    slam = km.Slam.load(path)
    slam.process(km.Scan(t_s=100.0, robot="a", sensor="eye", y=[[3.0, 0.1]], ids=[1]))


# ------------------------------------------------------------------ events
class Numbers:
    """Reads an input as numbers; after its end all are 0."""

    ODD = (0.0, -0.0, 1.0, -1.0, 1e-300, 1e-12, 1e6, 1e9, 1e13, 1e155, 1e308, -1e155, np.inf, -np.inf, np.nan, 3.0, 0.1)

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    @property
    def left(self) -> bool:
        """Whether there is more."""
        return self.at < len(self.data)

    def byte(self) -> int:
        """Return the next byte."""
        self.at += 1
        return self.data[self.at - 1] if self.at <= len(self.data) else 0

    def choice(self, *values: Any) -> Any:
        """Return one of some values."""
        return values[self.byte() % len(values)]

    def number(self) -> float:
        """Return a number: a usual one, or an odd one."""
        first = self.byte()
        if first < 200:
            return (first - 100) / 25.0 + self.byte() / 5000.0
        return self.ODD[first % len(self.ODD)]

    def array(self, *shape: int) -> Any:
        """Return an array."""
        size = int(np.prod(shape))
        return np.array([self.number() for _ in range(size)]).reshape(shape)

    def covariance(self, size: int) -> Any:
        """Return a covariance, or what is none."""
        kind = self.byte() % 8
        if kind < 4:
            return None
        if kind == 7:
            return self.array(size, size)
        return np.diag(np.abs(self.array(size)) if kind < 6 else self.array(size))


def event(numbers: Numbers, space: bool, now_ns: int) -> tuple[Any, int]:
    """Return an event, or raise KalmarkError, and its time."""
    t_ns = now_ns + numbers.choice(0, 1, 50_000_000, 50_000_000, 10**9, -1, -(10**9), 2**62)
    robot, d = numbers.choice("a", "b", "a", "b", "a", "b", "c", ""), 3 if space else 2
    kind = numbers.byte() % 8
    if kind < 3:
        size = (6 if space else 2 if robot == "a" else 3) if numbers.byte() < 240 else numbers.byte() % 8
        u, cov = numbers.array(size), numbers.covariance(size)
        return lambda: km.Control(t_ns=t_ns, robot=robot, u=u, cov=cov), t_ns
    if kind < 7:
        many, width = numbers.byte() % 5, d if numbers.byte() < 240 else numbers.byte() % 5
        y = numbers.array(many, width)
        names: list[Any] = [
            numbers.choice(1, 2, 3, 4, 5, 6, None, "post", "b", "a bias", -1, 2**70) for _ in range(many)
        ]
        cov, sensor = numbers.covariance(width), numbers.choice("eye", "eye", "eye", "ear")
        ids = names if numbers.byte() < 200 else None
        return lambda: km.Scan(t_ns=t_ns, robot=robot, sensor=sensor, y=y, ids=ids, cov=cov), t_ns
    y, cov = numbers.array(d), numbers.covariance(d)
    return lambda: km.Fix(t_ns=t_ns, robot=robot, y=y, cov=np.eye(d) if cov is None else cov), t_ns


def process(data: bytes, folder: Path | None = None) -> None:
    """Hand a stream of events to a filter: after an error its state is what it was, its covariance always is one."""
    numbers = Numbers(data)
    space = numbers.byte() % 4 == 3
    slam = km.Slam(
        robots(space), estimator=[*ESTIMATORS.values()][numbers.byte() % 3](), map=numbers.choice(*MAPS),
        association=numbers.choice(km.association.ByIdentity(), km.association.Automatic()),
    )  # fmt: skip
    now_ns = 0
    while numbers.left:
        before = digest(slam)
        make, t_ns = event(numbers, space, now_ns)
        try:
            slam.process(make())
        except DivergedError as error:
            plain(error)
            return
        except KalmarkError as error:
            plain(error)
            if digest(slam) != before:
                raise Broken(f"changed by {error}") from None
            continue
        now_ns = max(now_ns, t_ns)
        for name in slam.robots:
            P = slam.covariance(name)
            if not np.isfinite(P).all() or np.linalg.eigvalsh(P)[0] < -1e-9 * max(1.0, float(np.abs(P).max())):
                raise Broken(f"covariance of {name}: {np.linalg.eigvalsh(P)}")


# ------------------------------------------------------------------ all of them
def a_map() -> bytes:
    """Return a saved map."""
    slam = km.Slam(robots(False))
    slam.process(km.Control(t_s=1.0, robot="a", u=(0.5, 0.1)))
    slam.process(km.Scan(t_s=1.5, robot="a", sensor="eye", y=[[3.0, 0.1], [2.0, 0.4]], ids=[1, "post"]))
    with tempfile.TemporaryDirectory() as folder:
        slam.save(Path(folder) / "map.kmk")
        return (Path(folder) / "map.kmk").read_bytes()


def a_log(parquet_: bool) -> bytes:
    """Return the scans of a log as Parquet, or the whole as MCAP."""
    from kalmark.bags.run_messages import export

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = open_log(written(folder / "log", {"controls.csv": CONTROLS, "scans.csv": SCANS}))
        if parquet_:
            return (write_native(log, folder / "parquet", parquet=True) / "scans.parquet").read_bytes()
        export(folder / "a.mcap", log)
        return (folder / "a.mcap").read_bytes()


def a_bag(ros1: bool) -> bytes:
    """Return a small bag of ROS 1, or of ROS 2 in sqlite3."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    from kalmark.bags.mcap_writer import Types, header_fields

    types_ = Types(get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE))
    encode = types_.store.serialize_ros1 if ros1 else types_.store.serialize_cdr
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "a.bag"
        with Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            for topic, kind in (("/odom", "nav_msgs/msg/Odometry"), ("/imu", "sensor_msgs/msg/Imu")):
                connection = writer.add_connection(topic, kind, typestore=types_.store)
                for k in range(3):
                    turn = {"orientation": {"w": 1.0}, "position": {"x": float(k)}}
                    fields = {"header": header_fields(k * 10**9 + 1, "base_link"), "pose": {"pose": turn}} | turn
                    writer.write(connection, k * 10**9 + 1, encode(types_.made(kind, fields), kind))
        return (path if ros1 else next(path.glob("*.db3"))).read_bytes()


def a_matlab_file() -> bytes:
    """Return a small log in a file of MATLAB."""
    import scipy.io

    column, seen = np.arange(3.0)[:, None], np.tile([[0.0, 2.0]], (3, 1))
    zero, out = 0 * column, BytesIO()
    truth = {"x_true": column, "y_true": zero, "th_true": zero, "true_valid": np.ones((3, 1), dtype=np.uint8)}
    told = {"t": column / 10, "v": zero, "om": zero, "r": seen, "b": seen / 10, "l": np.eye(2)}
    scipy.io.savemat(out, told | truth)
    return out.getvalue()


def first(seeds: dict[str, Any]) -> tuple[bytes, ...]:
    """Return seeds whose first byte says which file they are."""
    files = [
        (k, content) for k, each in enumerate(seeds.values()) for content in (each if type(each) is tuple else (each,))
    ]
    return tuple(bytes([k]) + content for k, content in files)


STREAM = bytes(
    [0, 1, 0, 0, 2, 0, 0, 0, 120, 0, 100, 0, 0, 2, 0, 4, 2, 0, 150, 0, 100, 9, 130, 0, 110, 0, 0, 1, 0, 0, 0]
)  # fmt: skip
KINDS = tuple(bytes(kind) + STREAM[4:] * 3 for kind in itertools.product((0, 3), range(3), range(2), range(2)))
"""The same events for each kind of filter: world, estimator, map, association.  All of them are compiled first."""


def targets() -> dict[str, Target]:
    """Return all targets by name."""
    found = {
        "native": Target(first(TABLES), tables),
        "mrclam": Target(first(MRCLAM), mrclam),
        "config": Target((CONFIG,), config),
        "map": Target((a_map(),), saved),
        "process": Target((*KINDS, bytes(range(256))), process, LONGEST_STREAM),
        "parquet": Target((b"\0" + a_log(True),), parquet),
        "mcap": Target((a_log(False),), mcap),
        "ros1": Target((a_bag(True),), bag("a.bag")),
        "sqlite": Target((a_bag(False),), bag("a.db3")),
        "matlab": Target((a_matlab_file(),), matlab),
    }
    return found | {
        kind: Target(tuple(b"\0" + seed for seed in seeds), text(kind)) for kind, (_, seeds) in TEXTS.items()
    }


def attacked(target: Target, data: bytes, folder: Path) -> bool:
    """Return whether an input was taken; raise what it broke."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            target.take(data, folder)
        except KalmarkError as error:
            plain(error)
            return False
    return True


# ------------------------------------------------------------------ without guidance
TOKENS = (
    b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"1e155", b"1e-320", b"9" * 400, b"9" * 5000, b",", b";", b"\n",
    b'"', b"'", b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"#", b"1_0", b"0x10", b"1e999990", b" ", b"\t", b"[", b"]", b"{",
    b"}", b": ", b"&a ", b"*a", b"!!int ", b"? ", b"true", b"null", b"~", b"[[1]]", b"1,5", b"\r\n", b"2001-99-99",
)  # fmt: skip


def mutated(seeds: tuple[bytes, ...], random: np.random.Generator) -> bytes:
    """Return a seed with some changes: bytes, pieces and lines changed, added, taken out, doubled, cut."""
    data = bytearray(seeds[random.integers(len(seeds))])
    for _ in range(1 + random.integers(5)):
        at, size = int(random.integers(len(data) + 1)), int(random.integers(1, 12))
        kind = random.integers(8)
        if kind == 0 and data:
            data[min(at, len(data) - 1)] = int(random.integers(256))
        elif kind == 1:
            del data[at : at + size]
        elif kind == 2:
            data[at:at] = data[at : at + size]
        elif kind in (3, 4):
            data[at : at + (size if kind == 3 else 0)] = TOKENS[random.integers(len(TOKENS))]
        elif kind == 5:
            lines = bytes(data).split(b"\n")
            a, b = random.integers(len(lines), size=2)
            lines[a], lines[b] = lines[b], lines[a]
            data = bytearray(b"\n".join(lines))
        elif kind == 6 and random.random() < 0.3:
            del data[at:]
        else:
            other = seeds[random.integers(len(seeds))]
            cut = int(random.integers(len(other) + 1))
            data[at:at] = other[cut : cut + 4 * size]
    return bytes(data)


def by_chance(target: Target, inputs: int, seed: int = 0) -> Iterator[tuple[bytes, bool | Exception]]:
    """Yield so many inputs, and whether they were taken or what they broke."""
    random = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(inputs):
            data = mutated(target.seeds, random)
            try:
                yield data, attacked(target, data, Path(folder))
            except Exception as error:
                yield data, error


# ------------------------------------------------------------------ guided by coverage
def instrumented() -> None:
    """Have the functions of the modules that guide report their coverage."""
    import atheris

    for name, module in list(sys.modules.items()):
        if not name.startswith(GUIDED):
            continue
        own = [value for value in vars(module).values() if getattr(value, "__module__", None) == name]
        methods = [value for cls in own if isinstance(cls, type) for value in vars(cls).values()]
        for function in (*own, *methods):
            if isinstance(function, types.FunctionType):
                atheris.instrument_func(function)


def guided(name: str, seconds: int, found: Path, timeout_s: int) -> None:
    """Attack one target, guided by coverage, in this process, which libFuzzer ends."""
    import atheris

    target = targets()[name]
    corpus = found / name / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for k, seed in enumerate(target.seeds):
        (corpus / f"seed{k}").write_bytes(seed)
    folder = Path(tempfile.mkdtemp())
    for seed in target.seeds:  # what the first of them compiles is no hang
        attacked(target, seed, folder)
    instrumented()
    options = (f"-max_total_time={seconds}", f"-timeout={timeout_s}", f"-rss_limit_mb={RSS_MB}",
               f"-max_len={target.longest}", f"-artifact_prefix={found / name}/", "-print_final_stats=1")  # fmt: skip
    atheris.Setup([sys.argv[0], *options, str(corpus)], lambda data: attacked(target, data, folder))
    atheris.Fuzz()


def main() -> None:
    """Attack the targets that are asked for, and print a line for each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("target", nargs="*", help="all if none is given")
    parser.add_argument("--seconds", type=int, default=600, help="of each target, guided by coverage")
    parser.add_argument("--inputs", type=int, help="so many of each target, without coverage")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--found", type=Path, default=Path("fuzz"), help="folder of what was found")
    parser.add_argument("--timeout", type=int, default=TIMEOUT_S, help="seconds after which an input hangs")
    parser.add_argument("--odd", action="store_true", help="odd files and configurations, each a whole run")
    parser.add_argument("--caches", type=int, help="so many damages to the cache of compiled code")
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--again", nargs=2, metavar=("TARGET", "FILE"), help="one input that was found")
    asked = parser.parse_args()
    if asked.again is not None:
        target, data, folder = targets()[asked.again[0]], Path(asked.again[1]).read_bytes(), Path(tempfile.mkdtemp())
        taken = attacked(target, data, folder)
        begin = time.process_time()
        attacked(target, data, folder)  # without what the first time compiles
        print(taken, f"{time.process_time() - begin:.2f}")
        return
    if asked.alone and asked.caches:
        print(*damaged(asked.caches, asked.seed))
        return
    if asked.alone:
        guided(asked.target[0], asked.seconds, asked.found, asked.timeout)
        return
    totals = np.zeros(3, dtype=int)
    special = {"odd": odd_ones} if asked.odd else {}
    if asked.caches:
        special["caches"] = lambda: damaged_caches(asked.caches, asked.seed)
    for name in special or asked.target or targets():
        counts = special[name]() if special else chances(name, asked) if asked.inputs else in_process(name, asked)
        print(f"{name}: {counts[0]} inputs, {counts[1]} taken, {counts[2]} broken", flush=True)
        totals += counts
    print(f"total {totals[0]} {totals[1]} {totals[2]}")
    sys.exit(int(totals[2] > 0))


def chances(name: str, asked: Any) -> tuple[int, int, int]:
    """Return how many inputs there were, were taken and broke something; keep the latter."""
    outcomes = [0, 0, 0]
    for k, (data, outcome) in enumerate(by_chance(targets()[name], asked.inputs, asked.seed)):
        outcomes[0], outcomes[1] = k + 1, outcomes[1] + (outcome is True)
        if isinstance(outcome, Exception):
            outcomes[2] += 1
            folder = asked.found / name
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"crash-{asked.seed}-{k}").write_bytes(data)
            print(
                f"  {type(outcome).__name__}: {' '.join(str(outcome).split())[:200]}  ({folder}/crash-{asked.seed}-{k})"
            )
    return outcomes[0], outcomes[1], outcomes[2]


def in_process(name: str, asked: Any) -> tuple[int, int, int]:
    """Attack a target in a process of its own; one that libFuzzer ends early has found something."""
    inputs, end = 0, time.monotonic() + asked.seconds
    while (left := round(end - time.monotonic())) > 0:
        command = [sys.executable, __file__, "--alone", name, "--seconds", str(left), "--found", str(asked.found)]
        command += ["--timeout", str(asked.timeout)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        stats = [line.split() for line in done.stderr.splitlines() if line.startswith("stat::number_of_executed_units")]
        inputs += int(stats[-1][1]) if stats else 0
        if done.returncode == 0:
            break
        lines = [*done.stdout.splitlines(), *done.stderr.splitlines()]
        slow = [Path(line.split("written to ")[1]) for line in lines if "written to" in line and "/timeout-" in line]
        if slow and (took_s := again_s(name, slow[-1], asked.timeout)) < asked.timeout:
            print(f"  {name}: {slow[-1]} takes {took_s:.2f} s of processor time alone: no hang", flush=True)
            continue
        said = [
            line for line in lines if "Error" in line or "Broken" in line or "ERROR" in line or "written to" in line
        ]
        print(f"  {name}: {' | '.join(said)[:600]}", flush=True)
        return inputs, 0, 1  # the same again would be found at once
    return inputs, 0, 0


def again_s(name: str, path: Path, timeout_s: int) -> float:
    """Return the seconds of processor time that an input takes in a process of its own; inf if it fails."""
    command = [sys.executable, __file__, "--again", name, str(path)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=20 * timeout_s)
    except subprocess.TimeoutExpired:
        return math.inf
    return float(done.stdout.split()[-1]) if done.returncode == 0 else math.inf


if __name__ == "__main__":
    main()
