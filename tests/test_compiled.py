"""Calls by address: from compiled code and from Python, what comes back and what goes wrong."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import FunctionType
from typing import Any
from unittest.mock import patch

import numba
import numpy as np
import pytest

from kalmark import compiled
from kalmark.compiled import _CheckedFiles, address_of, by_address, signature_of
from kalmark.filter.corrections import compile_correction, textbook

SUM = signature_of("f8(f8[::1])")
call = by_address(SUM)


@numba.njit
def positive_sum(a: np.ndarray) -> float:
    if a[0] < 0:
        raise ValueError("negative")
    return a.sum()


@numba.njit
def twice(address: int, a: np.ndarray) -> float:
    return 2 * call(address, (a,))


@numba.njit
def count(a: np.ndarray) -> int:
    return len(a)


def test_compiled_code_and_python_call_the_same_function_and_get_its_errors() -> None:
    address = address_of(positive_sum, SUM)
    assert twice(address, np.ones(3)) == 6.0
    assert call(address, (np.ones(3),)) == 3.0
    for caller in (lambda a: twice(address, a), lambda a: call(address, (a,))):
        with pytest.raises(ValueError, match="negative"):
            caller(-np.ones(3))


def test_a_function_that_returns_something_else_has_no_address_to_be_called_by() -> None:
    with pytest.raises(TypeError, match="returns int64, expected float64"):
        address_of(count, SUM)


def test_what_is_compiled_ahead_is_asked_for_once_in_a_cache_and_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited, asked = [], []

    class Started:
        def __init__(self, command: list[str], **_: object) -> None:
            asked.append(command[-2:])

        def wait(self) -> None:
            waited.append(True)

    def begin() -> None:
        compiled.compile_on_second_core(positive_sum, compile_correction, "textbook", "none", 1, False, False)

    monkeypatch.setattr(compiled.subprocess, "Popen", Started)
    monkeypatch.setattr(compiled, "cache_folder", lambda part: str(tmp_path))
    monkeypatch.setattr(compiled.os, "cpu_count", lambda: 2)
    begin()
    begin()  # while it is under way
    ((text, mark),) = asked
    for _ in range(2):
        compiled.wait_for_compilation(count)
        compiled.wait_for_compilation(positive_sum)
    assert waited == [True]
    compiled.work_ahead(text, mark)
    begin()
    assert len(asked) == 1 and textbook.overloads


def test_a_job_that_fails_is_not_taken_for_done(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    with pytest.raises(KeyError):
        job = '["kalmark.filter.corrections", "compile_correction", "no", "none", 1, false, false]'
        compiled.work_ahead(job, str(mark))
    assert not mark.exists()


DAMAGED = """
import sys
from pathlib import Path
from types import FunctionType
from typing import Any
from unittest.mock import patch
import numpy as np
from kalmark.compiled import compiled
from kalmark.geometry.frames import product

A = np.arange(12.0).reshape(3, 4)

def anew():
    function = compiled(product.py_func)
    np.testing.assert_array_equal(function(A, A.T), A @ A.T)
    return sum(function.stats.cache_hits.values())

assert anew() == 0 and anew() == 1
index, data = sorted(Path(sys.argv[1]).rglob("frames.product-*.nb*"), key=lambda file: file.suffix, reverse=True)
assert (index.suffix, data.suffix) == (".nbi", ".nbc")
cases = 0
for file in (index, data):
    whole = file.read_bytes()
    flips = [bytes([*whole[:at], whole[at] ^ 0x41, *whole[at + 1:]]) for at in (0, 40, len(whole) // 2, len(whole) - 1)]
    for damage in (b"", whole[:10], whole[: len(whole) // 2], whole[:-1], whole + b"0", bytes(len(whole)), *flips):
        file.write_bytes(damage)
        assert anew() == 0, "what is damaged is not loaded"
        assert anew() == 1, "it has been made again"
        cases += 1
    (index if file is data else data).replace(file)
    assert anew() == 0 and anew() == 1, "another file under its name is not loaded"
    file.unlink()
    assert anew() == 0 and anew() == 1
    file.unlink()
    file.mkdir()
    assert anew() == 0 and anew() == 1, "a folder under its name is no reason to stop"
print(cases)
"""


def test_compiled_code_that_is_damaged_on_the_disk_is_noticed_and_made_anew(tmp_path: Path) -> None:
    environment = os.environ | {"KALMARK_CACHE": str(tmp_path)}
    command = [sys.executable, "-c", DAMAGED, str(tmp_path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "20\n"


COMPILED = """
import numpy as np
from kalmark.compiled import compiled
from kalmark.geometry.frames import product

A = np.arange(12.0).reshape(3, 4)
for _ in range(2):
    function = compiled(product.py_func)
    np.testing.assert_array_equal(function(A, A.T), A @ A.T)
    print(sum(function.stats.cache_misses.values()))
"""


def test_of_processes_that_need_the_same_code_at_once_one_compiles_it(tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    environment = os.environ | {"KALMARK_CACHE": str(tmp_path)}
    command = [sys.executable, "-c", COMPILED]
    made = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    assert sorted(one.communicate()[0] for one in made) == ["0\n0\n", "0\n0\n", "1\n0\n"]


def test_a_cache_that_cannot_be_written_is_warned_of_once_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    environment = os.environ | {"KALMARK_CACHE": str(tmp_path / "file")}
    command = [sys.executable, "-c", COMPILED]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "1\n1\n"), done.stderr
    (said,) = [line for line in done.stderr.splitlines() if "warning" in line]
    assert said.startswith(f"kalmark: warning: compiled code cannot be kept in {tmp_path / 'file' / 'compiled'}")
    assert said.endswith("KALMARK_CACHE can name another folder")


def test_two_processes_that_save_two_overloads_at_once_name_two_files(tmp_path: Path) -> None:
    one, other = (_CheckedFiles(str(tmp_path), "f", source_stamp=0) for _ in range(2))
    with patch.object(other, "_load_index", return_value={}):  # read before the other was saved
        one.save("a", 1)
        other.save("b", 2)
    assert other.load("b") == 2 and one.load("a") in (1, None)
    one.save("a", 1)
    assert (one.load("a"), one.load("b")) == (1, 2)


WITHOUT = """
import numpy as np
import kalmark as km

def drive(robot, sensor, views, options, ids):
    slam = km.Slam(robot, **options)
    for k in range(4):
        name = robot.name
        slam.process(km.Control(t_s=0.1 * k, robot=name, u=np.full(len(robot.motion.columns), 0.01)))
        named = range(len(views)) if ids else None
        slam.process(km.Scan(t_s=0.1 * k + 0.05, robot=name, sensor="eye", y=sensor.expect(views)[0], ids=named))
    return len(slam.landmarks()), slam.mean("r")[0], np.trace(slam.covariance("r"))

rng = np.random.default_rng(1)
jcbb = km.association.JointCompatibility()
for ids in (True, False):
    for d, motion, sensor in ((2, km.motion.Unicycle(), km.sensors.RangeBearing()),
                              (3, km.motion.Odometry3D(), km.sensors.RangeBearing3D())):
        robot = km.Robot("r", motion, sensors={"eye": km.Mount(sensor)})
        views = rng.uniform(1.0, 5.0, (4, d))
        print(*drive(robot, sensor, views, {} if ids else {"association": jcbb}, ids))
robot = km.Robot("r", km.motion.Unicycle(), sensors={"eye": km.Mount(km.sensors.RangeBearing())})
print(*drive(robot, km.sensors.RangeBearing(), rng.uniform(1.0, 30.0, (84, 2)), {}, True))
"""


def test_the_filter_runs_without_compilation_as_it_does_with_it() -> None:
    told = []
    for disabled in ("0", "1"):
        environment = os.environ | {"NUMBA_DISABLE_JIT": disabled}
        command = [sys.executable, "-c", WITHOUT]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        told.append(np.array([line.split() for line in done.stdout.splitlines()], dtype=np.float64))
    assert told[1] == pytest.approx(told[0], rel=1e-6)
    assert told[0][-1, 0] == 84  # a compressed map


def test_errors_of_slices_are_short_in_inner_loops_alone() -> None:
    def assign(to: Any, numbers: Any) -> None:
        to[:3] = numbers

    own = FunctionType(assign.__code__, {"__name__": "kalmark.models.some"}, "assign")
    for function, error in ((compiled.compiled(own), "slice of another size"), (numba.njit(assign), r"shape \(4,\)")):
        with pytest.raises(ValueError, match=error):
            function(np.zeros(5), np.zeros(4))
