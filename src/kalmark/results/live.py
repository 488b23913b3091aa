"""A filter that a robot's program talks to: each line an event, each answer the estimate after it.

The answer to a line that is refused is an error, and the map is what it was.
"""

from __future__ import annotations

import json
import os
import select
import socket
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, TextIO

from kalmark.errors import DivergedError, EventError, KalmarkError
from kalmark.events import Event, kind_of, label_of_event, seconds_text, short_text
from kalmark.logs.json_lines import LONGEST_LINE, event_of_object, mapping_of
from kalmark.report import Report
from kalmark.slam.slam import Slam

Answer = dict[str, Any]  # as JSON
PIECE = 1 << 16  # bytes that are read at once


class EndedError(Exception):
    """Silence or a foreign protocol of the other side of a connection, to which the message is sent."""


class Live:
    """Answers to lines of input: objects for JSON.  `lost` is the reason why the filter has ended, "" while it goes on.

    The map is whole but within the context `changing`.
    """

    def __init__(self, slam: Slam, changing: AbstractContextManager[Any] | None = None) -> None:
        self.slam, self.number, self.lost = slam, 0, ""
        self.changing = nullcontext() if changing is None else changing

    def ready(self) -> Answer:
        """Return the message before the first line: the robots, and the columns of their controls and sensors."""
        robots = {
            name: {
                "u": [*robot.motion.columns],
                "sensors": {sensor: [*mount.sensor.columns] for sensor, mount in robot.sensors.items()},
            }
            for name, robot in self.slam.robots.items()
        }
        return {"ready": True, "robots": robots}

    def answer(self, line: str) -> Answer:
        """Return the answer to a line: the estimate after its event, the map if it requests it, or an error."""
        self.number += 1
        head = {"line": self.number}
        try:
            given = mapping_of(line)
            if given == {"type": "map"}:
                return head | {"landmarks": self.landmarks()}
            event = event_of_object(given)
            with self.changing:
                return head | self.estimate(event, self.process(event))
        except KalmarkError as error:
            text = " ".join(str(error).split())
            self.lost = text if isinstance(error, DivergedError) else ""
            return head | {"error": text}

    def process(self, event: Event) -> Report:
        """Take an event; a second one of its robot and sensor at its time is refused: it was sent twice.

        Raises EventError or DivergedError.
        """
        if self.slam.has_taken(event):
            whose = " by ".join(short_text(name) for name in kind_of(event)[1:] if name)
            raise EventError(f"{label_of_event(event)}: a second one of {whose} at this time, expected each event once")
        return self.slam.process(event)

    def estimate(self, event: Event, report: Report) -> Answer:
        """Return the robot's mean and covariance after an event, and what became of its observations."""
        out: Answer = {"t_ns": event.t_ns, "t_s": float(seconds_text(event.t_ns)), "robot": event.robot}
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

    def landmarks(self) -> list[Answer]:
        """Return the map: id, kind, mean, covariance and number of observations of each landmark."""
        rows = (row._asdict() for row in self.slam.landmarks())
        return [row | {"mean": row["mean"].tolist(), "covariance": row["covariance"].tolist()} for row in rows]


class LineStream:
    """The lines that a program writes to a pipe (its descriptor) or to a socket.

    `idle` is called whenever nothing has come for `idle_s`.  Of a `stranger`, the first character has to be that of an
    object of JSON, and a line has to be whole `silent_s` after the one before it: else EndedError.
    """

    def __init__(
        self,
        source: socket.socket | int,
        idle: Callable[[], object] = lambda: None,
        idle_s: float | None = None,
        silent_s: float | None = None,
        stranger: bool = False,
    ) -> None:
        self.source, self.idle, self.idle_s, self.silent_s = source, idle, idle_s, silent_s
        self.read: Callable[[int], bytes] = partial(os.read, source) if isinstance(source, int) else source.recv
        self.stranger, self.came = stranger, bytearray()

    def readline(self, most: int) -> str:
        """Return the next line, or `most` bytes of it; "" at the end."""
        until = None if self.silent_s is None else time.monotonic() + self.silent_s
        seen = 0
        while (end := self.came.find(b"\n", seen)) < 0 and len(self.came) < most:
            seen = len(self.came)
            if not self._ready(until):
                raise EndedError(
                    f"no line for {self.silent_s:g} s, expected one sooner; the map is kept: connect again"
                )
            piece = self.read(PIECE)
            self.came += piece
            if self.stranger and (first := self.came.lstrip()[:1]):
                if first != b"{":
                    text = short_text(self.came.decode("utf-8", "replace").splitlines()[0])
                    raise EndedError(f"{text} is no object of JSON, expected events as docs/live.md has them")
                self.stranger = False
            if not piece:
                end = len(self.came) - 1
                break
        length = min(most, end + 1 if end >= 0 else most)
        line = self.came[:length].decode("utf-8", "replace")
        del self.came[:length]
        return line

    def _ready(self, until: float | None) -> bool:
        """Wait until something can be read; return False if nothing came until then."""
        while True:
            left = None if until is None else max(0.0, until - time.monotonic())
            waits = min((s for s in (left, self.idle_s) if s is not None), default=None)
            try:
                if select.select([self.source], [], [], waits)[0]:
                    return True
            except OSError:  # Windows, where only a socket can be waited for
                return True
            self.idle()
            if left is not None and until is not None and time.monotonic() >= until:
                return False


def converse(
    live: Live, incoming: TextIO | LineStream, outgoing: TextIO, after: Callable[[], object] = lambda: None
) -> None:
    """Answer each line until there are no more, or the filter is lost; blank lines have no answer.

    `after` is called after each answer.
    """

    def send(answer: Answer) -> None:
        outgoing.write(json.dumps(answer, allow_nan=False) + "\n")
        outgoing.flush()

    send(live.ready())
    try:
        while not live.lost and (line := incoming.readline(LONGEST_LINE + 1)):
            while len(line) > LONGEST_LINE and not line.endswith("\n"):  # the rest of a line that is too long
                rest = incoming.readline(LONGEST_LINE + 1)
                if len(rest) <= LONGEST_LINE or rest.endswith("\n"):
                    break
            if line.strip():
                send(live.answer(line))
                after()
    except EndedError as error:
        send({"error": str(error)})
