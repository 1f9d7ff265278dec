"""A folder of load-case tables of a structure with known condensed potential."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from condense.conftest import basis_of, cases_of
from truths.hidden_membrane import HiddenMembrane, hidden_membrane

import snrmjax as sj
from snrmjax.condense.load_cases import StaticCases


class Folder(NamedTuple):
    """A folder of tables; `write` replaces one of them by its columns."""

    path: Path
    truth: HiddenMembrane
    cases: StaticCases

    def write(self, name, **columns):
        parts, header = [], []
        for stem, values in columns.items():
            values = np.asarray(values)
            if values.ndim == 1:
                header.append(stem)
                values = values[:, None]
            else:
                header += [f"{stem}_{k + 1}" for k in range(values.shape[1])]
            parts.append(values.astype(object))
        rows = [",".join(str(value) for value in row) for row in np.concatenate(parts, axis=1)]
        (self.path / name).write_text("\n".join([",".join(header), *rows]) + "\n")

    def replace(self, name, old, new):
        text = (self.path / name).read_text()
        assert old in text
        (self.path / name).write_text(text.replace(old, new, 1))

    def load_rows(self):
        """The lines of cases.csv, header first."""
        return (self.path / "cases.csv").read_text().splitlines()


@pytest.fixture(scope="session")
def two_modes():
    truth = hidden_membrane(2, 2, curved=30.0)
    return truth, cases_of(truth, sj.condense.modal_loads(basis_of(truth), 3.0))


@pytest.fixture
def folder(tmp_path, two_modes):
    truth, cases = two_modes
    made = Folder(tmp_path / "tables", truth, cases)
    made.path.mkdir()
    hertz = ", ".join(repr(float(one)) for one in truth.frequency / (2 * np.pi))
    (made.path / "modes.toml").write_text(
        f'name = "panel"\nfrequency_hz = [{hertz}]\nnumbers = [1, 3]\ndamping_ratio = 0.02\n'
        'shapes = "shapes.csv"\nmass = "mass.csv"\nparticipation = [1.0, 2.0]\n'
        "[sensors]\ntip = [0.5, -0.25]\n"
    )
    made.write("shapes.csv", shape=truth.shapes)
    inverse = np.linalg.inv(truth.map)
    made.write("mass.csv", mass=inverse.T @ inverse)
    made.write(
        "cases.csv",
        case=list(cases.names),
        f=np.asarray(cases.force),
        u=np.asarray(cases.displacement),
        energy=np.asarray(cases.energy),
    )
    return made
