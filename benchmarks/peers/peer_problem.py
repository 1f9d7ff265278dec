"""What a peer is given and how it answers: NumPy only, so that it runs in every environment.

A peer is a script with one function `solver(problem)` that prepares everything that does not
depend on the run and returns a function without arguments that follows the whole curve. `serve`
starts it, runs it once to compile or warm up, and then once for every line on standard input, so
that the caller can interleave the methods. One JSON line answers each.
"""

import json
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True)
class Problem:
    """q̈ + 2ζωq̇ + ω²q + f(q) = p F cos Ωt in modal coordinates, and the wanted range."""

    natural_frequency: np.ndarray  # (mode,) rad/s
    damping_ratio: np.ndarray  # (mode,)
    participation: np.ndarray  # (mode,) kg^-1/2
    mode_shape: np.ndarray  # (mode,) at the sensor, kg^-1/2
    monomials: tuple[tuple[int, ...], ...]  # of the force f: modes, counted from zero
    coefficient: np.ndarray  # (monomial, mode)
    force: float  # N
    from_hz: float  # where the linear response is a good guess
    to_hz: float  # may lie below `from_hz`
    harmonic_order: int
    n_samples: int  # over a period, alias-free for the polynomial
    displacement_scale: float  # kg^1/2 m: makes the largest motion about one
    first_step: float  # along the curve, in unknowns over their scales
    largest_step: float
    smallest_step: float
    angle: float  # rad, aimed at between neighbouring tangents by those that look at it
    tolerance: float  # on the last Newton step or the residual, scaled

    @property
    def n_modes(self) -> int:
        """Number of modal coordinates."""
        return len(self.natural_frequency)

    @property
    def frequency_scale(self) -> float:
        """Natural frequency of the first mode, rad/s."""
        return float(self.natural_frequency[0])

    @property
    def ends(self) -> tuple[float, float]:
        """First and last frequency over the frequency scale."""
        unit = 2 * np.pi / self.frequency_scale
        return self.from_hz * unit, self.to_hz * unit


class Curve(NamedTuple):
    """What a peer found: scaled coefficients and frequencies, in order along the curve."""

    coefficients: np.ndarray  # (point, coefficient, mode) over the displacement scale
    frequency: np.ndarray  # (point,) over the frequency scale
    status: str  # "ok" or what went wrong
    n_solves: int | None = None  # factorisations, where the peer counts them


class Polynomial:
    """The force f(q) and its tangent stiffness ∂f/∂q at many time samples, q over a scale."""

    def __init__(self, problem: Problem):
        n, scale = problem.n_modes, problem.displacement_scale
        longest = max((len(m) for m in problem.monomials), default=1)
        self.index = np.full((len(problem.monomials), longest), n)  # n stands for the factor one
        for row, monomial in enumerate(problem.monomials):
            self.index[row, : len(monomial)] = monomial
        size = np.array([scale ** len(m) for m in problem.monomials])
        self.coefficient = problem.coefficient * size[:, None] / scale
        # The derivative of every monomial by every mode is a monomial of one degree less.
        rows: dict[tuple[int, ...], np.ndarray] = {}
        for monomial, value in zip(problem.monomials, self.coefficient, strict=True):
            for mode in set(monomial):
                rest = list(monomial)
                rest.remove(mode)
                entry = rows.setdefault(tuple(rest), np.zeros((n, n)))
                entry[:, mode] += monomial.count(mode) * value
        self.slope_index = np.full((len(rows), max(longest - 1, 1)), n)
        for row, monomial in enumerate(rows):
            self.slope_index[row, : len(monomial)] = monomial
        self.slope = np.array(list(rows.values())).reshape(len(rows), n * n)

    def force(self, q: np.ndarray) -> np.ndarray:
        """(time, mode) to (time, mode), divided by the displacement scale."""
        return self._products(q, self.index) @ self.coefficient

    def stiffness(self, q: np.ndarray) -> np.ndarray:
        """(time, mode) to (time, mode · mode)."""
        return self._products(q, self.slope_index) @ self.slope

    @staticmethod
    def _products(q: np.ndarray, index: np.ndarray) -> np.ndarray:
        padded = np.concatenate([q, np.ones((len(q), 1))], axis=1)
        product = padded[:, index[:, 0]]
        for column in range(1, index.shape[1]):
            product = product * padded[:, index[:, column]]
        return product


class Basis(NamedTuple):
    """Alternating frequency-time matrices; coefficients run mean, cos 1, sin 1, cos 2, …"""

    synthesis: np.ndarray  # (time, coefficient)
    analysis: np.ndarray  # (coefficient, time)
    derivative: np.ndarray  # (coefficient, coefficient): d/dτ
    product: np.ndarray  # (coefficient · coefficient, time): analysis ⊗ synthesis


def basis(harmonic_order: int, n_samples: int) -> Basis:
    """The matrices for harmonics 0 to `harmonic_order`."""
    tau = 2 * np.pi * np.arange(n_samples) / n_samples
    size = 2 * harmonic_order + 1
    synthesis, derivative = np.ones((n_samples, size)), np.zeros((size, size))
    for h in range(1, harmonic_order + 1):
        synthesis[:, 2 * h - 1], synthesis[:, 2 * h] = np.cos(h * tau), np.sin(h * tau)
        derivative[2 * h - 1, 2 * h], derivative[2 * h, 2 * h - 1] = h, -h
    analysis = 2 * synthesis.T / n_samples
    analysis[0] /= 2
    product = np.einsum("at,tb->abt", analysis, synthesis).reshape(size * size, n_samples)
    return Basis(synthesis, analysis, derivative, product)


def linear_start(problem: Problem) -> np.ndarray:
    """Scaled coefficients of the linear response where the curve starts."""
    omega = 2 * np.pi * problem.from_hz
    natural, damping = problem.natural_frequency, problem.damping_ratio
    phasor = (
        problem.force
        * problem.participation
        / (natural**2 - omega**2 + 2j * damping * natural * omega)
    )
    start = np.zeros((2 * problem.harmonic_order + 1, problem.n_modes))
    start[1], start[2] = phasor.real, -phasor.imag
    return start / problem.displacement_scale


def read_problem(path: Path | str) -> Problem:
    """The problem in a JSON file."""
    data = json.loads(Path(path).read_text())
    for name in ("natural_frequency", "damping_ratio", "participation", "mode_shape"):
        data[name] = np.array(data[name], dtype=np.float64)
    data["monomials"] = tuple(tuple(m) for m in data["monomials"])
    data["coefficient"] = np.array(data["coefficient"], dtype=np.float64)
    return Problem(**data)


def midspan(problem: Problem, curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Frequency (Hz) and velocity amplitude (m/s) of the fundamental at the sensor."""
    omega = curve.frequency * problem.frequency_scale
    x = curve.coefficients[:, 1:3] @ problem.mode_shape * problem.displacement_scale
    return omega / (2 * np.pi), omega * np.hypot(x[:, 0], x[:, 1])


def serve(method: str, version: str, settings: str, solver: Callable) -> None:
    """Answer `problem.json curve.npz` on the command line and then every line on stdin."""
    problem, target = read_problem(Path(sys.argv[1])), Path(sys.argv[2])
    told = sys.stdout
    sys.stdout = sys.stderr  # what a package prints must not get among the answers

    def answer(**fields: object) -> None:
        print(json.dumps(fields), file=told, flush=True)

    try:
        begin = time.perf_counter()
        run = solver(problem)
        prepared = time.perf_counter()
        curve = run()
        first = time.perf_counter() - prepared
    except Exception as error:  # reported in the answer, and in full on stderr
        traceback.print_exc()
        answer(method=method, version=version, status=f"{type(error).__name__}: {error}")
        return
    hertz, velocity = midspan(problem, curve)
    np.savez(target, frequency_hz=hertz, velocity=velocity)
    size = (2 * problem.harmonic_order + 1) * problem.n_modes
    answer(
        method=method,
        version=version,
        settings=settings,
        status=curve.status,
        unknowns=size + 1,
        points=len(hertz),
        n_solves=curve.n_solves,
        reached_hz=float(hertz[-1]),
        prepare_seconds=prepared - begin,
        first_seconds=first,
    )
    for _ in sys.stdin:
        begin = time.perf_counter()
        run()
        answer(seconds=time.perf_counter() - begin)


def end_status(problem: Problem, frequency: np.ndarray) -> str:
    """The text "ok" when the curve went through the whole range."""
    begin, end = problem.ends
    if (frequency[-1] - end) * np.sign(end - begin) >= -1e-9:
        return "ok"
    return f"stopped at {frequency[-1] * problem.frequency_scale / (2 * np.pi):.2f} Hz"
