"""The command line in an empty folder, and a small log."""

from __future__ import annotations

from pathlib import Path

import pytest

from command_line import Done, Kalmark, write_log
from kalmark.cli import main


@pytest.fixture
def kalmark(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Kalmark:
    """Run the command line in an empty folder; whether it has to compile first is not what these tests look at."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("kalmark.compiled.say_compiling", lambda: None)

    def run(*arguments: str | Path) -> Done:
        status = main([str(a) for a in arguments])
        captured = capsys.readouterr()
        return Done(status, captured.out, captured.err)

    return run


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log")
