"""The methods that a table of steady states allows, side by side on the same data."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from snrmjax.identify.inference.fitted_curves import as_backbone
from snrmjax.identify.joint.joint_fit import fit_jointly
from snrmjax.identify.pointwise.identification import identify_backbone
from snrmjax.measure.states import SteadyStates
from snrmjax.methods.result import MethodPoint, MethodResult, MethodStatus, method_result
from snrmjax.methods.steady.arslan_ozguven import arslan_ozguven
from snrmjax.methods.steady.concerto import concerto
from snrmjax.methods.steady.harmonic_force_surface import harmonic_force_surface
from snrmjax.methods.steady.phase_resonance import phase_resonance
from snrmjax.methods.steady.rct import rct
from snrmjax.model.modes import LinearModes

_SAMPLES = 41  # of the curves that the inverse method gives

Method = Callable[[SteadyStates, LinearModes], MethodResult]


def snrm(data: SteadyStates, modes: LinearModes) -> MethodResult:
    """The inverse single nonlinear resonant mode method: its curves at 41 amplitudes.

    `identify_backbone` in the form of the other methods; where the force is known only as a drive
    voltage `fit_jointly`, with the gain and the instrument's phase as unknowns. Arguments: `data`
    and `modes` as there. Returns a `MethodResult` between the smallest and the largest measured
    amplitude; 1σ as stated by the data or from the scatter about the curve.
    Raises `ValueError` as these do.
    Reference: Kwarta & Allen, section 2.2.
    """
    if np.isfinite(np.asarray(data.force)).any():
        found = identify_backbone(data, modes)
        backbone, notes = found.fit.backbone, found.notes
    else:
        joint = fit_jointly(data, modes, free=("instrument_phase",))
        backbone, notes = as_backbone(joint), joint.notes
    ends = float(backbone.smallest), float(backbone.largest)
    curve = backbone.values(jnp.linspace(*ends, _SAMPLES))
    columns = (
        *(curve.velocity, curve.natural_frequency, curve.natural_frequency_std),
        *(curve.damping_ratio, curve.damping_ratio_std),
    )
    points = [
        MethodPoint(MethodStatus.FOUND, -1, *(float(value) for value in row))
        for row in np.stack([np.asarray(one) for one in columns], axis=1)
    ]
    return method_result("snrm", points, data.n_states, notes)


METHODS: dict[str, Method] = {
    "snrm": snrm,
    "concerto": concerto,
    "arslan_ozguven": arslan_ozguven,
    "rct": rct,
    "harmonic_force_surface": harmonic_force_surface,
    "phase_resonance": phase_resonance,
}
"""Methods that read a table of steady states, by name."""


class Comparison(NamedTuple):
    """What each method found, and what stopped those that could not run."""

    results: tuple[MethodResult, ...]
    stopped: dict[str, str]  # method: why


def compare_methods(
    data: SteadyStates, modes: LinearModes, methods: Sequence[str] | None = None
) -> Comparison:
    """Run several methods on the same steady states.

    Arguments: `methods` are names in `METHODS`, all of them by default. A method that the data do
    not allow is in `stopped` with the reason; the others still run.
    Raises `ValueError` for a name that no method has, and where not one method could run.
    """
    names = list(METHODS) if methods is None else list(methods)
    unknown = [name for name in names if name not in METHODS]
    if unknown:
        raise ValueError(
            f"`methods` must be among {', '.join(METHODS)}, but has {', '.join(unknown)}."
        )
    results, stopped = [], {}
    for name in names:
        try:
            results.append(METHODS[name](data, modes))
        except ValueError as error:
            stopped[name] = str(error)
    if not results:
        first, reason = next(iter(stopped.items()), ("none", "no method was asked for."))
        raise ValueError(f"no method could run; {first}: {reason}")
    return Comparison(tuple(results), stopped)
