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


class AlikeForces(NamedTuple):
    """A force, or several of one kind stacked along a leading axis, and the places of each."""

    force: AbstractForce
    places: np.ndarray  # (force, row): one row, or several of a force that acts on several motions

    def taken(self, motion: Float[Array, "time place"]) -> Float[Array, "time force row"]:
        """What the forces act on, of the motions of all places."""
        first = self.places[0, 0]
        if self.places.size == 1:  # no gathering, which is slow
            return motion[:, first : first + 1, None]
        if self.places.shape[1] == 1 and np.array_equal(self.places[:, 0], range(motion.shape[1])):
            return motion[:, :, None]
        return motion[:, self.places]

    def values(self, of: OfForce, x: Array, v: Array) -> Float[Array, "time force row"]:
        """`of(force, x, ẋ)` of every force; the arguments (time, force, row)."""
        if self.places.shape[1] == 1:
            x, v = x[..., 0], v[..., 0]
        if len(self.places) == 1:
            values = of(self.force, x[:, 0], v[:, 0])[:, None]
        else:
            values = jax.vmap(of, (0, 1, 1), 1)(self.force, x, v)
        return values.reshape(len(x), *self.places.shape)

    def cycle_force(self, x: Array, v: Array) -> Float[Array, "time force row"]:
        """The forces over a steady cycle; the arguments (time, force, row)."""
        return self.values(lambda force, x, v: force.cycle_force(x, v), x, v)


class Elements(NamedTuple):
    """Forces by the places at which they act, equal ones together.

    A place's row over the modes gives its displacement x = row·q.
    """

    groups: tuple[AlikeForces, ...]
    rows: Float[Array, "place mode"]  # kg^-1/2; for the mode of interest 1, without a unit
    own: int | None  # the mode of interest where no force acts at points

    @property
    def n_places(self) -> int:
        """Number of places."""
        return self.rows.shape[0]

    def only(self, kinds: type | tuple[type, ...]) -> "Elements":
        """The forces of some classes, at the same places."""
        return self._replace(groups=tuple(g for g in self.groups if isinstance(g.force, kinds)))

    def without(self, kinds: type | tuple[type, ...]) -> "Elements":
        """The forces of other classes, at the same places."""
        return self._replace(groups=tuple(g for g in self.groups if not isinstance(g.force, kinds)))

    def apart(self) -> tuple["Elements", "Elements"]:
        """The forces that act on one displacement each, and those that act on several."""
        one = tuple(group for group in self.groups if group.places.shape[1] == 1)
        several = tuple(group for group in self.groups if group.places.shape[1] > 1)
        return self._replace(groups=one), self._replace(groups=several)

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
        for group in self.groups:
            values = group.values(of, group.taken(x), group.taken(v))
            total = total + self.at_places(group, values)
        return total

    def at_places(
        self, group: AlikeForces, values: Float[Array, "time force row"]
    ) -> Float[Array, "time place"]:
        """The sums of a group's forces at every place."""
        flat, index = values.reshape(len(values), -1), group.places.reshape(-1)
        one_each = np.array_equal(index, np.arange(self.n_places))
        return flat if one_each else flat @ np.eye(self.n_places)[index]

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
    places = list(dict.fromkeys(row for force in forces for row in force.rows))
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


def _groups(forces: Sequence[AbstractForce], places: list) -> tuple[AlikeForces, ...]:
    """Forces of one kind, with parameters of the same shapes, together."""
    alike: dict[object, list[tuple[AbstractForce, list[int]]]] = {}
    for force in forces:
        # Which points does not matter here, whether points at all does.
        where = [name for name in ("at", "normal_at") if getattr(force, name, None) is not None]
        somewhere = dataclasses.replace(force, **dict.fromkeys(where, _SOMEWHERE))
        leaves, kind = jax.tree.flatten(somewhere)
        key = (kind, tuple(np.shape(leaf) for leaf in leaves))
        alike.setdefault(key, []).append((somewhere, [places.index(row) for row in force.rows]))
    groups = []
    for members in alike.values():
        each = [force for force, _ in members]
        stacked = each[0] if len(each) == 1 else jax.tree.map(lambda *a: jnp.stack(a), *each)
        groups.append(AlikeForces(stacked, np.array([index for _, index in members])))
    return tuple(groups)
