"""Output error: the parameters with which the simulation comes nearest to all logs at once, and how
sure they are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ehbench.errors import InsufficientData
from ehbench.identification.steps import (
    LEVEL,
    VAGUE,
    Bench,
    Coordinate,
    FittedParameter,
    HydraulicsFit,
    Log,
    Progress,
    finish,
)
from ehbench.rig import parameter_row
from ehbench.signals import correlation_time, lowpass, rms
from ehbench.terms import CORRELATED

# a scale's floor as a share of the channel's spread: no sensor makes a channel worth more than that
SCALE_FLOOR = 5.0e-3
# a parameter is not excited if moving it by its unit (a factor e, or its whole range) changes no
# channel by more than
# this share of the channel's spread, rms
FAINT = 2.0e-3
DIFFERENCE = 1.0e-3  # step of finite differences, in units of a parameter
NEAR = 5.0e-3  # share of its reach within which a parameter is tried at its bound
SCAN = math.log(10.0)  # how far the first look goes either way
FINER = 97  # its points over other parameters: 5 % apart, 2.4 % in frequency, which twenty cycles of ringing can still tell


class OutputError:
    """Weighted least squares over all logs; one instance a fit."""

    def __init__(
        self,
        bench: Bench,
        search: list[Coordinate],
        tell: Progress,
        most: int,
        cutoff: float | None,
    ) -> None:
        self.bench, self.search, self.tell, self.most, self.cutoff = (
            bench,
            search,
            tell,
            most,
            cutoff,
        )
        names = sorted({channel for log in bench.logs for channel in log.channels})
        self.spread = {
            c: self._pooled(c, [log.recorded - np.mean(log.recorded, axis=0) for log in bench.logs])
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
        for log, part in zip(self.bench.logs, parts, strict=True):
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
        logs = self.bench.chosen(chosen)
        result = []
        for row in self.bench.simulate(
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
            for part, log in zip(parts, self.bench.chosen(chosen), strict=True)
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
            for k, log in enumerate(self.bench.logs)
        ]

    def scan(self) -> None:
        """A coarse look over bulk modulus and damping together, then over each other positive
        parameter, on one log for each set of cylinders asked: least squares from far off could lock
        on to the wrong cycle of the ringing."""
        first: dict[tuple[str, ...], int] = {}
        for i, log in enumerate(self.bench.logs):
            first.setdefault(log.asked, i)
        chosen = list(first.values())
        bulk = [i for i, c in enumerate(self.search) if c.name.endswith("bulk_modulus") and c.log]
        damping = [i for i, c in enumerate(self.search) if c.name.endswith("damping") and c.log]
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
            slopes,
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
        fine = self.bench.step
        self.bench.step = 2.0 * fine
        self.tell("output error: looking over the range of the bulk modulus", 0.0)
        self.scan()
        self._drop(
            [
                i
                for i, size in self._effects(self.slopes(self.theta, self.free)).items()
                if size < FAINT
            ]
        )
        self.solve(1e-3)
        self.bench.step = fine
        self.cache.clear()
        converged, released = True, False
        for _ in range(2 * len(self.search) + 2):
            self._snap(released)
            left = self.at(self.theta)
            for channel, spread in self.spread.items():
                self.scales[channel] = max(self._pooled(channel, left), SCALE_FLOOR * spread)
            converged = self.solve(1e-6)
            errors = self._errors()
            lost = [i for i, error in errors.items() if error.kind == "not_excited"]
            self._drop(lost)
            released = self._release(errors) or released
            if not lost and not any(error.inward for error in errors.values()):
                break
        warnings = (
            []
            if converged
            else [
                f"the fit stopped after {self.most} evaluations without converging; its numbers are not final"
            ]
        )
        self.tell("output error: done", 1.0)
        return self._result(errors, warnings)

    def _effects(self, slopes: Sequence[np.ndarray]) -> dict[int, float]:
        """Largest rms change of a channel in a log when a parameter moves by its unit, as a share
        of the channel's spread.
        """
        ratio = [
            self._per(self.scales, log) / self._per(self.spread, log) for log in self.bench.logs
        ]
        each = [
            np.sqrt(np.mean(part**2, axis=0)) * r[:, None]
            for part, r in zip(slopes, ratio, strict=True)
        ]
        return dict(zip(self.free, np.max(np.concatenate(each), axis=0), strict=True))

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

    def _errors(self) -> dict[int, _Error]:
        """Standard errors of the parameters in search coordinates, and what they mean; of those at
        a bound as if it were free.
        """
        live = sorted(self.free + self.bound)
        slopes = self.slopes(self.theta, live, central=True)
        left = self.scaled(self.at(self.theta))
        inside = [k for k, i in enumerate(live) if i in self.free]
        every = _covariance(slopes, left)
        among = _covariance([part[:, :, inside] for part in slopes], left) if inside else every
        kept, self.free = self.free, live
        effects = self._effects(slopes)
        self.free = kept
        self.names = tuple(self.search[i].name for i in self.free)
        self.correlation = among.correlation if inside else np.zeros((0, 0))
        result = {}
        for k, i in enumerate(live):
            held = i in self.bound
            found, at = (every, k) if held else (among, inside.index(k))
            std, quantile, source = found.error(at)
            vague, inward = VAGUE[self.search[i].log], False
            if effects[i] < FAINT or found.alone[at] > vague:
                kind = "not_excited"
            elif held:
                kind = "at_bound"
                pull = (
                    -every.gradient[k]
                    if self.theta[i] == self.search[i].bounds[0]
                    else every.gradient[k]
                )
                inward = pull > 2.0 * math.sqrt(every.meat[k, k])
            elif (
                std > vague
                or np.max(np.abs(np.delete(self.correlation[at], at)), initial=0.0) > CORRELATED
            ):
                kind = "correlated"
            else:
                kind = "estimated"
            result[i] = _Error(std, quantile, source, kind, inward)
        return result

    def _result(self, errors: Mapping[int, _Error], warnings: list[str]) -> HydraulicsFit:
        samples = sum(int(log.counts.any(axis=1).sum()) for log in self.bench.logs)
        fitted = []
        for i, c in enumerate(self.search):
            one = FittedParameter(
                c.name,
                parameter_row(c.name).unit,
                c.start,
                None,
                None,
                c.lower,
                c.upper,
                c.start,
                "not_excited",
                samples,
            )
            if i in errors and errors[i].kind != "not_excited":
                error = errors[i]
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
        for a, name in enumerate(self.names):
            for b, other in enumerate(self.names[:a]):
                if abs(self.correlation[a, b]) > CORRELATED:
                    warnings.append(
                        f"{other} and {name} are correlated by {self.correlation[a, b]:+.3f}: the logs tell them only together"
                    )
        return finish(
            self.bench,
            "output_error",
            fitted,
            warnings,
            self.names,
            self.correlation,
            (),
            self.scales,
            self.iterations,
            self.cutoff,
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


@dataclass(frozen=True)
class _Covariance:
    """Covariances of the search coordinates: ``hac`` and, with three logs or more, ``jackknife``;
    ``alone`` is the standard error each parameter would have if all the others were known."""

    hac: np.ndarray
    jackknife: np.ndarray | None
    logs: int
    alone: np.ndarray
    meat: np.ndarray
    gradient: np.ndarray

    def error(self, k: int) -> tuple[float, float, str]:
        """(standard error, quantile of the 95 % interval, where it is from) of parameter k:
        whichever gives the wider interval.
        """
        from scipy.stats import norm, t

        normal = float(norm.ppf(0.5 + 0.5 * LEVEL))
        hac = math.sqrt(max(self.hac[k, k], 0.0))
        if self.jackknife is not None:
            jack, quantile = (
                math.sqrt(max(self.jackknife[k, k], 0.0)),
                float(t.ppf(0.5 + 0.5 * LEVEL, self.logs - 1)),
            )
            if jack * quantile > hac * normal:
                return jack, quantile, "jackknife"
        return hac, normal, "hac"

    @property
    def correlation(self) -> np.ndarray:
        size = np.sqrt(np.maximum(np.diag(self.hac), 1e-300))
        return self.hac / np.outer(size, size)


def _covariance(slopes: Sequence[np.ndarray], left: Sequence[np.ndarray]) -> _Covariance:
    """Covariance of a least-squares solution whose residuals are coloured.

    Sandwich ``H⁻¹ M H⁻¹`` with ``H = Σ JᵀJ`` and M the long-run covariance of the scores ``s_t =
    J_tᵀ r_t`` of each log, Bartlett weights to four correlation times of the scores (Newey & West
    1987). Jackknife: each log left out in turn, one Gauss–Newton step; directions that one log
    alone informs are left to the sandwich.

    Args:
        slopes: by log, shape (samples, channels, parameters).
        left: residuals by log, shape (samples, channels).
    """
    information = [np.einsum("tci,tcj->ij", part, part) for part in slopes]
    scores = [np.einsum("tci,tc->ti", part, rest) for part, rest in zip(slopes, left, strict=True)]
    total = np.sum(information, axis=0)
    size = np.sqrt(np.maximum(np.diag(total), 1e-300))
    values, vectors = np.linalg.eigh(total / np.outer(size, size))
    root = vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1])) / size[:, None]
    inverse = root @ root.T
    meat = np.sum([_long_run(score) for score in scores], axis=0)
    alone = np.sqrt(np.maximum(np.diag(meat), 0.0)) / np.maximum(np.diag(total), 1e-300)
    jackknife = None
    count = len(slopes)
    if count >= 3:
        moves = np.empty((count, len(size)))
        for k in range(count):
            keep, turned = np.linalg.eigh(np.eye(len(size)) - root.T @ information[k] @ root)
            held = np.where(keep > 0.05, 1.0 / np.maximum(keep, 0.05), 0.0)
            moves[k] = root @ (turned @ (held * (turned.T @ (root.T @ np.sum(scores[k], axis=0)))))
        moves -= moves.mean(axis=0)
        jackknife = (count - 1) / count * moves.T @ moves
    gradient = np.sum([np.sum(score, axis=0) for score in scores], axis=0)
    return _Covariance(inverse @ meat @ inverse, jackknife, count, alone, meat, gradient)


def _long_run(score: np.ndarray) -> np.ndarray:
    """n times the long-run covariance of a series of scores, shape (samples, parameters) →
    (parameters, parameters).
    """
    n = len(score)
    reach = min(n // 4, math.ceil(4.0 * max(correlation_time(column) for column in score.T)))
    result = score.T @ score
    for lag in range(1, reach + 1):
        product = score[lag:].T @ score[:-lag]
        result += (1.0 - lag / (reach + 1.0)) * (product + product.T)
    return result
