"""Spectral submanifold of one mode from a free decay: embedding, manifold, normal form, backbone.

In the delay embedding of one velocity the decaying motion lies on a two-dimensional invariant
manifold, the spectral submanifold of the slowest mode. Its tangent plane is from a singular value
decomposition, the manifold is a polynomial over the plane (its misfit is reported), and the linear
map in the plane gives the complex coordinate from which the polynomial normal form starts. The
normal form's coefficients are then those whose *trajectory* fits the whole record best, without a
derivative of the data, so that standard deviations are right for white noise. (Cenedese et al.
minimise the error of the reduced vector field instead; manifold, reduced dynamics and normal form
are the same, their code is not used.)

References: M. Cenedese, J. Axås, B. Bäuerlein, K. Avila & G. Haller, Nat. Commun. 13 (2022) 872,
doi:10.1038/s41467-022-28518-y; G. Haller & S. Ponsioen, Nonlinear Dyn. 86 (2016) 1493,
doi:10.1007/s11071-016-2974-z; for delays, F. Takens, Lect. Notes Math. 898 (1981) 366.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from numpy.polynomial import chebyshev
from scipy.signal import decimate

from snrmjax.measure.decays.decay_record import even_record, require_cycles
from snrmjax.methods.records.normal_form import NormalForm, form_of, sensor_signal, unknowns_of
from snrmjax.methods.result import MethodResult, method_result, points_of_curves
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.levenberg_marquardt import Minimum, StepRule, minimise
from snrmjax.numerics.rules import InputError

_DELAYS = 5  # 2·2 + 1: enough for a plane, by Takens' theorem
_FEWEST_SAMPLES = 8  # a cycle
_MOST_TERMS = 7  # of α and ω: polynomials of degree 13 in ρ e^{iθ}
_ORDERS = (2, 3, 4, 5)  # harmonics in the record
_START = 0.1  # of the largest amplitude: least amplitude in the fit of the start
_MOST_SAMPLES = 2**18
_ROUNDS = 4  # fits, each scaled by the misfit of the one before
_SAME = 0.7  # ratio of successive misfits above which the fits end
_RULE = StepRule(steps=25, settled=0.1)
_POINTS = 25
_MANIFOLD_DEGREE = 5
_NEIGHBOURS = 4  # lines per term, on each side of the mode, whose residual enters the bands
_MOST_LEFT = 0.25  # largest residual of one mode as a fraction of the record's power
_STEP = 1e-4  # of an unknown's 1σ or magnitude, for finite differences of the curves


class SpectralSubmanifold(NamedTuple):
    """Normal form of a decay with its errors and checks."""

    form: NormalForm
    covariance: Float[np.ndarray, "unknown unknown"]  # of the unknowns of the form
    smallest: float  # m/s, fundamental velocity amplitude
    largest: float
    noise_std: float  # m/s, of a sample: rms residual of the trajectory
    slow_std: float  # m/s, of white noise with the residual's density near the mode
    manifold_misfit: float  # rms distance from the manifold over rms of the embedded record
    left: float  # residual as a fraction of the record's power
    samples: int


class _Fit(NamedTuple):
    """The trajectory that fits best."""

    form: NormalForm
    minimum: "Minimum[_Trial]"
    mean_square: float  # of the residual, (m/s)²


class _Trial(NamedTuple):
    """The trajectory fit linearised at one point, in units of the rms misfit."""

    residuals: Float[np.ndarray, " sample"]
    jacobian: Float[np.ndarray, "sample unknown"]


def ssm(
    time: Float[np.ndarray, " sample"],
    velocity: Float[np.ndarray, " sample"],
    *,
    terms: int | None = None,
    least_amplitude: float = 0.0,
    noise_std: float = 0.0,
) -> MethodResult:
    """Natural frequency and damping against amplitude from the normal form on a decay's manifold.

    The natural frequency is √(ω² + α²) of the decaying motion's ω(ρ) and α(ρ); the damping is the
    dissipated power over ½ m V², as at phase resonance (`NormalForm.modal_damping`).

    Arguments and errors as in `fit_submanifold`, and `ValueError` where the residual exceeds a
    quarter of the record's power. Returns a `MethodResult` of 25 amplitudes, whose velocity is
    that of the fundamental; 1σ from the fit's residual near the mode's frequency. An amplitude at
    which the mode gains energy is `NOT_A_MODE`.
    """
    return curves_of_submanifold(
        fit_submanifold(
            time, velocity, terms=terms, least_amplitude=least_amplitude, noise_std=noise_std
        )
    )


def curves_of_submanifold(manifold: SpectralSubmanifold) -> MethodResult:
    """Natural frequency and damping of a submanifold at 25 amplitudes; errors as in `ssm`."""
    amplitude = np.linspace(manifold.smallest, manifold.largest, _POINTS)
    values = _curves(manifold.form, amplitude)
    if manifold.left > _MOST_LEFT and np.any(values[1] > 0):
        raise InputError(
            f"the residual of one decaying mode is {100 * manifold.left:.2g} % of the record's "
            "power: the record has interfering modes; isolate the mode before (`isolate_decay`)."
        )
    std = _curve_std(manifold, amplitude)
    points = points_of_curves(amplitude, values[0], std[0], values[1], std[1])
    degree = 2 * len(manifold.form.decay) - 1
    notes = (
        Fact("normal_form_fitted", degree=degree, noise_std=manifold.noise_std),
        Fact("off_the_manifold", misfit=manifold.manifold_misfit),
    )
    return method_result("ssm", points, 0, notes)


def fit_submanifold(
    time: Float[np.ndarray, " sample"],
    velocity: Float[np.ndarray, " sample"],
    *,
    terms: int | None = None,
    least_amplitude: float = 0.0,
    noise_std: float = 0.0,
) -> SpectralSubmanifold:
    """The spectral submanifold and its normal form from one velocity in free decay.

    Arguments: `time` in s, evenly spaced; `velocity` in m/s, from the removal of the force on;
    `terms` of the polynomials α and ω in ρ² (1 for a linear mode), from 1 to 7, by default one
    more than Schwarz' criterion selects; the record is used down to `least_amplitude` (m/s);
    `noise_std` (m/s) of white noise with the density near the mode, for a filtered record.
    Returns a `SpectralSubmanifold`. Raises `ValueError` for a record as in `resonant_decay` and
    where the record holds no decaying oscillation.
    Validity: one mode (isolate it before, `isolate_decay`), smooth forces: dry friction is not
    polynomial, and 1σ does not include its model error.
    """
    if terms is not None and not 1 <= terms <= _MOST_TERMS:
        raise InputError(f"`terms` must be from 1 to {_MOST_TERMS}, but is {terms}.")
    times, signal = even_record(time, velocity)
    while len(times) > _MOST_SAMPLES:
        signal, times = decimate(signal, 2, ftype="fir", zero_phase=True), times[::2]
    step = float(np.mean(np.diff(times)))
    times = times - times[0]
    hertz = _main_frequency(signal, step)
    require_cycles(signal, hertz * float(times[-1]))
    if 1 / (hertz * step) < _FEWEST_SAMPLES:
        raise InputError(
            f"{_FEWEST_SAMPLES} samples a cycle are needed, but the record has "
            f"{1 / (hertz * step):.1f}: the sampling rate is too low."
        )
    lag = max(1, round(1 / (_DELAYS * hertz * step)))
    coordinate, misfit = _on_the_plane(signal - signal.mean(), lag)
    amplitude = np.abs(coordinate)
    below = np.flatnonzero(amplitude < max(least_amplitude, 0.0))
    end = below[0] if below.size else len(amplitude)
    require_cycles(signal[:end], end * step * hertz)
    times, signal, coordinate = times[:end], signal[:end], coordinate[:end]
    per_cycle = 1 / (hertz * step)
    orders = tuple(order for order in _ORDERS if order < per_cycle / 2)
    best = _selected(times, signal, coordinate, orders, terms, noise_std)
    if best is None:
        raise InputError("the record holds no oscillation that decays smoothly.")
    return _submanifold(best, times, signal, misfit, noise_std)


def _main_frequency(signal: np.ndarray, step: float) -> float:
    """Frequency in Hz of the record's largest spectral line, without the mean."""
    spectrum = np.abs(np.fft.rfft((signal - signal.mean()) * np.hanning(len(signal))))
    return max(1, int(np.argmax(spectrum))) / (len(signal) * step)


def _on_the_plane(signal: np.ndarray, lag: int) -> tuple[Complex[np.ndarray, " k"], float]:
    """Complex coordinate of the decay in the manifold's tangent plane, and the manifold's misfit.

    The coordinate's modulus is close to the fundamental amplitude, its angle increases.
    """
    count = len(signal) - (_DELAYS - 1) * lag
    delays = np.stack([signal[j * lag : j * lag + count] for j in range(_DELAYS)])
    directions, _, _ = np.linalg.svd(delays @ delays.T)
    plane = directions[:, :2].T @ delays
    moved, *_ = np.linalg.lstsq(plane[:, :-lag].T, plane[:, lag:].T, rcond=None)
    multipliers, left = np.linalg.eig(moved)  # rows: plane(t + lag)ᵀ = plane(t)ᵀ · moved
    k = int(np.argmax(multipliers.imag))
    if not multipliers[k].imag > 0:
        raise InputError("the record holds no oscillation in its plane of largest motion.")
    rotating = left[:, k] @ plane
    design = np.stack([rotating.real, -rotating.imag], axis=1)
    real, imaginary = np.linalg.lstsq(design, signal[:count], rcond=None)[0]
    return (real + 1j * imaginary) * rotating, _off_the_manifold(delays, directions, plane)


def _off_the_manifold(delays: np.ndarray, directions: np.ndarray, plane: np.ndarray) -> float:
    """rms distance of the embedded record from a polynomial over the plane, relative to its rms."""
    x, y = plane / np.abs(plane).max()
    powers = [(a, d - a) for d in range(1, _MANIFOLD_DEGREE + 1) for a in range(d + 1)]
    design = np.stack([x**a * y**b for a, b in powers], axis=1)
    across = (directions[:, 2:].T @ delays).T
    solved, *_ = np.linalg.lstsq(design, across, rcond=None)
    return float(np.linalg.norm(across - design @ solved) / np.linalg.norm(delays))


def _selected(
    times: np.ndarray,
    signal: np.ndarray,
    coordinate: np.ndarray,
    orders: tuple[int, ...],
    wanted: int | None,
    noise_std: float,
) -> _Fit | None:
    """The fit with the wanted number of terms, or one more than Schwarz' criterion selects.

    The truncation error is then small compared with the bands; with the criterion's own choice it
    is not, and the bands are too narrow.
    """
    n, best, least = len(times), None, np.inf
    starts: list[NormalForm] = []
    for terms in range(1, (wanted or _MOST_TERMS) + 1):
        starts.append(_started(times, coordinate, orders, terms))
        tried = [_with_terms(form, terms) for form in starts]
        fit = _fitted(times, signal, tried if best is None else [*tried, best.form])
        if fit is None:
            return best
        best = fit._replace(form=_with_terms(fit.form, terms + 1))
        misfit = n * (fit.mean_square / noise_std**2 if noise_std else np.log(fit.mean_square))
        score = misfit + len(fit.minimum.point) * np.log(n)
        if wanted is None and score > least:
            return fit
        least = score
    return fit


def _with_terms(form: NormalForm, terms: int) -> NormalForm:
    """The same normal form, padded with zero terms."""
    more = (0, terms - len(form.decay))
    return form._replace(decay=np.pad(form.decay, more), frequency=np.pad(form.frequency, more))


def _started(
    times: np.ndarray, coordinate: np.ndarray, orders: tuple[int, ...], terms: int
) -> NormalForm:
    """Start values from integrals along the decay, without derivatives of the data."""
    amplitude, phase = np.abs(coordinate), np.unwrap(np.angle(coordinate))
    scale = float(np.quantile(amplitude[: max(8, len(amplitude) // 50)], 0.9))
    below = np.flatnonzero(amplitude < _START * scale)
    part = slice(0, below[0] if below.size else None)
    amplitude, phase, at = amplitude[part], phase[part], times[: len(coordinate)][part]
    ratio = amplitude / scale
    steps = np.diff(at)[:, None]
    powers = chebyshev.chebvander(2 * ratio**2 - 1, terms - 1)
    integrals = np.concatenate(
        [np.zeros((1, terms)), np.cumsum((powers[1:] + powers[:-1]) / 2 * steps, axis=0)]
    )
    design = np.concatenate([np.ones((len(at), 1)), integrals], axis=1) * ratio[:, None]
    length = np.linalg.norm(design, axis=0)
    target = np.stack([np.log(ratio), phase], axis=1) * ratio[:, None]
    solved = np.linalg.lstsq(design / length, target, rcond=None)[0] / length[:, None]
    none = np.zeros((len(orders), 2), dtype=complex)
    return NormalForm(solved[1:, 0], solved[1:, 1], none, orders, np.zeros(2), scale, solved[0])


def _fitted(times: np.ndarray, signal: np.ndarray, starts: list[NormalForm]) -> _Fit | None:
    """The best trajectory fit from the best start, or None where no start can be integrated."""
    squares = [float(np.mean(_trial(form, times, signal, 1.0).residuals ** 2)) for form in starts]
    if not np.isfinite(squares).any():
        return None
    form = starts[int(np.nanargmin(squares))]
    unit, point = float(np.sqrt(np.nanmin(squares))), unknowns_of(form)
    terms, orders = len(form.decay), form.orders
    unlimited = np.full(len(point), np.inf)
    for _ in range(_ROUNDS):

        def evaluate(points: np.ndarray, unit: float = unit) -> list[_Trial]:
            return [
                _trial(form_of(point, terms, orders, form.scale), times, signal, unit)
                for point in points
            ]

        [fit] = minimise(
            evaluate, point[None], evaluate(point[None]), (-unlimited, unlimited), _RULE
        )
        point = fit.point
        before, unit = unit, unit * float(np.sqrt(fit.sum_of_squares / len(times)))
        if unit > _SAME * before:
            break
    return _Fit(form_of(point, terms, orders, form.scale), fit, unit**2)


def _trial(form: NormalForm, times: np.ndarray, signal: np.ndarray, unit: float) -> _Trial:
    try:
        trajectory = sensor_signal(form, times)
    except ArithmeticError:
        unknown = len(unknowns_of(form))
        return _Trial(np.full(len(times), np.nan), np.zeros((len(times), unknown)))
    return _Trial((trajectory.signal - signal) / unit, trajectory.jacobian / unit)


def _submanifold(
    best: _Fit,
    times: np.ndarray,
    signal: np.ndarray,
    misfit: float,
    noise_std: float,
) -> SpectralSubmanifold:
    form = best.form
    trajectory = sensor_signal(form, times)
    left = signal - trajectory.signal
    free = len(times) - len(best.minimum.point)
    variance = float(left @ left) / free
    # Of coloured residuals only the part near the rotating mode's frequency affects its curves.
    lines = _NEIGHBOURS * len(form.decay)
    density = np.abs(np.fft.fft(left * np.exp(-1j * trajectory.phase))) ** 2 / len(left)
    near = np.concatenate([density[: lines + 1], density[-lines:]])
    coloured = float(near.sum()) / (len(near) - 1 - len(form.decay))
    slow = float(np.sqrt(max(variance, coloured, noise_std**2)))
    norms = np.linalg.norm(trajectory.jacobian, axis=0)
    inverse = np.linalg.pinv(
        (trajectory.jacobian / norms).T @ (trajectory.jacobian / norms), hermitian=True
    )
    noise = float(np.sqrt(variance))
    # The first cycle does not determine the decay at its own amplitude.
    first = int(np.searchsorted(trajectory.phase - trajectory.phase[0], 2 * np.pi))
    return SpectralSubmanifold(
        form,
        slow**2 * inverse / np.outer(norms, norms),
        float(max(trajectory.amplitude.min(), min(noise, 0.1 * trajectory.amplitude.max()))),
        float(trajectory.amplitude[min(first, len(times) - 1) :].max()),
        noise,
        slow,
        misfit,
        best.mean_square / float(np.var(signal)),
        len(times),
    )


def _curves(form: NormalForm, amplitude: np.ndarray) -> Float[np.ndarray, "2 k"]:
    """Natural frequency (rad/s) and damping ratio."""
    natural = np.hypot(form.angular_frequency(amplitude), form.decay_rate(amplitude))
    return np.stack([natural, form.modal_damping(amplitude) / (2 * natural)])


def _curve_std(manifold: SpectralSubmanifold, amplitude: np.ndarray) -> Float[np.ndarray, "2 k"]:
    """1σ of both curves from the covariance of the form's unknowns."""
    form = manifold.form
    point, std = unknowns_of(form), np.sqrt(np.diag(manifold.covariance))
    slopes = np.zeros((2, len(amplitude), len(point)))
    for k in range(2, len(point) - 2):  # the curves depend on neither start nor middle
        step = np.zeros(len(point))
        step[k] = _STEP * max(std[k], abs(point[k]), np.finfo(float).tiny)
        ends = [
            _curves(
                form_of(point + sign * step, len(form.decay), form.orders, form.scale), amplitude
            )
            for sign in (1, -1)
        ]
        slopes[..., k] = (ends[0] - ends[1]) / (2 * step[k])
    return np.sqrt(np.einsum("cki,ij,ckj->ck", slopes, manifold.covariance, slopes))
