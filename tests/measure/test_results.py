"""What the results of a force calibration say, label and show."""

import numpy as np
from matplotlib.figure import Figure

import snrmjax as sj


def test_a_force_calibration():
    line = sj.measure.calibrate_force([0.01, 0.02, 0.03], [1.0, 2.1, 2.9])
    np.testing.assert_allclose(line.to_xarray().gain, 95.0)
    assert line.to_xarray().residual_std_n.attrs["units"] == "N"
    assert isinstance(line.plot(), Figure)


def test_an_equivalent_force():
    modes = sj.model.linear_modes([500.0], [0.01], [[2.0]], [3.0])
    frequency = np.tile(np.linspace(490.0, 510.0, 8), 2)
    force = np.repeat([1.0, 2.0], 8)
    velocity = sj.model.linear_response(modes, frequency, force)
    data = sj.measure.steady_states(
        np.repeat([1, 2], 8), frequency, np.full(16, np.nan), velocity, drive=0.1 * force
    )
    found = sj.measure.equivalent_force(data, modes)
    table = found.to_pandas()
    np.testing.assert_allclose(table.force_n, [1.0, 2.0], rtol=1e-6)
    assert table.status.tolist() == ["successful", "successful"]
    assert isinstance(found.plot(), Figure)
