"""The door of the command line: help, version, bugs, interrupts."""

from __future__ import annotations

import subprocess
import sys

import pytest

from command_line import Kalmark
from kalmark.cli import main


def test_version_and_help(kalmark: Kalmark) -> None:
    assert kalmark("--version").out.startswith("kalmark ")
    done = kalmark("--help")
    assert done.status == 0
    for verb in (
        "demo",
        "run",
        "simulate",
        "evaluate",
        "report",
        "campaign",
        "config",
        "convert",
        "check",
        "data",
        "view",
        "compare",
        "live",
    ):
        assert f" {verb} " in done.out
    assert kalmark().status == 2


def test_help_does_not_wait_for_the_numerical_libraries() -> None:
    program = (
        "import sys; from kalmark.cli import main; main(['--help']); "
        "sys.exit(any(m in sys.modules for m in ('numpy', 'scipy', 'numba', 'matplotlib', 'pydantic')))"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, check=False).returncode == 0


def test_a_bug_exits_with_1_and_its_traceback() -> None:
    program = (
        "import sys, kalmark.cli.app as app, kalmark.cli.run as run\n"
        "def bug(*a, **k): raise ZeroDivisionError('a bug')\n"
        "run.run_log = bug\n"
        "sys.exit(app.main(['run', 'native']))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert done.stderr.endswith("ZeroDivisionError: a bug\n")


def test_an_interrupt_is_one_line(kalmark: Kalmark, monkeypatch: pytest.MonkeyPatch) -> None:
    from kalmark.cli import run as module

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "run_log", interrupt)
    assert main(["run", "native"]) == 130
