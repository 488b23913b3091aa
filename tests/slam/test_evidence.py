"""The evidence that a robot is elsewhere: a ratio over the time of its onset, and that of its second hypothesis."""

from __future__ import annotations

import pytest

from kalmark.slam.evidence import NEVER_NS, Evidence

BEGUN = {"old": 10, "new": 60, "tree": NEVER_NS}


def evidence() -> Evidence:
    """Return what is known of a robot that saw an old landmark at 50 for the last time, and missed it at 70."""
    of = Evidence()
    of.see(["old"], [7.0], 50, BEGUN.__getitem__)
    of.miss(["old"], [-7.0], 70, BEGUN.__getitem__)
    return of


def test_the_onset_is_the_last_time_before_a_landmark_is_missed() -> None:
    of = evidence()
    of.weigh()
    assert (of.ratio, of.since_ns) == (-7.0, 69)


def test_a_landmark_that_was_begun_since_an_onset_does_not_count_against_it() -> None:
    of = evidence()
    of.see(["new"], [7.0], 70, BEGUN.__getitem__)
    of.weigh()
    assert (of.ratio, of.since_ns) == (-7.0, 59), "later onsets have the new one against them"


def test_an_older_landmark_that_fits_after_an_onset_counts_against_it() -> None:
    of = evidence()
    of.see(["tree"], [7.0], 80, BEGUN.__getitem__)
    of.weigh()
    assert of.ratio == 0.0


def test_what_is_mapped_again_counts_for_onsets_before_it() -> None:
    of = evidence()
    of.again = [(60, -3.0)]
    of.weigh()
    assert (of.ratio, of.since_ns) == (-7.0, 59)


def test_a_landmark_that_is_missed_when_it_is_begun_decides_nothing() -> None:
    of = Evidence()
    of.miss(["new"], [-7.0], 60, BEGUN.__getitem__)
    of.weigh()
    assert of.ratio == 0.0


def test_a_landmark_counts_once_for_a_second_hypothesis_and_when_it_is_seen_no_more_as_missed() -> None:
    of = Evidence(gain=5.0, fitted={"of the constellation": 0.0})
    of.count({"of the constellation": 2.0, "a": -0.5, "b": 3.0})
    assert of.gain == pytest.approx(7.5)
    of.count({"a": -0.5, "b": 3.0})
    assert of.gain == pytest.approx(7.5)
    of.count({"a": 2.0, "b": -1.0})
    assert of.gain == pytest.approx(10.0)
