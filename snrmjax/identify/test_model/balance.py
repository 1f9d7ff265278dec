"""The balance of every state with all that is unknown, and its straight line about any point.

A record that is corrected for its errors lies on the curves exactly (`nearest_errors`): the
problem is made straight there (orthogonal distance regression), so that large errors of levels and
steep curves cost rounds and not accuracy.
Reference: Boggs, Byrd & Schnabel, SIAM J. Sci. Stat. Comput. 8 (1987) 1052, doi:10.1137/0908085.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from snrmjax.identify.test_model import priors
from snrmjax.identify.test_model.curve_terms import CurveTerms
from snrmjax.identify.test_model.hyper import (
    ALONG,
    MASS,
    OFFSET,
    PHASE,
    TREND,
    WITH_FREQUENCY,
    Places,
)
from snrmjax.identify.test_model.linear_gaussian import LinearRows
from snrmjax.identify.test_model.states import TestStates

_STEPS = 4  # towards every state's most likely errors
_NO_STEP = 1e-8  # relative or rad, by which the last step moves
_FARTHEST = 0.3  # relative or rad, of a state's error
_SOFTEST = 1e-3  # of the squared frequencies, that a stiffness is for its logarithm
_LOST = 1e100  # slopes that no mode has


class Balance(NamedTuple):
    """Z − (κ(K − Ω²) + iΩκδ) of every state, by its errors and by the unknowns."""

    states: TestStates
    terms: tuple[CurveTerms, CurveTerms]  # of stiffness and damping
    places: Places
    weight: Float[np.ndarray, " state"]  # 1, or less for an outlier
    beside: Complex[np.ndarray, "state function"]  # what a discrepancy is made of
    in_order: tuple[bool, ...] = (False,) * 4  # which of `LEVEL_ERRORS` would run with the levels

    def at(self, unknowns: np.ndarray, errors: np.ndarray) -> "BalancedStates":
        """The balance of states whose records are corrected by these errors."""
        states, places = self.states, self.places
        omega, level = states.frequency, states.level
        gain, phase, _, lossier = unknowns[places.levels][level].T
        stiffer = self.stiffer(unknowns, errors)
        velocity = np.exp(errors[:, 1] + 1j * (errors[:, 2] - phase - unknowns[PHASE]))
        velocity = velocity * np.exp(0.0 if states.force_is_free else -gain)
        velocity = self.own_velocity(unknowns) * velocity
        force = states.force * np.exp(errors[:, 0] - (gain if states.force_is_free else 0.0))
        force = force + unknowns[OFFSET] * np.min(states.force)
        z = 1j * omega * states.constant * force / velocity
        mass, own = 1 + unknowns[MASS], unknowns[places.stiffness]
        (stiff, lossy), (x, v) = self.terms, self.amplitudes(velocity)
        curve, slope = stiff.curve(x, own)
        lost, rate = lossy.curve(v, unknowns[places.damping])
        stiffness, damping = curve + mass * places.reference, 1j * omega * lost
        added = curve - stiff.at_rest(own)[0]
        away = self.away
        with_frequency = np.stack([added, damping], axis=1) * away[:, None]
        softer, faster = away * unknowns[WITH_FREQUENCY, None]
        slope = (1 + stiffer + softer) * slope + 1j * omega * (1 + lossier + faster) * rate
        model = (1 + stiffer) * stiffness - mass * omega**2 + (1 + lossier) * damping
        model = model + self.beside @ unknowns[places.beside]
        model = model + with_frequency @ unknowns[WITH_FREQUENCY]
        inputs = errors.shape[1]
        return BalancedStates(
            force, z, model, slope, velocity, stiffness, damping, with_frequency, inputs
        )

    @property
    def flat(self) -> Bool[np.ndarray, " unknown"]:
        """Which unknowns have no prior."""
        flat = np.zeros(self.places.others.stop, dtype=bool)
        flat[self.places.stiffness], flat[self.places.damping] = (one.flat for one in self.terms)
        return flat

    def amplitudes(self, velocity: Complex[np.ndarray, " state"]) -> tuple[np.ndarray, np.ndarray]:
        """Of each curve its own, for the states' velocities."""
        frequency = self.states.frequency
        displacement = np.abs(velocity) / frequency
        stiff, lossy = (terms.amplitude(displacement, frequency) for terms in self.terms)
        return stiff, lossy

    @property
    def away(self) -> Float[np.ndarray, " state"]:
        """ln of the forcing frequency over the natural one that the record itself has."""
        states, omega = self.states, self.states.frequency
        return off_resonance(1j * omega * states.constant * states.force / states.velocity, omega)

    def stiffer(self, unknowns: np.ndarray, errors: np.ndarray) -> Float[np.ndarray, " state"]:
        """Relative deviations of the stiffness: of levels, along a trend, and of states whose own
        wanders.
        """
        of_level = unknowns[self.places.levels][self.states.level][:, 2]
        shared = of_level + unknowns[TREND] * self.states.trend
        return shared + errors[:, 3] if errors.shape[1] > 3 else shared

    def own_velocity(self, unknowns: np.ndarray) -> Complex[np.ndarray, " state"]:
        """The mode's own velocity as it was recorded, by what the other modes' parameters are."""
        if self.states.beside is None:
            return self.states.velocity
        return self.states.velocity - self.states.beside @ unknowns[self.places.others]

    def with_discrepancy(self, unknowns: np.ndarray, errors: np.ndarray) -> "Balance":
        """With functions of what one mode leaves off resonance: of phase and log amplitude.

        They are in units of the damping's force by these unknowns. In phase with the motion they
        leave out what another modal mass would do: that is not theirs.
        """
        if self.places.discrepancy[0].start == self.places.discrepancy[0].stop:
            return self
        states, now = self.states, self.at(unknowns, errors)
        damping, weight = np.abs(now.damping), 1 / np.abs(now.z) ** 2
        mass = now.stiffness - (1 + unknowns[MASS]) * states.frequency**2
        theta, n = np.angle(states.velocity)[:, None], ALONG // 2
        order = (np.arange(n) + 1) // 2
        turn = np.where((np.arange(n) % 2 == 0) & (order > 0), 0.5 * np.pi, 0.0)
        waves = np.cos(order * theta - turn)
        waves = waves * np.exp(-0.25 * (order * priors.DISCREPANCY_LENGTH) ** 2)
        along = np.log(states.amplitude / np.max(states.amplitude))[:, None]
        beside = damping[:, None] * np.sin(theta) * np.hstack([waves, waves * along])
        fraction = (weight * mass) @ beside / max((weight * mass) @ mass, 1e-300)
        return self._replace(beside=np.hstack([beside - np.outer(mass, fraction), 1j * beside]))

    def nearest_errors(self, unknowns: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """The most likely errors with which every state lies on the curves, from some on.

        NaN where curves are so steep that no number holds their squares.
        """
        for _ in range(_STEPS):
            last, now = errors, self.at(unknowns, errors)
            slopes = now.by_error
            if not np.all(np.abs(slopes) < _LOST):
                return np.full_like(errors, np.nan)
            root, _ = whitening(slopes, self.states.errors, np.ones(len(errors)))
            gap = now.z - now.model - np.sum(slopes * errors, axis=1)
            white = np.einsum("nij,nj->ni", root, np.stack([gap.real, gap.imag], axis=1))
            pull = np.einsum("nji,nj->ni", root, white)
            parts = np.stack([slopes.real, slopes.imag], axis=1)
            errors = -np.einsum("nie,ni->ne", parts, pull) * self.states.errors**2
            errors = np.clip(errors, -_FARTHEST, _FARTHEST)
            if np.max(np.abs(errors - last)) < _NO_STEP:
                break
        return errors

    def misfit(self, unknowns: np.ndarray, errors: np.ndarray) -> float:
        """Sum of the squares of the states' errors, and of what they leave, in their own 1σ."""
        now = self.at(unknowns, errors)
        root, _ = whitening(now.by_error, self.states.errors, self.weight)
        gap = now.z - now.model - np.sum(now.by_error * errors, axis=1)
        white = np.einsum("nij,nj->ni", root, np.stack([gap.real, gap.imag], axis=1))
        return float(np.sum(white**2))

    def straight(
        self, unknowns: np.ndarray, errors: np.ndarray, *, first: bool = False, apart: bool = True
    ) -> "Straight":
        """The problem made straight about some unknowns and errors.

        With `apart` errors of levels that nobody stated are what levels differ by: an error that
        all have in common is one of the instruments, or of the modal mass. One that runs with
        their order (`in_order`) is a curve.
        At `first` curves are not known yet: what they would pass on of an error is left out, and
        errors of levels move what was recorded.
        """
        states, places = self.states, self.places
        now, omega = self.at(unknowns, errors), states.frequency
        z = now.z if first else now.model
        slope = 0.0 * now.slope if first else now.slope
        slopes = now._replace(slope=slope).by_error
        stiffer = self.stiffer(unknowns, errors)
        lossier = unknowns[places.levels][states.level][:, 3]
        design = np.zeros((len(omega), len(unknowns)), dtype=complex)
        design[:, MASS] = (1 + stiffer) * places.reference - omega**2
        design[:, PHASE] = -1j * z
        design[:, OFFSET] = -z * np.min(states.force) / now.force
        design[:, TREND] = states.trend * now.stiffness
        design[:, WITH_FREQUENCY] = now.with_frequency
        (softer, faster), (stiff, lossy) = unknowns[WITH_FREQUENCY], self.terms
        away, (x, v) = self.away, self.amplitudes(now.velocity)
        own = unknowns[places.stiffness]
        values, at_rest = stiff.columns(x, own), stiff.at_rest(own)[1]
        added = softer * away[:, None] * (values - at_rest)
        design[:, places.stiffness] = (1 + stiffer)[:, None] * values + added
        lossier = 1j * omega * (1 + lossier + faster * away)
        design[:, places.damping] = lossier[:, None] * lossy.columns(v, unknowns[places.damping])
        if states.beside is not None:
            moved = -states.beside / self.own_velocity(unknowns)[:, None]
            design[:, places.others] = z[:, None] * moved + slope[:, None] * moved.real
        of_gain = z if states.force_is_free else -z - slope
        columns = (of_gain, -1j * z, now.stiffness, now.damping)
        common = states.common_to_levels
        for k, column in enumerate(columns):
            level = places.levels[:, k]
            design[np.arange(len(omega)), level[states.level]] = column
            if not states.level_std[k] > 0:
                taken = common[:, 0 if apart else 1 : 1 + self.in_order[k]]
                design[:, level] -= design[:, level] @ taken @ taken.T
        design[:, places.beside] = self.beside
        # Residual at the record: rows − design @ unknowns, by its straight line.
        rows = now.z - now.model - np.sum(slopes * errors, axis=1) + design @ unknowns
        if first:  # the curves of the start count for nothing
            rows = now.z - (places.reference - omega**2)
        root, log_det = whitening(slopes, states.errors, self.weight)
        white = np.einsum("nij,njk->nik", root, np.stack([design.real, design.imag], axis=1))
        goal = np.einsum("nij,nj->ni", root, np.stack([rows.real, rows.imag], axis=1))
        # Of the rows to what was recorded: |∂Z/∂X| a state.
        jacobian = float(np.sum(np.log(np.abs(now.z) * np.abs(now.z + slope))))
        matrix, vector = white.reshape(-1, len(unknowns)), goal.reshape(-1)
        return Straight(
            LinearRows.of(matrix, vector, jacobian - 0.5 * log_det, self.flat),
            matrix,
            vector,
        )


def off_resonance(
    z: Complex[np.ndarray, " state"], frequency: Float[np.ndarray, " state"]
) -> Float[np.ndarray, " state"]:
    """ln of the forcing frequency over the natural one, by records' Z = FA/X."""
    return -0.5 * np.log(np.maximum(1 + z.real / frequency**2, _SOFTEST))


class BalancedStates(NamedTuple):
    """Both sides of the balance, and what its slopes are made of."""

    force: Float[np.ndarray, " state"]  # corrected, N
    z: Complex[np.ndarray, " state"]  # FA/X
    model: Complex[np.ndarray, " state"]
    slope: Complex[np.ndarray, " state"]  # of the model by the logarithm of amplitude
    velocity: Complex[np.ndarray, " state"]  # of the mode, corrected
    stiffness: Float[np.ndarray, " state"]  # κK
    damping: Complex[np.ndarray, " state"]  # iΩκδ
    with_frequency: Complex[np.ndarray, "state curve"]  # what exponents of frequency add
    inputs: int  # errors that a state may have

    @property
    def by_error(self) -> Complex[np.ndarray, "state input"]:
        """Derivatives of what is left by relative errors of force and velocity, of phase, and of
        a stiffness that wanders.
        """
        columns = [self.z, -self.z - self.slope, -1j * self.z, -self.stiffness + 0j]
        return np.stack(columns[: self.inputs], axis=1)


class Straight(NamedTuple):
    """The problem made straight, in rows of unit variance where errors are as stated."""

    equations: LinearRows
    design: Float[np.ndarray, "row unknown"]
    rows: Float[np.ndarray, " row"]


def whitening(
    slopes: Complex[np.ndarray, "state input"],
    std: Float[np.ndarray, "state input"],
    weight: Float[np.ndarray, " state"],
) -> tuple[Float[np.ndarray, "state 2 2"], float]:
    """Inverse Cholesky factors of every state's covariance, and the sum of log determinants."""
    scaled = slopes * std / np.sqrt(weight)[:, None]
    a = np.sum(scaled.real**2, axis=1)
    b = np.sum(scaled.real * scaled.imag, axis=1)
    c = np.sum(scaled.imag**2, axis=1)
    floor = 1e-12 * (a + c)  # rounding must not make it singular
    a = a + floor
    det = np.maximum(a * c - b**2, floor * a)
    root = np.zeros((len(a), 2, 2))
    root[:, 0, 0] = 1 / np.sqrt(a)
    low = np.sqrt(det / a)
    root[:, 1, 0] = -b / (a * low)
    root[:, 1, 1] = 1 / low
    return root, float(np.sum(np.log(det)))
