"""Forced response by harmonic balance with pyHarm's continuation (`FRF_NonLinear`).

The modal matrices are a pyHarm substructure; load and polynomial force are elements of its plug-in
interface, the latter with the analytic Jacobian as one matrix product. Used as they come: the
non-dimensional form, tangent predictor, pseudo-arclength closure and default solver (SciPy's hybr).
Building the system is timed with the rest. Run by simulator_speed.py.
"""

from collections.abc import Callable
from importlib.metadata import version

import numpy as np
from pyHarm import Maestro
from pyHarm.Elements.SubstructureMatrixElements.MatrixElement import MatrixElement
from simulator_peer import Curve, Polynomial, Problem, basis, serve

LARGEST_STEP = 0.5  # of the others': without control of the angle this gives as many points


class PolynomialForce(MatrixElement):
    """f(q) - p F cos Ωt on every coordinate of a substructure."""

    factory_keyword = "PolynomialForce"

    def _generateMatrices(self, data: dict) -> None:
        self.problem = problem = data["problem"]
        self.basis = basis(problem.harmonic_order, problem.n_samples)
        self.load = np.zeros((2 * problem.harmonic_order + 1, problem.n_modes))
        self.load[1] = problem.force * problem.participation

    def __flag_update__(self, *_: object) -> None:
        self.flag_nonlinear = True
        self.flag_AFT = True

    def adim(self, lc: float, wc: float) -> None:
        """The polynomial takes displacements over `lc` and gives forces over `lc`."""
        self.polynomial, self.lc = Polynomial(self.problem), lc
        self.flag_adim = True

    def evalResidual(self, xg: np.ndarray, om: float) -> np.ndarray:
        """Fourier coefficients of the force."""
        q = self.basis.synthesis @ xg[self.indices].reshape(self.load.shape)
        force = self.basis.analysis @ self.polynomial.force(q) * self.lc
        return (force - self.load).reshape(-1)

    def evalJacobian(self, xg: np.ndarray, om: float) -> tuple:
        """Their derivatives."""
        size, n = self.load.shape
        q = self.basis.synthesis @ xg[self.indices].reshape(size, n)
        blocks = (self.basis.product @ self.polynomial.stiffness(q)).reshape(size, size, n, n)
        by_x = blocks.transpose(0, 2, 1, 3).reshape(size * n, size * n)
        return by_x * self.lc, np.zeros(size * n)


def ways(problem: Problem) -> dict[str, Callable]:
    """Describe the system; `curve` builds it and follows the whole curve."""
    n, natural = problem.n_modes, problem.natural_frequency
    low, high = sorted((2 * np.pi * problem.from_hz, 2 * np.pi * problem.to_hz))
    damping = np.diag(2 * problem.damping_ratio * natural)
    matrices = {"M": np.eye(n), "C": damping, "K": np.diag(natural**2)}
    polynomial = {"type": "PolynomialForce", "connect": "beam", "problem": problem}
    unit = {"status": True, "lc": problem.displacement_scale, "wc": problem.frequency_scale}
    order, samples = problem.harmonic_order, problem.n_samples
    response = {
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
        "puls_inf": low,
        "puls_sup": high,
        "verbose": False,
    }
    data = {
        "plugin": [PolynomialForce],
        "system": {"type": "Base", "nh": order, "nti": samples, "adim": unit},
        "substructures": {"beam": {"matrix": matrices, "ndofs": n}},
        "connectors": {"polynomial": polynomial},
        "analysis": {"response": response},
    }

    def curve() -> Curve:
        maestro = Maestro(data)  # a fresh one for every run: it keeps its solutions
        maestro.operate()
        rows = np.array([s.x for s in maestro.nls["response"].SolList if s.flag_accepted])
        coefficients = rows[:, :-1].reshape(len(rows), 2 * order + 1, n)
        return Curve(coefficients, rows[:, -1])

    return {"curve": curve}


if __name__ == "__main__":
    serve(ways, f"pyHarm-os {version('pyHarm-os')}")
