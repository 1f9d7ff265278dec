"""Where a condensed model ends to hold: its forced response against that of all finite elements.

A uniform harmonic force on a flat and a curved clamped beam (20 elements, 57 degrees of freedom),
from small amplitudes to 1.5 thicknesses. All elements: harmonic balance by `full_order.py` with
sines and cosines to the ninth harmonic, stepped through resonance by the phase of the midspan
velocity, which passes the folds. Condensed models: `forced_response`. Both have the same damping:
C = MΦ diag(2ζ_kω_k) ΦᵀM with all modes of the mesh, of which the condensed model keeps its own;
"mass" is C ∝ M, ζ_k = ζω₁/ω_k, and "stiffness" C ∝ K, ζ_k = ζω_k/ω₁, which also damps stretching.

Errors: of frequency and velocity at the peak of the velocity fundamental at midspan; of the whole
curve at equal phase, largest and rms over 60 phases of frequency (relative) and velocity (over the
peak's; null where the condensed model's phase turns back, in an internal resonance); of the fold at
the end of the bent resonance. `holds_to_thicknesses`:
the largest peak among the forces whose peak frequency is right to 1 %, and the next beyond.

One JSON line a case.

    python benchmarks/rom_forced_response.py [--only flat]
"""

import time
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from full_order import (
    CURVED,
    FLAT,
    ORDER,
    Closing,
    balanced,
    condensed,
    cosines_and_sines,
    free_mass,
    free_tangent,
)
from harness import options, teller
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh

import snrmjax as sj
from snrmjax.condense.elements.strain_energy import interpolation, uniform_load

tell = teller(__file__)

HERTZ = 2 * np.pi
_RATIO = 0.02  # damping ratio of the first mode
_PHASES = np.deg2rad(np.linspace(80.0, -80.0, 81))  # of the midspan velocity
_COMPARED = np.deg2rad(np.linspace(78.0, -78.0, 60))
_BAR = 0.01  # of the peak's frequency
# Forces in N, uniform, for peaks of about 0.3, 0.6, 1 and 1.5 (curved: 0.85 and 1) thicknesses.
_CASES = {
    "flat": (FLAT, (0.0323, 0.0695, 0.131, 0.235), ((1,), (1, 3), (1, 3, 5, 7))),
    "curved": (CURVED, (0.0113, 0.0214, 0.028, 0.032), ((1,), (1, 3), (1, 3, 5, 7))),
}


class FullModel(NamedTuple):
    """All free degrees of freedom of a beam, damped, with its modes."""

    beam: sj.condense.Beam
    damping: np.ndarray  # kg/s
    frequency: np.ndarray  # rad/s, of all modes
    ratio: np.ndarray  # damping ratio of all modes
    load: np.ndarray  # per newton in total
    middle: np.ndarray  # row of the midspan displacement


class Features(NamedTuple):
    """Peak of the velocity fundamental, and the fold at the far end of the bent resonance."""

    peak_frequency: float  # rad/s
    peak_velocity: float  # m/s
    fold: float  # rad/s; NaN where the response does not fold


class Response(NamedTuple):
    """A forced response in order of falling phase of the midspan velocity."""

    phase: np.ndarray  # rad
    frequency: np.ndarray  # rad/s
    velocity: np.ndarray  # fundamental, m/s
    features: Features


def full_model(beam: sj.condense.Beam, kind: str) -> FullModel:
    """All elements with mass- or stiffness-proportional damping."""
    free = beam.free
    mass = np.asarray(free_mass(beam))
    stiffness = np.asarray(free_tangent(beam, jnp.zeros(free.size)))
    squared, shapes = eigh(stiffness, mass)
    frequency = np.sqrt(squared)
    first = frequency[0]
    ratio = _RATIO * (first / frequency if kind == "mass" else frequency / first)
    weighted = mass @ shapes
    damping = weighted * (2 * ratio * frequency) @ weighted.T
    load, middle = (
        np.asarray(row)[free] for row in (uniform_load(beam), interpolation(beam, 0.5)[1])
    )
    return FullModel(beam, damping, frequency, ratio, load, middle)


def full_response(full: FullModel, force: float) -> Response:
    """The response of all elements through resonance."""
    waves, n = cosines_and_sines(), full.load.size
    basis = sj.condense.beam_modes(full.beam, (1,))
    shape = np.asarray(basis.shapes)[full.beam.free, 0]
    # The linear response of the first mode begins it: tan of the velocity's phase is given.
    first, zeta = full.frequency[0], full.ratio[0]
    tangent = np.tan(_PHASES[0])
    omega = first * (np.sqrt((zeta * tangent) ** 2 + 1) - zeta * tangent)
    speed = force * (shape @ full.load) * np.cos(_PHASES[0]) / (2 * zeta * first)
    phasor = speed * np.exp(1j * _PHASES[0]) / (1j * omega)
    c = np.zeros((2 * ORDER + 1, n))
    c[1], c[ORDER + 1] = phasor.real * shape, -phasor.imag * shape
    motions: list = []
    system = full.beam, jnp.asarray(full.damping), jnp.asarray(force * full.load)
    for phase in _PHASES:
        # Velocity phasor Ω(b₁ + i a₁) at midspan along e^{iφ}.
        row = np.zeros((2 * ORDER + 1, n))
        row[1], row[ORDER + 1] = np.cos(phase) * full.middle, -np.sin(phase) * full.middle
        row /= np.abs(full.middle).max()
        # From the line through the last two motions, or from the last.
        starts = [(c, omega), *((m.coefficients, m.frequency) for m in motions[-1:])]
        for start in starts:
            at = jnp.asarray(start[0]), jnp.asarray(start[1])
            found = balanced(*system, waves, at, Closing(jnp.asarray(row), 0.0))
            if found.moved < 1e-8:
                break
        else:
            raise RuntimeError(f"no balance at {force:g} N and {np.rad2deg(phase):.0f} degrees.")
        motions.append(found)
        ahead = motions[-1] if len(motions) == 1 else motions[-2]
        c = 2 * np.asarray(found.coefficients) - np.asarray(ahead.coefficients)
        omega = 2 * float(found.frequency) - float(ahead.frequency)
    return response_of(full, motions)


def response_of(full: FullModel, motions: list) -> Response:
    """Frequency and midspan velocity of balanced motions, peak and fold between them."""
    frequency = np.array([float(m.frequency) for m in motions])
    moved = np.array([np.asarray(m.coefficients) @ full.middle for m in motions])
    velocity = frequency * (moved[:, ORDER + 1] + 1j * moved[:, 1])
    phase, speed = np.unwrap(np.angle(velocity)), np.abs(velocity)
    along, across = (CubicSpline(-phase, values) for values in (frequency, speed))
    tops = across.derivative().roots(extrapolate=False)
    top = tops[np.argmax(across(tops))]
    roughness = along(along.derivative().roots(extrapolate=False))
    features = Features(
        float(along(top)), float(across(top)), furthest(roughness, full.frequency[0])
    )
    return Response(phase, frequency, speed, features)


def furthest(folds: np.ndarray, first: float) -> float:
    """The fold furthest from the linear natural frequency: where the bent resonance ends."""
    return float(folds[np.argmax(np.abs(folds - first))]) if len(folds) else np.nan


def reduced_response(model: sj.model.Structure, force: float, full: Response) -> Response:
    """The whole response of a condensed model, over the range of the full one and more."""
    low, high = 0.8 * full.frequency.min(), 1.2 * full.frequency.max()
    curve = sj.forced_response(model, [force], low, high, stability=False)[0]
    velocity = curve.velocity[:, 1, 0]
    phase, speed = np.unwrap(np.angle(velocity)), np.abs(velocity)
    peaks, folds = curve.at_events("peak"), curve.at_events("fold")
    top = peaks[np.argmax(speed[peaks])]
    first = float(model.modes.natural_frequency[0])
    fold = furthest(curve.frequency[folds], first)
    features = Features(float(curve.frequency[top]), float(speed[top]), fold)
    return Response(phase, curve.frequency, speed, features)


def at_phases(response: Response) -> tuple[np.ndarray, np.ndarray]:
    """Frequency and velocity at the compared phases; NaN where the phase turns back."""
    along = -response.phase
    inside = (along > -_PHASES[0]) & (along < -_PHASES[-1])
    if np.any(np.diff(along[inside]) < 0):
        return np.full((2, _COMPARED.size), np.nan)
    keep = np.concatenate([[True], np.diff(np.maximum.accumulate(along)) > 1e-9])
    splines = [
        CubicSpline(along[keep], values[keep]) for values in (response.frequency, response.velocity)
    ]
    return splines[0](-_COMPARED), splines[1](-_COMPARED)


def errors_of(full: Response, reduced: Response) -> dict[str, float]:
    """Relative errors of one response."""
    a, b = full.features, reduced.features
    (f, v), (g, w) = at_phases(full), at_phases(reduced)
    along, across = g / f - 1, (w - v) / a.peak_velocity
    return {
        "peak_frequency": b.peak_frequency / a.peak_frequency - 1,
        "peak_velocity": b.peak_velocity / a.peak_velocity - 1,
        "fold_frequency": b.fold / a.fold - 1,
        "curve_frequency_largest": np.max(np.abs(along)),
        "curve_frequency_rms": np.sqrt(np.mean(along**2)),
        "curve_velocity_largest": np.max(np.abs(across)),
        "curve_velocity_rms": np.sqrt(np.mean(across**2)),
    }


def main() -> None:
    """Both beams, all forces, with one mode and with more, both kinds of damping."""
    chosen = options(__doc__, only=list(_CASES))
    for name in chosen.only:
        for kind in ("mass", "stiffness"):
            compared(name, kind, *_CASES[name])


def compared(name: str, kind: str, beam, forces, sets) -> None:
    """Print the lines of one beam with one kind of damping."""
    full = full_model(beam, kind)
    thickness = float(beam.thickness)
    begin = time.perf_counter()
    whole = [full_response(full, force) for force in forces]
    seconds = (time.perf_counter() - begin) / len(forces)
    sizes = [one.velocity / one.frequency / thickness for one in whole]
    head = {"beam": name, "damping": kind}
    line = {
        **head,
        "model": "all elements",
        "force_n": list(forces),
        "peak_hz": [one.features.peak_frequency / HERTZ for one in whole],
        "peak_velocity_m_s": [one.features.peak_velocity for one in whole],
        "largest_thicknesses": [one.max() for one in sizes],
        "fold_hz": [one.features.fold / HERTZ for one in whole],
        "seconds_a_response": seconds,
    }
    tell(**line)
    for modes in sets:
        ratio = full.ratio[np.array(modes) - 1]
        reduced = condensed(beam, modes, ratio)
        begin = time.perf_counter()
        parts = [reduced_response(reduced, f, w) for f, w in zip(forces, whole, strict=True)]
        seconds = (time.perf_counter() - begin) / len(forces)
        rows = [errors_of(a, b) for a, b in zip(whole, parts, strict=True)]
        good = [abs(row["peak_frequency"]) <= _BAR for row in rows]
        held = [float(size.max()) for size, g in zip(sizes, good, strict=True) if g]
        lost = [float(size.max()) for size, g in zip(sizes, good, strict=True) if not g]
        line = {
            **head,
            "model": f"modes {', '.join(map(str, modes))}",
            "force_n": list(forces),
            **{key: [row[key] for row in rows] for key in rows[0]},
            "holds_to_thicknesses": [
                round(max(held, default=0.0), 2),
                round(min(lost), 2) if lost else None,
            ],
            "seconds_a_response": seconds,
        }
        tell(**line)


if __name__ == "__main__":
    main()
