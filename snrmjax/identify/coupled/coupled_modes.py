"""Modes that exchange energy, identified from steady states by harmonic balance."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float

from snrmjax.identify.calibrate.calibrated_model import CalibratedModel
from snrmjax.identify.calibrate.calibration import calibrate_model
from snrmjax.measure.states import SteadyStates, check_phases
from snrmjax.model.parameters import stated_stds
from snrmjax.model.potential import monomial_key, polynomial_potential
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting

RATIOS = (1, 2, 3)
"""Harmonics of the mode of interest at which another mode may be excited."""

# Exponents (a, b) of q_j^a q_k^b by frequency ratio: the resonant terms, then the others.
_RESONANT = {1: ((3, 1), (2, 2), (1, 3)), 2: ((2, 1),), 3: ((3, 1),)}
_NONRESONANT = {1: ((0, 4),), 2: ((2, 2), (1, 2), (0, 4)), 3: ((2, 2), (0, 4))}
_OWN = ((4, 0), (3, 0))
_EXTRA_TERM = 0.2  # prior probability of a nonresonant term


class CouplingTerm(NamedTuple):
    """A monomial q_j^a q_k^b of a potential."""

    key: str  # as in a model file
    powers: tuple[int, int]  # a and b
    couples: bool  # whether it is resonant: exchanges energy between the modes at the ratio

    @property
    def kept(self) -> bool:
        """Whether it is always in the model of coupled modes.

        q_j²q_k² detunes both modes at every ratio and so changes the action of a resonant term.
        """
        return self.couples or self.powers == (2, 2)


def coupling_terms(mode: int, other: int, ratio: int) -> tuple[CouplingTerm, ...]:
    """The terms of two modes at a ratio: the resonant ones, others of both, the mode's own."""
    resonant = _RESONANT[ratio]
    return tuple(
        CouplingTerm(
            monomial_key(tuple(sorted((mode,) * a + (other,) * b))), (a, b), (a, b) in resonant
        )
        for a, b in (*resonant, *_NONRESONANT[ratio], *_OWN)
    )


class ChosenTerms(NamedTuple):
    """Posterior over choices of terms."""

    best: Bool[np.ndarray, " term"]
    coupled: float  # probability of at least one resonant term


def chosen_terms(
    terms: Sequence[CouplingTerm],
    values: Float[np.ndarray, " term"],
    information: Float[np.ndarray, "term term"],
    prior_std: Float[np.ndarray, " term"],
) -> ChosenTerms:
    """Posterior probabilities of all choices of terms, from their evidence.

    With χ² quadratic about `values`, of `information` H, and coefficients N(0, σ²), a choice A has
    ln Z = ½ bᵀP⁻¹b − ½ ln det P − Σ ln σ, P = H_AA + diag(1/σ²), b = (H c)_A. The prior
    probability of coupling is ½; each nonresonant term has a smaller one.
    """
    gradient, resonant = information @ values, np.array([term.couples for term in terms])
    choices = np.array(list(itertools.product([False, True], repeat=len(terms))))
    evidence = np.zeros(len(choices))
    for row, choice in enumerate(choices):
        at = np.flatnonzero(choice)
        if not at.size:
            continue
        std = prior_std[at]
        # Scaled by the prior 1σ for conditioning.
        matrix = information[np.ix_(at, at)] * np.outer(std, std) + np.eye(len(at))
        b = gradient[at] * std
        evidence[row] = 0.5 * (b @ np.linalg.solve(matrix, b) - np.linalg.slogdet(matrix)[1])
    couples = choices[:, resonant].any(axis=1)
    further = choices[:, ~resonant].sum(axis=1)
    prior = _EXTRA_TERM**further * (1 - _EXTRA_TERM) ** ((~resonant).sum() - further)
    prior = prior * np.where(couples, 0.5 / (2 ** resonant.sum() - 1), 0.5)
    weight = prior * np.exp(evidence - evidence.max())
    weight /= weight.sum()
    return ChosenTerms(
        best=choices[np.argmax(weight)],
        coupled=float(weight[couples].sum()),
    )


_NEAR = 0.15  # relative detuning up to which a harmonic can excite a mode strongly
_COUPLED = 0.5  # probability above which modes are reported as coupled
_EVEN = 2  # the harmonic that cubic terms of a potential generate
_SEEN = 5.0  # standard errors of another mode's motion and
_STRONG = (
    5e-3  # its fraction of the mode of interest's, above which coupling is assessed by default
)


class Interaction(NamedTuple):
    """How the mode of interest and another one may exchange energy."""

    mode: int  # counted from zero, as `other` is
    other: int
    ratio: int  # harmonic of the motion at which the other mode is excited
    detuning: float  # of the other mode from that harmonic, relative, smallest over the states
    fraction: float  # of the energy in the other mode at that harmonic, largest over the states
    probability: float  # of a term that couples them at this ratio


class CoupledModes(AbstractResult):
    """A model of modes that exchange energy, fitted to steady states; see `coupled_modes`.

    `interactions` lists all that were assessed, the most probable first.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("interaction",)

    calibration: CalibratedModel
    interactions: tuple[Interaction, ...] = eqx.field(static=True)
    probability: Float[np.ndarray, " interaction"] = quantity(
        "interaction", "1", "probability that the modes are coupled"
    )
    fraction: Float[np.ndarray, " interaction"] = quantity(
        "interaction", "1", "largest fraction of the energy in the other mode"
    )
    coupled: bool = setting()
    notes: tuple[Fact, ...] = setting()

    @property
    def model(self) -> Structure:
        """The model with the terms that the data support."""
        return self.calibration.model

    @property
    def interaction(self) -> Interaction | None:
        """The most probable interaction; None where the modes are not coupled."""
        return self.interactions[0] if self.coupled else None

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        lines = [
            f"mode {i.mode + 1} and mode {i.other + 1}, 1:{i.ratio}: probability "
            f"{i.probability:.3g}, up to {100 * i.fraction:.2g} % of the energy in mode "
            f"{i.other + 1}"
            for i in self.interactions
        ]
        verdict = "coupled" if self.coupled else "not coupled"
        return (
            f"CoupledModes: {verdict}",
            *lines,
            *self.calibration.summary(),
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, with modes and ratio of each interaction."""
        names = [f"{i.mode + 1}-{i.other + 1} 1:{i.ratio}" for i in self.interactions]
        where = Variable(("interaction",), np.array(names, dtype=str), "", "modes and ratio")
        return {"interaction": where, **super().variables()}


@on_numbers("Differentiate `sj.identify.identify_points`.")
def coupled_modes(
    data: SteadyStates,
    model: Structure,
    *,
    harmonic_order: int = 7,
) -> CoupledModes:
    """Identify internal resonances of the mode of interest and fit the coupling terms.

    Candidates are modes near the first, second or third harmonic of the measured frequencies (1:1,
    1:2, 1:3). For each, the potential gets the cubic and quartic terms of both modes that matter at
    that ratio, and their coefficients are fitted with the motions of both modes prescribed as
    measured (`calibrate_model` with `prescribed_modes`): no branch has to be chosen. Terms are
    selected by their evidence and fitted once more.

    Arguments: `data` of sensors that observe both modes, best two or more with harmonics and their
    errors; without the second harmonic, 1:2 and cubic terms are left out. `model` with both modes
    and, in its potential, the terms already known (also fitted). Frequencies and damping ratios
    with a stated 1σ are fitted with it as prior.
    Returns `CoupledModes`; without a mode near a harmonic its `interactions` are empty and the
    mode's own stiffness is fitted.
    Raises what `calibrate_model` raises.
    Validity: smooth stiffness; mode shapes and participations are not fitted. Modes near other
    harmonics, or indistinguishable at the sensors, are not identified.
    Not differentiable: differentiate `snrmjax.identify.identify_points`.
    Reference: evidence as in MacKay, Neural Comput. 4 (1992) 415, doi:10.1162/neco.1992.4.3.415;
    the formulation with prescribed modes is this package's own.
    """
    check_phases(data, "an identification of coupled modes")
    assessed = []
    for pair in _candidates(data, model):
        terms = coupling_terms(pair.mode, pair.other, pair.ratio)
        if not _even_recorded(data):
            # At zero a cubic term affects the fundamental to second order only.
            terms = tuple(term for term in terms if sum(term.powers) % 2 == 0)
        fit = _fitted(
            data, model, [term.key for term in terms], (pair.mode, pair.other), harmonic_order
        )
        chosen = _chosen(data, model, terms, fit)
        assessed.append((pair._replace(probability=chosen.coupled), terms, chosen, fit))
    assessed.sort(key=lambda one: -one[0].probability)
    interactions = tuple(one[0] for one in assessed)
    coupled = bool(interactions) and interactions[0].probability > _COUPLED
    j = model.modes.mode_of_interest
    keys: Sequence[str] = [monomial_key((j,) * 4)]
    prescribed: tuple[int, ...] = (j,)
    if assessed:
        pair, terms, chosen, _ = assessed[0]
        kept = np.array([term.kept for term in terms])
        own = np.array([term.powers[1] == 0 for term in terms])
        best = chosen.best | kept if coupled else chosen.best & own
        keys = [term.key for term, used in zip(terms, best, strict=True) if used] or keys
        prescribed = (pair.mode, pair.other)
    final = _fitted(data, model, keys, prescribed, harmonic_order)
    return CoupledModes(
        calibration=final,
        interactions=interactions,
        probability=np.array([one.probability for one in interactions]),
        fraction=np.array([one.fraction for one in interactions]),
        coupled=coupled,
        notes=(),
    )


def _candidates(data: SteadyStates, model: Structure) -> list[Interaction]:
    """Other modes near a harmonic of the measured frequencies, each at its nearest ratio."""
    modes, j = model.modes, model.modes.mode_of_interest
    frequency = np.asarray(data.frequency)
    candidates = []
    for k in modes.residual_modes:
        detuning = {
            ratio: float(np.min(np.abs(modes.natural_frequency.item(k) / (ratio * frequency) - 1)))
            for ratio in RATIOS
        }
        ratio = min(detuning, key=lambda r: detuning[r])
        if detuning[ratio] > _NEAR or (ratio == _EVEN and not _even_recorded(data)):
            continue
        pair = Interaction(j, k, ratio, detuning[ratio], np.nan, np.nan)
        candidates.append(pair._replace(fraction=_fraction(data, model, pair)))
    return candidates


def other_mode_moves(data: SteadyStates, model: Structure) -> bool:
    """Whether a mode near a harmonic moves more than the linear response to the force.

    Significantly over the errors of the states, and by a relevant fraction; False for fewer than
    two sensors.
    """
    if len(data.sensors) < 2:
        return False
    shapes = np.asarray(model.modes.mode_shape)
    order = (1, *data.harmonic_order)
    for pair in _candidates(data, model):
        if pair.ratio not in order:
            continue
        inverse = np.linalg.pinv(shapes[:, [pair.mode, pair.other]])
        motion = modal_motions(data, model, (pair.mode, pair.other))[..., order.index(pair.ratio)]
        moved = motion[:, 1] - (_forced(data, model, pair.other) if pair.ratio == 1 else 0.0)
        std = data.velocity_std if pair.ratio == 1 else data.harmonic_std
        error = np.sqrt(np.asarray(std) ** 2 @ inverse[1] ** 2)
        whole = np.abs(modal_motions(data, model, (pair.mode, pair.other))[:, 0, 0])
        if np.any((np.abs(moved) > _SEEN * error) & (np.abs(moved) > _STRONG * whole)):
            return True
    return False


def _forced(data: SteadyStates, model: Structure, k: int) -> Complex[np.ndarray, " state"]:
    """Velocity of a linear mode under the measured force, kg^1/2 m/s."""
    modes, omega = model.modes, np.asarray(data.frequency)
    natural, ratio = modes.natural_frequency.item(k), modes.damping_ratio.item(k)
    stiffness = natural**2 - omega**2 + 2j * ratio * natural * omega
    return 1j * omega * modes.participation.item(k) * np.asarray(data.force) / stiffness


def _even_recorded(data: SteadyStates) -> bool:
    """Whether the second harmonic was recorded, with its error."""
    return _EVEN in data.harmonic_order and bool(np.any(np.asarray(data.harmonic_std) > 0))


def _fraction(data: SteadyStates, model: Structure, pair: Interaction) -> float:
    """Largest fraction of both modes' energy in the other mode at its harmonic; NaN if unknown."""
    motion = modal_motions(data, model, (pair.mode, pair.other))
    energy = np.nansum(np.abs(motion) ** 2, axis=(1, 2))
    order = (1, *data.harmonic_order)
    if len(data.sensors) < 2 or pair.ratio not in order:
        return float("nan")
    return float(np.nanmax(np.abs(motion[:, 1, order.index(pair.ratio)]) ** 2 / energy))


def modal_motions(
    data: SteadyStates, model: Structure, modes: Sequence[int]
) -> Complex[np.ndarray, "state mode order"]:
    """Modal velocities (kg^1/2 m/s) from the sensors, at all recorded orders.

    Least squares over the sensors of each state; NaN where one was not measured.
    """
    fundamental = np.where(data.measured, data.velocity, np.nan)[..., None]
    observed = np.concatenate([fundamental, np.asarray(data.harmonics)], axis=2)
    inverse = np.linalg.pinv(np.asarray(model.modes.mode_shape)[:, list(modes)])
    return np.einsum("ms,kso->kmo", inverse, observed)


def _with_terms(model: Structure, keys: Sequence[str]) -> Structure:
    """The model with additional terms in its potential, starting at zero."""
    potential, n = model.potential, model.n_modes
    known = {
        monomial_key(m): float(value)
        for m, value in zip(potential.monomials, np.asarray(potential.coefficient), strict=True)
    }
    whole = dict.fromkeys(keys, 0.0) | known
    return dataclasses.replace(model, potential=polynomial_potential(whole, n))


def _fitted(
    data: SteadyStates,
    model: Structure,
    keys: Sequence[str],
    prescribed: tuple[int, ...],
    harmonic_order: int,
) -> CalibratedModel:
    wide = _with_terms(model, keys)
    names = [f"potential.{key}" for key in keys]
    fields = ("natural_frequency", "damping_ratio")
    linear = [f"mode_{k + 1}.{field}" for k in prescribed for field in fields]
    names += [name for name in linear if name in stated_stds(model)]
    return calibrate_model(
        wide,
        data,
        names,
        harmonic_order=harmonic_order,
        priors=True,
        prescribed_modes=prescribed,
    )


def _chosen(
    data: SteadyStates, model: Structure, terms: Sequence[CouplingTerm], fit: CalibratedModel
) -> ChosenTerms:
    """Selection of terms from a fit with all of them."""
    n = len(terms)
    known = np.isfinite(np.diag(fit.covariance))[:n]
    information = np.zeros((n, n))
    observed = np.flatnonzero(known)
    information[np.ix_(observed, observed)] = np.linalg.inv(
        fit.covariance[np.ix_(observed, observed)]
    )
    modes, j = model.modes, model.modes.mode_of_interest
    omega = modes.natural_frequency.item(j)
    motion = modal_motions(data, model, (j,))[:, 0, 0] if len(data.sensors) > 1 else None
    if motion is None:
        motion = np.asarray(data.velocity)[:, 0] / modes.mode_shape.item(0, j)
    amplitude = np.nanmax(np.abs(motion)) / omega
    # Prior 1σ: as much energy as the linear stiffness at the largest amplitude.
    prior = np.array([omega**2 * amplitude ** (2 - sum(term.powers)) for term in terms])
    values = np.where(known, fit.values[:n], 0.0)
    return chosen_terms(terms, values, information, prior)
