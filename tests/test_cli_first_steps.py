"""What a newcomer types first: the examples' own commands, and refusals that say what to type next."""

from __future__ import annotations

from pathlib import Path

import pytest

from test_cli import Kalmark, kalmark  # noqa: F401 - `kalmark` is a fixture

EXAMPLES = Path(__file__).parents[1] / "examples"


def test_the_example_of_an_own_sensor_passes_the_check_that_it_names(kalmark: Kalmark) -> None:  # noqa: F811
    done = kalmark("check", f"{EXAMPLES / '03_own_sensor.py'}:sonar")
    assert (done.status, done.err) == (0, "")
    assert "expect(invert(y)) = y" in done.out


@pytest.mark.filterwarnings("error")
def test_a_check_finds_a_wrong_inverse_without_a_warning(kalmark: Kalmark, tmp_path: Path) -> None:  # noqa: F811
    text = (EXAMPLES / "03_own_sensor.py").read_text().replace("np.arcsin(y[1])", "2 * np.arcsin(y[1])")
    (tmp_path / "wrong.py").write_text(text)
    done = kalmark("check", "wrong.py:sonar")
    assert done.status == 2
    assert "expect(invert(y)) = y differs by" in done.err
