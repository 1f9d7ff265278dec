"""Steady states of one nonlinear mode by exact harmonic balance (checked by `check.py`).

NumPy alone, nothing of the package under test. Scaled by ω₀ and by the amplitude at the top level:
w² y'' + 2ζ w y' + K y + n(y, w y') = f cos(τ + π/2 − θ) with the fundamental of y equal to a cos τ,
so that θ is the phase of the velocity relative to the force. Harmonics 0 to 31 of 1024 samples;
the jumps of Coulomb's force are exact, Iwan's element follows Masing's rule (two reversals a
cycle). A batch of states is solved at once by Newton's method with exact derivatives.
"""

from typing import NamedTuple

import numpy as np

STIFFNESS = ("cubic_hardening", "cubic_softening", "quadratic", "quintic", "gap", "stop")
LAWS = ("none", *STIFFNESS, "coulomb", "iwan", "quadratic_damping")
_CUBIC_OF_QUADRATIC = 0.1  # y³ beside y², over the square of its coefficient: the well is bounded
_ROUNDS, _ENOUGH = 60, 1e-11


class Law(NamedTuple):
    """A force n(y, v): its name, strength, and gap or exponent."""

    name: str
    strength: float
    shape: float = 0.0

    @property
    def sizes(self) -> tuple[int, int]:
        """Harmonics and samples: a polynomial needs few to be exact."""
        smooth = self.name in ("none", *STIFFNESS[:4])
        return (15, 128) if smooth else (31, 1024)

    def force(self, y, v):
        """The force and its slopes by y and v, where the present state alone matters."""
        s, g, zero = self.strength, self.shape, np.zeros_like(y)
        if self.name == "cubic_hardening":
            return s * y**3, 3 * s * y**2, zero
        if self.name == "cubic_softening":
            return -s * y**3, -3 * s * y**2, zero
        if self.name == "quadratic":
            c = _CUBIC_OF_QUADRATIC * s**2
            return s * y**2 + c * y**3, 2 * s * y + 3 * c * y**2, zero
        if self.name == "quintic":
            return s * y**5, 5 * s * y**4, zero
        if self.name == "gap":
            return s * np.sign(y) * np.maximum(np.abs(y) - g, 0), s * (np.abs(y) > g), zero
        if self.name == "stop":
            return s * np.maximum(y - g, 0), s * (y > g), zero
        if self.name == "quadratic_damping":
            return s * np.abs(v) * v, zero, 2 * s * np.abs(v)
        return zero, zero, zero


class States(NamedTuple):
    """Steady states, one a row."""

    coefficients: np.ndarray  # of y: mean, cosines, sines
    w: np.ndarray
    force: np.ndarray
    phase: np.ndarray  # θ
    slope: np.ndarray  # dw/dθ along the response at constant force: negative where stable
    good: np.ndarray

    @property
    def amplitude(self) -> np.ndarray:
        """Of the fundamental."""
        return self.coefficients[:, 1]

    def of(self, rows) -> "States":
        """Some rows."""
        return States(*(column[rows] for column in self))


def _sampled(x, n: int, samples: int):
    spectrum = np.zeros((*x.shape[:-1], samples // 2 + 1), complex)
    spectrum[..., : n + 1] = x[..., : n + 1] * samples / 2
    spectrum[..., 0] *= 2
    spectrum[..., 1 : n + 1] -= 1j * x[..., n + 1 :] * samples / 2
    return np.fft.irfft(spectrum, samples)


def _projected(f, n: int):
    spectrum = 2 * np.fft.rfft(f)[..., : n + 1] / f.shape[-1]
    spectrum[..., 0] /= 2
    return np.concatenate([spectrum.real, -spectrum.imag[..., 1:]], axis=-1)


def _multiplied(f, n: int):
    """Matrix of the product with the samples f, from coefficients to coefficients."""
    d = np.fft.rfft(f)[..., : 2 * n + 1] / f.shape[-1]
    even, odd = d.real, -d.imag  # means of f cos mτ, f sin mτ
    j, k = np.arange(n + 1)[:, None], np.arange(n + 1)
    apart, both, sign = np.abs(j - k), j + k, np.sign(k - j)
    cc, ss = even[..., apart] + even[..., both], even[..., apart] - even[..., both]
    cs = odd[..., both] + sign * odd[..., apart]
    sc = odd[..., both] - sign * odd[..., apart]
    top = np.concatenate([cc, cs[..., 1:]], axis=-1)
    top[..., 0, :] /= 2
    return np.concatenate([top, np.concatenate([sc, ss[..., 1:]], axis=-1)[..., 1:, :]], axis=-2)


def _rated(x, n: int):
    """Coefficients of dy/dτ; along the last axis."""
    k = np.arange(1, n + 1)
    c, s = x[..., 1 : n + 1], x[..., n + 1 :]
    return np.concatenate([np.zeros_like(x[..., :1]), k * s, -k * c], axis=-1)


def _basis(tau, n: int):
    k = np.arange(n + 1)
    angle = tau[..., None] * k
    return np.concatenate([np.cos(angle), np.sin(angle[..., 1:])], axis=-1)


def _reversals(x, n: int):
    """Times of largest and least y, near 0 and π, with the slopes of these times by x."""
    tau = np.stack([np.zeros(len(x)), np.full(len(x), np.pi)], 1)
    rate = _rated(x, n)
    bend = _rated(rate, n)
    for _ in range(8):
        basis = _basis(tau, n)
        tau = tau - (basis * rate[:, None]).sum(-1) / (basis * bend[:, None]).sum(-1)
    basis = _basis(tau, n)
    # y'(τ) = Σ x_k φ_k'(τ): φ' of cos kτ is −k sin kτ, of sin kτ is k cos kτ.
    k = np.arange(1, n + 1)
    turned = np.concatenate(
        [np.zeros_like(basis[..., :1]), -k * basis[..., n + 1 :], k * basis[..., 1 : n + 1]], -1
    )
    return tau, basis, -turned / (basis * bend[:, None]).sum(-1)[..., None]


def _nonlinear(law: Law, x, w, n: int, samples: int):
    """Coefficients of the force, their slopes by those of y, and by w."""
    s = law.strength
    if law.name == "coulomb":
        (first, second), (by_first, by_second) = (
            np.moveaxis(part, 1, 0) for part in _reversals(x, n)[::2]
        )
        k = np.concatenate([np.arange(n + 1), np.arange(1, n + 1)])
        one, two = _basis(first, n), _basis(second, n)
        # Integrals of −2 between the reversals; of cos kτ it is sin kτ/k, of sin kτ −cos kτ/k.
        step = np.zeros_like(x)
        step[:, 0] = (np.pi - second + first) / np.pi
        step[:, 1 : n + 1] = -2 / np.pi * (two - one)[:, n + 1 :] / k[1 : n + 1]
        step[:, n + 1 :] = 2 / np.pi * (two - one)[:, 1 : n + 1] / k[1 : n + 1]
        half = np.where(np.arange(2 * n + 1) == 0, 1.0, 2.0) / np.pi
        slopes = (half * one)[:, :, None] * by_first[:, None] - (half * two)[:, :, None] * (
            by_second[:, None]
        )
        return s * step, s * slopes, np.zeros_like(x)
    y, rate = _sampled(x, n, samples), _sampled(_rated(x, n), n, samples)
    if law.name == "iwan":
        _, basis, _ = _reversals(x, n)
        at_high = basis[:, 0]
        high, p = (at_high * x).sum(-1)[:, None], law.shape
        falling = np.where(rate <= 0, 1.0, -1.0)
        gone = np.maximum((high - falling * y) / 2, 1e-300)  # half the way since the reversal
        force = falling * (2 * gone**p - high**p) * s
        by_y, by_high = (
            -s * p * gone ** (p - 1),
            falling * s * p * (gone ** (p - 1) - high**p / high),
        )
        slopes = _multiplied(by_y, n) + _projected(by_high, n)[:, :, None] * at_high[:, None]
        return _projected(force, n), slopes, np.zeros_like(x)
    force, by_y, by_v = law.force(y, w[:, None] * rate)
    slopes = _multiplied(np.asarray(by_y, float), n)
    of_rate = _multiplied(by_v, n)
    k = np.arange(1, n + 1)
    by_x = np.concatenate([0 * of_rate[..., :1], -k * of_rate[..., n + 1 :],
                           k * of_rate[..., 1 : n + 1]], axis=-1)  # fmt: skip
    return _projected(force, n), slopes + w[:, None, None] * by_x, _projected(by_v * rate, n)


def solved(law: Law, damping: float, stiffness, phase, start: States, fixed: str) -> States:
    """Newton's method from `start`: "force" fixed gives amplitudes, "amplitude" fixed gives forces.

    `damping` is ζ; `stiffness` K and `phase` θ (rad) one a state.
    """
    n, samples = law.sizes
    x, w, f = start.coefficients.copy(), start.w.copy(), start.force.copy()
    rows, order = np.arange(2 * n + 1), np.concatenate([np.arange(n + 1), np.arange(1, n + 1)])
    k = np.arange(1, n + 1)
    for _ in range(_ROUNDS):
        force, slopes, by_w = _nonlinear(law, x, w, n, samples)
        linear = stiffness[:, None] - (order * w[:, None]) ** 2
        rate = _rated(x, n)
        residual = force + linear * x + 2 * damping * w[:, None] * rate
        residual[:, 1] -= f * np.sin(phase)
        residual[:, n + 1] += f * np.cos(phase)
        slopes[:, rows, rows] += linear
        slopes[:, k, k + n] += 2 * damping * w[:, None] * k
        slopes[:, k + n, k] -= 2 * damping * w[:, None] * k
        # The fundamental has no sine: its place is w's.
        slopes[:, :, n + 1] = by_w + 2 * damping * rate - 2 * order**2 * w[:, None] * x
        if fixed == "amplitude":
            slopes[:, :, 1] = 0
            slopes[:, 1, 1], slopes[:, n + 1, 1] = -np.sin(phase), np.cos(phase)
        by_phase = np.zeros_like(x)
        by_phase[:, 1], by_phase[:, n + 1] = -f * np.cos(phase), -f * np.sin(phase)
        # Rows of the fundamental shrink with damping: scaled by the force.
        scale = np.ones_like(x)
        scale[:, [1, n + 1]] = 1 / np.maximum(f, 1e-300)[:, None]
        given = np.stack([residual, by_phase], -1) * scale[..., None]
        found = np.linalg.solve(slopes * scale[..., None], given)
        step, slope = found[..., 0], -found[:, n + 1, 1]
        size = np.where(fixed == "amplitude", f, x[:, 1])
        limit = np.minimum(1, 0.3 / np.maximum(np.abs(step[:, 1]) / size, 1e-300))
        limit = np.minimum(limit, 0.1 * w / np.maximum(np.abs(step[:, n + 1]), 1e-300))
        step = limit[:, None] * step
        error = np.maximum(np.abs(step[:, 1]) / size, np.abs(step).max(-1) / x[:, 1])
        w = w - step[:, n + 1]
        f = f - step[:, 1] * (fixed == "amplitude")
        step[:, n + 1] = 0
        step[:, 1] *= fixed == "force"
        x = x - step
        if np.all(error < _ENOUGH):
            break
    return States(x, w, f, phase + 0 * w, slope, error < 1e-7)


def backbone(law: Law, damping: float, amplitude, steps: int = 8) -> States:
    """Phase resonances at amplitudes, the law's strength growing from zero to its own."""
    n = law.sizes[0]
    amplitude, one = np.asarray(amplitude, float), np.ones(len(amplitude))
    x = np.zeros((len(amplitude), 2 * n + 1))
    x[:, 1] = amplitude
    found = States(x, one, 2 * damping * amplitude, 0 * one, 0 * one, one > 0)
    for fraction in np.linspace(0, 1, steps + 1)[1:]:
        now = law._replace(strength=fraction * law.strength)
        found = solved(now, damping, one, 0 * one, found, "amplitude")
    return found
