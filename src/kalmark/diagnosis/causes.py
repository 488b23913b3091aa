"""Possible faults of a log or its configuration: systematic errors, noise, landmarks, steps and observations.

Each kind of cause answers with findings.  `gain` is the logarithm of the likelihood ratio against a run without the
cause, the common measure of all; `p` is the probability of such a finding, or a larger one, where nothing is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtr, chdtrc, chdtri, expit, ndtr

from kalmark.arrays import Array, Flags
from kalmark.batch.batch_state import LANDMARKS, Ints
from kalmark.batch.motion_chain import START, UNKNOWN
from kalmark.diagnosis.error_columns import HEIGHT, Column, Where, stacked
from kalmark.diagnosis.linear import OUT, Left, Linear

BLOCKS = 40  # stretches of a run; the variance of their scores is that of a sum of them
LEAST_INFORMATION = 1e-9
LEAST_GAIN = 8.0
SPREADS = (5.0, 20.0, 100.0)  # how many times as wide as the noise outliers may be
MOST_OUTLIERS = 0.2  # of all observations: more are noise
FIRST_SHARE, MIXTURE_ROUNDS = 0.01, 30
FAR = 4.0  # sigmas of an outlier
SETS = 40  # of simulated data
SEEN = 8  # observations of a landmark that can be judged alone
LOOKED_AT = 20  # landmarks
MOST_CONDITION = 1e12
SHOWS = 3.0  # sigmas of a measurement, that a moving landmark is off by in the end
MOST_STEPS = 0.9  # share of steps without a jump
FAR_STEPS, FAR_S = 3.0, 5.0  # no driving: farther than so many long steps, and than it drives in this time
SELDOM = 1e-3
MOST_RHO = 0.999
ALIKE = 0.85  # of what another one explains: they are alike
SUCCESSIVE = 3.0  # times the usual time between two observations of a landmark
TIMES = "times"  # the unit of noise
JUMPS = ("odometry_jump", "kidnapped")


@dataclass(frozen=True, eq=False)
class Finding:
    """A cause that explains the data better by `gain`.  `of` names its robot, sensor or landmark.

    That is robot, sensor and column, or robot, column and kind of error of its controls, or a landmark, or a robot.
    `value` and `sigma` are its size in `unit`.  `cure` is what takes it out of the data: the systematic error itself as
    (Z, W), factors of the noise (N,) and of the motion's errors (r,).  `since_s` is when it begins, after the first
    scan, None for all the time, `until_s` when a systematic error ends.  `alike` are causes that explain the same.
    `moved_m` is by how much a place in the map is wrong for it while it was seen.  `at` is where a surveyed landmark
    seems to be, or the step (q,) of a jump.  `told` are evidence and cure of a cause that no data show, but the log.
    """

    name: str
    of: tuple[str, ...]
    gain: float
    p: float
    value: float
    sigma: float = 0.0
    unit: str = ""
    Z: Array | None = None
    W: Array | None = None
    noise: Array | float = 1.0
    errors: Array | float = 1.0
    rows: Flags | None = None
    since_s: float | None = None
    until_s: float = math.inf
    alike: tuple[Finding, ...] = ()
    moved_m: float | None = None
    at: Array | None = None
    told: tuple[str, str] | None = None

    @property
    def is_steady(self) -> bool:
        """True if it is a systematic error all the time."""
        return self.Z is not None and self.at is None and self.since_s is None

    @property
    def begins(self) -> bool:
        """True if it is a systematic error that begins during the run."""
        return self.Z is not None and self.at is None and self.since_s is not None

    @property
    def kind(self) -> tuple[str, ...]:
        """The kind of a cause: landmarks of one kind explain together, and so do noises.  Other causes are alone."""
        if self.Z is None:
            return (TIMES if self.unit == TIMES else self.name,)
        return (self.name, *self.of, str(self.since_s))

    @property
    def takes_up(self) -> bool:
        """True if it takes up any misfit: a noise that is larger, or outliers."""
        return self.name == "outliers" or (self.unit == TIMES and self.value > 1.0)

    @property
    def overstated(self) -> bool:
        """True if it is a noise that is smaller than stated."""
        return self.unit == TIMES and self.value < 1.0


def systematic(linear: Linear, columns: list[Column]) -> list[Finding]:
    """Return the systematic errors, each as if it were the only one.  Rao's score test.

    Its statistic is divided by the variance of the scores of stretches, where that is above the model's: errors
    that last from scan to scan, or a noise that is not the configured one, would else look like a systematic error.
    """
    if not columns:
        return []
    Z, W = stacked(columns)
    have, left = linear.residuals, linear.left(Z, W)
    g, I = Z.T @ have.r + W.T @ have.m, np.sum(Z * left.r, axis=0) + np.sum(W * left.m, axis=0)
    n, found = len(linear.problem.robots), []
    for k, column in enumerate(columns):
        if not LEAST_INFORMATION * (Z[:, k] @ Z[:, k] + 1.0) < I[k] < math.inf:
            continue
        s = float(g[k] / I[k])
        moves = 0.0 if Z[:, k].any() else np.abs(s * W[:, k]).reshape(n, -1)[:, : linear.state.d].max(initial=0.0)
        if abs(s) > column.most or moves > linear.step or (column.name == HEIGHT and s < 0.0):
            continue  # no small error: the problem is not linear so far away
        parts = stretches(linear, Left(left.r[:, [k]], left.m[:, [k]]), np.array([s]))[0]
        sigma = float(np.sqrt(max(I[k], float(parts @ parts))) / I[k])
        t2 = (s / sigma) ** 2
        found.append(
            Finding(
                column.name,
                column.of,
                0.5 * s * s * float(I[k]),
                float(chdtrc(1, t2)),
                s,
                sigma,
                column.unit,
                column.Z,
                column.W,
            )
        )
    return found


def joint_errors(linear: Linear, columns: list[Column]) -> tuple[Array, Array]:
    """Return the systematic errors s (K,), all at once and within their limits, and their information (K, K)."""
    g, I, _ = linear.scores_of(*stacked(columns))
    s = np.linalg.lstsq(I + np.diag([c.most**-2 for c in columns]), g)[0]
    return np.asarray(s, dtype=np.float64), np.asarray(I, dtype=np.float64)


def stretches(linear: Linear, left: Left, s: Array) -> Array:
    """Return the scores (K, `BLOCKS`) of stretches of the run, with systematic errors s (K,) taken out.

    `left` is what the state leaves of one unit of each.
    """
    (block, motion), have = _blocks(linear), linear.residuals
    rows = left.r * (have.r - left.r @ s)[:, None]
    moves = left.m * (linear.Q @ (have.m - left.m @ s))[:, None]
    parts = [
        np.bincount(block, r, BLOCKS) + np.bincount(motion, m, BLOCKS) for r, m in zip(rows.T, moves.T, strict=True)
    ]
    return np.array(parts)


def _blocks(linear: Linear) -> tuple[Ints, Ints]:
    """Return of which stretch of the run each residual and each error of the motion is."""
    n = len(linear.problem.robots)
    q = len(linear.at.w) // max(n, 1)
    return linear.rows.node * BLOCKS // n, np.repeat(np.arange(n) * BLOCKS // n, q)


# ------------------------------------------------------------------ noise
def noise(linear: Linear, simulated: Left, sensors: Mapping[Where, tuple[str, ...]]) -> list[Finding]:
    """Return the ratio of actual to stated noise of each measured column and component of the controls.

    Variance components: the sum of squares of what is left of a group, over what it is in data as configured.
    """
    rows, factors, found = linear.rows, linear.problem.factors, []
    have = linear.residuals
    most = 0.5 * float(have.r @ have.r + have.m @ (linear.Q @ have.m))  # is all that a noise can explain
    r2, simulated2 = linear.residuals.r**2, simulated.r**2
    for f, factor in enumerate(factors):
        names = sensors.get(factor.sensor, ())
        for column, of_it in _measured(names, factor.R.shape[1], rows.column) if factor.sensor[1] else ():
            mine = (rows.factor == f) & of_it & linear.kept
            name = f"{column.rsplit('_', 1)[0]}_sigma" if column in names else "measurement_sigma"
            of = (*factor.sensor, column)
            factor_of = _ratio(r2[mine].sum(), simulated2[mine].sum(axis=0))
            if factor_of is not None:
                found.append(_noise(name, of, *factor_of, noise=mine))
    e2, simulated2 = linear.errors_of(linear.residuals) ** 2, linear.errors_of(simulated) ** 2
    kinds = np.where(linear.errors < OUT, np.array(linear.problem.motions.kinds), "")
    for kind in dict.fromkeys(k for k in linear.problem.motions.kinds if k != UNKNOWN):
        mine = kinds == kind
        factor_of = _ratio(e2[mine].sum(), simulated2[mine].sum(axis=0))
        if factor_of is not None and (kind != START or factor_of[0] > 1.0):  # a start may be surer than stated
            name = "start" if kind == START else "control_sigma"
            found.append(_noise(name, tuple(kind.split(".")), *factor_of, errors=mine))
    return [replace(f, gain=min(f.gain, most)) if f.value > 1.0 else f for f in found]


def _measured(names: tuple[str, ...], p: int, column: Ints) -> Iterator[tuple[str, Flags]]:
    """Yield the quantities of a sensor of p residuals by name, and their rows among the numbers `column` (N,).

    The corners of a tag have one noise, and its size, a column too, has none.
    """
    if len(names) != p and any(name.endswith("_px") for name in names):
        yield "corners_px", column >= 0
        return
    for c in range(p):
        yield names[c] if len(names) == p else f"component {c}", column == c


def _ratio(value: float, simulated: Array) -> tuple[float, float] | None:
    """Return a sum of squares over its mean, and the degrees of freedom of that; None if there are none."""
    mean, variance = float(simulated.mean()), float(simulated.var())
    if mean < LEAST_INFORMATION or variance <= 0:
        return None
    dof = 2.0 * mean**2 / variance
    return (max(float(value) / mean, 1e-9), dof) if dof >= 1 else None


def _noise(
    name: str, of: tuple[str, ...], ratio: float, dof: float, noise: Flags | bool = False, errors: Flags | bool = False
) -> Finding:
    """Return the finding of a group of residuals, or of errors of the motion, of `ratio` times the variance."""
    gain = 0.5 * dof * (ratio - 1.0 - math.log(ratio))
    p = 2.0 * min(float(chdtrc(dof, ratio * dof)), float(chdtr(dof, ratio * dof)))
    value = math.sqrt(ratio)
    sigma, factors = value / math.sqrt(2.0 * dof), (np.where(noise, value, 1.0), np.where(errors, value, 1.0))
    return Finding(name, of, gain, min(p, 1.0), value, sigma, TIMES, noise=factors[0], errors=factors[1])


def correlations(
    linear: Linear, simulated: Left, sensors: Mapping[Where, tuple[str, ...]], t_s: Array
) -> list[Finding]:
    """Return by how much what is left of successive observations of one landmark is correlated, by sensor and column.

    `t_s` (n,) are the times of the poses.  The noise of a finding is the white noise of the same information.
    """
    rows, found = linear.rows, []
    apart = t_s[rows.node[rows.two]] - t_s[rows.node[rows.one]]
    soon = apart <= SUCCESSIVE * np.median(apart) if len(apart) else np.ones(0, dtype=np.bool_)
    pairs = linear.residuals.r[rows.one] * linear.residuals.r[rows.two]
    squares = 0.5 * (linear.residuals.r[rows.one] ** 2 + linear.residuals.r[rows.two] ** 2)
    both = simulated.r[rows.one] * simulated.r[rows.two]
    for f, factor in enumerate(linear.problem.factors):
        names = sensors.get(factor.sensor, ())
        for c in range(factor.R.shape[1]) if factor.sensor[1] else ():
            mine = soon & (rows.factor[rows.one] == f) & (rows.column[rows.one] == c)
            usual, total, number = both[mine].sum(axis=0), squares[mine].sum(), int(mine.sum())
            if number < SETS or total <= 0 or usual.std() == 0:
                continue
            rho = float(np.clip(pairs[mine].sum() / total - usual.mean() / number, -MOST_RHO, MOST_RHO))
            sigma = float(usual.std() / number)
            column = names[c] if len(names) == factor.R.shape[1] else f"component {c}"
            gain = -0.5 * number * math.log(1.0 - rho**2)
            p = 2.0 * float(ndtr(-abs(rho) / sigma))
            mine = (rows.factor == f) & (rows.column == c)
            noise = np.where(mine, math.sqrt(max((1.0 + rho) / (1.0 - rho), 1.0)), 1.0)
            found.append(Finding("correlated_noise", (*factor.sensor, column), gain, p, rho, sigma, noise=noise))
    return found


# ------------------------------------------------------------------ single observations, landmarks and steps
def outliers(linear: Linear, t_s: Array) -> list[Finding]:
    """Return how much better a mixture with few observations of a far wider noise explains what is left."""
    of = linear.observations
    d2, m = np.bincount(of, linear.residuals.r**2), np.bincount(of)
    if not len(d2):
        return []
    d2[of[linear.surveys]] = 0.0  # a survey that is off is a cause of its own
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
    p, sigma = float(chdtrc(2, 2 * gain)), math.sqrt(max(share, 1e-9) / len(d2))
    noise, when = np.where(far[of], OUT, 1.0), t_s[linear.rows.node[far[of]]]
    return [Finding("outliers", (), gain, p, share, sigma, "of the observations", noise=noise, rows=far,
                    since_s=float(when.min(initial=np.inf)))]  # fmt: skip


def moving_landmarks(linear: Linear, t_s: Array) -> list[Finding]:
    """Return the landmarks that move: whose observations fit a constant velocity better than a place.

    `t_s` (n,) are the times of the poses.  Only those are looked at that seem to move most with all else as it is.
    """
    rows, have, d, found = linear.rows, linear.residuals.r, linear.state.d, []
    if linear.state.spaces[LANDMARKS].dof < d:
        return []
    block, _ = _blocks(linear)
    for _, l, mine, part in sorted(_seeming(linear, t_s), key=lambda seems: -seems[0])[:LOOKED_AT]:
        Z = np.zeros((len(have), d))
        Z[mine] = part
        left = linear.left(Z, np.zeros((len(linear.at.w), d))).r
        I, g = part.T @ left[mine], part.T @ have[mine]
        if np.linalg.cond(I) > MOST_CONDITION:
            continue
        v = np.linalg.solve(I, g)
        if np.abs(part @ v).max() < SHOWS:
            continue
        speed = float(np.linalg.norm(v))
        parts = np.bincount(block, (left @ v / speed) * (have - left @ v))
        information = float(v @ I @ v) / speed**2
        sigma = math.sqrt(max(information, float(parts @ parts))) / information
        p = float(chdtrc(d, (speed / sigma) ** 2))
        noise = np.where(rows.landmark == l, OUT, 1.0)
        since_s = float(t_s[rows.node[mine]].min())
        name, gain = str(linear.problem.ids[l]), 0.5 * float(g @ v)
        moved_m = speed * float(np.ptp(t_s[rows.node[mine]]))
        found.append(Finding("moving_landmark", (name,), gain, p, speed, sigma, "m/s", noise=noise, since_s=since_s,
                             moved_m=moved_m))  # fmt: skip
    return found


def _seeming(linear: Linear, t_s: Array) -> Iterator[tuple[float, int, Ints, Array]]:
    """Yield of each landmark how much it seems to move, its number, its rows and their derivative by a velocity."""
    rows, d = linear.rows, linear.state.d
    at = linear.state.columns(LANDMARKS, np.arange(len(linear.problem.ids)))
    order = np.argsort(rows.landmark, kind="stable")
    ends = np.searchsorted(rows.landmark[order], np.arange(len(linear.problem.ids) + 1))
    for l in range(len(linear.problem.ids)):
        mine = order[ends[l] : ends[l + 1]]
        t = t_s[rows.node[mine]]
        if linear.kept[mine].sum() < SEEN * d or np.ptp(t) <= 0:
            continue
        part = linear.at.H[mine][:, at[l] : at[l] + d].toarray() * (t - t.mean())[:, None]
        g = part.T @ linear.residuals.r[mine]
        yield float(g @ np.linalg.pinv(part.T @ part) @ g), l, mine, part


def jumps(linear: Linear, t_s: Array) -> list[Finding]:
    """Return the step of the motion that fits best if any motion may be there, and what jump that is.

    Only the steps of the largest errors are looked at, and how each robot comes to its start.  A jump farther than
    steps are long, and than landmarks are apart or a robot drives in some seconds, is "kidnapped", else it is the
    odometry that jumps.  `p` counts it in
    the chi-square of steps all over the run, which is larger where errors of a sensor last, or where noise is.
    """
    e = linear.errors_of(linear.residuals)
    root = linear.problem.motions.root.tocoo()
    n = len(linear.problem.robots)
    q = len(linear.at.w) // max(n, 1)
    owner = np.full(len(e), -1)
    owner[root.col] = root.row // q
    kinds = np.array(linear.problem.motions.kinds)
    counts = ~np.isin(kinds, (START, UNKNOWN)) & (owner >= 0)
    squares = np.bincount(owner[counts], e[counts] ** 2, minlength=n)
    starts = [*{robot: k for k, robot in reversed([*enumerate(linear.problem.robots)])}.values()]
    nodes = [*np.argsort(-squares)[: min(LOOKED_AT, int((squares > 0).sum()))].tolist(), *starts]
    found: list[Finding] = []
    times = np.unique(t_s)
    usual_s = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    for node, (chi2, step, W) in zip(nodes, _free_steps(linear, nodes), strict=True):
        if chi2 <= 0:
            continue
        size, robot = math.sqrt(chi2), linear.problem.robots[node]
        driven = linear.step * FAR_S / usual_s if usual_s > 0 else np.inf
        far = np.linalg.norm(step[: linear.state.d]) > max(min(linear.spacing, driven), FAR_STEPS * linear.step)
        name = "start" if node in starts else "kidnapped" if far else "odometry_jump"
        errors, none = np.where((owner == node) & counts, OUT, 1.0), np.zeros(len(linear.at.z))
        found.append(Finding(
            name, (robot, f"{t_s[node]:.6g}"), 0.5 * chi2, min(1.0, n * float(chdtrc(q, chi2))), size, 1.0,
            "sigmas", none, W / size, errors=errors, since_s=float(t_s[node]), at=step,
        ))  # fmt: skip
    most = max((f.gain for f in found), default=0.0)
    begins = [f for f in found if f.name == "start" and f.gain > ALIKE * most]  # so is the first step in all but name
    best = sorted(begins or found, key=lambda f: -f.gain)[:1]
    if not best or best[0].p > SELDOM:
        return best
    known = np.flatnonzero(squares > 0)
    usual = [chi2 for chi2, *_ in _free_steps(linear, known[:: max(1, len(known) // SETS)].tolist())]
    larger = max(1.0, float(np.quantile(usual, MOST_STEPS)) / float(chdtri(q, 1.0 - MOST_STEPS)))
    return [replace(best[0], p=min(1.0, n * float(chdtrc(q, 2.0 * best[0].gain / larger))))]


def _free_steps(linear: Linear, nodes: list[int]) -> Iterator[tuple[float, Array, Array]]:
    """Yield of each node by how much chi-square falls if any step leads to it, the step (q,), what it adds (q n,)."""
    q = len(linear.at.w) // max(len(linear.problem.robots), 1)
    rows = np.array(nodes)[:, None] * q + np.arange(q)
    W = np.zeros((len(linear.at.w), rows.size))
    W[rows.ravel(), np.arange(rows.size)] = 1.0
    left, m = linear.left(np.zeros((len(linear.at.z), rows.size)), W).m, linear.residuals.m
    for mine, columns in zip(rows, np.arange(rows.size).reshape(-1, q), strict=True):
        step = np.linalg.pinv(left[np.ix_(mine, columns)], rcond=1.0 / MOST_CONDITION, hermitian=True) @ m[mine]
        yield float(m[mine] @ step), step, W[:, columns] @ step


def priors(linear: Linear, t_s: Array) -> list[Finding]:
    """Return the surveyed landmarks that are elsewhere than their survey, each as if it were the only one.

    Their observations determine where they are.  Only those are looked at whose surveys seem to be off most.
    """
    rows, d, found = linear.rows, linear.state.d, []
    for _, l, place, sign, mine, part in sorted(_surveyed(linear), key=lambda seems: -seems[0])[:LOOKED_AT]:
        Z = np.zeros((len(linear.at.z), d))
        Z[mine] = part
        left = linear.left(Z, np.zeros((len(linear.at.w), d))).r
        I, g = part.T @ left[mine], part.T @ linear.residuals.r[mine]
        if not 0 < np.linalg.cond(I) < MOST_CONDITION:
            continue
        off = np.linalg.solve(I, g)
        far, chi2 = float(np.linalg.norm(off)), float(g @ off)
        if far <= 0 or chi2 <= 0:
            continue
        parts = np.bincount(_blocks(linear)[0], (left @ off) * (linear.residuals.r - left @ off))
        sigmas = chi2 / math.sqrt(max(chi2, float(parts @ parts)))
        seen = (rows.landmark == l) & linear.kept
        noise = np.ones(len(linear.at.z))
        noise[mine] = OUT
        since_s = float(t_s[rows.node[seen]].min()) if seen.any() else 0.0
        name, p = str(linear.problem.ids[l]), float(chdtrc(d, sigmas**2))
        found.append(Finding("landmark_prior", (name,), 0.5 * chi2, p, far, far / sigmas, "m", noise=noise,
                             since_s=since_s, at=place + sign * off))  # fmt: skip
    return found


def _surveyed(linear: Linear) -> Iterator[tuple[float, int, Array, int, Ints, Array]]:
    """Yield of each surveyed landmark how much it seems to be off, its number and place, a sign, rows and derivative.

    A survey with a covariance is data: it is off by what was added to it, sign -1.  One that is exact is not: its
    observations are of a landmark that is elsewhere, sign +1.
    """
    d, problem, rows = linear.state.d, linear.problem, linear.rows
    if linear.state.spaces[LANDMARKS].dof < d:
        return
    have, at = linear.residuals.r, linear.state.columns(LANDMARKS, np.arange(len(problem.ids)))
    surveys: list[tuple[int, Array, int, Ints]] = []
    for f, factor in enumerate(problem.factors):
        block = factor.term.blocks[0]
        if factor.is_survey:
            at_factor = np.flatnonzero((rows.factor == f) & linear.kept)
            of = [at_factor[rows.row[at_factor] == k] for k in range(len(factor.y))]
            surveys += [(l, *rest) for l, *rest in zip(block.rows.tolist(), factor.y, [-1] * len(of), of, strict=True)]
    for l in np.flatnonzero(~problem.free[at]).tolist():
        seen = np.flatnonzero((rows.landmark == l) & linear.kept)
        surveys.append((l, linear.state.groups[LANDMARKS][l, :d], 1, seen))
    for l, place, sign, mine in surveys:
        if len(mine) >= d:
            part = linear.at.H[mine][:, at[l] : at[l] + d].toarray()
            g = part.T @ have[mine]
            yield float(g @ np.linalg.pinv(part.T @ part) @ g), l, place, sign, mine, part
