"""The progress bar: nothing for what is quick, standard error for what is not."""

from __future__ import annotations

import pytest

from kalmark.logs.progress import track


def test_quick_things_show_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(track(range(1000), "log", 1000)) == list(range(1000))
    assert capsys.readouterr() == ("", "")


def test_slow_things_show_a_bar_on_standard_error_only(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(track(iter("abc"), "my log", 3, delay_s=-1.0)) == ["a", "b", "c"]
    out, err = capsys.readouterr()
    assert out == ""
    assert "my log" in err
    assert "3/3" in err


def test_a_bar_can_be_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(track("abc", "log", show=False, delay_s=-1.0)) == ["a", "b", "c"]
    assert capsys.readouterr() == ("", "")


def test_the_bar_is_closed_when_the_loop_is_left(capsys: pytest.CaptureFixture[str]) -> None:
    def first(items: object) -> object:
        raise RuntimeError(items)

    with pytest.raises(RuntimeError):
        for item in track("abc", "log", 3, delay_s=-1.0):
            first(item)
    assert "log" in capsys.readouterr().err


def test_the_bar_shows_what_stands_behind_it(capsys: pytest.CaptureFixture[str]) -> None:
    list(track("abc", "my log", 3, delay_s=-1.0, note=lambda: "60 images/s"))
    assert "60 images/s" in capsys.readouterr().err
