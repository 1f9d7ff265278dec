"""Forced response by harmonic balance with pyHarm's continuation (`FRF_NonLinear`).

The modal matrices are a pyHarm substructure; the load and the polynomial force are elements of
pyHarm's plug-in interface, the latter with its analytic Jacobian as one matrix product. Used as
they come: the non-dimensional form, the tangent predictor, the pseudo-arclength closure and the
default solver (SciPy's hybr), which is faster here than pyHarm's own Newton's method at the same
tolerance. Building the system is timed with the rest. Run by simulator_speed.py.
"""

from collections.abc import Callable
from importlib.metadata import version

import numpy as np
from peer_problem import Curve, Polynomial, Problem, basis, end_status, serve
from pyHarm import Maestro
from pyHarm.Elements.SubstructureMatrixElements.MatrixElement import MatrixElement

LARGEST_STEP = 0.5  # of the others': without control of the angle this gives as many points


class PolynomialForce(MatrixElement):
    """f(q) on every coordinate of a substructure."""

    factory_keyword = "PolynomialForce"

    def _generateMatrices(self, data: dict) -> None:
        self.problem = data["problem"]

    def __flag_update__(self, *_: object) -> None:
        self.flag_nonlinear = True
        self.flag_AFT = True

    def adim(self, lc: float, wc: float) -> None:
        """The polynomial takes displacements over `lc` and gives forces over `lc`."""
        problem = self.problem
        self.polynomial, self.lc = Polynomial(problem), lc
        self.basis = basis(problem.harmonic_order, problem.n_samples)
        self.shape = (2 * problem.harmonic_order + 1, problem.n_modes)
        self.no_slope = np.zeros(self.shape[0] * self.shape[1])
        self.flag_adim = True

    def evalResidual(self, xg: np.ndarray, om: float) -> np.ndarray:
        """Fourier coefficients of the force."""
        q = self.basis.synthesis @ xg[self.indices].reshape(self.shape)
        return (self.basis.analysis @ self.polynomial.force(q)).reshape(-1) * self.lc

    def evalJacobian(self, xg: np.ndarray, om: float) -> tuple:
        """Their derivatives."""
        size, n = self.shape
        q = self.basis.synthesis @ xg[self.indices].reshape(self.shape)
        blocks = (self.basis.product @ self.polynomial.stiffness(q)).reshape(size, size, n, n)
        by_x = blocks.transpose(0, 2, 1, 3).reshape(size * n, size * n) * self.lc
        return by_x, self.no_slope


class ModalLoad(MatrixElement):
    """p F cos Ωt in one element; pyHarm's own forcing would take one for every coordinate."""

    factory_keyword = "ModalLoad"

    def _generateMatrices(self, data: dict) -> None:
        load = np.zeros((2 * data["problem"].harmonic_order + 1, data["problem"].n_modes))
        load[1] = data["problem"].force * data["problem"].participation
        self.load = load.reshape(-1)
        self.no_slope = np.zeros((load.size, load.size)), np.zeros(load.size)

    def __flag_update__(self, *_: object) -> None:
        self.flag_extforcing = True

    def adim(self, lc: float, wc: float) -> None:
        """Forces keep their unit in pyHarm's non-dimensional form."""
        self.flag_adim = True

    def evalResidual(self, xg: np.ndarray, om: float) -> np.ndarray:
        """Minus the load."""
        return -self.load

    def evalJacobian(self, xg: np.ndarray, om: float) -> tuple:
        """Nothing depends on the motion."""
        return self.no_slope


def solver(problem: Problem) -> Callable[[], Curve]:
    """Describe the system; the returned function builds it and follows the curve."""
    n = problem.n_modes
    scale, omega = problem.displacement_scale, problem.frequency_scale
    natural = problem.natural_frequency
    data = {
        "plugin": [PolynomialForce, ModalLoad],
        "system": {
            "type": "Base",
            "nh": problem.harmonic_order,
            "nti": problem.n_samples,
            "adim": {"status": True, "lc": scale, "wc": omega},
        },
        "substructures": {
            "beam": {
                "matrix": {
                    "M": np.eye(n),
                    "C": np.diag(2 * problem.damping_ratio * natural),
                    "K": np.diag(natural**2),
                },
                "ndofs": n,
            }
        },
        "connectors": {
            "polynomial": {"type": "PolynomialForce", "connect": "beam", "problem": problem},
            "load": {"type": "ModalLoad", "connect": "beam", "problem": problem},
        },
        "analysis": {
            "response": {
                "study": "frf",
                "solver": "scipyroot",
                "solver_options": {"root": {"options": {"xtol": problem.tolerance}}},
                "predictor": "tangent",
                "predictor_options": {"verbose": False},
                "corrector": "pseudo_arc_length",
                "ds0": problem.first_step,
                "ds_max": LARGEST_STEP * problem.largest_step,
                "ds_min": problem.smallest_step,
                "sign_ds": 1 if problem.to_hz > problem.from_hz else -1,
                "puls_inf": 2 * np.pi * min(problem.from_hz, problem.to_hz),
                "puls_sup": 2 * np.pi * max(problem.from_hz, problem.to_hz),
                "verbose": False,
            }
        },
    }

    def run() -> Curve:
        maestro = Maestro(data)  # a fresh one for every run: it keeps its solutions
        maestro.operate()
        found = [s for s in maestro.nls["response"].SolList if s.flag_accepted]
        rows = np.array([s.x for s in found])
        coefficients = rows[:, :-1].reshape(len(rows), 2 * problem.harmonic_order + 1, n)
        return Curve(coefficients, rows[:, -1], end_status(problem, rows[:, -1]))

    return run


if __name__ == "__main__":
    serve(
        "pyHarm",
        f"pyHarm-os {version('pyHarm-os')}",
        "scipyroot (hybr), xtol = tolerance, tangent predictor, pseudo_arc_length, non-dimensional",
        solver,
    )
