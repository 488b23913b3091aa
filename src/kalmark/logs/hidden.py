"""Hide from the filter which landmark is which, and keep it to score what it makes of that."""

from __future__ import annotations

from dataclasses import replace

from kalmark.events import Event, Scan
from kalmark.logs.log import Log


def hide_ids(log: Log) -> Log:
    """Return the log without the ids of landmarks; `true_ids` has those of every scan.  Robots keep their names."""
    true_ids = {}
    events: list[Event] = []
    for event in log.events:
        if isinstance(event, Scan) and event.ids is not None:
            ids = event.ids
            told = [i if i in log.robots else None for i in ids]
            hidden = Scan(t_ns=event.t_ns, robot=event.robot, sensor=event.sensor, y=event.y, ids=told, cov=event.cov)
            true_ids[hidden] = ids
            events.append(hidden)
        else:
            events.append(event)
    return replace(log, events=events, true_ids=true_ids)
