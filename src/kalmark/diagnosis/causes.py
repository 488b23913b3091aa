"""What may be wrong with a log or its configuration: systematic errors, noise, landmarks, steps and observations.

Each kind of cause answers with findings.  `gain` is the logarithm of the likelihood ratio against a run without the
cause, the common measure of all; `p` is the probability of such a finding, or a larger one, where nothing is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit
from scipy.stats import chi2, norm

from kalmark.arrays import Array, Flags
from kalmark.batch.course import START
from kalmark.batch.state import POSES, Ints
from kalmark.diagnosis.linear import OUT, Left, Linear
from kalmark.results.measures import pose_error

BLOCKS = 40  # stretches of a run, whose scores tell how much a sum of them varies
LEAST_INFORMATION = 1e-9
SPREADS = (5.0, 20.0, 100.0)  # how many times as wide as the noise outliers may be
MOST_OUTLIERS = 0.2  # of all observations: more are noise
FIRST_SHARE, MIXTURE_ROUNDS = 0.01, 30
FAR = 4.0  # sigmas of an outlier
SETS = 40  # of simulated data
SEEN = 8  # times a landmark that can be judged by itself
SLOW_S = 1e-3
MOST_RHO = 0.999
TIMES = "times"  # the unit of noise

Where = tuple[str, str]


@dataclass(frozen=True, eq=False)
class Finding:
    """A cause that explains the data better by `gain`, `name` and `label` say what it is of.

    `value` and `sigma` are its size in `unit`.  `cure` is what takes it out of the data: the systematic error itself as
    (Z, W), factors of the noise (N,) and of the motion's errors (r,).  `alike` are causes that explain the same.
    """

    name: str
    label: str
    gain: float
    p: float
    value: float
    sigma: float = 0.0
    unit: str = ""
    Z: Array | None = None
    W: Array | None = None
    noise: Array | None = None
    errors: Array | None = None
    rows: Flags | None = None
    alike: tuple[Finding, ...] = ()


class Column(NamedTuple):
    """A systematic error: what it is, and what one unit of it adds to the data, Z (N,) and W (q n,)."""

    name: str
    label: str
    unit: str
    Z: Array
    W: Array


def columns_of(linear: Linear, sensors: Mapping[Where, tuple[str, ...]], rates: Array) -> list[Column]:
    """Return the systematic errors that data may have.

    `sensors` are the columns that each sensor measures, `rates` (n, q) the velocities of the poses, in the world.
    """
    found = [*_of_sensors(linear, sensors, rates), *_of_controls(linear)]
    return [column for column in found if np.isfinite(column.Z).all() and (column.Z.any() or column.W.any())]


def _of_sensors(linear: Linear, sensors: Mapping[Where, tuple[str, ...]], rates: Array) -> Iterator[Column]:
    factors, none = linear.problem.factors, np.zeros(len(linear.at.w))
    for f, factor in enumerate(factors):
        names, (k, p) = sensors.get(factor.sensor, ()), factor.R.shape[:2]
        if len(names) != p:
            continue
        where, (z, E) = ".".join(factor.sensor), factor.term.at(linear.state)

        def added(part: Array, f: int = f) -> Array:
            parts = [np.zeros(other.R.shape[:2]) for other in factors]
            parts[f] += part
            return linear.whitened(parts)

        for c, name in enumerate(names):
            one = np.eye(p)[c]
            if name.startswith("range"):
                yield Column("range_scale", where, "", added((factor.y - z)[:, c : c + 1] * one), none)
                yield Column("range_offset", where, "m", added(np.tile(one, (k, 1))), none)
            elif name.endswith("_rad"):
                yield Column(f"{name.removesuffix('_rad')}_offset", where, "rad", added(np.tile(one, (k, 1))), none)
        pose = factor.term.blocks[0]
        moving = np.einsum("kij,kj->ki", E[:, :, : pose.space.dof], rates[pose.rows])
        yield Column("time_offset", where, "s", added(moving), none)


def _of_controls(linear: Linear) -> Iterator[Column]:
    nothing = np.zeros(len(linear.at.z))
    for k, error in enumerate(linear.problem.motions.errors):
        turns = error.column.endswith(("_rad", "_radps"))
        name = "odometry_turn" if turns else "odometry_scale" if error.kind == "scale" else "odometry_offset"
        if error.column == "steering_rad":
            name = "steering_offset"
        label = f"{error.robot} {error.column} {error.kind}"
        yield Column(name, label, error.unit, nothing, linear.problem.motions.systematic[:, k])


def rates_of(linear: Linear, robot: Any, t_ns: Ints) -> Array:
    """Return the velocities (n, q) of the poses at the scans, of `robot` (S,) at `t_ns` (S,), zero of all others."""
    nodes, poses = linear.problem.nodes, linear.state.groups[POSES]
    out = np.zeros((len(poses), linear.state.spaces[POSES].dof))
    for name in dict.fromkeys(robot.tolist()):
        mine = np.flatnonzero(robot == name)
        node, first = np.unique(nodes[mine], return_index=True)
        t = t_ns[mine][first] * 1e-9
        after = np.maximum(t[2:] - t[:-2], SLOW_S)
        out[node[1:-1]] = pose_error(poses[node[:-2]], poses[node[2:]]) / after[:, None]
    return out


def systematic(linear: Linear, columns: list[Column]) -> list[Finding]:
    """Return the systematic errors, each as if it were the only one.  Rao's score test.

    Its statistic is divided by how much the scores of stretches vary, where that is more than the model says: errors
    that last from scan to scan, or a noise that is not the configured one, would else look like a systematic error.
    """
    if not columns:
        return []
    Z, W = np.stack([c.Z for c in columns], axis=1), np.stack([c.W for c in columns], axis=1)
    have, left = linear.residuals, linear.left(Z, W)
    g, I = Z.T @ have.r + W.T @ have.m, np.sum(Z * left.r, axis=0) + np.sum(W * left.m, axis=0)
    block, motion = _blocks(linear)
    found = []
    for k, column in enumerate(columns):
        if not LEAST_INFORMATION * (Z[:, k] @ Z[:, k] + 1.0) < I[k] < math.inf:
            continue
        s = float(g[k] / I[k])
        parts = np.bincount(block, Z[:, k] * (have.r - s * left.r[:, k]), minlength=BLOCKS)
        parts += np.bincount(motion, W[:, k] * (have.m - s * left.m[:, k]), minlength=BLOCKS)
        sigma = float(np.sqrt(max(I[k], float(parts @ parts))) / I[k])
        t2 = (s / sigma) ** 2
        found.append(
            Finding(
                column.name,
                column.label,
                0.5 * s * s * float(I[k]),
                float(chi2.sf(t2, 1)),
                s,
                sigma,
                column.unit,
                column.Z,
                column.W,
            )
        )
    return found


def _blocks(linear: Linear) -> tuple[Ints, Ints]:
    """Return of which stretch of the run each residual and each error of the motion is."""
    n = len(linear.problem.robots)
    q = len(linear.at.w) // max(n, 1)
    return linear.rows.node * BLOCKS // n, np.repeat(np.arange(n) * BLOCKS // n, q)


# ------------------------------------------------------------------ noise
def noise(linear: Linear, simulated: Left, sensors: Mapping[Where, tuple[str, ...]]) -> list[Finding]:
    """Return how much larger the noise of each measured column, and component of the controls, is than stated.

    Variance components: the sum of squares of what is left of a group, over what it is in data as configured.
    """
    rows, factors, found = linear.rows, linear.problem.factors, []
    r2, simulated2 = linear.residuals.r**2, simulated.r**2
    for f, factor in enumerate(factors):
        names = sensors.get(factor.sensor, ())
        for c in range(factor.R.shape[1]) if factor.sensor[1] else ():
            mine = (rows.factor == f) & (rows.column == c) & linear.kept
            column = names[c] if len(names) == factor.R.shape[1] else ""
            name = f"{column.rsplit('_', 1)[0]}_sigma" if column else "measurement_sigma"
            label = f"{'.'.join(factor.sensor)} {column or f'component {c}'}"
            factor_of = _ratio(r2[mine].sum(), simulated2[mine].sum(axis=0))
            if factor_of is not None:
                found.append(_noise(name, label, *factor_of, noise=mine))
    e2, simulated2 = linear.errors_of(linear.residuals) ** 2, linear.errors_of(simulated) ** 2
    kinds = np.where(linear.errors < OUT, np.array(linear.problem.motions.kinds), "")
    for kind in dict.fromkeys(linear.problem.motions.kinds):
        mine = kinds == kind
        factor_of = _ratio(e2[mine].sum(), simulated2[mine].sum(axis=0))
        if factor_of is not None:
            name = "start" if kind == START else "control_sigma"
            label = kind if kind == START or not kind.endswith(".") else f"{kind[:-1]} unmodelled motion"
            found.append(_noise(name, label, *factor_of, errors=mine))
    return found


def _ratio(value: float, simulated: Array) -> tuple[float, float] | None:
    """Return a sum of squares over its mean, and the degrees of freedom of that; None if there are none."""
    mean, variance = float(simulated.mean()), float(simulated.var())
    if mean < LEAST_INFORMATION or variance <= 0:
        return None
    dof = 2.0 * mean**2 / variance
    return (max(float(value) / mean, 1e-9), dof) if dof >= 1 else None


def _noise(
    name: str, label: str, ratio: float, dof: float, noise: Flags | None = None, errors: Flags | None = None
) -> Finding:
    """Return the finding of a group of residuals, or of errors of the motion, of `ratio` times the variance."""
    gain = 0.5 * dof * (ratio - 1.0 - math.log(ratio))
    p = 2.0 * min(float(chi2.sf(ratio * dof, dof)), float(chi2.cdf(ratio * dof, dof)))
    value = math.sqrt(ratio)
    factors = [None if group is None else np.where(group, value, 1.0) for group in (noise, errors)]
    sigma = value / math.sqrt(2.0 * dof)
    return Finding(name, label, gain, min(p, 1.0), value, sigma, TIMES, noise=factors[0], errors=factors[1])


def correlations(linear: Linear, simulated: Left, sensors: Mapping[Where, tuple[str, ...]]) -> list[Finding]:
    """Return by how much what is left of successive sightings of one landmark is correlated, by sensor and column."""
    rows, found = linear.rows, []
    pairs = linear.residuals.r[rows.one] * linear.residuals.r[rows.two]
    squares = 0.5 * (linear.residuals.r[rows.one] ** 2 + linear.residuals.r[rows.two] ** 2)
    both = simulated.r[rows.one] * simulated.r[rows.two]
    for f, factor in enumerate(linear.problem.factors):
        names = sensors.get(factor.sensor, ())
        for c in range(factor.R.shape[1]) if factor.sensor[1] else ():
            mine = (rows.factor[rows.one] == f) & (rows.column[rows.one] == c)
            usual, total, number = both[mine].sum(axis=0), squares[mine].sum(), int(mine.sum())
            if number < SETS or total <= 0 or usual.std() == 0:
                continue
            rho = float(np.clip(pairs[mine].sum() / total - usual.mean() / number, -MOST_RHO, MOST_RHO))
            sigma = float(usual.std() / number)
            column = names[c] if len(names) == factor.R.shape[1] else f"component {c}"
            gain = -0.5 * number * math.log(1.0 - rho**2)
            p = 2.0 * float(norm.sf(abs(rho) / sigma))
            found.append(Finding("correlated_noise", f"{'.'.join(factor.sensor)} {column}", gain, p, rho, sigma))
    return found


# ------------------------------------------------------------------ single observations, landmarks and steps
def outliers(linear: Linear) -> list[Finding]:
    """Return how much better a mixture with few observations of a far wider noise explains what is left."""
    of = linear.observations
    d2, m = np.bincount(of, linear.residuals.r**2), np.bincount(of)
    if not len(d2):
        return []
    best = (0.0, 0.0)
    for spread in SPREADS:
        log_u, share = 0.5 * d2 * (1 - spread**-2) - m * math.log(spread), FIRST_SHARE
        for _ in range(MIXTURE_ROUNDS):
            outlying = expit(log_u + math.log(share / (1 - share)))
            share = min(max(float(np.mean(outlying)), 1e-12), MOST_OUTLIERS)
        gain = float(np.logaddexp(math.log1p(-share), math.log(share) + log_u).sum())
        best = max(best, (gain, share))
    gain, share = best
    far = d2 > FAR**2 + m
    p, sigma = float(chi2.sf(2 * gain, 2)), math.sqrt(max(share, 1e-9) / len(d2))
    noise = np.where(far[of], OUT, 1.0)
    return [Finding("outliers", "observations", gain, p, share, sigma, "of the observations", noise=noise, rows=far)]


def landmarks(linear: Linear, t_s: Array) -> list[Finding]:
    """Return the landmarks that move: whose sightings fit a constant velocity better than a place.

    `t_s` (n,) are the times of the poses.
    """
    rows, found = linear.rows, []
    d, dof = linear.state.d, linear.state.spaces[1].dof
    at = linear.state.columns(1, np.arange(len(linear.problem.ids)))
    H, have = linear.at.H, linear.residuals.r
    for l, name in enumerate(linear.problem.ids):
        mine = np.flatnonzero(rows.landmark == l)
        if len(mine) < SEEN * d:
            continue
        t = t_s[rows.node[mine]]
        if np.ptp(t) <= 0:
            continue
        Z = np.zeros((len(have), d))
        Z[mine] = H[mine][:, at[l] : at[l] + d].toarray() * (t - t.mean())[:, None]
        b = H.T @ Z
        step, _ = linear.reduced.solved(Z, np.zeros((len(linear.at.w), d)))
        I, g = Z.T @ Z - b.T @ step, Z.T @ have
        try:
            v = np.linalg.solve(I, g)
        except np.linalg.LinAlgError:
            continue
        others = linear.residuals.r[mine] ** 2
        scale = max(float(others.mean()), 1.0)
        t2 = float(g @ v)
        speed, sigma = float(np.linalg.norm(v)), float(np.sqrt(np.trace(np.linalg.inv(I)) / d))
        if not math.isfinite(t2) or t2 < 0 or dof < d:
            continue
        found.append(
            Finding("moving_landmark", str(name), 0.5 * t2, float(chi2.sf(t2 / scale, d)), speed, sigma, "m/s",
                    noise=np.where(rows.landmark == l, OUT, 1.0))
        )  # fmt: skip
    return found


def jumps(linear: Linear) -> list[Finding]:
    """Return the step of the motion whose error is largest."""
    e = linear.errors_of(linear.residuals)
    root = linear.problem.motions.root.tocoo()
    n = len(linear.problem.robots)
    q = len(linear.at.w) // max(n, 1)
    owner = np.full(len(e), -1)
    owner[root.col] = root.row // q
    kinds = np.array(linear.problem.motions.kinds)
    counts = np.array([kind != START for kind in kinds.tolist()]) & (owner >= 0)
    squares = np.bincount(owner[counts], e[counts] ** 2, minlength=n)
    numbers = np.bincount(owner[counts], minlength=n)
    if not len(squares):
        return []
    node = int(np.argmax(squares))
    p = min(1.0, n * float(chi2.sf(squares[node], max(int(numbers[node]), 1))))
    errors = np.where((owner == node) & counts, OUT, 1.0)
    return [
        Finding("kidnapped", linear.problem.robots[node], 0.5 * float(squares[node]), p, math.sqrt(squares[node]),
                1.0, "sigmas", errors=errors, rows=np.arange(n) == node)
    ]  # fmt: skip
