"""
Your own log format
===================

A format is a function that finds a log in a path and one that reads it as ``Control``, ``Scan``, ``Frame`` and
``Fix``. Tables and data frames need none: ``km.log_from(controls=df, scans=df)`` takes them.
"""

# %%
# A file of lines
# ---------------
#
# This log has a line an event: a time and two speeds, or a time, a number, a range and a bearing.
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt

import kalmark as km
from kalmark.logs import FORMATS
from kalmark.logs.source import Format

file = Path(mkdtemp()) / "day.walk"
file.write_text("0.0,0.5,0.1\n0.5,7,4.2,0.3\n1.0,0.5,0.1\n1.5,7,3.8,0.2\n")


# %%
# The reader
# ----------
#
# ``find`` returns the path that ``read`` takes, or None for what is not such a log. ``request`` has what the user asked
# for (times, robots, what is done about a bad row). Further parameters of ``read`` are the options of the format: with
# ``step_s: Annotated[Positive, "Time of a step."] = 1.0`` (``Positive`` of ``kalmark.declare``),
# ``km.open_log("day.walk", step_s=2)`` and ``log: {path: day.walk, step_s: 2}`` check the value by its annotation.
def find(path):
    return path if path.suffix == ".walk" else None


def read(path, request):
    events = []
    for line in path.read_text().splitlines():
        t, *values = map(float, line.split(","))
        if len(values) == 2:
            events.append(km.Control(t_s=t, robot="rover", u=values))
        else:
            y, ids = [values[1:]], [int(values[0])]
            events.append(km.Scan(t_s=t, robot="rover", sensor="lidar", y=y, ids=ids))
    return km.Log(path.stem, ("rover",), events, "walk", path)


FORMATS["walk"] = Format("walk", "a file that ends in .walk", find, read)

# %%
# Open it
# -------
#
# In a configuration, ``plugins: [my_formats.py]`` runs this file and ``log: {path: day.walk}`` finds the format by
# itself. A package adds formats by an entry point instead (:doc:`/plugins`).
log = km.open_log(file)
print(log)
rover = km.Robot("rover", km.motion.Unicycle(), sensors={"lidar": km.Mount(km.sensors.RangeBearing())})
run = km.record(km.Slam(rover), log, progress=False)
print(run)
km.draw(run.final_slam(), path=run.history.poses, labels=True).figure.legend(loc="outside lower center", ncols=2)
plt.show()

# %%
# Try changing
# ------------
#
# An option: ``def read(path, request, step_s: Annotated[Positive, "Time of a step."] = 1.0)``, with ``t * step_s`` as
# the times. ``km.open_log(file, step_s=2)`` then lasts 3 s, and ``step_s=-1`` is refused with one line.
