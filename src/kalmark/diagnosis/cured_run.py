"""The log of a run filtered again with the cure of its first cause: the second run, and both side by side."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kalmark.cli.run import run_log
from kalmark.diagnosis.trials import fit_of_run, likelihood_gain, options_of
from kalmark.diagnosis.verdict import Cause, Verdict, diagnose
from kalmark.results.figure_texts import figure
from kalmark.results.run import Run
from kalmark.results.verdict_text import verdict_lines

ENDING = "_cured"  # of the folder of the second run


@dataclass(frozen=True, eq=False)
class CuredRun:
    """Second run of a log, with the `options` that cure a cause, in a `folder` of its own.

    `gain` is the logarithm of the likelihood ratio of the same observations against the first run.
    """

    cause: Cause
    options: list[str]
    run: Run
    folder: Path
    verdict: Verdict
    gain: float

    def as_dict(self) -> dict[str, Any]:
        """Return what ``kalmark diagnose --apply --json`` prints of it."""
        keys = {"cause": self.cause.name, "options": self.options, "folder": str(self.folder), "gain": self.gain}
        return keys | {"verdict": self.verdict.as_dict()}

    def lines(self) -> Iterator[str]:
        """Yield it in words: its options, its likelihood and its verdict."""
        options = " ".join(f"--set '{option}'" for option in self.options)
        better = "more likely" if self.gain >= 0.0 else "LESS likely, keep the first run"
        yield f"cure of {self.cause.name}: {options}"
        yield f"with it the log is {better}: its log-likelihood changes by {figure(self.gain)}"
        yield from verdict_lines(self.verdict.as_dict())


def apply_cure(run: Run, folder: Path, verdict: Verdict, observations: int) -> CuredRun | None:
    """Run the log of the run in `folder` again with the cure of the first cause that has one; None if none has.

    The second run is written beside it, with its own verdict from about so many `observations`.
    """
    cures = ((cause, options_of(cause.cure)) for cause in verdict.causes if not cause.harmless)
    cause, options = next((each for each in cures if each[1]), (None, []))
    if cause is None:
        return None
    beside = Path(f"{folder.resolve()}{ENDING}")  # a folder may be given as "."
    cured = run_log(folder / "config.yaml", overrides=options, own=beside)
    cured.save(beside, report=False)
    after = diagnose(cured, observations, progress=True)
    cured.finish(beside)
    return CuredRun(cause, options, cured, beside, after, likelihood_gain(fit_of_run(run), fit_of_run(cured)))
