"""All effects of the library are tried where the noise is not stated."""

import pytest
from truths.one_mode import (
    RUBBING_CUBIC,
    RUBBING_MASS,
    RUBBING_SLIP,
    RUBBING_SQUARE,
    rubbing_test,
)

import snrmjax as sj


@pytest.mark.long
def test_three_effects_are_found_with_a_linear_test_biased_by_friction(tmp_path):
    """A low level has 0.85 % of damping, half of it friction's, and a modal mass 4 % too large."""
    shape = (1.04 * RUBBING_MASS) ** -0.5
    path = tmp_path / "model.toml"
    path.write_text(
        f"[[mode]]\nfrequency_hz = 47.0\ndamping_ratio = 0.0085\nparticipation = {shape}\n"
        f"shape = {{ tip = {shape} }}\n"
        "frequency_std_hz = 0.02\ndamping_ratio_std = 0.001\nmodal_mass_std = 0.08\n"
    )
    found = sj.diagnose_model(sj.read_model(path), rubbing_test(3))
    strengths = {
        "coulomb_friction.force": RUBBING_SLIP / RUBBING_MASS**0.5,
        "quadratic_damping.coefficient": RUBBING_SQUARE / RUBBING_MASS**1.5,
        "cubic_stiffness.coefficient": RUBBING_CUBIC / RUBBING_MASS**2,
    }
    assert {*found.effects} == {name.partition(".")[0] for name in strengths}
    for name, truth in strengths.items():
        # 4 % of the mass are 2 to 8 % of a modal strength.
        assert found.parameters[name].value == pytest.approx(truth, rel=0.12)
