"""Modes of low-level tests that already depend on the amplitude: their values at no amplitude."""

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

# Powers of the amplitude, of hysteresis and of smooth symmetric forces; of stiffness alone, and of
# damping too.
_KINDS = tuple(product((1, 2), (False, True)))
_CHI_SQUARE = 5.99  # of two numbers at 95 %
_REGION = 10.0  # half-power bandwidths about a mode, of the states from which a fit starts


class LevelRows(NamedTuple):
    """All states of some levels as rows of one fit, level after level."""

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
        """Bayes' information criterion, for residuals that are white.

        No dependence is as probable beforehand as all kinds of it together.
        """
        kinds = 1 if self.settings.dependence is None else len(_KINDS)
        size = self.fit.residuals.size
        return self.deviance + self.n_unknowns * float(np.log(size)) + 2 * float(np.log(kinds))

    @property
    def white(self) -> bool:
        """Whether neighbouring residuals are as independent as errors are: nothing is left."""
        return not self.fit.correlation.size


def amplitude_dependent_modes(
    rows: LevelRows,
    start: LinearModalFit,
    *,
    residual_terms: ResidualTerms = "auto",
    instrument_phase: bool = False,
) -> tuple[LinearModalFit, Fact] | None:
    """The modes at no amplitude where a joint fit of levels shows that one depends on it.

    The mode that responds most obeys (ω² − Ω² + 2iζωΩ + (α + iβΩ)|q|^p) q = F with p = 1 or 2 and
    with β or without; all else is linear. Fits with and without α are compared by Bayes'
    information criterion. From the lowest level upward levels count as long as the best fit leaves
    nothing but errors (neighbouring residuals are not correlated) and the next level asks for no
    frequency and damping of its own. What the other candidates say, with their weights, widens the
    errors.

    Arguments: `start` of the lowest level; further as `fit_linear_modes`.
    Returns the fit and what it says, or None where no dependence shows, or where what the lowest
    level shows does not hold at the next.
    Validity: one mode that depends on its amplitude, small changes of stiffness and damping, and
    one solution near each state.
    """
    levels = list(dict.fromkeys(rows.level.tolist()))
    best: tuple[LevelRows, list[_Candidate]] | None = None
    before: list[_Candidate] = []  # the best of fewer levels
    for count in range(1, len(levels) + 1):
        part = _levels(rows, levels[:count])
        settings = basis_settings(part.data, residual_terms, instrument_phase, None)
        found = _candidates(part, settings, start)
        if not (found and found[0].white):
            break
        if best is not None and _apart(part, found, levels[count - 1]):
            break
        before += [] if best is None else [best[1][0]]
        best = part, found
    if best is None:
        return None
    part, found = best
    if len(levels) > 1 and len(set(part.level.tolist())) == 1:
        return None
    of = found[0].settings.dependence
    return None if of is None else _told(part, found, of, start, before)


def rows_of_levels(
    data: SteadyStates,
    levels: Sequence[int],
    *,
    base: SensorMotion | None = None,
    band: tuple[float | None, float | None] = (None, None),
) -> LevelRows:
    """The states of levels, in this order and by frequency, as receptances with their errors.

    A level with phases that were not measured is left out.

    Arguments: `base` what the sensors record of a moving base, whose own motion is taken away;
    `band` in rad/s, open where None.
    """
    level, omega = np.asarray(data.level), np.asarray(data.frequency)
    low, high = (
        end if end is not None else far for end, far in zip(band, (0.0, np.inf), strict=True)
    )
    unknown = np.unique(level[np.asarray(data.phase_unknown).reshape(len(level), -1).any(axis=1)])
    inside = (omega >= low * (1 - 1e-12)) & (omega <= high * (1 + 1e-12))
    place = {number: k for k, number in enumerate(levels) if number not in unknown}
    keep = np.flatnonzero(inside & np.isin(level, list(place)))
    places = np.array([place[number] for number in level[keep].tolist()])
    order = keep[np.lexsort((omega[keep], places))]
    reference, load, velocity, std, known = over_reference(data, order)
    turn = 1j * omega[order, None] * load[:, None]
    receptance = velocity / turn + (omega[order, None] ** -2.0 if base == "absolute" else 0.0)
    given = ResponseData(
        omega=omega[order],
        receptance=receptance.T,
        std=(std / np.abs(turn)).T if known else np.full(receptance.T.shape, np.nan),
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
    """Some rows: their reference and its load (N, V, m/s²), velocities (NaN where not measured),
    1σ of real and of imaginary part, and whether all of these are stated.
    """
    load = np.asarray(data.force)[rows]
    reference = Channel("force", "force", "N")
    if not np.isfinite(load).any():
        load, reference = np.asarray(data.drive)[rows], Channel("drive", "voltage", "V")
    if data.base is not None:
        reference = Channel("base", "acceleration", "m/s^2")
    seen = np.asarray(data.measured)[rows]
    velocity = np.where(seen, np.asarray(data.velocity)[rows], np.nan)
    errors = np.asarray(relative_errors(data))[rows]
    std = np.sqrt(np.nansum(errors**2, axis=2) / 2) * np.abs(velocity)
    stated = np.isfinite(errors).all(axis=2) & (std > 0)
    return reference, load, velocity, std, bool(np.all(stated[seen]))


def pole_of_states(rows: LevelRows) -> float | None:
    """Natural frequency (rad/s) of one mode at the lowest level, by linear least squares.

    None where they find no damped mode.
    """
    data = _levels(rows, rows.level[:1].tolist()).data
    if not data.omega.size:
        return None
    size = np.where(np.isfinite(data.receptance), np.abs(data.receptance), 0.0) * data.load
    sensor, top = np.unravel_index(np.argmax(size), size.shape)
    found = _regressed(data, int(sensor), (float(data.omega[top]), np.inf), 2, False)
    return None if found is None else float(found[0])


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
    found = []
    poles = np.concatenate([start.natural_frequency, start.damping_ratio])
    size = np.max(np.abs(start.residue), axis=0)
    mode = int(np.argmax(size / (start.damping_ratio * start.natural_frequency**2)))
    linear = _fitted(rows, settings, [poles])
    if linear is not None:
        found.append(linear)
    for power, damping in _KINDS:
        found += _of_kind(rows, settings, (poles, mode, start), power, damping)
    return sorted(found, key=lambda one: one.criterion)


def _of_kind(
    rows: LevelRows,
    settings: BasisSettings,
    of: tuple[np.ndarray, int, LinearModalFit],
    power: int,
    damping: bool,
) -> Iterator[_Candidate]:
    """Fits with one kind of dependence, of all modes and without those that stand for a skew.

    A resonance that leans is fitted by two linear modes: the mode nearest to the one that depends
    on its amplitude is left out as long as that is the more probable.
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
        away = np.abs(poles[:n] - poles[mode])
        nearest = int(np.argsort(away)[1])
        poles = np.delete(poles, [nearest, n + nearest])
        mode -= nearest < mode
    if best is not None:
        yield best


def _start(
    rows: LevelRows, mode: tuple[float, float], start: LinearModalFit, power: int, damping: bool
) -> tuple[AmplitudeDependence, np.ndarray | None]:
    """The dependence with the amplitudes as measured; and ω, ζ, s, t by linear least squares.

    Ω²x = ω²x + icΩx + α|x|^p x + iβΩ|x|^p x − PF at the sensor that moves most.
    """
    data, (natural, ratio) = rows.data, mode
    nearest = int(np.argmin(np.abs(start.natural_frequency - natural)))
    sensor = int(np.argmax(np.abs(start.residue[:, nearest])))
    x = data.receptance[sensor] * data.load
    seen = np.isfinite(x)
    x = np.where(seen, x, np.nanmin(np.abs(x)))
    near = np.abs(x) / np.abs(start.residue[sensor, nearest])
    dependence = AmplitudeDependence(0, power, damping, natural, np.asarray(data.load), near)
    return dependence, _regressed(data, sensor, (natural, ratio), power, damping)


def _regressed(
    data: ResponseData, sensor: int, mode: tuple[float, float], power: int, damping: bool
) -> np.ndarray | None:
    """ω, ζ, s, t where asked for, and P by linear least squares at states about a mode."""
    natural, ratio = mode
    x = data.receptance[sensor] * data.load
    seen = np.isfinite(x)
    x = np.where(seen, x, 0.0)
    load, omega = np.asarray(data.load), data.omega
    fraction = (np.abs(x) / np.abs(x).max()) ** power
    use = seen & (np.abs(omega - natural) < _REGION * 2 * ratio * natural)
    columns = [x, 1j * omega * x, natural**2 * fraction * x]
    columns += [1j * natural * omega * fraction * x] * damping
    table = np.stack([*columns, -load], axis=1)[use]
    goal = (omega**2 * x)[use]
    both, wanted = np.concatenate([table.real, table.imag]), np.append(goal.real, goal.imag)
    if len(wanted) <= both.shape[1]:
        return None
    scale = np.maximum(np.linalg.norm(both, axis=0), 1e-300)
    found = np.linalg.lstsq(both / scale, wanted, rcond=None)[0] / scale
    if not (found[0] > 0 and found[1] > 0):
        return None
    own = np.sqrt(found[0])
    return np.array([own, found[1] / (2 * own), *found[2:]])


def _fitted(
    rows: LevelRows, settings: BasisSettings, starts: Sequence[np.ndarray]
) -> _Candidate | None:
    """The best fit from several starts; None where none ends at modes with positive damping."""
    data, found = rows.data, []
    std = 1 / np.maximum(line_weights(data), 1e-300)
    for start in starts:
        unknowns = np.append(start, np.zeros(int(settings.phase)))
        columns = receptance_bases(data.omega, unknowns, settings)[0].columns
        if not np.isfinite(columns).all():
            continue
        fit, spread = weighted_fit(data, settings, unknowns, std)
        if np.all(unpacked(fit.unknowns, settings)[1] > 0) and np.isfinite(fit.residuals).all():
            good = np.isfinite(data.receptance)
            of_size = 4 * np.sum(np.log(spread.std[good]))
            deviance = float(np.sum(fit.residuals**2) + of_size)
            n = len(fit.unknowns) + fit.coefficients.size
            found.append(_Candidate(settings, fit, spread, deviance, n))
    return min(found, key=lambda one: one.deviance, default=None)


def _apart(rows: LevelRows, found: Sequence[_Candidate], level: int) -> bool:
    """Whether the states of a level ask for a frequency and a damping of their own."""
    dependent = [one for one in found if one.settings.dependence is not None]
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
    """The largest square by which ω, ζ and residues moved since a fit of fewer levels.

    Where ω and ζ did by more than the 95 % of that fit's own errors; else nothing.
    """
    natural, ratio, residue = mode
    moved, farthest = np.zeros((2 + len(residue),) * 2), _CHI_SQUARE
    for one in before:
        w, z, _ = unpacked(one.fit.unknowns, one.settings)
        nearest = int(np.argmin(np.abs(w - natural)))
        rows = np.array([nearest, len(w) + nearest])
        own = one.fit.covariance[np.ix_(rows, rows)]
        away = np.array([w[nearest] - natural, z[nearest] - ratio])
        apart = float(away @ np.linalg.solve(own, away))
        if apart > farthest:
            whole = np.concatenate([away, one.fit.coefficients[:, nearest] - residue])
            moved, farthest = np.outer(whole, whole), apart
    return moved


def _told(
    rows: LevelRows,
    found: Sequence[_Candidate],
    of: AmplitudeDependence,
    start: LinearModalFit,
    before: Sequence[_Candidate],
) -> tuple[LinearModalFit, Fact]:
    """The fit of the best candidate, with what the others say in its errors.

    Also those of fewer levels (`before`): where the values at no amplitude move with every further
    level by more than their own errors, a power of the amplitude is not all that the mode does.
    """
    best = found[0]
    modes = modal_result(rows.data, best.settings, best.fit, best.spread, start.orders)
    natural, ratio, _ = unpacked(best.fit.unknowns, best.settings)
    n, k = len(natural), of.mode
    place = int(np.argsort(np.argsort(natural))[k])
    weights = np.array([one.criterion for one in found])
    weights = np.exp(-0.5 * (weights - weights.min()))
    covariance = modes.mode_covariance.copy()
    for one, weight in zip(found, weights / weights.sum(), strict=True):
        w, z, _ = unpacked(one.fit.unknowns, one.settings)
        nearest = int(np.argmin(np.abs(w - natural[k])))
        away = np.array([w[nearest] - natural[k], z[nearest] - ratio[k]])
        covariance[place, :2, :2] += weight * np.outer(away, away)
    covariance[place] += _drift(before, (natural[k], ratio[k], best.fit.coefficients[:, k]))
    change, loss = best.fit.unknowns[2 * n], best.fit.unknowns[2 * n + 1] if of.damping else 0.0
    column = receptance_bases(rows.data.omega, best.fit.unknowns, best.settings)[0].columns[:, k]
    half = len(column) // 2
    size = np.abs(column[:half] + 1j * column[half:]) * rows.data.load
    fraction = (size / of.near.max()) ** of.power
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
        mode=place + 1,
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
