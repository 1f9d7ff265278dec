"""Responses of structures with elements at points by other programs, in their own environments.

Run by element_peers.py: reads a pickled problem, writes the curve of every run and its seconds.
Each is used as its own examples use it: elements as they come, its own continuation, steps so that
about as many points as ours come out. pyHarm-os from its index; NLvib-py and tmdsimpy, which are
on none, from a clone on the path.
"""

import pickle
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

Curve = tuple[np.ndarray, np.ndarray]  # frequency in rad/s, phasor of the watched point in m


def pyharm(of: dict[str, Any]) -> Callable[[], Curve]:
    """pyHarm-os: the matrices as a substructure, a node an unknown."""
    from pyHarm import Maestro

    n, order = len(of["mass"]), of["harmonics"]

    def ends(row: np.ndarray) -> dict[str, list[int]]:
        first, *other = np.argsort(-row)[: np.count_nonzero(row)].tolist()
        return {"structure": [first], **({"INTERNAL": other} if other else {})}

    connectors = {
        "force": {
            **{"type": "CosinusForcing", "connect": {"structure": [of["driven"]]}},
            **{"dirs": [0], "amp": of["force"]},
        }
    }
    for k, (kind, row, values) in enumerate(of["elements"]):
        made = {"connect": ends(row), "dirs": [0]}
        if kind == "cubic_stiffness":
            made |= {"type": "CubicSpring", "k": values["coefficient"]}
        else:
            limit = values["stiffness"] * values["slip_displacement"]
            made |= {"type": "Jenkins", "k": values["stiffness"], "mu": 1.0, "N0": limit}
        connectors[f"element {k}"] = made
    matrices = {"M": of["mass"], "C": of["damping"], "K": of["stiffness"]}
    response = {
        **{"study": "frf", "solver": "scipyroot", "predictor": "tangent"},
        **{"corrector": "pseudo_arc_length", "sign_ds": 1, "verbose": False},
        **{"ds0": of["pyharm_step"], "ds_max": of["pyharm_step"], "ds_min": 1e-8},
        **{"puls_inf": of["low"], "puls_sup": of["high"]},
        **{"puls_start": of["low"], "solver_options": {"root": {"options": {"xtol": 1e-8}}}},
        "predictor_options": {"verbose": False},
    }
    data = {
        "system": {
            **{"type": "Base", "nh": order, "nti": of["samples"]},
            "adim": {"status": True, "lc": of["size"], "wc": of["unit"]},
        },
        "substructures": {"structure": {"matrix": matrices, "ndofs": 1, "nnodes": n}},
        "connectors": connectors,
        "analysis": {"response": response},
    }

    def curve() -> Curve:
        maestro = Maestro(data)
        maestro.operate()
        rows = np.array([s.x for s in maestro.nls["response"].SolList if s.flag_accepted])
        x = rows[:, :-1].reshape(len(rows), 2 * order + 1, n)[:, :, of["watched"]] * of["size"]
        return rows[:, -1] * of["unit"], x[:, 1] - 1j * x[:, 2]

    return curve


def nlvib(of: dict[str, Any]) -> Callable[[], Curve]:
    """NLvib-py: exact elements, its own continuation."""
    from nlvib.continuation.solver import ContinuationOptions, ContinuationSolver
    from nlvib.nonlinearities.elements import (
        cubic_spring,
        elastic_dry_friction,
        polynomial_stiffness,
    )
    from nlvib.solvers.harmonic_balance import hb_residual
    from nlvib.systems.base import MechanicalSystem

    n, order = len(of["mass"]), of["harmonics"]
    system = MechanicalSystem(of["mass"], of["damping"], of["stiffness"])
    for kind, row, values in of["elements"]:
        at = np.flatnonzero(row)
        if kind == "jenkins_slider":
            limit = values["stiffness"] * values["slip_displacement"]
            made = elastic_dry_friction(values["stiffness"], limit, dof_index=int(at[0]))
            system.add_nonlinear_element(made)
        elif len(at) == 1:
            system.add_nonlinear_element(cubic_spring(values["coefficient"], int(at[0])))
        else:  # as its example writes a spring between two points
            powers = np.array([[3, 0], [2, 1], [1, 2], [0, 3]])
            each = values["coefficient"] * np.array([1.0, -3.0, 3.0, -1.0])
            for pair in (at, at[::-1]):
                system.add_nonlinear_element(polynomial_stiffness(powers, each, pair))
    load = {"dof": of["driven"], "amplitude": of["force"]}

    def residual(x: np.ndarray, omega: float) -> tuple[np.ndarray, np.ndarray]:
        return hb_residual(x, omega, system, order, load)

    def curve() -> Curve:
        x = np.zeros(n * (2 * order + 1))
        for _ in range(50):
            left, jacobian = residual(x, of["low"])
            x = x - np.linalg.solve(jacobian, left)
        settings = ContinuationOptions(
            **{"verbose": False, "ds_initial": of["nlvib_step"], "ds_min": 1e-9},
            **{"ds_max": of["nlvib_step"], "max_steps": 4000, "max_newton_iter": 25},
            **{"newton_tol": of["nlvib_tolerance"], "adapt_step": True},
            **{"lambda_min": 0.99 * of["low"], "lambda_max": of["high"]},
        )
        rows = ContinuationSolver().run(residual, x, of["low"], settings).solutions
        x = rows[:, :-1].reshape(len(rows), 2 * order + 1, n)[:, :, of["watched"]]
        return rows[:, -1], x[:, 1] - 1j * x[:, 2]

    return curve


def tmdsimpy(of: dict[str, Any]) -> Callable[[], Curve]:
    """tmdsimpy: its elements, conditioning and orthogonal corrector, as in its examples."""
    import tmdsimpy.utils.harmonic as harmonic
    from tmdsimpy.continuation import Continuation
    from tmdsimpy.nlforces.cubic_stiffness import CubicForce
    from tmdsimpy.nlforces.vector_jenkins import VectorJenkins
    from tmdsimpy.solvers import NonlinearSolver
    from tmdsimpy.vibration_system import VibrationSystem

    n, orders = len(of["mass"]), np.arange(of["harmonics"] + 1)
    system = VibrationSystem(of["mass"], of["stiffness"], C=of["damping"])
    for kind, row, values in of["elements"]:
        q, t = row[None, :], row[:, None]
        if kind == "cubic_stiffness":
            system.add_nl_force(CubicForce(q, t, np.array([values["coefficient"]])))
        else:
            limit = values["stiffness"] * values["slip_displacement"]
            system.add_nl_force(VectorJenkins(q, t, values["stiffness"], limit))
    load = np.zeros(harmonic.Nhc(orders) * n)
    load[n + of["driven"]] = of["force"]

    def curve() -> Curve:
        solver = NonlinearSolver()

        def at_start(x: np.ndarray) -> tuple:
            point = np.hstack((x, of["low"]))
            return system.hbm_res(point, load, orders, Nt=of["samples"])[0:2]

        x, _, slope, _ = solver.nsolve(at_start, 0 * load, verbose=False)
        start = np.hstack((x, of["low"]))
        scale = harmonic.harmonic_wise_conditioning(start, n, orders, delta=1e-3 * of["size"])
        scale[-1] = of["high"]
        settings = {
            **{"DynamicCtoP": True, "TargetNfev": 200, "MaxSteps": 8000, "verbose": 0},
            **{"dsmin": 1e-7, "dsmax": of["tmdsimpy_step"], "corrector": "Ortho"},
            "xtol": 1e-9 * len(start),
        }
        unit = 1 / np.max(np.abs(np.diag(slope * scale[:-1])))
        step = of["tmdsimpy_step"]
        way = Continuation(solver, ds0=step, CtoP=scale, RPtoC=unit, config=settings)

        def residual(point: np.ndarray) -> tuple:
            return system.hbm_res(point, load, orders, Nt=of["samples"])

        rows = way.continuation(residual, start, of["low"], of["high"])
        at = of["watched"]
        return rows[:, -1], rows[:, n + at] - 1j * rows[:, 2 * n + at]

    return curve


if __name__ == "__main__":
    with open(sys.argv[2], "rb") as source:
        problem = pickle.load(source)
    curve = globals()[sys.argv[1]](problem)
    found = []
    for _ in range(problem["runs"]):
        begin = time.perf_counter()
        points = curve()
        found.append((time.perf_counter() - begin, points))
    with open(sys.argv[3], "wb") as target:
        pickle.dump(found, target)
