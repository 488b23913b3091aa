"""The self-calibration of mounts in a run: values, sigmas, and directions that were not observed.

The posterior covariance P of a mount is compared with its prior C: the eigenvectors of C^-1/2 P C^-1/2 are directions
in units of the prior's sigmas, the eigenvalues by how much each has become better known.  An eigenvalue near 1 belongs
to a direction that no measurement determined.  C^-1/2 is the symmetric root: directions stay near the axes they are
named by.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from kalmark.arrays import Array
from kalmark.declare import unit_of
from kalmark.geometry.named_poses import describe_pose
from kalmark.logs.log import Section
from kalmark.results.figure_texts import Figures, Summary, TextRow, figure
from kalmark.results.history import Biased, CalibratedMount
from kalmark.results.measures import sigmas

AXES = {3: ("x", "y", "theta"), 6: ("x", "y", "z", "roll", "pitch", "yaw")}
UNITS = {"x": "m", "y": "m", "z": "m", "offset": "m"} | dict.fromkeys(("theta", "roll", "pitch", "yaw"), "deg")
UNOBSERVED = 0.9  # of its prior sigma: so much is left of a direction that counts as not observed
SINGULAR = 1e-12  # eigenvalues of a prior's correlations that are zero
NAMED = 0.01  # the least share of an axis in a direction that is named
ESTIMATE_COLUMNS = ("of", "constant", "estimate", "sigma")
_SIGMA_OF = dict.fromkeys(("x_m", "y_m", "z_m"), "sigma_position_m") | dict.fromkeys(
    ("theta_rad", "roll_deg", "pitch_deg", "yaw_deg"), "sigma_rotation_deg"
)
MOUNT_COLUMNS = ("mount", "direction", "sigma before", "after", "ratio (1: not observed)")


class Direction(NamedTuple):
    """A direction in which a mount was uncertain: shares of the axes in it, the largest first, and its sigmas.

    The sigmas are those of the first axis, in `unit`, at the end and of the prior.
    """

    axes: dict[str, float]
    sigma: float
    prior: float
    unit: str

    @property
    def ratio(self) -> float:
        """The sigma at the end over the prior's: 1 for a direction that was not observed."""
        return self.sigma / self.prior

    def __str__(self) -> str:
        return ", ".join(f"{axis} {share:.2f}" for axis, share in self.axes.items())


def directions(prior: Array, posterior: Array, constants: Sequence[str] = ()) -> list[Direction]:
    """Return the directions of a mount between a prior and a posterior covariance, the least observed first.

    The covariances are (3, 3) or (6, 6), and more with the `constants` of the sensor behind.
    Axes of zero prior variance are left out.  Turns are about the axes of the robot.
    """
    open_ = np.flatnonzero(np.diagonal(prior) > 0)
    axes_of = (*AXES[len(prior) - len(constants)], *constants)
    names = [axes_of[i] for i in open_]
    sigma = np.sqrt(np.diagonal(prior)[open_])
    C, P = (cov[np.ix_(open_, open_)] / np.outer(sigma, sigma) for cov in (prior, posterior))
    values, vectors = np.linalg.eigh(C)
    inverse = np.zeros_like(values)
    inverse[values > SINGULAR] = values[values > SINGULAR] ** -0.5
    root = (vectors * inverse) @ vectors.T
    ratios, axes = np.linalg.eigh(root @ P @ root)
    found = []
    for ratio, shares in zip(ratios[::-1].tolist(), axes.T[::-1] ** 2, strict=True):
        order = np.argsort(-shares, kind="stable").tolist()
        first, named = order[0], {names[i]: float(shares[i]) for i in order if shares[i] >= NAMED}
        unit = UNITS.get(names[first], unit_of(names[first]))
        before = float(np.degrees(sigma[first]) if unit == "deg" else sigma[first])
        found.append(Direction(named, math.sqrt(max(ratio, 0.0)) * before, before, unit))
    return found


def mount_figures(mount: CalibratedMount) -> Figures:
    """Return the estimated mount of a self-calibrating sensor, its sigmas, and the directions observed."""
    d, pose, dof = (3, 7, 6) if len(mount.mean) - len(mount.constants) == 7 else (2, 3, 3)
    sigma = sigmas(mount.covariance)
    axes = describe_pose(mount.mean[:pose])
    own = {f"sigma_{key}": each for key, each in zip(axes, sigma[:d].tolist(), strict=False)}
    found = [
        {"direction": str(each), "sigma": each.sigma, "prior_sigma": each.prior, "unit": each.unit, "ratio": each.ratio}
        for each in directions(mount.prior, mount.covariance, mount.constants)
    ]
    return {
        **axes,
        **own,
        "sigma_position_m": float(sigma[:d].max()),
        "sigma_rotation_deg": math.degrees(sigma[d:dof].max()),
        **_constant_figures(mount.constants, mount.mean[pose:], mount.covariance[dof:, dof:]),
        "directions": found,
    }


def bias_figures(bias: Biased, motion: Section) -> dict[str, float]:
    """Return the estimated correction to be added to a robot's controls, and its sigmas.

    Of a parameter of its `motion`, a radius or a track, it is the parameter itself: the configured one, corrected.
    """
    found = {name: motion.get(name, 0.0) + off for name, off in zip(bias.columns, bias.mean.tolist(), strict=True)}
    return found | {f"sigma_{name}": own for name, own in zip(found, sigmas(bias.covariance).tolist(), strict=True)}


def _constant_figures(names: Sequence[str], values: Array, P: Array) -> dict[str, float]:
    """Return a sensor's constants with their sigmas: scale and bias for a gain and an offset, others as named."""
    found, J = dict(zip(names, values.tolist(), strict=True)), np.eye(len(names))
    if "gain" in found:
        gain, offset, i = found.pop("gain"), found.pop("offset", None), names.index("gain")
        J[i:, i:] = (np.array([[-1.0 / gain, 0.0], [-(offset or 0.0) / gain, 1.0]]) / gain)[: len(J) - i, : len(J) - i]
        found |= {"scale": 1.0 / gain} | ({} if offset is None else {"bias_m": offset / gain})
    return found | {f"sigma_{name}": own for name, own in zip(found, sigmas(J @ P @ J.T).tolist(), strict=True)}


def _found(summary: Summary) -> Iterator[tuple[str, Figures, str, str]]:
    """Yield every direction of every mount in a summary, and its sigmas before and after as people read them."""
    for name, figures in summary.get("mounts", {}).items():
        for row in figures.get("directions", ()):
            yield name, row, _sigma(row["prior_sigma"], row["unit"]), _sigma(row["sigma"], row["unit"])


def mount_rows(summary: Summary) -> list[TextRow]:
    """Return a row of text for every direction of every mount in a summary: mount, direction, before, after, ratio."""
    return [(name, row["direction"], *sigmas, f"{row['ratio']:.3f}") for name, row, *sigmas in _found(summary)]


def estimate_rows(summary: Summary) -> list[TextRow]:
    """Return a row of text for every constant of a mount, a range or a control that was estimated."""
    rows: list[TextRow] = []
    for name, figures in {**summary.get("mounts", {}), **summary.get("biases", {})}.items():
        for key, value in figures.items():
            sigma = figures.get(f"sigma_{key}", figures.get(_SIGMA_OF.get(key, ""), 0.0))
            if key == "theta_rad" and sigma > 0:
                rows.append((name, "theta_deg", figure(math.degrees(value)), figure(sigma, 2)))
            elif not key.startswith("sigma_") and isinstance(value, float) and sigma > 0:
                rows.append((name, key, figure(value), figure(sigma, 2)))
    return rows


def mount_warnings(_: Any, summary: Summary) -> Iterator[str]:
    """Return a line for every direction of a mount that was not observed."""
    for name, row, before, after in _found(summary):
        if row["ratio"] > UNOBSERVED:
            axis = row["direction"].split()[0]
            yield (
                f"mount {name}: its {axis} ({row['direction']}) was not observed: sigma {after} of {before}; with this "
                "route and noise it stays as stated: measure it, or drive other turns and slopes"
            )


def _sigma(value: float, unit: str) -> str:
    """Return a sigma as people read it: 5 cm, 1.2 mm, 0.06 deg."""
    if unit != "m":
        return f"{figure(value)} {unit}".rstrip()
    scale, name = (1.0, "m") if value >= 1.0 else (1e-2, "cm") if value >= 1e-2 else (1e-3, "mm")
    return f"{figure(value / scale)} {name}"
