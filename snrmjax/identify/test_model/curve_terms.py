"""The terms of each of a test's two curves: those of a family, and smooth functions.

Without a family the smooth functions are the curve. With one they are its remainder: a straight
line in a² and roughness with one common 1σ, either exactly zero or estimated by the evidence. A
family that is nonlinear in a parameter (an exponent) is linearised about its current value, in the
same Gauss–Newton iterations as everything else.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.identify.curves.family_base import AbstractFamily, Argument
from snrmjax.identify.test_model.curve_basis import CurveBasis

_WIDE = 1e8  # 1σ of a family's coefficients, in the curve's unit: a flat prior


class CurveTerms(NamedTuple):
    """The terms of one curve; their coefficients are of the curve times κ, the modal mass ratio.

    Those of a family come first; its dimensionless parameters (an exponent) are not scaled.
    """

    basis: CurveBasis
    unit: float  # of the coefficients, rad²/s² or 1/s
    argument: Argument = "displacement"
    family: AbstractFamily | None = None
    smooth: bool = True  # whether smooth functions are among the terms

    @property
    def n_own(self) -> int:
        """Number of terms of the family."""
        return 0 if self.family is None else len(self.family.parameters)

    @property
    def without(self) -> int:
        """Number of smooth functions left out: a family has its own constant."""
        return int(self.family is not None)

    @property
    def n_functions(self) -> int:
        """Number of terms."""
        return self.n_own + self.smooth * (self.basis.n_functions - self.without)

    @property
    def units(self) -> Float[np.ndarray, " term"]:
        """Units of the coefficients: the curve's, and 1 for dimensionless ones of a family."""
        units = np.full(self.n_functions, self.unit)
        units[: self.n_own][~self._is_value] = 1.0
        return units

    @property
    def scaled(self) -> Bool[np.ndarray, " term"]:
        """Which coefficients scale with the modal mass: all but a family's dimensionless ones."""
        scaled = np.ones(self.n_functions, dtype=bool)
        scaled[: self.n_own] = self._is_value
        return scaled

    @property
    def _is_value(self) -> Bool[np.ndarray, " own"]:
        named = () if self.family is None else self.family.coefficients()
        return np.array([one.is_value for one in named], dtype=bool)

    @property
    def flat(self) -> Bool[np.ndarray, " term"]:
        """Which coefficients have a flat prior: a family's, where it states no 1σ."""
        flat = np.zeros(self.n_functions, dtype=bool)
        if self.family is not None:
            flat[: self.n_own] = ~np.isfinite(self.family.expected_std())
        return flat

    def amplitude(self, displacement: np.ndarray, frequency: np.ndarray) -> np.ndarray:
        """The amplitude that the curve is a function of, m or m/s."""
        return displacement * frequency if self.argument == "velocity" else displacement

    def curve(
        self, amplitude: Float[np.ndarray, " point"], coefficients: Float[np.ndarray, " term"]
    ) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, " point"]]:
        """Values at amplitudes of the curve's argument, and derivatives by their logarithm."""
        if self.family is None:
            return tuple(one[0] for one in self._smooth_curves(amplitude, coefficients))
        own = self.family.linearised(amplitude, (self.units * coefficients)[: self.n_own])
        value, slope = own.value, amplitude * own.by_amplitude
        if self.smooth:
            (rest,), (rest_slope,) = self._smooth_curves(
                amplitude, np.append(0.0, coefficients[self.n_own :])
            )
            value, slope = value + rest, slope + rest_slope
        return value, slope

    def _smooth_curves(self, amplitude: np.ndarray, coefficients: np.ndarray) -> tuple:
        return self.basis.curves(amplitude, self.unit * coefficients[:, None])

    def columns(
        self, amplitude: Float[np.ndarray, " point"], coefficients: Float[np.ndarray, " term"]
    ) -> Float[np.ndarray, "point term"]:
        """Derivatives of the values by the coefficients."""
        columns = np.empty((len(amplitude), 0))
        if self.family is not None:
            own = (self.units * coefficients)[: self.n_own]
            columns = self.family.linearised(amplitude, own).by_parameters
        if self.smooth:
            columns = np.hstack([columns, self.basis.values(amplitude)[0][:, self.without :]])
        return columns * self.units

    def at_rest(
        self, coefficients: Float[np.ndarray, " term"]
    ) -> tuple[float, Float[np.ndarray, " term"]]:
        """Value and columns in the limit of zero amplitude; 0 where it diverges (dry friction)."""
        if self.family is None:
            columns = self.unit * self.basis.at_rest
            return float(columns @ coefficients), columns
        value, columns = self.curve(np.zeros(1), coefficients)[0], np.zeros(self.n_functions)
        if not np.isfinite(value[0]):
            return 0.0, columns
        return float(value[0]), self.columns(np.zeros(1), coefficients)[0]

    def log_variances(self) -> tuple[Float[np.ndarray, " term"], Float[np.ndarray, "term hyper"]]:
        """ln of the prior variances for roughness of 1σ = 1 (`CurveBasis`), and their slopes by ln
        of that 1σ and by its variation along the curve.
        """
        constant, slopes = self.basis.log_variances()
        if self.family is None:
            return constant, slopes
        if self.smooth:  # the line has the prior 1σ that the roughness adds up to
            constant[1] = 2 * np.log(self.basis.reach)
            slopes[1, 0] = 2.0
        std = self.family.expected_std()
        own = 2 * np.log(np.where(np.isfinite(std), std, _WIDE))
        n = self.n_functions - self.n_own
        slopes = np.vstack([np.zeros((self.n_own, slopes.shape[1])), slopes[1:][:n]])
        return np.concatenate([own, constant[1:][:n]]), slopes
