"""Amplitude-dependent modes of low-level tests, extrapolated to zero amplitude."""

import dataclasses
from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.identify.modal.linear_fit import ResidualTerms, basis_settings
from snrmjax.identify.modal.modal_bases import (
    AmplitudeDependence,
    BasisSettings,
    receptance_bases,
    unpacked,
)
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.modal.response_data import ResponseData
from snrmjax.identify.modal.separable_fit import SeparableFit
from snrmjax.identify.modal.weighted_fit import (
    FitSpread,
    line_weights,
    lines_in_half_power,
    modal_result,
    weighted_fit,
)
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.states import SteadyStates, relative_errors
from snrmjax.model.moving_base import SensorMotion
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

# (power of the amplitude, damping too): 1 for hysteresis, 2 for smooth symmetric forces.
_KINDS = tuple(product((1, 2), (False, True)))
_CHI_SQUARE = 5.99  # 95 % quantile for two degrees of freedom
_REGION = 10.0  # half-power bandwidths about a mode, whose states give the starting values


class LevelRows(NamedTuple):
    """All states of given levels as rows of one fit, level after level."""

    data: ResponseData
    level: np.ndarray  # (row,)
    velocity: Float[np.ndarray, " row"]  # m/s, the largest of all sensors


class _Candidate(NamedTuple):
    settings: BasisSettings
    fit: SeparableFit
    spread: FitSpread
    deviance: float  # −2 log likelihood
    n_unknowns: int

    @property
    def criterion(self) -> float:
        """Bayesian information criterion, for white residuals.

        No dependence has the same prior probability as all kinds of dependence together.
        """
        kinds = 1 if self.settings.dependence is None else len(_KINDS)
        n_data = self.fit.residuals.size
        return self.deviance + self.n_unknowns * float(np.log(n_data)) + 2 * float(np.log(kinds))

    @property
    def white(self) -> bool:
        """Whether neighbouring residuals are uncorrelated: no systematic misfit."""
        return not self.fit.correlation.size


def amplitude_dependent_modes(
    rows: LevelRows,
    start: LinearModalFit,
    *,
    residual_terms: ResidualTerms = "auto",
    instrument_phase: bool = False,
) -> tuple[LinearModalFit, Fact] | None:
    """The modes at zero amplitude, where a joint fit of levels shows a dependence on it.

    The mode that responds most obeys (ω² − Ω² + 2iζωΩ + (α + iβΩ)|q|^p) q = F with p = 1 or 2 and
    with β or without; all else is linear. Fits with and without α are compared by the
    Bayesian information criterion. Levels are added from the lowest upward as long as the best fit
    has white residuals (neighbouring ones are not correlated) and the next level needs no frequency
    and damping of its own. The spread of the other candidates, with their weights, widens the
    errors.

    Arguments: `start` of the lowest level; further as `fit_linear_modes`.
    Returns the fit and a `Fact` on the dependence, or None without a significant dependence or
    where that of the lowest level does not hold at the next.
    Validity: one mode that depends on its amplitude, small changes of stiffness and damping, and
    one solution near each state.
    """
    levels = list(dict.fromkeys(rows.level.tolist()))
    best: tuple[LevelRows, list[_Candidate]] | None = None
    before: list[_Candidate] = []  # the best fits of fewer levels
    for count in range(1, len(levels) + 1):
        part = _levels(rows, levels[:count])
        settings = basis_settings(part.data, residual_terms, instrument_phase, None)
        candidates = _candidates(part, settings, start)
        if not (candidates and candidates[0].white):
            break
        if best is not None and _apart(part, candidates, levels[count - 1]):
            break
        before += [] if best is None else [best[1][0]]
        best = part, candidates
    if best is None:
        return None
    part, candidates = best
    if len(levels) > 1 and len(set(part.level.tolist())) == 1:
        return None
    of = candidates[0].settings.dependence
    return None if of is None else _result(part, candidates, of, start, before)


def rows_of_levels(
    data: SteadyStates,
    levels: Sequence[int],
    *,
    base: SensorMotion | None = None,
    band: tuple[float | None, float | None] = (None, None),
) -> LevelRows:
    """The states of levels, in this order and by frequency, as receptances with their errors.

    Levels with unmeasured phases are left out.

    Arguments: `base` states what the sensors record on a moving base, whose own motion is
    subtracted; `band` in rad/s, open where None.
    """
    level, omega = np.asarray(data.level), np.asarray(data.frequency)
    low, high = (
        end if end is not None else far for end, far in zip(band, (0.0, np.inf), strict=True)
    )
    unknown = np.unique(level[np.asarray(data.phase_unknown).reshape(len(level), -1).any(axis=1)])
    inside = (omega >= low * (1 - 1e-12)) & (omega <= high * (1 + 1e-12))
    rank = {number: k for k, number in enumerate(levels) if number not in unknown}
    keep = np.flatnonzero(inside & np.isin(level, list(rank)))
    ranks = np.array([rank[number] for number in level[keep].tolist()])
    order = keep[np.lexsort((omega[keep], ranks))]
    reference, load, velocity, std, known = over_reference(data, order)
    per_receptance = 1j * omega[order, None] * load[:, None]
    receptance = velocity / per_receptance + (
        omega[order, None] ** -2.0 if base == "absolute" else 0.0
    )
    given = ResponseData(
        omega=omega[order],
        receptance=receptance.T,
        std=(std / np.abs(per_receptance)).T if known else np.full(receptance.T.shape, np.nan),
        powers=(1,) * len(data.sensors),
        channels=tuple(Channel(name, "velocity", "m/s") for name in data.sensors),
        reference=reference,
        source="stated" if known else "residuals",
        averages=None,
        notes=(),
        load=load,
    )
    return LevelRows(given, level[order], np.nanmax(np.abs(velocity), axis=1))


def over_reference(
    data: SteadyStates, rows: np.ndarray
) -> tuple[Channel, np.ndarray, np.ndarray, np.ndarray, bool]:
    """Selected rows: reference, its load (N, V, m/s²), velocities (NaN where not measured), 1σ of
    real and of imaginary part, and whether all 1σ are stated.
    """
    load = np.asarray(data.force)[rows]
    reference = Channel("force", "force", "N")
    if not np.isfinite(load).any():
        load, reference = np.asarray(data.drive)[rows], Channel("drive", "voltage", "V")
    if data.base is not None:
        reference = Channel("base", "acceleration", "m/s^2")
    measured = np.asarray(data.measured)[rows]
    velocity = np.where(measured, np.asarray(data.velocity)[rows], np.nan)
    errors = np.asarray(relative_errors(data))[rows]
    std = np.sqrt(np.nansum(errors**2, axis=2) / 2) * np.abs(velocity)
    stated = np.isfinite(errors).all(axis=2) & (std > 0)
    return reference, load, velocity, std, bool(np.all(stated[measured]))


def pole_of_states(rows: LevelRows) -> float | None:
    """Natural frequency (rad/s) of one mode at the lowest level, by linear least squares.

    None where the fit has no damped mode.
    """
    data = _levels(rows, rows.level[:1].tolist()).data
    if not data.omega.size:
        return None
    amplitude = np.where(np.isfinite(data.receptance), np.abs(data.receptance), 0.0) * data.load
    sensor, top = np.unravel_index(np.argmax(amplitude), amplitude.shape)
    values = _regressed(data, int(sensor), (float(data.omega[top]), np.inf), 2, False)
    return None if values is None else float(values[0])


def _levels(rows: LevelRows, levels: Sequence[int]) -> LevelRows:
    return _chosen(rows, np.isin(rows.level, levels))


def _chosen(rows: LevelRows, keep: Bool[np.ndarray, " row"]) -> LevelRows:
    data = rows.data
    part = data._replace(
        omega=data.omega[keep],
        receptance=data.receptance[:, keep],
        std=data.std[:, keep],
        load=np.asarray(data.load)[keep],
    )
    return LevelRows(part, rows.level[keep], rows.velocity[keep])


def _candidates(
    rows: LevelRows, settings: BasisSettings, start: LinearModalFit
) -> list[_Candidate]:
    """Fits of all kinds of dependence and of none, the most probable first."""
    candidates = []
    poles = np.concatenate([start.natural_frequency, start.damping_ratio])
    residue = np.max(np.abs(start.residue), axis=0)
    mode = int(np.argmax(residue / (start.damping_ratio * start.natural_frequency**2)))
    linear = _fitted(rows, settings, [poles])
    if linear is not None:
        candidates.append(linear)
    for power, damping in _KINDS:
        candidates += _of_kind(rows, settings, (poles, mode, start), power, damping)
    return sorted(candidates, key=lambda one: one.criterion)


def _of_kind(
    rows: LevelRows,
    settings: BasisSettings,
    of: tuple[np.ndarray, int, LinearModalFit],
    power: int,
    damping: bool,
) -> Iterator[_Candidate]:
    """Fits with one kind of dependence, of all modes and without spurious ones.

    Two linear modes can fit a skewed resonance: the mode nearest to the amplitude-dependent one is
    left out as long as that lowers the criterion.
    """
    poles, mode, start = of
    best: _Candidate | None = None
    while True:
        n = len(poles) // 2
        dependence, regressed = _start(rows, (poles[mode], poles[n + mode]), start, power, damping)
        dependence = dependence._replace(mode=mode)
        terms = np.zeros(dependence.n_terms)
        tries = [np.concatenate([poles, terms])]
        if regressed is not None:
            other = tries[0].copy()
            other[[mode, n + mode]] = regressed[:2]
            other[2 * n : 2 * n + len(terms)] = regressed[2 : 2 + len(terms)]
            tries.append(other)
        one = _fitted(rows, settings._replace(dependence=dependence), tries)
        if one is None or (best and one.criterion >= best.criterion):
            break
        best = one
        if n == 1:
            break
        distance = np.abs(poles[:n] - poles[mode])
        nearest = int(np.argsort(distance)[1])
        poles = np.delete(poles, [nearest, n + nearest])
        mode -= nearest < mode
    if best is not None:
        yield best


def _start(
    rows: LevelRows, mode: tuple[float, float], start: LinearModalFit, power: int, damping: bool
) -> tuple[AmplitudeDependence, np.ndarray | None]:
    """The dependence at the measured amplitudes; and ω, ζ, s, t by linear least squares.

    Ω²x = ω²x + icΩx + α|x|^p x + iβΩ|x|^p x − PF at the sensor that moves most.
    """
    data, (natural, ratio) = rows.data, mode
    nearest = int(np.argmin(np.abs(start.natural_frequency - natural)))
    sensor = int(np.argmax(np.abs(start.residue[:, nearest])))
    x = data.receptance[sensor] * data.load
    measured = np.isfinite(x)
    x = np.where(measured, x, np.nanmin(np.abs(x)))
    near = np.abs(x) / np.abs(start.residue[sensor, nearest])
    dependence = AmplitudeDependence(0, power, damping, natural, np.asarray(data.load), near)
    return dependence, _regressed(data, sensor, (natural, ratio), power, damping)


def _regressed(
    data: ResponseData, sensor: int, mode: tuple[float, float], power: int, damping: bool
) -> np.ndarray | None:
    """ω, ζ, s, t (if requested) and P by linear least squares at states about a mode."""
    natural, ratio = mode
    x = data.receptance[sensor] * data.load
    measured = np.isfinite(x)
    x = np.where(measured, x, 0.0)
    load, omega = np.asarray(data.load), data.omega
    fraction = (np.abs(x) / np.abs(x).max()) ** power
    use = measured & (np.abs(omega - natural) < _REGION * 2 * ratio * natural)
    columns = [x, 1j * omega * x, natural**2 * fraction * x]
    columns += [1j * natural * omega * fraction * x] * damping
    table = np.stack([*columns, -load], axis=1)[use]
    goal = (omega**2 * x)[use]
    both, target = np.concatenate([table.real, table.imag]), np.append(goal.real, goal.imag)
    if len(target) <= both.shape[1]:
        return None
    scale = np.maximum(np.linalg.norm(both, axis=0), 1e-300)
    solution = np.linalg.lstsq(both / scale, target, rcond=None)[0] / scale
    if not (solution[0] > 0 and solution[1] > 0):
        return None
    own = np.sqrt(solution[0])
    return np.array([own, solution[1] / (2 * own), *solution[2:]])


def _fitted(
    rows: LevelRows, settings: BasisSettings, starts: Sequence[np.ndarray]
) -> _Candidate | None:
    """The best fit from several starts; None if none has positive damping of all modes."""
    data, candidates = rows.data, []
    std = 1 / np.maximum(line_weights(data), 1e-300)
    for start in starts:
        unknowns = np.append(start, np.zeros(int(settings.phase)))
        columns = receptance_bases(data.omega, unknowns, settings)[0].columns
        if not np.isfinite(columns).all():
            continue
        fit, spread = weighted_fit(data, settings, unknowns, std)
        if np.all(unpacked(fit.unknowns, settings)[1] > 0) and np.isfinite(fit.residuals).all():
            good = np.isfinite(data.receptance)
            log_determinant = 4 * np.sum(np.log(spread.std[good]))
            deviance = float(np.sum(fit.residuals**2) + log_determinant)
            n = len(fit.unknowns) + fit.coefficients.size
            candidates.append(_Candidate(settings, fit, spread, deviance, n))
    return min(candidates, key=lambda one: one.deviance, default=None)


def _apart(rows: LevelRows, candidates: Sequence[_Candidate], level: int) -> bool:
    """Whether the states of a level need a frequency and a damping of their own."""
    dependent = [one for one in candidates if one.settings.dependence is not None]
    if not dependent:
        return True
    best = dependent[0]
    own = best.settings.dependence
    if own is None:
        return True
    apart = own._replace(apart=(rows.level == level).astype(float))
    settings = best.settings._replace(dependence=apart)
    n = best.settings.modes_of(best.fit.unknowns)
    last = 2 * n + own.n_terms
    start = np.concatenate([best.fit.unknowns[:last], np.zeros(2)])
    other = _fitted(rows, settings, [start])
    return other is not None and other.criterion < best.criterion


def _drift(
    before: Sequence[_Candidate], mode: tuple[float, float, Float[np.ndarray, " sensor"]]
) -> Float[np.ndarray, "entry entry"]:
    """Outer product of the largest change of ω, ζ and residues since a fit of fewer levels.

    Only where ω and ζ left the 95 % region of that fit; zero otherwise.
    """
    natural, ratio, residue = mode
    moved, largest = np.zeros((2 + len(residue),) * 2), _CHI_SQUARE
    for one in before:
        w, z, _ = unpacked(one.fit.unknowns, one.settings)
        nearest = int(np.argmin(np.abs(w - natural)))
        rows = np.array([nearest, len(w) + nearest])
        own = one.fit.covariance[np.ix_(rows, rows)]
        distance = np.array([w[nearest] - natural, z[nearest] - ratio])
        apart = float(distance @ np.linalg.solve(own, distance))
        if apart > largest:
            whole = np.concatenate([distance, one.fit.coefficients[:, nearest] - residue])
            moved, largest = np.outer(whole, whole), apart
    return moved


def _result(
    rows: LevelRows,
    candidates: Sequence[_Candidate],
    of: AmplitudeDependence,
    start: LinearModalFit,
    before: Sequence[_Candidate],
) -> tuple[LinearModalFit, Fact]:
    """The fit of the best candidate, its errors widened by the spread of the others.

    Also by fits of fewer levels (`before`): if the values at zero amplitude change with further
    levels by more than their errors, a power of the amplitude is not the full dependence.
    """
    best = candidates[0]
    modes = modal_result(rows.data, best.settings, best.fit, best.spread, start.orders)
    natural, ratio, _ = unpacked(best.fit.unknowns, best.settings)
    n, k = len(natural), of.mode
    rank = int(np.argsort(np.argsort(natural))[k])
    weights = np.array([one.criterion for one in candidates])
    weights = np.exp(-0.5 * (weights - weights.min()))
    covariance = modes.mode_covariance.copy()
    for one, weight in zip(candidates, weights / weights.sum(), strict=True):
        w, z, _ = unpacked(one.fit.unknowns, one.settings)
        nearest = int(np.argmin(np.abs(w - natural[k])))
        distance = np.array([w[nearest] - natural[k], z[nearest] - ratio[k]])
        covariance[rank, :2, :2] += weight * np.outer(distance, distance)
    covariance[rank] += _drift(before, (natural[k], ratio[k], best.fit.coefficients[:, k]))
    change, loss = best.fit.unknowns[2 * n], best.fit.unknowns[2 * n + 1] if of.damping else 0.0
    column = receptance_bases(rows.data.omega, best.fit.unknowns, best.settings)[0].columns[:, k]
    half = len(column) // 2
    amplitude = np.abs(column[:half] + 1j * column[half:]) * rows.data.load
    fraction = (amplitude / of.near.max()) ** of.power
    ends = np.sqrt(natural[k] ** 2 + of.unit**2 * change * np.array([fraction.max(), 0.0]))
    shift = float(ends[0] - ends[1])
    error = best.fit.covariance[2 * n, 2 * n] ** 0.5 * abs(shift / change) if change else np.inf
    lowest = rows.level == rows.level[0]
    kept = _chosen(rows, lowest).data
    curves = modes.curves._replace(
        omega=kept.omega,
        measured=kept.receptance,
        fitted=modes.curves.fitted[:, lowest],
        std=modes.curves.std[:, lowest],
    )
    fact = Fact(
        "amplitude_dependent_mode",
        mode=rank + 1,
        frequency_hz=float(natural[k]) / HERTZ,
        power=of.power,
        shift_hz=shift / HERTZ,
        shift_std_hz=float(error) / HERTZ,
        bandwidths=abs(shift) / float(2 * ratio[k] * natural[k]),
        damping_change=float(0.5 * loss * of.unit / ends[0] * fraction.max())
        if of.damping
        else None,
        levels=tuple(dict.fromkeys(rows.level.tolist())),
        velocity=float(rows.velocity.max()),
    )
    lines = np.unique(kept.omega)
    in_band = lines_in_half_power(lines, modes.natural_frequency, modes.damping_ratio)
    whole = dataclasses.replace(
        modes, mode_covariance=covariance, curves=curves, lines_in_band=in_band
    )
    return whole, fact
