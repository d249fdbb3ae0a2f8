"""Output error: the parameters with which the simulation comes nearest to all logs at once, and how
sure they are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.errors import InsufficientData
from ehbench.identification.covariance import covariance_of
from ehbench.identification.results import Estimate, HydraulicsFit, Progress, finish, untold
from ehbench.identification.search import VAGUE, Coordinate
from ehbench.identification.simulator import Log, Simulator
from ehbench.signals import lowpass, rms
from ehbench.terms import CORRELATED

# a scale's floor as a share of the channel's spread: no sensor makes a channel worth more than that
SCALE_FLOOR = 5.0e-3
# a parameter is not excited if moving it by its unit (a factor e, or its whole range) changes no
# channel by more than this share of the channel's spread, rms
FAINT = 2.0e-3
DIFFERENCE = 1.0e-3  # step of finite differences, in units of a parameter
NEAR = 5.0e-3  # share of its reach within which a parameter is tried at its bound
SCAN = math.log(10.0)  # how far the first look goes either way
# its points over other parameters: 5 % apart, 2.4 % in frequency, which twenty cycles of ringing
# can still tell
FINER = 97


class OutputError:
    """Weighted least squares over all logs; one instance a fit."""

    def __init__(
        self,
        simulator: Simulator,
        search: list[Coordinate],
        tell: Progress,
        most: int,
        cutoff: float | None,
    ) -> None:
        self.simulator, self.search, self.tell = simulator, search, tell
        self.most, self.cutoff = most, cutoff
        names = sorted({channel for log in simulator.logs for channel in log.channels})
        self.spread = {
            c: self._pooled(
                c, [log.recorded - np.mean(log.recorded, axis=0) for log in simulator.logs]
            )
            for c in names
        }
        self.scales = dict(self.spread)
        self.theta = np.array([c.begin for c in search])
        self.free = list(range(len(search)))
        self.bound: list[int] = []
        self.iterations = 0
        self.cache: dict[bytes, list[np.ndarray]] = {}

    def _pooled(self, channel: str, parts: Sequence[np.ndarray]) -> float:
        """rms of a channel's column over all logs that have it, where it counts."""
        found = []
        for log, part in zip(self.simulator.logs, parts, strict=True):
            if channel in log.channels:
                i = log.channels.index(channel)
                found.append(part[log.counts[:, i], i])
        return rms(np.concatenate(found))

    def _per(self, sizes: Mapping[str, float], log: Log) -> np.ndarray:
        return np.array([sizes[channel] for channel in log.channels])

    def residuals(
        self, thetas: Sequence[np.ndarray], chosen: Sequence[int] | None = None
    ) -> list[list[np.ndarray]]:
        """Residuals simulated − recorded [SI], low-passed, zero where they do not count, by vector
        and log; a failed simulation counts ten spreads.
        """
        logs = self.simulator.chosen(chosen)
        result = []
        for row in self.simulator.simulate(
            [[c.at(x) for c, x in zip(self.search, theta, strict=True)] for theta in thetas], chosen
        ):
            parts = []
            for log, simulated in zip(logs, row, strict=True):
                if simulated is None:
                    left = np.tile(10.0 * self._per(self.spread, log), (len(log.recorded), 1))
                else:
                    left = simulated - log.recorded
                    left = (
                        lowpass(left, log.record.sample_time, self.cutoff) if self.cutoff else left
                    )
                parts.append(left * log.counts)
            result.append(parts)
        return result

    def at(self, theta: np.ndarray) -> list[np.ndarray]:
        """Residuals [SI] by log at one vector, remembered."""
        key = theta.tobytes()
        if key not in self.cache:
            if len(self.cache) > 8:
                self.cache.pop(next(iter(self.cache)))
            self.cache[key] = self.residuals([theta])[0]
        return self.cache[key]

    def scaled(
        self, parts: Sequence[np.ndarray], chosen: Sequence[int] | None = None
    ) -> list[np.ndarray]:
        """Residuals divided by their channels' scales."""
        return [
            part / self._per(self.scales, log)
            for part, log in zip(parts, self.simulator.chosen(chosen), strict=True)
        ]

    def slopes(
        self, theta: np.ndarray, which: Sequence[int], central: bool = False
    ) -> list[np.ndarray]:
        """Scaled sensitivities by log, shape (samples, channels, parameters), by differences that
        stay inside the bounds.
        """
        ends, vectors = [], [theta]
        for i in which:
            low, high = self.search[i].bounds
            h = DIFFERENCE if theta[i] + DIFFERENCE <= high else -DIFFERENCE
            pair = [h, -h if central and low <= theta[i] - h <= high else 0.0]
            for side, shift in enumerate(pair):
                if shift != 0.0:
                    vectors.append(theta + shift * np.eye(len(theta))[i])
                    pair[side] = len(vectors) - 1
                else:
                    pair[side] = 0
            ends.append((int(pair[0]), int(pair[1]), 2.0 * h if pair[1] else h))
        done = [self.at(theta), *self.residuals(vectors[1:])]
        return [
            np.stack([(done[up][k] - done[down][k]) / width for up, down, width in ends], axis=-1)
            / self._per(self.scales, log)[:, None]
            for k, log in enumerate(self.simulator.logs)
        ]

    def scan(self) -> None:
        """A coarse look over bulk modulus and damping together, then over each other positive
        parameter, on one log for each set of cylinders asked: least squares from far off could lock
        on to the wrong cycle of the ringing."""
        first: dict[tuple[str, ...], int] = {}
        for i, log in enumerate(self.simulator.logs):
            first.setdefault(log.asked, i)
        chosen = list(first.values())
        bulk, damping = (
            [i for i, c in enumerate(self.search) if c.row.rings == what and c.log]
            for what in ("frequency", "decay")
        )
        low, high = np.array([c.bounds for c in self.search]).T
        others = [[i] for i, c in enumerate(self.search) if c.log and i not in (*bulk, *damping)]
        for group in [bulk, *others] if bulk else others:
            ends = (
                max(-SCAN, max(low[group] - self.theta[group])),
                min(SCAN, min(high[group] - self.theta[group])),
            )
            shifts = np.linspace(*ends, 11 if group is bulk else FINER)
            vectors = []
            for shift in (0.0, *shifts):
                for loss in (0.0, -1.4, 1.4) if damping and group is bulk else (0.0,):
                    theta = self.theta.copy()
                    theta[group] += shift
                    theta[damping] += loss
                    vectors.append(np.clip(theta, low + 1e-6, high - 1e-6))
            costs = [
                sum(float(np.sum(p**2)) for p in self.scaled(parts, chosen))
                for parts in self.residuals(vectors, chosen)
            ]
            self.theta = vectors[int(np.argmin(costs))]

    def solve(self, tolerance: float) -> bool:
        """Move ``theta`` to the minimum over the free parameters; whether it converged."""
        from scipy.optimize import least_squares

        if not self.free:
            return True
        free = np.array(self.free)
        low, high = np.array([self.search[i].bounds for i in free]).T

        def whole(x: np.ndarray) -> np.ndarray:
            theta = self.theta.copy()
            theta[free] = x
            return theta

        def slopes(x: np.ndarray) -> np.ndarray:
            self.iterations += 1
            self.tell("output error: fitting", self.iterations / (self.iterations + 6.0))
            return np.concatenate(
                [part.reshape(-1, len(free)) for part in self.slopes(whole(x), self.free)]
            )

        found = least_squares(
            lambda x: np.concatenate([part.ravel() for part in self.scaled(self.at(whole(x)))]),
            np.clip(self.theta[free], low + 1e-9, high - 1e-9),
            slopes,  # pyright: ignore[reportArgumentType]
            bounds=(low, high),
            method="trf",
            x_scale="jac",
            ftol=tolerance,
            xtol=tolerance,
            gtol=1e-12,
            max_nfev=self.most,
        )
        self.theta = whole(found.x)
        return found.status > 0

    def fit(self) -> HydraulicsFit:
        fine = self.simulator.step
        self.simulator.step = 2.0 * fine
        self.tell("output error: looking over the range of the bulk modulus", 0.0)
        self.scan()
        self._drop(
            [
                i
                for i, size in self._effects(self.slopes(self.theta, self.free), self.free).items()
                if size < FAINT
            ]
        )
        self.solve(1e-3)
        self.simulator.step = fine
        self.cache.clear()
        converged, released, found = True, False, _Errors({}, (), np.zeros((0, 0)))
        for _ in range(2 * len(self.search) + 2):
            self._snap(released)
            left = self.at(self.theta)
            for channel, spread in self.spread.items():
                self.scales[channel] = max(self._pooled(channel, left), SCALE_FLOOR * spread)
            converged = self.solve(1e-6)
            found = self._errors()
            errors = found.by_index
            lost = [i for i, error in errors.items() if error.kind == "not_excited"]
            self._drop(lost)
            released = self._release(errors) or released
            if not lost and not any(error.inward for error in errors.values()):
                break
        self.tell("output error: done", 1.0)
        return self._result(found, converged)

    def _effects(self, slopes: Sequence[np.ndarray], which: Sequence[int]) -> dict[int, float]:
        """Largest rms change of a channel in a log when one of the parameters ``which`` moves by
        its unit, as a share of the channel's spread.
        """
        ratio = [
            self._per(self.scales, log) / self._per(self.spread, log) for log in self.simulator.logs
        ]
        each = [
            np.sqrt(np.mean(part**2, axis=0)) * r[:, None]
            for part, r in zip(slopes, ratio, strict=True)
        ]
        return dict(zip(which, np.max(np.concatenate(each), axis=0), strict=True))

    def _drop(self, which: Sequence[int]) -> None:
        """Put parameters back to their start and leave them out.

        Raises:
            InsufficientData: none is left.
        """
        for i in which:
            self.theta[i] = self.search[i].of(self.search[i].start)
        self.free = [i for i in self.free if i not in which]
        self.bound = [i for i in self.bound if i not in which]
        if not self.free and not self.bound:
            names = ", ".join(c.name for c in self.search)
            raise InsufficientData(
                f"the logs tell nothing about {names}",
                hint="use logs in which the commands excite them",
            )

    def _snap(self, only_exact: bool) -> None:
        """Try parameters that have come near a bound exactly there: the solver only creeps towards
        it.
        """
        for i in list(self.free):
            low, high = self.search[i].bounds
            near = 1e-9 if only_exact else NEAR * self.search[i].reach
            for bound in (low, high):
                if abs(self.theta[i] - bound) < near and i in self.free:
                    self.theta[i] = bound
                    self.free.remove(i)
                    self.bound.append(i)

    def _release(self, errors: Mapping[int, _Error]) -> bool:
        """Free again what is held at a bound although the data pull it inside."""
        inward = [i for i in self.bound if i in errors and errors[i].inward]
        self.bound = [i for i in self.bound if i not in inward]
        self.free = sorted(self.free + inward)
        return bool(inward)

    def _errors(self) -> _Errors:
        """Standard errors of the parameters in search coordinates, and what they mean; of those at
        a bound as if it were free.
        """
        live = sorted(self.free + self.bound)
        slopes = self.slopes(self.theta, live, central=True)
        left = self.scaled(self.at(self.theta))
        inside = [k for k, i in enumerate(live) if i in self.free]
        every = covariance_of(slopes, left)
        among = covariance_of([part[:, :, inside] for part in slopes], left) if inside else every
        effects = self._effects(slopes, live)
        correlation = among.correlation if inside else np.zeros((0, 0))
        result = {}
        for k, i in enumerate(live):
            held = i in self.bound
            found, at = (every, k) if held else (among, inside.index(k))
            std, quantile, source = found.error(at)
            vague, inward = VAGUE[self.search[i].log], False
            others = () if held else np.delete(correlation[at], at)
            if effects[i] < FAINT or found.alone[at] > vague:
                kind = "not_excited"
            elif held:
                kind = "at_bound"
                at_lower = self.theta[i] == self.search[i].bounds[0]
                pull = -every.gradient[k] if at_lower else every.gradient[k]
                inward = pull > 2.0 * math.sqrt(every.meat[k, k])
            elif std > vague or np.max(np.abs(others), initial=0.0) > CORRELATED:
                kind = "correlated"
            else:
                kind = "estimated"
            result[i] = _Error(std, quantile, source, kind, inward)
        return _Errors(result, tuple(self.search[i].name for i in self.free), correlation)

    def _result(self, found: _Errors, converged: bool) -> HydraulicsFit:
        samples = sum(int(log.counts.any(axis=1).sum()) for log in self.simulator.logs)
        fitted = []
        for i, c in enumerate(self.search):
            one, error = untold(c, samples), found.by_index.get(i)
            if error is not None and error.kind != "not_excited":
                std, ends = c.spread(self.theta[i], error.std, error.quantile)
                one = replace(
                    one,
                    value=c.at(self.theta[i]),
                    std=std,
                    interval=ends,
                    status=error.kind,
                    error_from=error.source,
                )
            fitted.append(one)
        warnings = []
        if not converged:
            warnings.append(
                f"the fit stopped after {self.most} evaluations without converging; its numbers "
                "are not final"
            )
        for a, name in enumerate(found.names):
            for b, other in enumerate(found.names[:a]):
                if abs(found.correlation[a, b]) > CORRELATED:
                    warnings.append(
                        f"{other} and {name} are correlated by {found.correlation[a, b]:+.3f}: "
                        "the logs tell them only together"
                    )
        return finish(
            self.simulator,
            Estimate(
                method="output_error",
                fitted=fitted,
                warnings=warnings,
                iterations=self.iterations,
                names=found.names,
                correlation=found.correlation,
                scales=self.scales,
                cutoff=self.cutoff,
            ),
        )


@dataclass(frozen=True)
class _Error:
    """A standard error in search coordinates, its interval's quantile, where it is from, what it
    means, and whether the data pull a parameter held at a bound back inside."""

    std: float
    quantile: float
    source: str
    kind: str
    inward: bool


@dataclass(frozen=True, eq=False)
class _Errors:
    """Errors by index of the parameter, and the correlation between the free ones, in the order of
    their names."""

    by_index: dict[int, _Error]
    names: tuple[str, ...]
    correlation: np.ndarray
