"""Noise of the compared numbers, own and shared, and comparison of magnitudes without phases.

Rows with a few shared errors are decorrelated at a cost proportional to their number. The force
that a motion requires does not depend on the origin of time: where the phase of a velocity is
unknown, only the magnitude of the model's force is compared, one equation in place of two, and the
phase follows from the model. No phase is assumed, and nothing is iterated.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int
from scipy.special import chdtrc, ive

from snrmjax.identify.calibrate.calibration_states import CalibrationStates, ComparedColumns
from snrmjax.numerics.facts import Fact


class SharedCovariance(NamedTuple):
    """The covariance C = I + S Sᵀ of rows with own errors of unit variance and shared errors.

    S has one column for every shared error: the change of each row by its 1σ. With the singular
    value decomposition S = U D Vᵀ the inverse and its symmetric root are I and a low-rank
    correction, C⁻¹ = I − U D²(1 + D²)⁻¹ Uᵀ and C^(−½) = I − U (1 − (1 + D²)^(−½)) Uᵀ: no dense
    matrix of rows by rows is formed.
    """

    shared: Float[np.ndarray, "row shared"]  # S
    directions: Float[np.ndarray, "row shared"]  # U, zero where there are fewer rows than errors
    singular_values: Float[np.ndarray, " shared"]  # D
    errors: Float[np.ndarray, "shared shared"]  # Vᵀ, square

    def decorrelated(
        self, rows: Float[np.ndarray, "*entry row"]
    ) -> Float[np.ndarray, "*entry row"]:
        """C^(−½) times rows: independent and of unit variance."""
        return self._less(rows, 1 - 1 / np.hypot(1.0, self.singular_values))

    def solved(self, rows: Float[np.ndarray, "*entry row"]) -> Float[np.ndarray, "*entry row"]:
        """C⁻¹ times rows: rows less the most likely part of the shared errors."""
        return self._less(rows, self.singular_values**2 / (1 + self.singular_values**2))

    def most_likely_errors(self, rows: Float[np.ndarray, " row"]) -> Float[np.ndarray, " shared"]:
        """SᵀC⁻¹ times rows: most likely shared errors, in units of their 1σ."""
        return (
            self.singular_values / (1 + self.singular_values**2) * (rows @ self.directions)
        ) @ self.errors

    def of_rows(self, keep: Bool[np.ndarray, " row"]) -> "SharedCovariance":
        """The covariance of some of the rows."""
        return shared_covariance(self.shared[keep])

    def given_rows(self, known: Bool[np.ndarray, " row"]) -> "ConditionalCovariance":
        """The covariance of the unknown rows, conditional on the known ones."""
        others = self.of_rows(known)
        # Square root of the posterior covariance of the errors.
        root = others.errors.T / np.hypot(1.0, others.singular_values)
        own = self.shared[~known]
        return ConditionalCovariance(known, own, others, shared_covariance(own @ root))

    def _less(
        self, rows: Float[np.ndarray, "*entry row"], part: Float[np.ndarray, " shared"]
    ) -> Float[np.ndarray, "*entry row"]:
        return rows - (rows @ self.directions * part) @ self.directions.T


class ConditionalCovariance(NamedTuple):
    """The covariance of some rows conditional on all others, by their shared errors."""

    known: Bool[np.ndarray, " row"]
    shared: Float[np.ndarray, "other shared"]  # of the unknown rows
    others: SharedCovariance  # of the known rows
    left: SharedCovariance  # of the unknown rows, with the remaining shared errors

    def decorrelated(
        self, rows: Float[np.ndarray, "*entry row"]
    ) -> Float[np.ndarray, "*entry other"]:
        """Rows less their expectation given the known ones, independent and of unit variance."""
        expected = self.others.most_likely_errors(rows[..., self.known]) @ self.shared.T
        return self.left.decorrelated(rows[..., ~self.known] - expected)


def shared_covariance(shared: Float[np.ndarray, "row shared"]) -> SharedCovariance:
    """The covariance I + S Sᵀ for the shared errors S.

    >>> one = shared_covariance(np.ones((3, 1)))
    >>> one.solved(np.ones(3))  # three rows with one common error, all of unit variance
    array([0.25, 0.25, 0.25])
    """
    n, errors = shared.shape
    # With fewer rows than errors, pad with zeros for a square V.
    filled = np.concatenate([shared, np.zeros((max(errors - n, 0), errors))])
    directions, singular_values, own = np.linalg.svd(filled, full_matrices=False)
    return SharedCovariance(shared, directions[:n], singular_values, own)


class NoiseModel(NamedTuple):
    """Covariance of the misfits of all states, in units of each state's own noise.

    A row is one measured number: a column of a state. Each has the noise of its state; rows share
    the errors of their level and of the baseline model's parameters.
    """

    whiten: Float[np.ndarray, "state column column"]
    known: Bool[np.ndarray, "state column"]
    covariance: SharedCovariance
    shared_kind: Int[np.ndarray, " shared"]  # kind of level error; −1: of no level
    state: Int[np.ndarray, " row"]
    column: Int[np.ndarray, " row"]

    @property
    def shared(self) -> Float[np.ndarray, "row shared"]:
        """Derivatives of the rows by the shared errors, times their 1σ."""
        return self.covariance.shared

    def noise_units(
        self, columns: Float[np.ndarray, "trial state column"]
    ) -> Float[np.ndarray, "trial row"]:
        """Measured columns in units of their own noise; NaN stays NaN."""
        return np.einsum("sij,...sj->...si", self.whiten, columns)[..., self.known]

    def decorrelated(
        self, rows: Float[np.ndarray, "*entry row"], kept: Bool[np.ndarray, " row"] | None = None
    ) -> Float[np.ndarray, "*entry row"]:
        """Rows, or the rows `kept`, made independent and of unit variance.

        An entry with any non-finite row is NaN.
        """
        if kept is not None:
            return self.covariance.of_rows(kept).decorrelated(rows[..., kept])
        good = np.all(np.isfinite(rows), axis=-1, keepdims=True)
        return np.where(good, self.covariance.decorrelated(np.where(good, rows, 0.0)), np.nan)

    def without_shared(self, rows: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        """Rows less the most likely values of the shared errors."""
        return self.covariance.solved(rows)

    def shared_errors(
        self, rows: Float[np.ndarray, " row"], kept: Bool[np.ndarray, " row"] | None = None
    ) -> Float[np.ndarray, " shared"]:
        """Most likely values of the shared errors in units of their 1σ, from all rows or some."""
        if kept is not None:
            return -self.covariance.of_rows(kept).most_likely_errors(rows[kept])
        return -self.covariance.most_likely_errors(rows)

    def shared_std(self, slopes: Float[np.ndarray, "row parameter"], index: int) -> float:
        """Posterior 1σ of a shared error with free parameters, in units of its prior 1σ."""
        columns = np.concatenate([slopes, self.shared], axis=1)
        known = np.append(np.zeros(slopes.shape[1]), np.ones(self.shared.shape[1]))
        norm = np.linalg.norm(np.vstack([columns, np.diag(known)]), axis=0)
        norm = np.where(norm > 0, norm, 1.0)
        scaled = columns / norm
        covariance = np.linalg.pinv(scaled.T @ scaled + np.diag(known / norm**2), hermitian=True)
        at = slopes.shape[1] + index
        return float(np.sqrt(max(covariance[at, at], 0.0))) / norm[at]


def unit_columns(
    columns: Float[np.ndarray, "row column"],
) -> tuple[Float[np.ndarray, "row column"], Float[np.ndarray, " column"]]:
    """Columns of unit norm, and their norms: one for a zero column."""
    norm = np.linalg.norm(columns, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    return columns / norm, norm


def chi_square_p_value(chi_square: float, freedom: int) -> float:
    """p-value of χ² for a number of degrees of freedom."""
    # Differences of sums of squares may be negative by rounding.
    return float(chdtrc(max(freedom, 1), np.maximum(chi_square, 0.0)))


class Magnitudes(NamedTuple):
    """The measured phasors, and which of them are compared by magnitude alone.

    A part is the force over the measured one, or another sensor's fundamental or a harmonic over
    the reference velocity: two columns each.
    """

    measured: Complex[np.ndarray, "state part"]
    by_error: Complex[np.ndarray, "part input"]  # of its logarithm
    noise: Float[np.ndarray, "state part"]  # rms of the complex error of a harmonic
    alone: Bool[np.ndarray, "state part"]

    def compared(
        self,
        columns: Float[np.ndarray, "trial state column"],
        slopes: Float[np.ndarray, "trial state column direction"],
        *,
        of_errors: bool = False,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns and slopes, with differences of magnitudes for parts without phase.

        `of_errors`: whether directions are errors of the states, which change the measured phasors.
        """
        if not self.alone.any():
            return columns, slopes
        phasor, change = self.phasors(columns), _complex(slopes, 2)
        own_change = np.zeros((*self.measured.shape, slopes.shape[3]), dtype=complex)
        if of_errors:
            own_change = self.measured[:, :, None] * self.by_error
        change = change + own_change
        magnitude, by_square = self._expected(np.abs(phasor))
        own = np.abs(self.measured)
        moved = by_square[..., None] * np.real(phasor.conj()[..., None] * change)
        there = np.where(own > 0, own, 1.0)[..., None]
        moved = moved - np.real(self.measured.conj()[..., None] * own_change) / there
        columns, slopes = columns.copy(), slopes.copy()
        columns[..., ::2] = np.where(self.alone, magnitude - own, columns[..., ::2])
        columns[..., 1::2] = np.where(self.alone, 0.0, columns[..., 1::2])
        alone = self.alone[..., None]
        slopes[..., ::2, :] = np.where(alone, moved, slopes[..., ::2, :])
        slopes[..., 1::2, :] = np.where(alone, 0.0, slopes[..., 1::2, :])
        return columns, slopes

    def phasors(
        self, columns: Float[np.ndarray, "trial state column"]
    ) -> Complex[np.ndarray, "trial state part"]:
        """The model's phasors, from their differences to the measured ones."""
        return _complex(columns, 2) + self.measured

    def own_std(
        self, stated: Float[np.ndarray, "state column"], phasors: Complex[np.ndarray, "state part"]
    ) -> Float[np.ndarray, "state column"]:
        """1σ of each column's own noise, for a model with these phasors.

        The magnitude of a harmonic below the noise scatters less than one of its parts.
        """
        magnitude = np.abs(phasors)
        variance = self.noise**2 + magnitude**2 - self._expected(magnitude)[0] ** 2
        least = (1 - np.pi / 4) * self.noise**2  # Rayleigh distribution: pure noise
        std = np.sqrt(np.clip(variance, least, self.noise**2 / 2))
        alone = self.alone & (self.noise > 0) & np.isfinite(magnitude)
        own_std = np.array(stated)
        own_std[:, ::2] = np.where(alone, std, own_std[:, ::2])
        return own_std

    def _expected(self, magnitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Expected measured magnitude for a true one, and twice its derivative by the square of it.

        Mean of Rice's distribution: noise makes small harmonics larger.
        """
        noise = np.broadcast_to(self.noise, magnitude.shape)
        there = np.where(noise > 0, noise, 1.0)
        half = 0.5 * (magnitude / there) ** 2
        zeroth, first = ive(0, half), ive(1, half)
        mean = there * np.sqrt(np.pi) / 2 * ((1 + 2 * half) * zeroth + 2 * half * first)
        slope = np.sqrt(np.pi) / 2 / there * (zeroth + first)
        exact = np.where(magnitude > 0, magnitude, np.inf)
        return np.where(noise > 0, mean, magnitude), np.where(noise > 0, slope, 1 / exact)


def magnitudes_of(chosen: ComparedColumns) -> Magnitudes:
    """The phasors compared by the columns of the states."""
    states: CalibrationStates = chosen.states
    velocity = np.asarray(states.velocity)
    n, sensors = velocity.shape
    reference = np.abs(velocity[:, :1])
    higher = np.asarray(states.harmonics).reshape(n, -1) / reference
    measured = np.concatenate([np.ones((n, 1)), velocity[:, 1:] / reference, higher], axis=1)
    whose = np.append(np.arange(1, sensors), np.repeat(np.arange(sensors), len(chosen.orders)))
    by_error = np.zeros((measured.shape[1], 2 * sensors + 1), dtype=complex)
    by_error[0, 0] = 1.0
    rows = np.arange(1, len(by_error))
    by_error[rows, 1 + whose], by_error[rows, 1 + sensors + whose] = 1.0, 1.0j
    known = np.asarray(states.known)
    noise = np.where(known[:, ::2], np.asarray(states.own_std)[:, ::2], 0.0) * np.sqrt(2)
    return Magnitudes(measured, by_error, noise, known[:, ::2] & ~known[:, 1::2])


def notes_without_phases(
    chosen: ComparedColumns,
    phase: Float[np.ndarray, " state"],
    levels: Int[np.ndarray, " level"],
) -> Iterator[Fact]:
    """Notes on what a diagnosis cannot identify without phases.

    Arguments: `phase`: that of the velocities in the model, rad; `levels`: numbers of the levels.
    """
    unknown = chosen.phase_unknown[:, 0]
    if not unknown.any():
        if chosen.phase_unknown.any():
            yield Fact("phases_of_sensors_unknown")
        return
    yield Fact("phases_unknown", n_states=int(unknown.sum()), of_states=len(unknown))
    if unknown.all():
        yield Fact("sensor_phase_unseen")
    if chosen.orders:
        yield Fact("harmonics_without_phase")
    level, off = np.asarray(chosen.states.level), np.abs(phase) > np.radians(30.0)
    for near in (True, False):
        lacking = tuple(
            int(number)
            for index, number in enumerate(levels)
            if (states := (level == index) & unknown).any() and np.all(off[states] == near)
        )
        if lacking:
            yield Fact("no_state_there", near=near, levels=lacking)


def _complex(columns: np.ndarray, axis: int) -> np.ndarray:
    """Pairs of columns as complex numbers."""
    real, imaginary = (
        np.take(columns, np.arange(k, columns.shape[axis], 2), axis=axis) for k in (0, 1)
    )
    return np.asarray(real + 1j * imaginary)
