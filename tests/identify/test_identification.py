"""The whole inverse method: the flat beam's virtual test, and a measured bolted beam."""

from pathlib import Path

import numpy as np

HERTZ = 2 * np.pi
MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data" / "brake_reuss_beam"
