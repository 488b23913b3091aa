"""Offline: a log in, a map you can trust out.  Make a log, run it, look at the folder it leaves.

python examples/01_offline.py
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import kalmark as km
from kalmark.logs import write_native
from kalmark.simulate import load_world, simulate

with TemporaryDirectory() as folder:
    write_native(simulate(load_world("cloister", overrides=["steps=200"]), seed=1), folder)  # stands for your own log

    log = km.open_log(folder)  # controls.csv, scans.csv and, to score against, truth.csv and landmarks.csv
    robot = km.Robot(
        log.robots[0],
        motion=km.motion.Odometry2D(sigma_x_m=0.01, sigma_theta_rad=0.02),
        start=log.truth[log.robots[0]].poses[0],
        sensors={"lidar": km.Mount(km.sensors.RangeBearing(sigma_range_m=0.1, sigma_bearing_rad=0.0175))},
    )
    run = km.record(km.Slam([robot]), log)

summary = run.evaluate()
out = Path("out/offline")
run.save(out)
print(
    f"position error {summary['robots'][robot.name]['ate_raw_m']:.3f} m, {summary['landmarks']} landmarks, see {out}/"
)
