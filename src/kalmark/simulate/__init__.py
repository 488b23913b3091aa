"""Simulated worlds: landmarks, robots and noise in, logs with truth out.  The estimator never imports this."""

from kalmark.simulate.robots import simulate
from kalmark.simulate.worlds import World, load_world, shipped_worlds

__all__ = ["World", "load_world", "shipped_worlds", "simulate"]
