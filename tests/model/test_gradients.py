"""Derivatives of the functions of `sj.model` that an engineer would expect to have them."""

import dataclasses

import equinox as eqx
import numpy as np
from truths.derivatives import check_derivatives, numbers

import snrmjax as sj

MODES = sj.model.linear_modes([500.0, 1400.0], [0.01, 0.02], [[2.0, 0.5]], [3.0, 1.0])
POTENTIAL = sj.model.polynomial_potential({"111": 1e7, "1112": 3e9, "1111": 1e10}, 2)
FREQUENCY = np.array([480.0, 500.0, 1390.0])
AMPLITUDE = np.array([1e-4, 5e-4, 1e-3])
DISPLACEMENT = np.array([[1e-3, 2e-4], [-5e-4, 1e-4], [2e-4, -3e-4]])


def of_modes(relative):
    modes = dataclasses.replace(
        MODES,
        natural_frequency=MODES.natural_frequency * (1 + relative[:2]),
        damping_ratio=MODES.damping_ratio * (1 + relative[2:4]),
        mode_shape=MODES.mode_shape * (1 + relative[4:6]),
        participation=MODES.participation * (1 + relative[6:8]),
    )
    force = 1 + relative[11:14]
    return numbers(sj.model.linear_response(modes, FREQUENCY * (1 + relative[8:11]), force))


def test_linear_response():
    check_derivatives(of_modes, 14)


def of_averages(relative):
    amplitude, frequency = AMPLITUDE * (1 + relative[:3]), FREQUENCY * (1 + relative[3:6])
    size = 1 + relative[6]

    slider = sj.model.make_effect(
        "jenkins_slider", {"stiffness": 1e4 * size, "slip_displacement": 3e-4 * (1 + relative[7])}
    )
    drag = sj.model.make_effect("quadratic_damping", {"coefficient": 0.3 * size})
    return numbers(
        sj.model.averaged_effect(drag, amplitude, frequency).damping,
        *sj.model.averaged_effect(slider, amplitude, frequency),
    )


def test_averages():
    check_derivatives(of_averages, 8, step=1e-7)


def of_structures(relative):
    coefficient = POTENTIAL.coefficient * (1 + relative[:3])
    potential = eqx.tree_at(lambda p: p.coefficient, POTENTIAL, coefficient)
    displacement = DISPLACEMENT * (1 + relative[3:9].reshape(3, 2))
    effects = (sj.model.make_effect("cubic_damping", {"coefficient": 0.2 * (1 + relative[9])}),)
    beam = sj.model.structure(MODES, potential, effects=effects)
    velocity = 300.0 * displacement[::-1]
    return numbers(
        *(potential.energy(displacement), potential.force(displacement)),
        *(potential.stiffness(displacement), beam.nonlinear_force(displacement, velocity)),
        *(beam.potential_energy(displacement), *beam.slopes(displacement, velocity)),
    )


def test_structures():
    check_derivatives(of_structures, 10)
