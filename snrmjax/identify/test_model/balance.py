"""The force balance of every state as a function of all unknowns, and its linearisation.

The balance is linearised at the states corrected for their most likely errors (`nearest_errors`),
which satisfy the model exactly (orthogonal distance regression): large level errors and steep
curves then cost iterations, not accuracy.
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
    Layout,
)
from snrmjax.identify.test_model.linear_gaussian import LinearRows
from snrmjax.identify.test_model.states import TestStates

_STEPS = 4  # Gauss–Newton steps towards the most likely errors of every state
_NO_STEP = 1e-8  # relative or rad: steps below this have converged
_FARTHEST = 0.3  # relative or rad: bound of a state's error
_SOFTEST = 1e-3  # lower bound of ω̃²/Ω² in its logarithm
_LOST = 1e100  # slopes beyond this overflow when squared


class Balance(NamedTuple):
    """Residual Z − (κ(K − Ω²) + iΩκδ) of every state, a function of its errors and the unknowns."""

    states: TestStates
    terms: tuple[CurveTerms, CurveTerms]  # of stiffness and damping
    layout: Layout
    weight: Float[np.ndarray, " state"]  # 1, or less for an outlier
    discrepancy: Complex[np.ndarray, "state function"]  # basis of the model discrepancy
    in_order: tuple[bool, ...] = (False,) * 4  # which of `LEVEL_ERRORS` correlate with force

    def at(self, unknowns: np.ndarray, errors: np.ndarray) -> "BalancedStates":
        """The balance with the records corrected by these errors."""
        states, layout = self.states, self.layout
        omega, level = states.frequency, states.level
        gain, phase, _, damping_deviation = unknowns[layout.levels][level].T
        stiffness_deviation = self.stiffness_deviation(unknowns, errors)
        velocity = np.exp(errors[:, 1] + 1j * (errors[:, 2] - phase - unknowns[PHASE]))
        velocity = velocity * np.exp(0.0 if states.force_is_free else -gain)
        velocity = self.own_velocity(unknowns) * velocity
        force = states.force * np.exp(errors[:, 0] - (gain if states.force_is_free else 0.0))
        force = force + unknowns[OFFSET] * np.min(states.force)
        z = 1j * omega * states.constant * force / velocity
        mass, own = 1 + unknowns[MASS], unknowns[layout.stiffness]
        (stiffness_terms, damping_terms), (x, v) = self.terms, self.amplitudes(velocity)
        curve, slope = stiffness_terms.curve(x, own)
        damping_value, rate = damping_terms.curve(v, unknowns[layout.damping])
        stiffness, damping = curve + mass * layout.reference, 1j * omega * damping_value
        added = curve - stiffness_terms.at_rest(own)[0]
        detuning = self.detuning
        with_frequency = np.stack([added, damping], axis=1) * detuning[:, None]
        stiffness_exponent, damping_exponent = detuning * unknowns[WITH_FREQUENCY, None]
        slope = (1 + stiffness_deviation + stiffness_exponent) * slope + 1j * omega * (
            1 + damping_deviation + damping_exponent
        ) * rate
        model = (
            (1 + stiffness_deviation) * stiffness
            - mass * omega**2
            + (1 + damping_deviation) * damping
        )
        model = model + self.discrepancy @ unknowns[layout.both_discrepancies]
        model = model + with_frequency @ unknowns[WITH_FREQUENCY]
        inputs = errors.shape[1]
        return BalancedStates(
            force, z, model, slope, velocity, stiffness, damping, with_frequency, inputs
        )

    @property
    def flat(self) -> Bool[np.ndarray, " unknown"]:
        """Which unknowns have no prior."""
        flat = np.zeros(self.layout.others.stop, dtype=bool)
        flat[self.layout.stiffness], flat[self.layout.damping] = (one.flat for one in self.terms)
        return flat

    def amplitudes(self, velocity: Complex[np.ndarray, " state"]) -> tuple[np.ndarray, np.ndarray]:
        """The amplitude that each curve is a function of, from the states' velocities."""
        frequency = self.states.frequency
        displacement = np.abs(velocity) / frequency
        x, v = (terms.amplitude(displacement, frequency) for terms in self.terms)
        return x, v

    @property
    def detuning(self) -> Float[np.ndarray, " state"]:
        """ln(Ω/ω̃), with ω̃ from each state's own record."""
        states, omega = self.states, self.states.frequency
        return off_resonance(1j * omega * states.constant * states.force / states.velocity, omega)

    def stiffness_deviation(
        self, unknowns: np.ndarray, errors: np.ndarray
    ) -> Float[np.ndarray, " state"]:
        """Relative stiffness deviation of every state: its level's, the trend's, and its own
        scatter.
        """
        of_level = unknowns[self.layout.levels][self.states.level][:, 2]
        shared = of_level + unknowns[TREND] * self.states.trend
        return shared + errors[:, 3] if errors.shape[1] > 3 else shared

    def own_velocity(self, unknowns: np.ndarray) -> Complex[np.ndarray, " state"]:
        """Recorded velocity of the mode of interest, less the contribution of the other modes."""
        if self.states.other_modes is None:
            return self.states.velocity
        return self.states.velocity - self.states.other_modes @ unknowns[self.layout.others]

    def with_discrepancy(self, unknowns: np.ndarray, errors: np.ndarray) -> "Balance":
        """With basis functions of the model discrepancy off resonance, in phase and log amplitude.

        Their unit is the damping force at these unknowns. The in-phase part is made orthogonal to
        a change of modal mass, which has an unknown of its own.
        """
        if self.layout.discrepancy[0].start == self.layout.discrepancy[0].stop:
            return self
        states, now = self.states, self.at(unknowns, errors)
        damping, weight = np.abs(now.damping), 1 / np.abs(now.z) ** 2
        mass = now.stiffness - (1 + unknowns[MASS]) * states.frequency**2
        theta, n = np.angle(states.velocity)[:, None], ALONG // 2
        order = (np.arange(n) + 1) // 2
        quarter_turn = np.where((np.arange(n) % 2 == 0) & (order > 0), 0.5 * np.pi, 0.0)
        waves = np.cos(order * theta - quarter_turn)
        waves = waves * np.exp(-0.25 * (order * priors.DISCREPANCY_LENGTH) ** 2)
        along = np.log(states.amplitude / np.max(states.amplitude))[:, None]
        basis = damping[:, None] * np.sin(theta) * np.hstack([waves, waves * along])
        fraction = (weight * mass) @ basis / max((weight * mass) @ mass, 1e-300)
        return self._replace(discrepancy=np.hstack([basis - np.outer(mass, fraction), 1j * basis]))

    def nearest_errors(self, unknowns: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """The most likely errors with which every state satisfies the balance, by iteration.

        NaN where the curves are so steep that their squared slopes overflow.
        """
        for _ in range(_STEPS):
            last, now = errors, self.at(unknowns, errors)
            slopes = now.by_error
            if not np.all(np.abs(slopes) < _LOST):
                return np.full_like(errors, np.nan)
            root, _ = whitening(slopes, self.states.errors, np.ones(len(errors)))
            residual = now.z - now.model - np.sum(slopes * errors, axis=1)
            white = np.einsum("nij,nj->ni", root, np.stack([residual.real, residual.imag], axis=1))
            gradient = np.einsum("nji,nj->ni", root, white)
            parts = np.stack([slopes.real, slopes.imag], axis=1)
            errors = -np.einsum("nie,ni->ne", parts, gradient) * self.states.errors**2
            errors = np.clip(errors, -_FARTHEST, _FARTHEST)
            if np.max(np.abs(errors - last)) < _NO_STEP:
                break
        return errors

    def misfit(self, unknowns: np.ndarray, errors: np.ndarray) -> float:
        """Sum of the states' squared errors and residuals, in units of their 1σ."""
        now = self.at(unknowns, errors)
        root, _ = whitening(now.by_error, self.states.errors, self.weight)
        residual = now.z - now.model - np.sum(now.by_error * errors, axis=1)
        white = np.einsum("nij,nj->ni", root, np.stack([residual.real, residual.imag], axis=1))
        return float(np.sum(white**2))

    def linearised(
        self, unknowns: np.ndarray, errors: np.ndarray, *, first: bool = False, apart: bool = True
    ) -> "Linearisation":
        """The problem linearised about these unknowns and errors.

        With `apart` unstated level errors are differences between levels only: their mean is
        projected out, as it belongs to the instruments or the modal mass, and so is a line over
        the levels' log force (`in_order`), which belongs to the curves.
        In the `first` iteration the curves are unknown: their slopes do not propagate errors, and
        level errors act on the recorded Z.
        """
        states, layout = self.states, self.layout
        now, omega = self.at(unknowns, errors), states.frequency
        z = now.z if first else now.model
        slope = 0.0 * now.slope if first else now.slope
        slopes = now._replace(slope=slope).by_error
        stiffness_deviation = self.stiffness_deviation(unknowns, errors)
        damping_deviation = unknowns[layout.levels][states.level][:, 3]
        design = np.zeros((len(omega), len(unknowns)), dtype=complex)
        design[:, MASS] = (1 + stiffness_deviation) * layout.reference - omega**2
        design[:, PHASE] = -1j * z
        design[:, OFFSET] = -z * np.min(states.force) / now.force
        design[:, TREND] = states.trend * now.stiffness
        design[:, WITH_FREQUENCY] = now.with_frequency
        (stiffness_exponent, damping_exponent), (stiffness_terms, damping_terms) = (
            unknowns[WITH_FREQUENCY],
            self.terms,
        )
        detuning, (x, v) = self.detuning, self.amplitudes(now.velocity)
        own = unknowns[layout.stiffness]
        values, at_rest = stiffness_terms.columns(x, own), stiffness_terms.at_rest(own)[1]
        added = stiffness_exponent * detuning[:, None] * (values - at_rest)
        design[:, layout.stiffness] = (1 + stiffness_deviation)[:, None] * values + added
        damping_deviation = 1j * omega * (1 + damping_deviation + damping_exponent * detuning)
        design[:, layout.damping] = damping_deviation[:, None] * damping_terms.columns(
            v, unknowns[layout.damping]
        )
        if states.other_modes is not None:
            moved = -states.other_modes / self.own_velocity(unknowns)[:, None]
            design[:, layout.others] = z[:, None] * moved + slope[:, None] * moved.real
        of_gain = z if states.force_is_free else -z - slope
        columns = (of_gain, -1j * z, now.stiffness, now.damping)
        common = states.common_to_levels
        for k, column in enumerate(columns):
            level = layout.levels[:, k]
            design[np.arange(len(omega)), level[states.level]] = column
            if not states.level_std[k] > 0:
                taken = common[:, 0 if apart else 1 : 1 + self.in_order[k]]
                design[:, level] -= design[:, level] @ taken @ taken.T
        design[:, layout.both_discrepancies] = self.discrepancy
        # Linearised residual at the record: rows − design @ unknowns.
        rows = now.z - now.model - np.sum(slopes * errors, axis=1) + design @ unknowns
        if first:  # the initial curves are arbitrary
            rows = now.z - (layout.reference - omega**2)
        root, log_det = whitening(slopes, states.errors, self.weight)
        white = np.einsum("nij,njk->nik", root, np.stack([design.real, design.imag], axis=1))
        goal = np.einsum("nij,nj->ni", root, np.stack([rows.real, rows.imag], axis=1))
        # The rows are Z, the record is X: their density needs |∂Z/∂X| of every state.
        jacobian = float(np.sum(np.log(np.abs(now.z) * np.abs(now.z + slope))))
        matrix, vector = white.reshape(-1, len(unknowns)), goal.reshape(-1)
        return Linearisation(
            LinearRows.of(matrix, vector, jacobian - 0.5 * log_det, self.flat),
            matrix,
            vector,
        )


def off_resonance(
    z: Complex[np.ndarray, " state"], frequency: Float[np.ndarray, " state"]
) -> Float[np.ndarray, " state"]:
    """ln(Ω/ω̃) from recorded Z = FA/X."""
    return -0.5 * np.log(np.maximum(1 + z.real / frequency**2, _SOFTEST))


class BalancedStates(NamedTuple):
    """Both sides of the balance, and the quantities that its derivatives need."""

    force: Float[np.ndarray, " state"]  # corrected, N
    z: Complex[np.ndarray, " state"]  # FA/X
    model: Complex[np.ndarray, " state"]
    slope: Complex[np.ndarray, " state"]  # d model / d ln(amplitude)
    velocity: Complex[np.ndarray, " state"]  # of the mode, corrected
    stiffness: Float[np.ndarray, " state"]  # κK
    damping: Complex[np.ndarray, " state"]  # iΩκδ
    with_frequency: Complex[np.ndarray, "state curve"]  # derivative by the frequency exponents
    inputs: int  # number of errors per state

    @property
    def by_error(self) -> Complex[np.ndarray, "state input"]:
        """Derivatives of the residual by relative errors of force and velocity, by the phase error,
        and by a relative stiffness that scatters.
        """
        columns = [self.z, -self.z - self.slope, -1j * self.z, -self.stiffness + 0j]
        return np.stack(columns[: self.inputs], axis=1)


class Linearisation(NamedTuple):
    """The linearised problem, whitened: rows have unit variance where errors are as stated."""

    equations: LinearRows
    design: Float[np.ndarray, "row unknown"]
    rows: Float[np.ndarray, " row"]


def whitening(
    slopes: Complex[np.ndarray, "state input"],
    std: Float[np.ndarray, "state input"],
    weight: Float[np.ndarray, " state"],
) -> tuple[Float[np.ndarray, "state 2 2"], float]:
    """Inverse Cholesky factors of every state's 2×2 covariance, and the sum of log determinants."""
    scaled = slopes * std / np.sqrt(weight)[:, None]
    real, imag = scaled.real, scaled.imag
    a, b, c = ((x * y).sum(axis=1) for x, y in ((real, real), (real, imag), (imag, imag)))
    floor = 1e-12 * (a + c)  # keeps it regular in floating point
    a = a + floor
    det = np.maximum(a * c - b**2, floor * a)
    root = np.zeros((len(a), 2, 2))
    root[:, 0, 0] = 1 / np.sqrt(a)
    low = np.sqrt(det / a)
    root[:, 1, 0] = -b / (a * low)
    root[:, 1, 1] = 1 / low
    return root, float(np.sum(np.log(det)))
