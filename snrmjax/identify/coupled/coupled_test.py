"""Modes that exchange energy: their model, its responses, and what it says of the backbone."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from snrmjax.identify.coupled.coupled_modes import CoupledModes, coupled_modes
from snrmjax.identify.coupled.single_mode_bias import SingleModeBias, single_mode_bias
from snrmjax.identify.inference.identification import Identification
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact
from snrmjax.simulate.solutions.forced_response import ResponseCurve, forced_response

_AROUND = (0.5, 1.0)  # of the measured range of frequencies, below and above it
_STDS = 2.0  # of the identified curve, beyond which its bias is worth a note


class CoupledDetails(NamedTuple):
    """Coupled modes, what a backbone of one mode is wrong by, and predicted responses."""

    modes: CoupledModes
    bias: SingleModeBias
    responses: tuple[ResponseCurve, ...]

    def notes(self) -> list[Fact]:
        """What a reader of the backbone must know."""
        found, notes = self.modes.interaction, []
        if found is None:
            looked = self.modes.interactions
            ratios = tuple((one.other + 1, one.ratio) for one in looked)
            return [Fact("modes_not_coupled", looked=ratios)]
        notes.append(
            Fact(
                "modes_coupled",
                mode=found.mode + 1,
                other=found.other + 1,
                ratio=found.ratio,
                probability=found.probability,
                share=found.share,
            )
        )
        velocity, frequency, damping, std = self.bias.at_largest
        if np.isfinite(frequency):
            clear = abs(frequency) > _STDS * std
            values = {"velocity": velocity, "frequency": frequency, "damping": damping}
            notes.append(Fact("single_mode_biased", clear=clear, **values))
        return notes


def coupled_details(
    data: SteadyStates, model: Structure, found: Identification, forces: Sequence[float]
) -> CoupledDetails:
    """Coupled modes of a test, and their responses to some forces (N).

    Raises what `coupled_modes` raises.
    """
    modes = coupled_modes(data, model)
    frequency = np.asarray(data.frequency)
    span = float(np.ptp(frequency))
    low, high = float(frequency.min()), float(frequency.max())
    curves: list[ResponseCurve] = []
    if forces:
        ends = max(low - _AROUND[0] * span, 0.5 * low), high + _AROUND[1] * span
        curves = forced_response(modes.model, list(dict.fromkeys(forces)), *ends)
    return CoupledDetails(modes, single_mode_bias(found, modes), tuple(curves))
