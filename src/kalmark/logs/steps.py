"""What the two step formats share: increments without a time, each followed by what was seen after it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from kalmark.events import Control, Event, Id, Scan
from kalmark.logs.log import Array
from kalmark.logs.source import STEP_NS
from kalmark.logs.text import Refuse


@dataclass
class Steps:
    """Gather steps and observations into events: step k ends at k seconds, its scan is of the same instant."""

    robot: str
    sensor: str
    count: int = 0

    def __post_init__(self) -> None:
        self.events: list[Event] = []
        self._y: list[Any] = []
        self._ids: list[Id | None] = []
        self._covs: list[Array] = []

    def step(self, u: Any, cov: Array | None = None) -> None:
        """Add the next step, after the scan of the one before."""
        self.close()
        self.count += 1
        self.events.append(Control(t_ns=self.count * STEP_NS, robot=self.robot, u=u, cov=cov))

    def see(self, y: Any, id_: Id | None, refuse: Refuse, where: str, cov: Array | None = None) -> None:
        """Add one observation to the scan of the step just made."""
        if self.count == 0:
            refuse(f"{where}: an observation before the first step, expected it after one")
        elif id_ is not None and id_ in self._ids:
            refuse(f"{where}: id {id_!r} twice after one step, expected each landmark once in a scan")
        else:
            self._y.append(y)
            self._ids.append(id_)
            if cov is not None:
                self._covs.append(cov)

    def close(self) -> list[Event]:
        """End the scan that is open and return all events."""
        if self._y:
            t_ns, cov = self.count * STEP_NS, self._covs or None
            self.events.append(Scan(t_ns=t_ns, robot=self.robot, sensor=self.sensor, y=self._y, ids=self._ids, cov=cov))
            self._y, self._ids, self._covs = [], [], []
        return self.events
