"""Reduced models of a parametrised beam: for studies, calibrations and derivatives."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.beam_parameters import (
    THICKNESS,
    BeamDescription,
    beam_parameters,
    check_beam_name,
    require_beam,
    with_beam_parameters,
)
from snrmjax.condense.beam_source import beam_source
from snrmjax.condense.condensation import reduced_model
from snrmjax.condense.reduction import run_load_cases
from snrmjax.model.parameters import parameter_names, with_parameters
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import compiled

_FORCE = "force_n"  # a parameter of the study, not of the beam


class BeamModels(eqx.Module):
    """Reduced models of a parametrised beam, from `snrmjax.io.read_beam_models`.

    Call it with parameter values by name (see `parameters`) to get the model of that beam. The
    load cases have a fixed scale in thicknesses (`displacement`, one number per mode), so that the
    model is a smooth function of the parameters.
    """

    stated: BeamDescription = eqx.field(static=True)
    file: str = eqx.field(static=True)
    displacement: tuple[float, ...] = eqx.field(static=True)  # thicknesses

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters by name, with their values in the file (SI units)."""
        return beam_parameters(self.stated)

    def __call__(self, values: Mapping[str, float | Float[Array, ""]]) -> Structure:
        """The reduced model of the beam with other parameter values.

        Geometry → linear modes → static load cases → one potential. The coefficients of the model
        are differentiable functions of `values`, in forward and reverse mode and twice.

        Arguments: `values` by the names of `parameters`; the others are as in the file. Names of
        the model (`snrmjax.model.parameter_names`, such as "mode_1.damping_ratio") change the
        reduced model itself; "force_n" is ignored, since it belongs to a test.
        Returns the model; within `jax.jit` and derivatives there are no checks, and coefficients
        are NaN if a load case has no solution. Raises `ValueError` for an unknown name, for an
        impossible beam, and if the load cases do not determine the model.
        """
        varied = {name: value for name, value in values.items() if name in self.parameters}
        rest = [name for name in values if name not in varied and name != _FORCE]
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(varied)):
            model = _traced_model(self, varied)
        else:
            require_beam(with_beam_parameters(self.stated, varied))
            model = _model(self, varied)
        if not rest:
            return model
        for name in rest:
            check_beam_name(self.stated, name, self.file, parameter_names(model))
        return with_parameters(model, rest, jnp.stack([jnp.asarray(values[n]) for n in rest]))


def _model(models: BeamModels, values: Mapping[str, Any]) -> Structure:
    beam = with_beam_parameters(models.stated, values)
    source = beam_source(beam, models.file)
    thickness = dict(beam.numbers)[THICKNESS]
    _, cases = run_load_cases(source, thickness * np.asarray(models.displacement))
    return source.structure(reduced_model(source.basis, cases, degree=source.degree))


# One program: otherwise derivatives would compile every operation by itself.
_traced_model = compiled(_model)
