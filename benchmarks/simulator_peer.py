"""Forced response by harmonic balance in plain NumPy and SciPy, as a careful engineer writes it.

Alternating frequency-time with the analytic Jacobian as one matrix product, pseudo-arclength
continuation, one LU factorisation (LAPACK) for the Newton step and for the tangent, steps chosen
by the turn of the tangent and by Newton's iterations.

A peer with an environment of its own (`simulator_peer_*.py`) is given the same equations, and
`serve` lets another process run it.
"""

import json
import pickle
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import lu_factor, lu_solve

ITERATIONS = 8
MAX_POINTS = 4000


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
    n_solves: int | None = None  # factorisations, where the program counts them


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


def midspan(problem: Problem, curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Frequency (Hz) and velocity amplitude (m/s) of the fundamental at the sensor."""
    omega = curve.frequency * problem.frequency_scale
    x = curve.coefficients[:, 1:3] @ problem.mode_shape * problem.displacement_scale
    return omega / (2 * np.pi), omega * np.hypot(x[:, 0], x[:, 1])


class Balance:
    """The scaled residual R(x, λ) and its Jacobian in one call."""

    def __init__(self, problem: Problem):
        self.n, self.unit = problem.n_modes, problem.frequency_scale**2
        self.scale = problem.frequency_scale
        self.basis = basis(problem.harmonic_order, problem.n_samples)
        self.polynomial = Polynomial(problem)
        self.size = 2 * problem.harmonic_order + 1
        natural = problem.natural_frequency
        h2 = np.diag(-(self.basis.derivative @ self.basis.derivative))[:, None]
        self.h2 = h2
        self.damping = 2 * problem.damping_ratio * natural
        self.stiffness = np.kron(np.eye(self.size), np.diag(natural**2))
        self.viscous = np.kron(self.basis.derivative, np.diag(self.damping))
        self.inertia = np.kron(np.diag(h2[:, 0]), np.eye(self.n))
        self.load = np.zeros((self.size, self.n))
        self.load[1] = problem.force * problem.participation / problem.displacement_scale
        self.load = self.load.reshape(-1)

    def __call__(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R and [∂R/∂x, ∂R/∂λ]."""
        n, size = self.n, self.size
        omega = point[-1] * self.scale
        x = point[:-1]
        q = self.basis.synthesis @ x.reshape(size, n)
        linear = self.stiffness + omega * self.viscous - omega**2 * self.inertia
        residual = linear @ x - self.load
        residual += (self.basis.analysis @ self.polynomial.force(q)).reshape(-1)
        blocks = (self.basis.product @ self.polynomial.stiffness(q)).reshape(size, size, n, n)
        jacobian = np.empty((size * n, size * n + 1))
        jacobian[:, :-1] = blocks.transpose(0, 2, 1, 3).reshape(size * n, size * n)
        jacobian[:, :-1] += linear
        jacobian[:, -1] = (self.viscous @ x - 2 * omega * (self.inertia @ x)) * self.scale
        return residual / self.unit, jacobian / self.unit


def correct(
    balance: Balance, guess: np.ndarray, across: np.ndarray, tolerance: float, iterations: int
) -> tuple[np.ndarray, np.ndarray, int, bool]:
    """Newton's method across a direction; the point, its tangent, iterations, converged."""
    point, matrix = guess.copy(), np.empty((len(guess), len(guess)))
    right = np.zeros((len(guess), 2))
    right[-1, 1] = 1.0
    for iteration in range(1, iterations + 1):
        right[:-1, 0], matrix[:-1] = balance(point)
        right[-1, 0] = across @ (point - guess)
        matrix[-1] = across
        factors = lu_factor(matrix, check_finite=False)
        solved = lu_solve(factors, right, check_finite=False)
        point -= solved[:, 0]
        step = np.max(np.abs(solved[:, 0]))
        if not np.isfinite(step):
            break
        if step <= tolerance:
            return point, solved[:, 1] / np.linalg.norm(solved[:, 1]), iteration, True
    return point, across, iteration, False


def solver(problem: Problem) -> Callable[[], Curve]:
    """Prepare the balance; the returned function follows the curve."""
    balance = Balance(problem)
    begin, end = problem.ends
    direction = np.sign(end - begin)
    start = np.append(linear_start(problem).reshape(-1), begin)

    def run() -> Curve:
        at_lambda = np.zeros(len(start))
        at_lambda[-1] = 1.0
        point, tangent, n_solves, ok = correct(balance, start, at_lambda, problem.tolerance, 40)
        tangent = direction * tangent  # it comes along the frequency
        points, step = [point], problem.first_step
        while ok and min(begin, end) <= point[-1] <= max(begin, end) and len(points) < MAX_POINTS:
            new, new_tangent, count, converged = correct(
                balance, point + step * tangent, tangent, problem.tolerance, ITERATIONS
            )
            n_solves += count
            turn = np.arccos(np.clip(new_tangent @ tangent, -1, 1)) if converged else np.inf
            if turn > 3 * problem.angle:
                step /= 2
                if step < problem.smallest_step:
                    break
                continue
            point, tangent = new, new_tangent
            points.append(point)
            grow = np.clip(problem.angle / max(turn, 1e-3), 0.5, 1.5)
            if count >= ITERATIONS - 2:
                grow = min(grow, 0.7)
            step = min(step * grow, problem.largest_step)
        rows = np.array(points)
        coefficients = rows[:, :-1].reshape(len(rows), balance.size, balance.n)
        return Curve(coefficients, rows[:, -1], n_solves)

    return run


def serve(ways: Callable[[Problem], dict[str, Callable]], version: str) -> None:
    """Answer every line on standard input, the name of a way to run, with its seconds.

    The problem is the pickle that the command line names; "points" answers with the curve.
    """
    told, sys.stdout = sys.stdout, sys.stderr  # what a package prints is no answer
    problem = pickle.loads(Path(sys.argv[1]).read_bytes())
    runs = ways(problem)
    for line in sys.stdin:
        begin = time.perf_counter()
        result = runs[line.strip().replace("points", "curve")]()
        answer = {"seconds": time.perf_counter() - begin, "version": version}
        if line.strip() == "points":
            hertz, velocity = midspan(problem, result)
            answer |= {"curve": [hertz.tolist(), velocity.tolist()], "n_solves": result.n_solves}
        print(json.dumps(answer), file=told, flush=True)
