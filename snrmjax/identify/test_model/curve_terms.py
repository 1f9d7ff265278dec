"""What each of a test's two curves is a sum of: a family's own terms, and smooth functions.

Without a family the smooth functions are the curve. With one they are its remainder: a straight
line in a² and bends, all of one size, which is exactly zero or found by the evidence. Terms of a
family that are not linear in their parameters (an exponent) are linearised about their present
values, in the same rounds as everything else.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.identify.curves.family_base import AbstractFamily, Argument
from snrmjax.identify.test_model.curve_basis import CurveBasis

_WIDE = 1e8  # 1σ of a family's coefficients, in the curve's unit: no prior at all


class CurveTerms(NamedTuple):
    """The terms of one curve, by coefficients that are the modal mass over the model's times it.

    Those of a family come first; they have its own numbers (an exponent) as they are.
    """

    basis: CurveBasis
    unit: float  # of the coefficients, rad²/s² or 1/s
    argument: Argument = "displacement"
    family: AbstractFamily | None = None
    smooth: bool = True  # whether smooth functions are among the terms

    @property
    def n_own(self) -> int:
        """How many terms the family has."""
        return 0 if self.family is None else len(self.family.parameters)

    @property
    def without(self) -> int:
        """Smooth functions that are left out: a family has a constant of its own."""
        return int(self.family is not None)

    @property
    def n_functions(self) -> int:
        """How many terms there are."""
        return self.n_own + self.smooth * (self.basis.n_functions - self.without)

    @property
    def units(self) -> Float[np.ndarray, " term"]:
        """Of the coefficients: the curve's, and 1 for numbers of a family."""
        units = np.full(self.n_functions, self.unit)
        units[: self.n_own][~self._is_value] = 1.0
        return units

    @property
    def scaled(self) -> Bool[np.ndarray, " term"]:
        """Which of them grow with the modal mass: all but numbers of a family."""
        scaled = np.ones(self.n_functions, dtype=bool)
        scaled[: self.n_own] = self._is_value
        return scaled

    @property
    def _is_value(self) -> Bool[np.ndarray, " own"]:
        named = () if self.family is None else self.family.coefficients()
        return np.array([one.is_value for one in named], dtype=bool)

    @property
    def flat(self) -> Bool[np.ndarray, " term"]:
        """Which have no prior: a family's, unless it says what one is near zero by."""
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
        """Values at its own amplitudes, and derivatives by their logarithm."""
        if self.family is None:
            return tuple(one[0] for one in self._drawn(amplitude, coefficients))
        own = self.family.linearised(amplitude, (self.units * coefficients)[: self.n_own])
        value, slope = own.value, amplitude * own.by_amplitude
        if self.smooth:
            (left,), (steep,) = self._drawn(amplitude, np.append(0.0, coefficients[self.n_own :]))
            value, slope = value + left, slope + steep
        return value, slope

    def _drawn(self, amplitude: np.ndarray, coefficients: np.ndarray) -> tuple:
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
        """Value and columns in the limit of no motion, zero where there is none (dry friction)."""
        if self.family is None:
            columns = self.unit * self.basis.at_rest
            return float(columns @ coefficients), columns
        value, columns = self.curve(np.zeros(1), coefficients)[0], np.zeros(self.n_functions)
        if not np.isfinite(value[0]):
            return 0.0, columns
        return float(value[0]), self.columns(np.zeros(1), coefficients)[0]

    def log_variances(self) -> tuple[Float[np.ndarray, " term"], Float[np.ndarray, "term hyper"]]:
        """ln of the prior variances for smooth functions of size one (`CurveBasis`), and what they
        gain by ln of the size, and by how it changes.
        """
        constant, slopes = self.basis.log_variances()
        if self.family is None:
            return constant, slopes
        if self.smooth:  # the straight line is as large as what bends reach
            constant[1] = 2 * np.log(self.basis.reach)
            slopes[1, 0] = 2.0
        std = self.family.expected_std()
        own = 2 * np.log(np.where(np.isfinite(std), std, _WIDE))
        n = self.n_functions - self.n_own
        slopes = np.vstack([np.zeros((self.n_own, slopes.shape[1])), slopes[1:][:n]])
        return np.concatenate([own, constant[1:][:n]]), slopes
