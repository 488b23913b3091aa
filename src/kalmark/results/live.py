"""A filter that a robot's program talks to: each line an event, each answer the estimate after it.

The answer to a line that is refused is an error, and the map is what it was.
"""

from __future__ import annotations

import json
from typing import Any, TextIO

from kalmark.errors import DivergedError, EventError, KalmarkError
from kalmark.events import Event, Scan, seconds, shown, when
from kalmark.logs.lines import LONGEST_LINE, event_of, mapping_of
from kalmark.report import Report
from kalmark.slam.slam import Slam


class Live:
    """Takes lines, gives answers: objects for JSON.  `lost` says why the filter has ended, "" while it goes on."""

    def __init__(self, slam: Slam) -> None:
        self.slam, self.number, self.lost = slam, 0, ""
        self.latest: dict[tuple[type[Event], str, str], int] = {}

    def ready(self) -> dict[str, Any]:
        """Return what is said before the first line: the robots, and the columns of their controls and sensors."""
        robots = {
            name: {
                "u": [*robot.motion.columns],
                "sensors": {sensor: [*mount.sensor.columns] for sensor, mount in robot.sensors.items()},
            }
            for name, robot in self.slam.robots.items()
        }
        return {"ready": True, "robots": robots}

    def answer(self, line: str) -> dict[str, Any]:
        """Return the answer to a line: the estimate after its event, the map if it asks for it, or an error."""
        self.number += 1
        head = {"line": self.number}
        try:
            given = mapping_of(line)
            if given == {"type": "map"}:
                return head | {"landmarks": self.landmarks()}
            event = event_of(given)
            return head | self.estimate(event, self.process(event))
        except KalmarkError as error:
            said = " ".join(str(error).split())
            self.lost = said if isinstance(error, DivergedError) else ""
            return head | {"error": said}

    def process(self, event: Event) -> Report:
        """Take an event; a second one of its robot and sensor at its time is refused: it was sent twice.

        Raises EventError or DivergedError.
        """
        key = type(event), event.robot, event.sensor if isinstance(event, Scan) else ""
        if self.latest.get(key) == event.t_ns:
            whose = " by ".join(shown(name) for name in key[1:] if name)
            raise EventError(f"{when(event)}: a second one of {whose} at this time, expected each event once")
        report = self.slam.process(event)
        self.latest[key] = event.t_ns
        return report

    def estimate(self, event: Event, report: Report) -> dict[str, Any]:
        """Return the robot's mean and covariance after an event, and what became of its observations."""
        out: dict[str, Any] = {"t_ns": event.t_ns, "t_s": float(seconds(event.t_ns)), "robot": event.robot}
        out |= {"mean": self.slam.mean(event.robot).tolist(), "covariance": self.slam.covariance(event.robot).tolist()}
        if report.observations:
            seen = (o._asdict() for o in report.observations)
            out["observations"] = [
                {key: value for key, value in o.items() if value not in (None, "", ())} for o in seen
            ]
        if report.merged or report.removed:
            out["merged"] = [[gone, kept] for gone, kept, _ in report.merged]
            out["removed"] = [gone for gone, _ in report.removed]
        if report.gaps:
            out["gaps_s"] = [gap.lasts_s for gap in report.gaps]
        if report.replaced:
            out["replaced_m"] = report.replaced
        return out

    def landmarks(self) -> list[dict[str, Any]]:
        """Return the map: id, kind, mean, covariance and number of observations of each landmark."""
        rows = (row._asdict() for row in self.slam.landmarks())
        return [row | {"mean": row["mean"].tolist(), "covariance": row["covariance"].tolist()} for row in rows]


def converse(live: Live, incoming: TextIO, outgoing: TextIO) -> None:
    """Answer each line until there are no more, or the filter is lost; blank lines have no answer."""

    def say(told: dict[str, Any]) -> None:
        outgoing.write(json.dumps(told, allow_nan=False) + "\n")
        outgoing.flush()

    say(live.ready())
    while not live.lost and (line := incoming.readline(LONGEST_LINE + 1)):
        while len(line) > LONGEST_LINE and not line.endswith("\n"):  # the rest of a line that is too long
            rest = incoming.readline(LONGEST_LINE + 1)
            if len(rest) <= LONGEST_LINE or rest.endswith("\n"):
                break
        if line.strip():
            say(live.answer(line))
