"""A small native log, any file of it replaced by a text."""

from __future__ import annotations

from pathlib import Path

HEAD = "t_s,robot,sensor,id,range_m,bearing_rad"
GOOD = "0.1,rover,lidar,7,4.2,0.3"
CONTROLS = "t_s, robot, v_mps, w_radps\n0.1, rover, 0.5, 0.02\n0.2, rover, 0.5, 0.02\n"
SCANS = "t_s,robot,sensor,id,range_m,bearing_rad\n0.2,rover,lidar,7,4.2,0.3\n0.2,rover,lidar,,3.1,-1\n"


def native(folder: Path, **files: str) -> Path:
    for name, text in {"controls": CONTROLS, "scans": SCANS, **files}.items():
        (folder / f"{name}.csv").write_text(text)
    return folder
