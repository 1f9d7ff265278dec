"""The curved beam tested near resonance, identified and predicted: once for all figures."""

import pytest
from truths.beam_forces import FORCES

import snrmjax as sj
from snrmjax.numerics.units import HERTZ


@pytest.fixture(scope="session")
def model():
    return sj.model.curved_beam()


@pytest.fixture(scope="session")
def virtual(model):
    errors = sj.simulate.MeasurementErrors(amplitude=0.005, phase=0.01)
    return sj.phase_resonance_test(
        model,
        FORCES,
        45 * HERTZ,
        85 * HERTZ,
        appropriation=(0.5, 0.98),
        recording=sj.simulate.Recording(errors, keep_harmonics=(2, 3)),
        harmonic_order=3,
    )


@pytest.fixture(scope="session")
def identification(model, virtual):
    return sj.identify_backbone(virtual.steady_states, model.modes, n_knots=4)


@pytest.fixture(scope="session")
def backbone(identification):
    return identification.backbone


@pytest.fixture(scope="session")
def mode(model):
    return sj.nonlinear_normal_mode(model, 50 * HERTZ, harmonic_order=3)


@pytest.fixture(scope="session")
def predicted(model, backbone):
    return sj.identify.predict_response(backbone, model.modes, FORCES[2], points_per_side=60)


@pytest.fixture(scope="session")
def resonance(model, backbone):
    return sj.identify.resonances(backbone, model.modes, FORCES[2])
