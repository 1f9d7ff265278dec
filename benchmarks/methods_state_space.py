"""Polynomial nonlinear state-space models beside pyvib: the same records, each by its own way.

Run: python benchmarks/methods_sources.py --pyvib FOLDER

`FOLDER` is a copy of github.com/pawsen/pyvib, an independent implementation (after the authors'
MATLAB toolbox), which is run where it lies. Three realisations of a multisine on an oscillator
with a cubic spring, two to fit and one to predict, from two laboratories that know nothing of each
other: the virtual one with its shaker, and SciPy's Runge-Kutta method of order 8. Both programs
get the same samples, monomials of the states of degrees 2 and 3 in the state equation, and two
states. pyvib takes the force as it is sampled; snrmjax corrects it for the straight lines between
samples, and pyvib is run once more on a force that was corrected in the same way.
pyvib starts its simulation two periods early: after the one period of its tutorial 0.6 % of the
transient of this mode would be left.

What is compared: rms error of the simulated velocity over that of the velocity, on the fitted and
on the predicted mean periods; poles; and phase resonances of the models against the exact cubic
oscillator (elliptic functions), pyvib's by a harmonic balance that is written here.
"""

import contextlib
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root
from scipy.special import ellipj, ellipk

import snrmjax as sj
from snrmjax.measure import Channel, time_recording

HERTZ = 2 * np.pi
REST, RATIO, MASS, CUBIC = 40 * HERTZ, 0.02, 0.8, 3e9  # cubic per modal mass, 1/(m² s²)
RATE, SAMPLES, PERIODS, SETTLING = 1000.0, 1024, 5, 2  # Hz; periods, and those left out of them
LINES = np.arange(19, 92)  # 18.6 to 88.9 Hz
SEEDS = (0, 1, 2)
NOISE = 1e-3  # 1σ of a sample of velocity over its rms
EARLY = 2  # periods before the one that pyvib simulates
HARMONICS, ANGLES = 7, 64
SHARES = np.linspace(0.15, 0.9, 6)  # of the records' largest velocity


class Records(NamedTuple):
    """Force (N) and velocity (m/s) by realisation and sample."""

    force: np.ndarray
    velocity: np.ndarray

    def steady(self) -> tuple[np.ndarray, np.ndarray]:
        """Both by realisation, period and sample of a period, without the first periods."""
        whole = (len(self.force), PERIODS, SAMPLES)
        return tuple(one.reshape(whole)[:, SETTLING:] for one in self)

    def recordings(self) -> list:
        """As snrmjax reads them."""
        channels = [Channel("force", "force"), Channel("tip", "velocity")]
        return [time_recording(np.stack(pair), channels, RATE) for pair in zip(*self, strict=True)]


def integrated(rms: float) -> Records:
    """By SciPy, under an exact multisine force."""
    both = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        omega = HERTZ * LINES * RATE / SAMPLES
        phase = rng.uniform(0, 2 * np.pi, len(LINES))
        size = rms * np.sqrt(2 / len(LINES))

        def push(at, omega=omega, phase=phase, size=size):
            return size * np.sum(np.cos(omega * at + phase))

        def rate(at, state, push=push):
            q, v = state
            return v, push(at) / MASS - REST**2 * q - CUBIC * q**3 - 2 * RATIO * REST * v

        at = np.arange(PERIODS * SAMPLES) / RATE
        found = solve_ivp(
            rate, (0, at[-1]), (0, 0), t_eval=at, rtol=1e-8, atol=1e-11, method="DOP853"
        )
        velocity = found.y[1]
        velocity = velocity + NOISE * velocity.std() * rng.standard_normal(len(velocity))
        both.append((np.array([push(one) for one in at]), velocity))
    return Records(*(np.array(one) for one in zip(*both, strict=True)))


def tested(volts: float, noise: float) -> Records:
    """By the virtual laboratory: a shaker, its force as it comes out."""
    shape = 1 / np.sqrt(MASS)
    modes = sj.model.linear_modes([REST], [RATIO], [[shape]], [shape])
    potential = sj.model.polynomial_potential({"1111": CUBIC * shape**2 / 4}, 1)
    laboratory = sj.simulate.Laboratory(
        sj.model.structure(modes, potential),
        sj.simulate.Shaker(30.0, 8.0, mass=0.05, damping=1.0, stiffness=500.0),
        sj.simulate.Instruments(velocity_noise=noise),
        RATE,
        substeps=8,
    )
    both = []
    for seed in SEEDS:
        test = sj.simulate.multisine_test(laboratory, volts, LINES, SAMPLES, PERIODS, seed=seed)
        both.append((np.asarray(test.record.force), np.asarray(test.record.velocity)))
    return Records(*(np.array(one) for one in zip(*both, strict=True)))


def exact_mode(velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ω̃ (rad/s) and 2ζ̃ω̃ (1/s) of the free oscillation of the cubic oscillator.

    Its displacement is a Jacobi cosine; viscous damping takes power from all harmonics of the
    velocity, a force in phase brings it in by the fundamental alone.
    """
    size = np.geomspace(1e-6, 1e-2, 2000)
    square = REST**2 + CUBIC * size**2
    parameter = CUBIC * size**2 / (2 * square)
    quarter = ellipk(parameter)
    turn = 4 * quarter[:, None] * np.arange(64) / 64
    sn, _, dn, _ = ellipj(turn, parameter[:, None])
    line = np.fft.rfft(-size[:, None] * np.sqrt(square)[:, None] * sn * dn, axis=1) / 32
    speed = np.abs(line)
    damping = 2 * RATIO * REST * np.sum(speed**2, axis=1) / speed[:, 1] ** 2
    natural = np.pi * np.sqrt(square) / (2 * quarter)
    return np.interp(velocity, speed[:, 1], natural), np.interp(velocity, speed[:, 1], damping)


class Answer(NamedTuple):
    """What one program says of a record."""

    estimation: float
    validation: float
    linear_estimation: float
    multiplier: complex  # of the linear part, a sample of `rate` on
    rate: float
    natural: np.ndarray  # rad/s
    damping: np.ndarray  # 2ζ̃ω̃, 1/s
    seconds: float


def ours(records: Records, velocity: np.ndarray | None) -> tuple[Answer, np.ndarray]:
    """snrmjax's model, and the velocities of the comparison."""
    began = time.perf_counter()
    given = (records.recordings(), "force", "tip")
    fit = sj.methods.fit_state_space(*given, skip=SETTLING)
    seconds = time.perf_counter() - began
    velocity = SHARES * fit.largest if velocity is None else velocity
    found = sj.methods.pnlss(*given, skip=SETTLING)
    good = found.found
    natural, damping = (
        np.interp(velocity, found.velocity[good], one[good])
        for one in (
            np.asarray(found.natural_frequency),
            2 * np.asarray(found.damping_ratio) * np.asarray(found.natural_frequency),
        )
    )
    p, q = np.asarray(fit.model.poles)[fit.mode]
    parts = (fit.misfit, fit.validation, fit.linear_misfit, complex(p, q), fit.rate)
    return Answer(*parts, natural, damping, seconds), velocity


def pyvib(folder: Path, records: Records, velocity: np.ndarray, *, corrected: bool) -> Answer:
    """pyvib's model by the steps of its tutorial, all samples alike: what is left is not noise.

    pyvib's data are (sample, channel, realisation, period). A `corrected` force has the samples of
    a force that is straight in between and has the same lines.
    """
    sys.path.insert(0, str(folder))
    with warnings.catch_warnings(), contextlib.redirect_stdout(sys.stderr):
        warnings.simplefilter("ignore")
        from pyvib.pnlss import PNLSS
        from pyvib.signal import Signal
        from pyvib.subspace import Subspace

        began = time.perf_counter()
        units = [float(np.std(one)) for one in records]
        push, moved = records.steady()
        if corrected:
            turn = HERTZ * np.fft.rfftfreq(SAMPLES)
            push = np.fft.irfft(np.fft.rfft(push) / _straight(turn), SAMPLES)
        force, motion = (
            (one / unit).transpose(2, 0, 1)[:, None]
            for one, unit in zip((push, moved), units, strict=True)
        )
        signal = Signal(force[:, :, :-1], motion[:, :, :-1], fs=RATE)
        signal.lines = LINES
        signal.bla()
        pushes, moves = signal.average()
        linear = Subspace(signal)
        linear.estimate(2, 10)
        linear.optimize(info=0)
        early = EARLY * SAMPLES
        settled = np.r_[early, np.arange(0, len(pushes), SAMPLES)]
        model = PNLSS(linear)
        model.nlterms("x", [2, 3], "statesonly")
        model.transient(settled)
        model.optimize(lamb=100, nmax=40, info=0)
        push, moved = force[:, :, -1].mean(-1), motion[:, :, -1].mean(-1)
        model.extract_model(moved, push, T1=early, info=0)
        errors = [
            _relative(one.simulate(given, T1=start)[1], wanted)
            for one, given, wanted, start in (
                (model, pushes, moves, settled),
                (model, push, moved, early),
                (linear, pushes, moves, settled),
            )
        ]
        seconds = time.perf_counter() - began
    multiplier = max(np.linalg.eigvals(model.A), key=np.imag)
    angle, force_size = _resonances(model, velocity / units[1])
    slight, slight_force = _resonances(model, velocity[:1] * 1e-4 / units[1])
    if corrected:
        force_size, slight_force = force_size * _straight(angle), slight_force * _straight(slight)
    # Force over velocity goes with 2ζ̃ω̃, which the poles say at rest.
    per_velocity = slight_force[0] / (velocity[0] * 1e-4)
    at_rest = -2 * np.log(np.abs(multiplier)) * RATE
    damping = at_rest * (force_size / velocity) / per_velocity
    return Answer(*errors, complex(multiplier), RATE, angle * RATE, damping, seconds)


def _straight(angle: np.ndarray) -> np.ndarray:
    """What straight lines between samples leave of a sine by its angle a sample."""
    return np.sinc(angle / (2 * np.pi)) ** 2


def _relative(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.sqrt(np.mean((found - wanted) ** 2) / np.mean(wanted**2)))


def _resonances(model: Any, speeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angle a sample and force at which x⁺ = A x + B u + E ζ moves with y in phase with u.

    The map takes the motion at each angle to that one sample later, which turns harmonic k by kΩ.
    """
    states = len(model.A)
    theta = 2 * np.pi * np.arange(ANGLES) / ANGLES
    order = np.arange(HARMONICS + 1)

    def residual(unknowns, speed):
        angle, force = unknowns[:2]
        real, imaginary = unknowns[2:].reshape(2, states, HARMONICS + 1)
        lines = real + 1j * imaginary * (order > 0)
        now = np.real(lines @ np.exp(1j * order[:, None] * theta)) * speed
        push = force * speed * np.cos(theta)
        given = np.vstack([now, push])
        terms = np.prod(given[None] ** model.xpowers[:, :, None], axis=1)
        later = model.A @ now + model.B @ push[None] + model.E @ terms
        spectrum = np.fft.fft(later / speed, axis=1)[:, : HARMONICS + 1] * 2 / ANGLES
        spectrum[:, 0] /= 2
        left = spectrum - lines * np.exp(1j * order * angle)
        seen = (model.C @ lines[:, 1])[0] + model.D[0, 0] * force - 1
        # Nothing turns the mean: its imaginary unknown is held at zero.
        return np.concatenate(
            [
                [seen.real, seen.imag],
                left.real.ravel(),
                np.where(order > 0, left.imag, imaginary).ravel(),
            ]
        )

    multiplier = max(np.linalg.eigvals(model.A), key=np.imag)
    angle = float(np.angle(multiplier))
    reply = np.linalg.solve(np.exp(1j * angle) * np.eye(states) - model.A, model.B)[:, 0]
    gain = (model.C @ reply)[0] + model.D[0, 0]
    lines = np.zeros((states, HARMONICS + 1), dtype=complex)
    lines[:, 1] = reply / abs(gain)
    point = np.concatenate([[angle, 1 / abs(gain)], lines.real.ravel(), lines.imag.ravel()])
    found = []
    for speed in speeds:
        solved = root(residual, point, args=(speed,), tol=1e-12)
        if np.abs(solved.fun).max() > 1e-8:
            raise RuntimeError(f"no phase resonance at {speed:g} of the rms velocity")
        point = solved.x
        found.append((point[0], point[1] * speed))
    angles, forces = np.array(found).T
    return angles, forces


def compared(folder: Path) -> Iterator[dict]:
    """The numbers of each record."""
    records = {"scipy_runge_kutta": integrated(5.0)}
    noise = NOISE * float(np.std(records["scipy_runge_kutta"].velocity))
    records["virtual_laboratory"] = tested(22.0, noise)
    for name, record in records.items():
        own, velocity = ours(record, None)
        theirs = pyvib(folder, record, velocity, corrected=False)
        alike = pyvib(folder, record, velocity, corrected=True)
        natural, damping = exact_mode(velocity)
        steady = record.steady()[1]
        kept = steady.shape[1]
        scatter = np.sqrt(np.mean(np.var(steady, axis=1, ddof=1)) / kept)
        line = {
            "record": name,
            "noise_of_mean_period": float(scatter / np.std(steady)),
            "largest_shift": float(natural.max() / REST - 1),
        }
        for program, one in (
            ("snrmjax", own),
            ("pyvib", theirs),
            ("pyvib_corrected_force", alike),
        ):
            pole = np.log(one.multiplier) * one.rate
            line |= {
                f"{program}_estimation": one.estimation,
                f"{program}_validation": one.validation,
                f"{program}_linear_model_estimation": one.linear_estimation,
                f"{program}_linear_frequency_error": float(abs(pole) / REST - 1),
                f"{program}_linear_damping_error": float(-pole.real / (RATIO * REST) - 1),
                f"{program}_frequency_error_max": _most(one.natural, natural),
                f"{program}_damping_error_max": _most(one.damping, damping),
                f"{program}_seconds": one.seconds,
            }
        yield {
            **line,
            "frequency_difference_max": _most(own.natural, theirs.natural),
            "damping_difference_max": _most(own.damping, theirs.damping),
            "frequency_difference_corrected_force_max": _most(own.natural, alike.natural),
            "damping_difference_corrected_force_max": _most(own.damping, alike.damping),
        }


def _most(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.abs(found / expected - 1).max())
