"""What a fit minimises: weighted least squares of simulations over all logs at once.

A `Problem` says what is fitted to which logs and never changes. A `State` says where a fit stands.
Functions take both and return a new state. The cost is

    Σ ‖residual/scale‖² + prior_weight · (Σ ‖shift‖² + Σ ((θ − centre)/std)²),

where ``shift`` moves a log's initial state in standard deviations of what its first samples leave
open (`initial_states.Uncertain`). Each log's shifts are nuisances of that log alone and are
eliminated from its block of the normal equations (`covariance.eliminate`)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ehbench.identification.covariance import Block, Prior
from ehbench.identification.journal import Journal
from ehbench.identification.search import Coordinate, of_sensors
from ehbench.identification.simulator import Log, Meshes, Shifts, Simulator
from ehbench.preprocessing.initial_states import prior_weight
from ehbench.signals.series import lowpass, rms, white_noise
from ehbench.vocabulary import Progress, setting


@dataclass(frozen=True)
class ProblemSettings:
    """Numbers of the least squares of a fit."""

    scale_floor: float = setting(
        5e-3, "", "smallest scale of a residual, share of its channel's spread", "best sensors"
    )
    faint: float = setting(
        2e-3,
        "",
        "change of every channel, share of its spread, up to which a parameter is not excited when "
        "it moves by a factor e or its whole range",
        "below the scatter of the best sensors",
    )
    difference: float = setting(
        1e-5,
        "",
        "step of finite differences, in units of a parameter",
        "larger ones bend over 30 s",
    )
    limit: float = setting(
        1e6, "", "largest residual, in spreads of its channel", "squares stay finite"
    )
    failed: float = setting(
        10.0, "", "residual of a failed simulation, in spreads", "worse than any useful one"
    )
    coarse_slack: float = setting(
        100.0, "", "error of integration in the coarse search over that of the fit", "half the time"
    )
    near_theta: float = setting(
        0.02,
        "",
        "move of a parameter, in its units, up to which integration steps are taken again",
        "chosen steps shift costs, which are compared to a millionth",
    )
    near_shift: float = setting(
        1.0, "", "the same of an initial state, in standard deviations", "as above"
    )


SETTINGS = ProblemSettings()


@dataclass(frozen=True, eq=False)
class Mesh:
    """The integration ``steps`` by log, and the point and ``slack`` for which they were chosen."""

    theta: np.ndarray
    shifts: Shifts
    steps: Meshes
    slack: float

    def serves(self, theta: np.ndarray, shifts: Shifts, slack: float) -> bool:
        """Whether a point is so near that its simulations may take the same steps."""
        if slack != self.slack or np.any(np.abs(theta - self.theta) > SETTINGS.near_theta):
            return False
        moves = [np.abs(a - b) for a, b in zip(shifts, self.shifts, strict=True)]
        return all(np.all(move <= SETTINGS.near_shift) for move in moves)


@dataclass(frozen=True, eq=False)
class Point:
    """A simulated point: search coordinates, shifts of the initial states, residuals [SI] by log,
    and the mesh they were simulated on. The columns of the Jacobians [SI] that are known already
    are cached: by (parameter, log) and by (log, shift)."""

    theta: np.ndarray
    shifts: Shifts
    residuals: list[np.ndarray]
    mesh: Mesh
    columns: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)
    start_columns: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Problem:
    """What is fitted to which logs.

    Args:
        simulator: of the logs; its parameters are those of ``search`` in the same order.
        search: the ``requested`` parameters, then the sensor terms that all logs share (up to
            ``fitted``).
        spread: rms [SI] of each channel about its mean.
        averaged: rms [SI] of the noise that block averages leave out, by channel.
        cutoff: of the low-pass on the residuals [Hz].
        max_iterations: of one descent.
        report: progress.
        journal: how far the search has come."""

    simulator: Simulator
    search: tuple[Coordinate, ...]
    requested: int
    fitted: int
    spread: Mapping[str, float]
    averaged: Mapping[str, float]
    cutoff: float | None
    max_iterations: int
    report: Progress
    journal: Journal

    @property
    def logs(self) -> Sequence[Log]:
        return self.simulator.logs

    def over(self, logs: Sequence[Log]) -> Problem:
        """The same problem over other logs; scales and effort stay those of the first."""
        return replace(self, simulator=self.simulator.over(logs))

    def values(self, theta: np.ndarray) -> list[float]:
        """Values [SI] of the parameters at search coordinates."""
        return [c.at(x) for c, x in zip(self.search, theta, strict=True)]

    def by_name(self, theta: np.ndarray) -> dict[str, float]:
        """The same by name; of sensors their bias."""
        return dict(zip((c.name for c in self.search), self.values(theta), strict=True))

    def bounds(self, which: Sequence[int]) -> np.ndarray:
        """Bounds in search coordinates, shape (parameters, 2)."""
        return np.array([self.search[i].bounds for i in which]).reshape(-1, 2)

    def room(
        self, theta: np.ndarray, which: Sequence[int], within: np.ndarray | None = None
    ) -> np.ndarray:
        """Bounds between which each parameter may move by itself from a point: those that are its
        own, or where another one limits it; shape (parameters, 2).

        Args:
            within: to look no farther than there, shape (parameters, 2); its own bounds by default.
        """
        ends = self.bounds(which) if within is None else within.copy()
        for i, row in zip(which, ends, strict=True):
            for side, end in enumerate(row):
                if end == theta[i] or not self.limit(theta, i, end):
                    continue
                inner, outer = theta[i], end
                while abs(outer - inner) > SETTINGS.difference:
                    middle = 0.5 * (inner + outer)
                    allowed = not self.limit(theta, i, middle)
                    inner, outer = (middle, outer) if allowed else (inner, middle)
                row[side] = inner
        return ends

    def limit(self, theta: np.ndarray, i: int, value: float) -> str:
        """What limits parameter i at a search coordinate beside the others; empty if nothing."""
        moved = theta.copy()
        moved[i] = value
        return self.simulator.misfit(self.values(moved))

    def limit_at(self, theta: np.ndarray, i: int) -> str:
        """The same of a parameter that has come to such a limit."""
        steps = SETTINGS.difference * np.array([-1.0, 1.0])
        limits = (self.limit(theta, i, x) for x in np.clip(theta[i] + steps, *self.bounds([i]).T))
        return next(filter(None, limits), "")

    def residual(self, log: Log, simulated: np.ndarray | None) -> np.ndarray:
        """Simulated − recorded [SI], low-passed, zero where a sample does not count, shape
        (samples, channels)."""
        spread = by_channel(self.spread, log)
        if simulated is None:
            return np.tile(SETTINGS.failed * spread, (len(log.recorded), 1)) * log.counts
        limit = SETTINGS.limit * spread
        residual = np.clip(simulated - log.recorded, -limit, limit)
        residual = lowpass(residual, log.sample_time, self.cutoff) if self.cutoff else residual
        return residual * log.counts


def problem_of(
    simulator: Simulator,
    search: Sequence[Coordinate],
    report: Progress | None,
    max_iterations: int,
    cutoff: float | None = None,
    journal: Journal | None = None,
) -> Problem:
    """The problem of fitting ``search``, and what the logs' sensors share, to the simulator's
    logs."""
    sensors, logs = of_sensors(simulator.logs[0].start.terms), simulator.logs
    names = sorted({channel for log in logs for channel in log.channels})
    about = [log.recorded - np.mean(log.recorded, axis=0) for log in logs]
    averaged = [np.tile(log.within, (len(log.recorded), 1)) for log in logs]
    return Problem(
        simulator,
        (*search, *sensors),
        len(search),
        len(search) + len(sensors),
        {c: pooled(logs, c, about) for c in names},
        {c: pooled(logs, c, averaged) for c in names},
        cutoff,
        max_iterations,
        report or (lambda text, share: None),
        journal or Journal(),
    )


@dataclass(frozen=True, eq=False)
class State:
    """Where a fit stands.

    ``free``, ``at_bound`` and ``ranges`` (by index, the part of its range that the logs do not
    deny) tell what each parameter does; ``influence[i, k]`` whether parameter i moves log k;
    ``coarse`` whether this is the search for a basin; ``point`` is what was simulated last."""

    theta: np.ndarray
    shifts: Shifts
    scales: Mapping[str, float]
    influence: np.ndarray
    free: tuple[int, ...]
    at_bound: tuple[int, ...] = ()
    ranges: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    prior_weight: float = 1.0
    coarse: bool = True
    point: Point | None = None

    @property
    def live(self) -> tuple[int, ...]:
        """Parameters that are free or at a bound."""
        return tuple(sorted((*self.free, *self.at_bound)))

    @property
    def slack(self) -> float:
        """Of the integration's steps."""
        return SETTINGS.coarse_slack if self.coarse else 1.0

    @property
    def here(self) -> Point:
        """What was simulated last: that of `evaluate`."""
        assert self.point is not None
        return self.point

    def fixed(self, i: int) -> State:
        """The state with a parameter that is not free."""
        return replace(self, free=tuple(k for k in self.free if k != i))

    def moved(self, i: int, theta: float) -> State:
        """The state with one parameter elsewhere."""
        moved = self.theta.copy()
        moved[i] = theta
        return replace(self, theta=moved)


def initial(problem: Problem) -> State:
    """Where a fit starts."""
    return State(
        np.array([c.begin for c in problem.search]),
        problem.simulator.unshifted(),
        problem.spread,
        np.ones((len(problem.search), len(problem.logs)), dtype=bool),
        tuple(range(problem.fitted)),
    )


def towards(problem: Problem, state: State, i: int, theta: float) -> State:
    """The state with one parameter elsewhere, or as near to there as the others let it."""
    there = state.moved(i, theta)
    if not problem.limit(there.theta, i, theta):
        return there
    return state.moved(i, float(np.clip(theta, *problem.room(state.theta, [i]).ravel())))


def at_values(problem: Problem, values: Mapping[str, float]) -> State:
    """A state at some values [SI], by name, just inside the bounds."""
    state = initial(problem)
    for i, c in enumerate(problem.search):
        if c.name in values:
            state = state.moved(i, c.inside(max(values[c.name], c.lower)))
    return state


def pooled(logs: Sequence[Log], channel: str, columns: Sequence[np.ndarray]) -> float:
    """rms of a channel over all logs that have it, where it counts."""
    results = []
    for log, part in zip(logs, columns, strict=True):
        if channel in log.channels:
            i = log.channels.index(channel)
            results.append(part[log.counts[:, i], i])
    return rms(np.concatenate(results))


def by_channel(sizes: Mapping[str, float], log: Log) -> np.ndarray:
    """Sizes by channel as those of a log's columns, shape (channels,)."""
    return np.array([sizes[channel] for channel in log.channels])


def evaluate(
    problem: Problem, state: State, theta: np.ndarray | None = None, shifts: Shifts | None = None
) -> State:
    """The state at a point, by default its own, with the residuals there. The integration takes the
    steps of the last point if that is near."""
    theta = state.theta if theta is None else theta
    shifts = state.shifts if shifts is None else shifts
    last, slack = state.point, state.slack
    values, logs = problem.values(theta), problem.logs
    points = [(values, k, shift) for k, shift in enumerate(shifts)]
    if last is not None and last.mesh.serves(theta, shifts, slack):
        mesh = last.mesh
        if all(
            np.array_equal(a, b)
            for a, b in zip([last.theta, *last.shifts], [theta, *shifts], strict=True)
        ):
            return replace(state, theta=theta, shifts=shifts)
        row, _ = problem.simulator.each(points, mesh.steps)
    else:
        row, steps = problem.simulator.each(points, slack=slack)
        mesh = Mesh(theta, shifts, steps, slack)
    residuals = [problem.residual(*pair) for pair in zip(logs, row, strict=True)]
    return replace(state, theta=theta, shifts=shifts, point=Point(theta, shifts, residuals, mesh))


def residuals_at(
    problem: Problem,
    state: State,
    thetas: Sequence[np.ndarray],
    chosen: Sequence[int] | None = None,
    slack: float = 1.0,
) -> list[list[np.ndarray] | None]:
    """Residuals [SI] by vector and log, with the initial states of a state and steps of their own;
    None where a log could not be simulated.

    Args:
        chosen: logs by index, all by default."""
    values = [problem.values(x) for x in thetas]
    rows = problem.simulator.simulate(values, chosen, state.shifts, slack)
    logs = problem.simulator.chosen(chosen)
    return [
        None
        if any(item is None for item in row)
        else [problem.residual(*pair) for pair in zip(logs, row, strict=True)]
        for row in rows
    ]


def scaled(
    problem: Problem,
    state: State,
    residuals: Sequence[np.ndarray] | None = None,
    chosen: Sequence[int] | None = None,
) -> list[np.ndarray]:
    """Residuals, by default those of the state, divided by their channels' scales."""
    residuals = state.here.residuals if residuals is None else residuals
    return [
        part / by_channel(state.scales, log)
        for part, log in zip(residuals, problem.simulator.chosen(chosen), strict=True)
    ]


def squares(problem: Problem, state: State) -> float:
    """Sum of the squared scaled residuals."""
    return sum(float(np.sum(r**2)) for r in scaled(problem, state))


def above_noise(problem: Problem, state: State) -> float:
    """Share of the squares that white noise of the readings does not make: all that a fixed number
    can explain, however noisy the readings.
    """
    if problem.cutoff or any(log.band is not None for log in problem.logs):
        return 1.0

    def noise(log: Log) -> float:
        apart = map(log.seen.apart, log.channels)
        sizes = list(map(white_noise, log.recorded.T, apart)) / by_channel(state.scales, log)
        return float(np.sum(sizes**2 * np.count_nonzero(log.counts, axis=0)))

    return 1.0 - sum(map(noise, problem.logs)) / squares(problem, state)


def cost(problem: Problem, state: State) -> float:
    """What is minimised."""
    known = sum(float(np.sum(shift**2)) for shift in state.here.shifts)
    prior = prior_of(problem, state, range(len(problem.search)))
    known += float(np.sum((prior.sharpness * prior.off) ** 2))
    return squares(problem, state) + state.prior_weight * known


def prior_of(problem: Problem, state: State, which: Sequence[int]) -> Prior:
    """What is known of some parameters besides the logs, and how far they are off it."""
    search = [problem.search[i] for i in which]
    sharpness = np.array([c.sharpness if c.known else 0.0 for c in search])
    centre = np.array([c.of(c.centre if c.known else c.start) for c in search])
    return Prior(sharpness, state.theta[list(which)] - centre, state.prior_weight)


def jacobian(problem: Problem, state: State, which: Sequence[int]) -> list[np.ndarray]:
    """Derivatives of the scaled residuals by log, shape (samples, channels, parameters).

    By differences inside the bounds, on the same mesh; the other side is tried where there is no
    such rig. Zero where a parameter does not move a log."""
    here, logs, known = state.here, problem.logs, state.here.columns
    missing = [
        (i, k)
        for i in which
        for k in range(len(logs))
        if (i, k) not in known and state.influence[i, k]
    ]
    for side in (1.0, -1.0):
        points, steps = [], []
        for i, k in missing:
            inside = here.theta[i] + SETTINGS.difference <= problem.search[i].bounds[1]
            steps.append(side * (1.0 if inside else -1.0) * SETTINGS.difference)
            theta = here.theta + steps[-1] * np.eye(len(here.theta))[i]
            points.append((problem.values(theta), k, here.shifts[k]))
        row, _ = problem.simulator.each(points, here.mesh.steps)
        for (i, k), step, simulated in zip(missing, steps, row, strict=True):
            if simulated is not None:
                change = problem.residual(logs[k], simulated) - here.residuals[k]
                known[i, k] = change / step
        missing = [pair for pair in missing if pair not in known]
    return [
        _stacked([known.get((i, k)) for i in which], here.residuals[k], state.scales, log)
        for k, log in enumerate(logs)
    ]


def fixed_changes(problem: Problem, state: State) -> list[np.ndarray]:
    """What one standard error of each number that the fit takes as known changes of the scaled
    residuals, by log, shape (samples, channels, numbers)."""
    here, errors = state.here, problem.simulator.fixed_errors()
    if not errors:
        return []
    values = [*problem.values(state.theta), *(value for value, _ in errors.values())]
    points, steps = [], []
    for i, (value, std) in enumerate(errors.values(), len(state.theta)):
        step = SETTINGS.difference * max(abs(value), std)
        moved = [*values[:i], value + step, *values[i + 1 :]]
        points += [(moved, k, shifts) for k, shifts in enumerate(here.shifts)]
        steps.append(step / std)
    row, _ = problem.simulator.beside(errors).each(points, here.mesh.steps)
    results = []
    for k, log in enumerate(problem.logs):
        left, size = here.residuals[k], by_channel(state.scales, log)
        change = np.zeros((*left.shape, len(errors)))
        for i, simulated in enumerate(row[k :: len(problem.logs)]):
            if simulated is not None:
                change[..., i] = (problem.residual(log, simulated) - left) / (steps[i] * size)
        results.append(change)
    return results


def start_jacobian(problem: Problem, state: State) -> list[np.ndarray]:
    """Derivatives of the scaled residuals by each log's shifts, shape (samples, channels, shifts);
    zero for logs that begin at a standstill while the search is coarse."""
    here, logs, known = state.here, problem.logs, state.here.start_columns
    missing = [
        (k, j, item.share)
        for k, log in enumerate(logs)
        for j, item in enumerate(log.start.uncertain)
        if (log.start.moves or not state.coarse) and (k, j) not in known
    ]
    values = problem.values(here.theta)
    points = [
        (values, k, here.shifts[k] + step * np.eye(len(here.shifts[k]))[j])
        for k, j, step in missing
    ]
    row, _ = problem.simulator.each(points, here.mesh.steps)
    for (k, j, step), simulated in zip(missing, row, strict=True):
        if simulated is not None:
            known[k, j] = (problem.residual(logs[k], simulated) - here.residuals[k]) / step
    return [
        _stacked(
            [known.get((k, j)) for j in range(len(log.start.uncertain))],
            here.residuals[k],
            state.scales,
            log,
        )
        for k, log in enumerate(logs)
    ]


def _stacked(
    columns: Sequence[np.ndarray | None], like: np.ndarray, scales: Mapping[str, float], log: Log
) -> np.ndarray:
    """Columns side by side along a last axis, in units of the scales; zero where there is none."""
    if not columns:
        return np.zeros((*like.shape, 0))
    whole = np.stack([np.zeros_like(like) if c is None else c for c in columns], axis=-1)
    return whole / by_channel(scales, log)[:, None]


def linearised(
    problem: Problem,
    state: State,
    which: Sequence[int],
    start_columns: Sequence[np.ndarray] | None = None,
) -> list[Block]:
    """What each log says of some parameters and of its own initial state, linear about a point.

    Args:
        start_columns: `start_jacobian` of another point, by default of this one."""
    columns = jacobian(problem, state, which)
    starts = start_jacobian(problem, state) if start_columns is None else start_columns
    residuals = scaled(problem, state)
    blocks = []
    for k, log in enumerate(problem.logs):
        size, shifts = by_channel(state.scales, log), state.here.shifts[k]
        given = columns[k], starts[k], residuals[k], shifts
        blocks.append(Block(log.channels, *given, log.recorded / size, log.coarse / size))
    return blocks


def weighed(problem: Problem, state: State, scales: bool = True) -> State:
    """The state with scales of the channels, and the weight of priors besides them, by the
    residuals. Where block averages are compared, the scale is that of samples, so that channels
    count for the same.

    Args:
        scales: whether these change too."""
    if scales:
        residuals = state.here.residuals
        sizes = {
            channel: max(
                math.hypot(pooled(problem.logs, channel, residuals), problem.averaged[channel]),
                SETTINGS.scale_floor * spread,
            )
            for channel, spread in problem.spread.items()
        }
        state = replace(state, scales=sizes)
    return replace(state, prior_weight=prior_weight(scaled(problem, state)))


def effects(
    problem: Problem,
    state: State,
    columns: Sequence[np.ndarray],
    chosen: Sequence[int] | None = None,
) -> np.ndarray:
    """Largest rms change of a channel in a log when a parameter moves by its unit, as a share of
    the channel's spread, by column of a Jacobian."""
    each = []
    for part, log in zip(columns, problem.simulator.chosen(chosen), strict=True):
        ratio = by_channel(state.scales, log) / by_channel(problem.spread, log)
        each.append(np.sqrt(np.mean(part**2, axis=0)) * ratio[:, None])
    return np.max(np.concatenate(each), axis=0)
