"""The forces of a structure where they act: on the mode of interest or at points."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.effect_base import AbstractForce
from snrmjax.model.modes import LinearModes
from snrmjax.model.places import row_over_points

OfForce = Callable[[Any, Array, Array], Array]

_SOMEWHERE = row_over_points("points")


class Slopes(NamedTuple):
    """Derivatives of the forces at every place with respect to what they act on."""

    stiffness: Float[Array, "time place"]  # ∂f/∂x
    damping: Float[Array, "time place"]  # ∂f/∂ẋ


class Elements(NamedTuple):
    """Forces by the places at which they act, equal ones together.

    Each group has one force, or several of one kind stacked along a leading axis, and the places
    of its forces. A place's row over the modes gives its displacement x = row·q.
    """

    groups: tuple[tuple[AbstractForce, tuple[int, ...]], ...]
    rows: Float[Array, "place mode"]  # kg^-1/2; for the mode of interest 1, without a unit
    own: int | None  # the mode of interest where no force acts at points

    @property
    def n_places(self) -> int:
        """Number of places."""
        return self.rows.shape[0]

    def only(self, kinds: type | tuple[type, ...]) -> "Elements":
        """The forces of some classes, at the same places."""
        return self._replace(groups=tuple(g for g in self.groups if isinstance(g[0], kinds)))

    def without(self, kinds: type | tuple[type, ...]) -> "Elements":
        """The forces of other classes, at the same places."""
        return self._replace(groups=tuple(g for g in self.groups if not isinstance(g[0], kinds)))

    def displacement(self, q: Float[Array, "*batch mode"]) -> Float[Array, "*batch place"]:
        """What the forces act on, in m at points; of q̇ its rate."""
        return q @ self.rows.T if self.own is None else q[..., self.own, None]

    def on_modes(self, forces: Float[Array, "*batch place"]) -> Float[Array, "*batch mode"]:
        """The modal forces of forces at the places."""
        # Multiplying is faster than writing to an entry, of which a `vmap` makes a loop.
        return forces @ self.rows if self.own is None else forces * self.rows[0]

    def matrix(self, slopes: Float[Array, "*batch place"]) -> Float[Array, "*batch mode mode"]:
        """The matrices over the modes that belong to slopes at the places."""
        if self.own is not None:
            return slopes[..., None] * np.outer(self.rows[0], self.rows[0])
        return jnp.tensordot(slopes, self.rows[:, :, None] * self.rows[:, None], axes=1)

    def applied(
        self, of: OfForce, x: Float[Array, "time place"], v: Float[Array, "time place"]
    ) -> Float[Array, "time place"]:
        """The sums of `of(force, x, ẋ)` over the forces at every place."""
        total = jnp.zeros_like(x)
        for force, places in self.groups:
            index = np.array(places)
            if len(places) == 1:
                values = of(force, x[:, places[0]], v[:, places[0]])[:, None]
            else:
                values = jax.vmap(of, (0, 1, 1), 1)(force, x[:, index], v[:, index])
            one_each = np.array_equal(index, np.arange(self.n_places))
            total = total + (values if one_each else values @ np.eye(self.n_places)[index])
        return total

    def cycle_force(
        self, x: Float[Array, "time place"], v: Float[Array, "time place"]
    ) -> Float[Array, "time place"]:
        """The forces over a steady cycle, in N at points."""
        return self.applied(lambda force, x, v: force.cycle_force(x, v), x, v)

    def force(
        self, x: Float[Array, "time place"], v: Float[Array, "time place"]
    ) -> Float[Array, "time place"]:
        """The forces at any samples; of forces without memory."""
        return self.applied(lambda force, x, v: jax.vmap(force.force)(x, v), x, v)

    def slopes(self, x: Float[Array, "time place"], v: Float[Array, "time place"]) -> Slopes:
        """Derivatives of the forces at any samples; of forces without memory."""

        def along(argument: int) -> OfForce:
            return lambda force, x, v: jax.vmap(jax.grad(force.force, argnums=argument))(x, v)

        return Slopes(self.applied(along(0), x, v), self.applied(along(1), x, v))


def elements_of(forces: Sequence[AbstractForce], modes: LinearModes) -> Elements:
    """The forces by their places, with the rows that the modes' shapes give these.

    Raises `ValueError` for a point at which the modes have no shape.
    """
    places = list(dict.fromkeys(force.at for force in forces))
    own = modes.mode_of_interest if all(place is None for place in places) else None
    of_interest = np.eye(modes.n_modes)[modes.mode_of_interest]
    if own is not None:
        rows = of_interest[None][: len(places)]
    else:
        rows = jnp.stack(
            [
                of_interest
                if place is None
                else sum(weight * modes.shape_at(point) for point, weight in place)
                for place in places
            ]
        )
    return Elements(_groups(forces, places), rows, own)


def _groups(
    forces: Sequence[AbstractForce], places: list
) -> tuple[tuple[AbstractForce, tuple[int, ...]], ...]:
    """Forces of one kind, with parameters of the same shapes, together."""
    alike: dict[object, list[tuple[AbstractForce, int]]] = {}
    for force in forces:
        # Which points does not matter here, whether points at all does.
        somewhere = force if force.at is None else dataclasses.replace(force, at=_SOMEWHERE)
        leaves, kind = jax.tree.flatten(somewhere)
        key = (kind, tuple(np.shape(leaf) for leaf in leaves))
        alike.setdefault(key, []).append((somewhere, places.index(force.at)))
    groups = []
    for members in alike.values():
        own = [force for force, _ in members]
        stacked = own[0] if len(own) == 1 else jax.tree.map(lambda *a: jnp.stack(a), *own)
        groups.append((stacked, tuple(place for _, place in members)))
    return tuple(groups)
