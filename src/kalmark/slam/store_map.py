"""The stochastic map in a file: a list of its blocks, its means and its covariance; of a postponed map the phase, too.

The tables are not written but built anew from the blocks, so none can point outside its arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from kalmark.errors import MapError
from kalmark.filter.estimators import Map
from kalmark.filter.map import Layout, StochasticMap
from kalmark.filter.postponed import PostponedMap
from kalmark.filter.storage import PANEL, Triangle
from kalmark.geometry.spaces import Space
from kalmark.management.lifecycle import NUMBERS
from kalmark.slam.describe import State

Array = npt.NDArray[np.float64]
Read = Callable[[str, tuple[int, ...]], Array]  # a name and the shape expected


def map_described(m: Map) -> State:
    """Return the blocks of a map and, of a postponed one, what is active in it."""
    if isinstance(m, PostponedMap):
        m.finish()  # which may be a flush, and frees the slots that are gone
    state = _blocks(m)
    if isinstance(m, PostponedMap):
        state["postponed"] = {
            "most": m.most,
            "numbers": m.storage.like.dtype.name,
            "limit_bytes": m.storage.limit_bytes,
            "active": _blocks(m.active),
            "owners": [[slot, at] for slot, at in m._owners.items()],
            "shadows": [[slot, at] for slot, at in m._shadows.items()],
            "gone": [[slot, space.name, list(space.kinds)] for slot, space in m._gone],
            "moved": list(m._moved),
            "moving": list(m._drift.moving),
            "costs": [m._pace.begun, m._pace.paid],
        }
    return state


def _blocks(m: Layout) -> State:
    removed = {slot: kinds for kinds, slots in m._free.items() for slot in slots}
    gone = {slot: space.kinds for slot, space in m._gone} if isinstance(m, PostponedMap) else {}
    spaces = [Space("removed", (removed | gone)[i]) if space is None else space for i, space in enumerate(m.spaces)]
    return {
        "capacity": min(len(m.x), max(1024, 2 * m.n, 2 * m.x_n)),
        "blocks": [[space.name, list(space.kinds)] for space in spaces],
        "free": list(removed),  # of each shape the last removed is the first to be filled again
    }


def map_arrays(m: Map) -> Iterator[tuple[str, Array]]:
    """Return the arrays of a map by name."""
    yield "x", m.x[: m.x_n]
    yield "x_first", m.x_first[: m.x_n]
    if isinstance(m, StochasticMap):
        yield "P", m.P[: m.n, : m.n][np.tril_indices(m.n)]
        return
    yield "P", np.concatenate([m.storage.panels[i // PANEL][i % PANEL, : i + 1] for i in range(m.n)])
    for name, array in map_arrays(m.active):
        yield f"active_{name}", array
    for i, moved in enumerate(m._moved.values()):
        yield f"moved{i}", moved


def map_restored(state: State, read: Read) -> Map:
    """Build a map again block by block, then remove what was removed: its tables fit each other by construction."""
    if state["postponed"] is None:
        return _dense(state, read, "")
    return _postponed(state, state["postponed"], read)


def _spaces(state: State) -> list[Space]:
    spaces = [Space(str(name), tuple(kinds)) for name, kinds in state["blocks"]]
    n, x_n, capacity = sum(s.dof for s in spaces), sum(s.size for s in spaces), state["capacity"]
    if type(capacity) is not int or not max(n, x_n) <= capacity <= max(1024, 2 * n, 2 * x_n):
        raise MapError(f"capacity is {capacity!r}, expected at least {max(n, x_n)} for the blocks of the map")
    return spaces


def _dense(state: State, read: Read, prefix: str) -> StochasticMap:
    spaces = _spaces(state)
    m = StochasticMap(state["capacity"])
    for space in spaces:
        m.add(space, np.zeros(space.size))
    for slot in state["free"]:
        m.remove(_removed(m, slot))
    n, x_n = m.n, m.x_n
    m.x[:x_n], m.x_first[:x_n] = read(f"{prefix}x", (x_n,)), read(f"{prefix}x_first", (x_n,))
    m.P[:n, :n][np.tril_indices(n)] = read(f"{prefix}P", (n * (n + 1) // 2,))
    return m


def _removed(m: Layout, slot: Any) -> int:
    if type(slot) is not int or not 0 <= slot < len(m.spaces) or m.spaces[slot] is None:
        raise MapError(f"removed slot is {slot!r}, expected each one of {len(m.spaces)} once")
    return slot


def _postponed(state: State, phase: State, read: Read) -> PostponedMap:
    dtype, most, limit = NUMBERS[phase["numbers"]], phase["most"], phase["limit_bytes"]
    for what, value in (("most", most), ("limit_bytes", limit)):
        if value is not None and (type(value) is not int or value < 0):
            raise MapError(f"{what} is {value!r}, expected a whole number or none")
    m = PostponedMap(Triangle(dtype, limit), most)
    for space in _spaces(state):
        m._place(space, np.zeros(space.size))
    for slot in state["free"]:
        m._vacate(_removed(m, slot))
    for slot, name, kinds in phase["gone"]:
        m._vacate(_removed(m, slot))
        m._free[tuple(kinds)].remove(slot)
        m._gone.append((slot, Space(str(name), tuple(kinds))))
    m.x[: m.x_n], m.x_first[: m.x_n] = read("x", (m.x_n,)), read("x_first", (m.x_n,))
    P = read("P", (m.n * (m.n + 1) // 2,))
    for i in range(m.n):
        m.storage.panels[i // PANEL][i % PANEL, : i + 1] = P[i * (i + 1) // 2 : (i + 1) * (i + 2) // 2]
    _activate(m, _dense(phase["active"], read, "active_"), phase, read)
    m.storage.fresh.forget()  # as where it was saved
    return m


def _activate(m: PostponedMap, active: StochasticMap, phase: State, read: Read) -> None:
    """Take up the phase, each of its blocks compared with the map's."""
    m.active = active
    used = set()
    gone = {slot: space for slot, space in m._gone}
    for what, pairs in (("active", phase["owners"]), ("shadow", phase["shadows"])):
        for slot, at in pairs:
            found = all(type(i) is int and i >= 0 for i in (slot, at)) and slot < len(m.spaces) and at not in used
            space = m.spaces[slot] or gone.get(slot) if found else None
            there = active.spaces[at] if found and at < len(active.spaces) else None
            if space is None or there is None:
                raise MapError(f"{what} block {at!r} of slot {slot!r} is not in the map, expected each one once")
            fits = there.kinds == space.kinds if what == "active" else there.kinds == (0,) * space.dof
            if not fits or (what == "active" and slot in gone):
                raise MapError(f"{what} block {at} of slot {slot} is {there}, expected one of {space}")
            used.add(at)
            if what == "active":
                m._activate(slot, at)
            else:
                m.cast_shadow(slot, at)
    if (
        used != {i for i, space in enumerate(active.spaces) if space is not None}
        or not gone.keys() <= m._shadows.keys()
    ):
        raise MapError(f"the active map has {len(active.spaces)} blocks, expected each to belong to one of the map")
    for slot in m._shadows:
        m.look_after(slot, m.x[m.numbers(slot)])
    for slot in phase["moving"]:
        if slot in m._owners:
            m.take_as_moving(slot)
    for i, robot in enumerate(phase["moved"]):
        space = m.spaces[robot] if robot in m._owners else None
        if space is None or space.kinds[:1] not in ((1,), (4,)) or space.dof < 3:
            raise MapError(f"slot {robot!r} is no robot in the active map")
        m._moved[robot] = read(f"moved{i}", (len(m._A0),))
    m._pace.begun, m._pace.paid = map(int, phase["costs"])
