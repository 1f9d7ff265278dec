"""Effects as candidates: starts, steps, confounders, and fit coordinates."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.kinds.confounders import CONFOUNDERS
from snrmjax.diagnose.kinds.hypothesis import Confounder
from snrmjax.diagnose.kinds.registry import hypothesis_of, starts_of
from snrmjax.identify.calibrate.calibration_states import ComparedColumns
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import EFFECTS, effect_parameters
from snrmjax.model.modes import LinearModes
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact


class EffectCandidate(NamedTuple):
    """Starts and bounds of one kind of effect; parameters in the order of its constructor."""

    kind: str
    starts: tuple[tuple[float, ...], ...]
    unit: tuple[float, ...]  # a change that is clearly detectable
    lower: tuple[float, ...]
    upper: tuple[float, ...]


def candidate(kind: str, scales: MotionScales) -> EffectCandidate:
    """Starts, units and bounds of a kind of effect."""
    starts = tuple(tuple(float(v) for v in start) for start in starts_of(kind, scales))
    priors = [of.prior.bounds(scales) for of in EFFECTS[kind].parameters().values()]
    lower, upper = zip(*priors, strict=True)
    unit = tuple(abs(v) if v else 1.0 for v in starts[0])
    steps = hypothesis_of(kind).steps
    return EffectCandidate(kind, starts, unit if steps is None else steps(unit), lower, upper)


def parameter_labels(kind: str) -> tuple[str, ...]:
    """Names of a candidate's parameters, as in a diagnosis."""
    return tuple(f"{kind}.{name}" for name in effect_parameters(kind))


def only_by_calibration(kinds: Iterable[str]) -> set[str]:
    """Those of some kinds that no test of one mode can separate, only a calibration."""
    groups = (
        _confounded(confounder, kinds)
        for confounder in _confounders(kinds)
        if confounder.by_calibration
    )
    return set().union(*(group for group in groups if len(group) > 1))


def decide_by(kinds: set[str], *, harmonics: bool) -> list[Fact | str]:
    """The measurements that would decide between several kinds, two at most."""
    fitting: list[Fact | str] = [
        confounder.separated_by
        for confounder in _confounders(kinds)
        if len(_confounded(confounder, kinds)) > 1 or confounder.by_itself
    ]
    if fitting:
        return list(dict.fromkeys(fitting))[:2]
    return [Fact("widen_range") if harmonics else Fact("record_harmonics")]


def _confounders(kinds: Iterable[str]) -> list[Confounder]:
    """Confounders of some kinds: the library's in its order, then a user's."""
    every = [confounder for kind in kinds for confounder in hypothesis_of(kind).confounders]
    library = [one for one in CONFOUNDERS if one in every]
    return library + [one for one in dict.fromkeys(every) if one not in CONFOUNDERS]


def _confounded(confounder: Confounder, kinds: Iterable[str]) -> set[str]:
    """Those of some kinds that a confounder concerns."""
    return {kind for kind in kinds if confounder in hypothesis_of(kind).confounders}


class Coordinates(NamedTuple):
    """Fit coordinates of a law c x^p: stiffness c R^(p − 1) at a typical amplitude R, and p.

    Data determine the force at the measured amplitudes, but c is that at unit amplitude and varies
    by powers of ten with p: a fit in c and p would have to follow a narrow, curved valley.
    """

    pairs: tuple[tuple[int, int], ...]  # indices of a coefficient and its exponent
    reference: float  # R, kg^1/2 m

    def inward(self, values: Float[np.ndarray, "*trial parameter"]) -> np.ndarray:
        """Fit coordinates from the effects' parameters."""
        return self._scaled(values, 1.0)

    def outward(self, inner: Float[np.ndarray, "*trial parameter"]) -> np.ndarray:
        """The effects' parameters from fit coordinates."""
        return self._scaled(inner, -1.0)

    def slopes(
        self,
        values: Float[np.ndarray, " parameter"],
        slopes: Float[np.ndarray, "row parameter"],
    ) -> Float[np.ndarray, "row parameter"]:
        """Derivatives by fit coordinates from those by the effects' parameters at `values`."""
        transformed = slopes.copy()
        for c, p in self.pairs:
            transformed[:, p] -= values[c] * np.log(self.reference) * slopes[:, c]
            transformed[:, c] *= self.reference ** (1 - values[p])
        return transformed

    def _scaled(self, values: Float[np.ndarray, "*trial parameter"], sign: float) -> np.ndarray:
        scaled = np.array(values, dtype=float)
        for c, p in self.pairs:
            scaled[..., c] *= self.reference ** (sign * (scaled[..., p] - 1))
        return scaled


def coordinates(labels: Sequence[str], reference: float) -> Coordinates:
    """Coordinates for parameters of these names; `reference`: a typical amplitude."""
    pairs = []
    for index, label in enumerate(labels):
        kind, _, name = label.partition(".")
        exponent = EFFECTS[kind].parameters()[name].exponent
        if exponent is not None:
            pairs.append((index, labels.index(f"{kind}.{exponent}")))
    return Coordinates(tuple(pairs), reference)


def motion_scales(model: Structure, chosen: ComparedColumns) -> MotionScales:
    """Typical magnitudes of the compared motions."""
    states, modes = chosen.states, model.modes
    columns = (np.abs(states.velocity[:, 0]), states.frequency, states.force)
    speed, omega, force = (np.asarray(part) for part in columns)
    return scales_of_motions(modes, chosen.sensors[0], speed, omega, force)


def scales_of_motions(
    modes: LinearModes,
    sensor: int,
    speed: Float[np.ndarray, " state"],
    omega: Float[np.ndarray, " state"],
    force: Float[np.ndarray, " state"],
) -> MotionScales:
    """Typical magnitudes of motions, from velocity amplitudes at a sensor, frequencies, forces."""
    j = modes.mode_of_interest
    amplitude = speed / omega / abs(modes.mode_shape.item(sensor, j))
    return MotionScales(
        amplitude=float(np.median(amplitude)),
        largest=float(np.max(amplitude)),
        frequency=modes.natural_frequency.item(j),
        stiffness=float(np.median(abs(modes.participation.item(j)) * force / amplitude)),
        receptance=float(np.median(speed / omega / force)),
        smallest_force=float(np.min(force)),
        damping_ratio=modes.damping_ratio.item(j),
    )
