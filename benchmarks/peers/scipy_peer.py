"""Forced response by harmonic balance in plain NumPy and SciPy, as a careful engineer writes it.

Alternating frequency-time with the analytic Jacobian as one matrix product, pseudo-arclength
continuation, one LU factorisation (LAPACK) for the Newton step and for the tangent, steps chosen
by the turn of the tangent and by Newton's iterations.
Run by simulator_speed.py: python scipy_peer.py problem.json curve.npz, or, for the bare cost of
factorisations, python scipy_peer.py --lu size.
"""

import json
import sys
import time
from collections.abc import Callable

import numpy as np
import scipy
from peer_problem import Curve, Polynomial, Problem, basis, end_status, linear_start, serve
from scipy.linalg import lu_factor, lu_solve
from scipy.linalg.lapack import dgetrf

ITERATIONS = 8
MAX_POINTS = 4000


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
        return Curve(coefficients, rows[:, -1], end_status(problem, rows[:, -1]), n_solves)

    return run


def factorisation_seconds(size: int, repeats: int = 2000) -> float:
    """Seconds of one bare LU factorisation in LAPACK."""
    matrix = np.asfortranarray(np.random.default_rng(0).normal(size=(size, size)))
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        for _ in range(repeats):
            dgetrf(matrix)
        times.append((time.perf_counter() - begin) / repeats)
    return float(np.median(times))


if __name__ == "__main__":
    if sys.argv[1] == "--lu":
        print(json.dumps({"seconds": factorisation_seconds(int(sys.argv[2]))}))
    else:
        serve(
            "numpy_scipy",
            f"numpy {np.__version__}, scipy {scipy.__version__}",
            "analytic Jacobian, pseudo-arclength, LU shared by step and tangent, step <= tolerance",
            solver,
        )
