"""The settings of the Matlab SLAM toolbox in the words of a configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from kalmark.logs.log import Array
from kalmark.logs.rig import placed

WXYZ_TO_XYZW = [0, 1, 2, 4, 5, 6, 3]
LANDMARKS = {
    "eucPnt": "point", "idpPnt": "inverse_depth", "ahmPnt": "anchored_homogeneous", "hmgPnt": "homogeneous",
    "plkLin": "pluecker_line", "aplLin": "anchored_pluecker_line", "idpLin": "inverse_depth_line",
    "ahmLin": "anchored_homogeneous_line", "hmgLin": "homogeneous_line",
}  # fmt: skip
PLUECKER = ("plkLin", "aplLin")
BORDER = 25.0  # no landmark starts nearer to the image's border than its width / 25
VELOCITY = ("vx_mps", "vy_mps", "vz_mps", "wx_radps", "wy_radps", "wz_radps")


@dataclass(frozen=True)
class Part:
    """Hold the settings of a robot or sensor, its name here and its index in the recording, from 0."""

    name: str
    index: int
    settings: dict[str, Any]


def parts(word: str, settings: Any) -> list[Part]:
    """Return the robots or sensors of a recording, named by their numbers: robot1, robot2, ..."""
    several = settings if isinstance(settings, list) else [settings]
    return [Part(f"{word}{i + 1}", i, one) for i, one in enumerate(several)]


def is_lines(cfg: dict[str, Any]) -> bool:
    """Return whether the recording maps lines, not points."""
    return str(cfg["Opt"]["init"]["initType"]).endswith("Lin")


def described(cfg: dict[str, Any], robots: list[Part]) -> dict[str, Any]:
    """Return the configuration with which kalmark repeats a recording, its landmark type included."""
    opt = cfg["Opt"]
    return {
        "robots": {robot.name: described_robot(cfg, robot) for robot in robots},
        "landmarks": landmark(opt["init"]) | (ends(opt["correct"]["lines"]) if is_lines(cfg) else {}),
        "map": {"reparametrize": float(opt["correct"]["linTestIdp"]) if opt["correct"]["reparametrize"] else "off"},
    }


def landmark(init: dict[str, Any]) -> dict[str, Any]:
    """Return the landmark type of a recording, with the prior of what one image does not tell."""
    kind = init["initType"]
    prior = init["plkLin" if kind in PLUECKER else "idpPnt"]
    mean, sigma = numbers(prior["nonObsMean"]), numbers(prior["nonObsStd"])
    section: dict[str, Any] = {"type": LANDMARKS[kind]}
    if kind in PLUECKER:
        names = ("prior_beta_1", "prior_beta_2", "sigma_beta_1", "sigma_beta_2")
        return section | dict(zip(names, mean + sigma, strict=True))
    return section if kind == "eucPnt" else section | {"prior_rho_per_m": mean[0], "sigma_rho_per_m": sigma[0]}


def ends(lines: dict[str, Any]) -> dict[str, Any]:
    """Return what becomes of the segment that is kept beside a line."""
    return {"extend": bool(lines["extPolicy"]), "switch_px": float(lines["extSwitch"])}


def described_robot(cfg: dict[str, Any], robot: Part) -> dict[str, Any]:
    """Return the section of one robot."""
    sensors = [one for one in parts("camera", cfg["Sensor"]) if one.settings["robot"] == robot.index + 1]
    return {
        "motion": motion(robot.settings["motion"], np.array(cfg["RobU"][robot.index])),
        "start": start(robot.settings, np.array(cfg["RobX0"][robot.index], dtype=np.float64)),
        "sensors": {sensor.name: camera(cfg, sensor) for sensor in sensors},
    }


def motion(kind: str, noise: Array) -> dict[str, Any]:
    """Return the motion model; `noise` (6, 6) is the covariance of one control."""
    sigmas = np.sqrt(np.diag(noise)).tolist()
    turn = root_mean_square(sigmas[3:])
    if kind == "constVel":
        return {"type": "constant_velocity_3d", "sigma_v_mps": root_mean_square(sigmas[:3]), "sigma_w_radps": turn}
    along = dict(zip(("sigma_x_m", "sigma_y_m", "sigma_z_m"), sigmas, strict=False))
    return {"type": "odometry_3d", **along, "sigma_rotation_rad": turn}


def start(settings: dict[str, Any], state: Array) -> dict[str, Any]:
    """Return where a robot starts; standard deviations of roll, pitch and yaw are taken about x, y and z."""
    section: dict[str, Any] = placed(state[WXYZ_TO_XYZW]) | {
        "sigma_position_m": numbers(settings["positionStd"]),
        "sigma_rotation_deg": numbers(settings["orientationStd"]),
    }
    if len(state) == 13:
        section |= dict(zip(VELOCITY, state[7:].tolist(), strict=True))
        section |= {"sigma_v_mps": numbers(settings["velStd"])}
        section |= {"sigma_w_radps": np.radians(settings["angVelStd"]).tolist()}
    return section


def camera(cfg: dict[str, Any], sensor: Part) -> dict[str, Any]:
    """Return the section of one camera: its model, mount, and which landmarks of an image it takes."""
    settings, opt = sensor.settings, cfg["Opt"]
    width, height = settings["imageSize"]
    k = np.asarray(settings["intrinsic"], dtype=np.float64).tolist()
    section: dict[str, Any] = {"type": "pinhole", "cx_px": k[0], "cy_px": k[1]}
    if settings["type"] == "omniCam":
        section |= {"type": "omnidirectional", "c": k[2], "d": k[3], "e": k[4]}
        section |= {
            "projection": numbers(settings["distortion"]),
            "back_projection": numbers(settings["invDistortion"]),
        }
    else:
        section |= {"fx_px": k[2], "fy_px": k[3]}
        if is_lines(cfg):
            section |= {"type": "segments", "min_length_px": float(opt["obs"]["lines"]["minLength"])}
        else:
            section |= {"lens": "radial", "distortion": numbers(settings["distortion"])}
    section |= {"width_px": int(width), "height_px": int(height), "sigma_px": float(settings["pixErrorStd"])}
    mount: dict[str, Any] = placed(np.array(cfg["SenFrame"][sensor.index], dtype=np.float64)[WXYZ_TO_XYZW])
    if settings["frameInMap"]:
        mount |= {"sigma_position_m": numbers(settings["positionStd"])}
        mount |= {"sigma_rotation_deg": numbers(settings["orientationStd"])}
    return section | {"mount": mount, "attention": attention(cfg, float(width))}


def attention(cfg: dict[str, Any], width: float) -> dict[str, Any]:
    """Return which landmarks of an image the toolbox corrects, starts and gives up."""
    first, later = cfg["Opt"]["init"]["nbrInits"]
    return {
        "updates": int(cfg["Opt"]["correct"]["nUpdates"]),
        "starts": int(later),
        "first_starts": int(first),
        "margin_px": 0.0 if is_lines(cfg) else width / BORDER,
        "searches": 10,
        "match_ratio": 0.1,
        "inlier_ratio": 0.5,
        "delete": True,
    }


def numbers(value: Any) -> list[float]:
    """Return a vector, which the recording has bare if it is of one element."""
    return np.atleast_1d(np.asarray(value, dtype=np.float64)).tolist()


def root_mean_square(sigmas: Any) -> float:
    """Return the standard deviation of an axis, if the three differ that of the mean variance."""
    return float(np.sqrt(np.mean(np.square(sigmas))))
