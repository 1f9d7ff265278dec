"""Coordinates in which a fit of effects steps: of a power law its size at a typical amplitude."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.model.effects import EFFECTS


class Coordinates(NamedTuple):
    """A law c x^p by its stiffness c R^(p − 1) at a typical amplitude R, and by p.

    Data determine the force at the measured amplitudes. The coefficient c is that at unit
    amplitude and changes by powers of ten with the exponent: a fit in c and p would follow a
    narrow, bent valley.
    """

    pairs: tuple[tuple[int, int], ...]  # places of a coefficient and its exponent
    reference: float  # R, kg^1/2 m

    def inward(self, values: Float[np.ndarray, "*trial parameter"]) -> np.ndarray:
        """Parameters as the fit sees them."""
        return self._scaled(values, 1.0)

    def outward(self, inner: Float[np.ndarray, "*trial parameter"]) -> np.ndarray:
        """Parameters of the effects."""
        return self._scaled(inner, -1.0)

    def slopes(
        self,
        values: Float[np.ndarray, " parameter"],
        slopes: Float[np.ndarray, "row parameter"],
    ) -> Float[np.ndarray, "row parameter"]:
        """Slopes by the fit's coordinates, of those by the effects' parameters at `values`."""
        turned = slopes.copy()
        for c, p in self.pairs:
            turned[:, p] -= values[c] * np.log(self.reference) * slopes[:, c]
            turned[:, c] *= self.reference ** (1 - values[p])
        return turned

    def _scaled(self, values: Float[np.ndarray, "*trial parameter"], sign: float) -> np.ndarray:
        scaled = np.array(values, dtype=float)
        for c, p in self.pairs:
            scaled[..., c] *= self.reference ** (sign * (scaled[..., p] - 1))
        return scaled


def coordinates(labels: Sequence[str], reference: float) -> Coordinates:
    """Coordinates for parameters of these names; `reference` is a typical amplitude."""
    pairs = []
    for place, label in enumerate(labels):
        kind, _, name = label.partition(".")
        exponent = EFFECTS[kind].parameters()[name].exponent
        if exponent is not None:
            pairs.append((place, labels.index(f"{kind}.{exponent}")))
    return Coordinates(tuple(pairs), reference)
