"""The whole inverse method: the flat beam's virtual test, and a measured bolted beam."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.identify.backbone import fit_backbone
from snrmjax.identify.backbone_points import identify_points
from snrmjax.identify.identification import identify_backbone
from snrmjax.identify.points import STATUS_MESSAGE, PointStatus
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states
from snrmjax.measure.steady_states import steady_states
from snrmjax.model.beams import flat_beam
from snrmjax.model.modes import linear_modes
from snrmjax.simulate.normal_modes import nonlinear_normal_mode
from snrmjax.simulate.virtual_test import phase_resonance_test

HERTZ = 2 * np.pi
MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data" / "brake_reuss_beam"
