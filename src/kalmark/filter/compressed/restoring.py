"""A compressed map from a file; its tables are built again from the blocks, so that they fit the arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from kalmark.errors import MapError
from kalmark.filter.compressed.compressed_map import CompressedMap
from kalmark.filter.compressed.storage import PANEL, Triangle
from kalmark.filter.layout import Read, State, spaces_of
from kalmark.filter.map import StochasticMap
from kalmark.geometry.spaces import Space

NUMBERS: dict[str, Any] = {"float64": np.float64, "float32": np.float32}


def restore_compressed(state: State, read: Read) -> CompressedMap:
    """Build a map that was saved in mid-interval.  Raises MapError if its parts do not fit each other."""
    interval = state["postponed"]
    dtype, most, limit = NUMBERS[interval["numbers"]], interval["most"], interval["limit_bytes"]
    for what, value in (("most", most), ("limit_bytes", limit)):
        if value is not None and (type(value) is not int or value < 0):
            raise MapError(f"{what} is {value!r}, expected a whole number or none")
    m = CompressedMap.of_blocks(spaces_of(state), state["free"], Triangle(dtype, limit), most)
    for slot, name, kinds in interval["gone"]:
        m.depart(m.removed(slot), Space(str(name), tuple(kinds)))
    m.x[: m.x_n], m.x_first[: m.x_n] = read("x", (m.x_n,)), read("x_first", (m.x_n,))
    P = read("P", (m.n * (m.n + 1) // 2,))
    for i in range(m.n):
        m.storage.panels[i // PANEL][i % PANEL, : i + 1] = P[i * (i + 1) // 2 : (i + 1) * (i + 2) // 2]
    m.active = StochasticMap.restored(interval["active"], read, "active_")
    _activate(m, interval)
    for i, robot in enumerate(interval["moved"]):
        space = m.spaces[robot] if robot in m.entered else None
        if space is None or space.kinds[:1] not in ((1,), (4,)) or space.dof < 3:
            raise MapError(f"slot {robot!r} is no robot in the active map")
        m.displaced[robot] = read(f"moved{i}", (len(m.A0),))
    m.schedule.begun, m.schedule.paid = map(int, interval["costs"])
    m.storage.prefault.clear()  # as where it was saved
    return m


def _activate(m: CompressedMap, interval: State) -> None:
    """Assign the blocks of the active map, each compared with the block of its slot."""
    used, departed = set(), dict(m.departed)
    for what, pairs in (("active", interval["owners"]), ("shadow", interval["shadows"])):
        for slot, at in pairs:
            found = all(type(i) is int and i >= 0 for i in (slot, at)) and slot < len(m.spaces) and at not in used
            space = m.spaces[slot] or departed.get(slot) if found else None
            there = m.active.spaces[at] if found and at < len(m.active.spaces) else None
            if space is None or there is None:
                raise MapError(f"{what} block {at!r} of slot {slot!r} is not in the map, expected each one once")
            fits = there.kinds == space.kinds if what == "active" else there.kinds == (0,) * space.dof
            if not fits or (what == "active" and slot in departed):
                raise MapError(f"{what} block {at} of slot {slot} is {there}, expected one of {space}")
            used.add(at)
            if what == "active":
                m.activate(slot, at)
            else:
                m.attach([slot], [at])
    blocks = {i for i, space in enumerate(m.active.spaces) if space is not None}
    if used != blocks or not departed.keys() <= m.auxiliary.keys():
        raise MapError(f"the active map has {len(m.active.spaces)} blocks, expected each to belong to one of the map")
    for slot in m.auxiliary:
        m.watch(slot, m.x[m.numbers(slot)], m.storage.diagonal(m.rows(slot)))
    for slot in interval["moving"]:
        if slot in m.entered:
            m.take_as_moving(slot)
