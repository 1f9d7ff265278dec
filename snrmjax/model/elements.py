"""Nonlinear elements of a structure, grouped by attachment: mode of interest or points."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.attachment import influence_vector
from snrmjax.model.effect_base import AbstractForce
from snrmjax.model.modes import LinearModes

ForceFunction = Callable[[Any, Array, Array], Array]

_SOMEWHERE = influence_vector("points")


class Slopes(NamedTuple):
    """Tangent stiffness and damping of the forces at every attachment."""

    stiffness: Float[Array, "time attachment"]  # ∂f/∂x
    damping: Float[Array, "time attachment"]  # ∂f/∂ẋ


class ForceGroup(NamedTuple):
    """A force, or several of one kind stacked along a leading axis, with their attachments."""

    force: AbstractForce
    attachments: np.ndarray  # (force, direction): their indices, several for contacts

    def gathered(
        self, motion: Float[Array, "time attachment"]
    ) -> Float[Array, "time force direction"]:
        """The motions of the forces, selected from those of all attachments."""
        first = self.attachments[0, 0]
        if self.attachments.size == 1:  # no gathering, which is slow
            return motion[:, first : first + 1, None]
        if self.attachments.shape[1] == 1 and np.array_equal(
            self.attachments[:, 0], range(motion.shape[1])
        ):
            return motion[:, :, None]
        return motion[:, self.attachments]

    def values(self, of: ForceFunction, x: Array, v: Array) -> Float[Array, "time force direction"]:
        """`of(force, x, ẋ)` of every force; the arguments (time, force, direction)."""
        if self.attachments.shape[1] == 1:
            x, v = x[..., 0], v[..., 0]
        if len(self.attachments) == 1:
            values = of(self.force, x[:, 0], v[:, 0])[:, None]
        else:
            values = jax.vmap(of, (0, 1, 1), 1)(self.force, x, v)
        return values.reshape(len(x), *self.attachments.shape)

    def cycle_force(self, x: Array, v: Array) -> Float[Array, "time force direction"]:
        """The forces over a steady cycle; the arguments (time, force, direction)."""
        return self.values(lambda force, x, v: force.cycle_force(x, v), x, v)


class Elements(NamedTuple):
    """Forces by their attachments, those of one kind in a group.

    The influence vector b of an attachment over the modes gives its displacement x = b·q.
    """

    groups: tuple[ForceGroup, ...]
    influence: Float[Array, "attachment mode"]  # kg^-1/2; 1 for the mode of interest
    own: int | None  # the mode of interest if no force acts at points

    @property
    def n_attachments(self) -> int:
        """Number of distinct attachments."""
        return self.influence.shape[0]

    def only(self, kinds: type | tuple[type, ...]) -> "Elements":
        """Only the forces of some classes, with the same attachments."""
        return self._replace(groups=tuple(g for g in self.groups if isinstance(g.force, kinds)))

    def without(self, kinds: type | tuple[type, ...]) -> "Elements":
        """The forces of all other classes, with the same attachments."""
        return self._replace(groups=tuple(g for g in self.groups if not isinstance(g.force, kinds)))

    def apart(self) -> tuple["Elements", "Elements"]:
        """The forces with one attachment each, and those with several."""
        one = tuple(group for group in self.groups if group.attachments.shape[1] == 1)
        several = tuple(group for group in self.groups if group.attachments.shape[1] > 1)
        return self._replace(groups=one), self._replace(groups=several)

    def displacement(self, q: Float[Array, "*batch mode"]) -> Float[Array, "*batch attachment"]:
        """Displacements at the attachments, in m at points; for q̇ the velocities."""
        return q @ self.influence.T if self.own is None else q[..., self.own, None]

    def on_modes(self, forces: Float[Array, "*batch attachment"]) -> Float[Array, "*batch mode"]:
        """Modal forces of the forces at the attachments."""
        # Multiplying is faster than writing to an entry, of which a `vmap` makes a loop.
        return forces @ self.influence if self.own is None else forces * self.influence[0]

    def matrix(self, slopes: Float[Array, "*batch attachment"]) -> Float[Array, "*batch mode mode"]:
        """Modal matrices Bᵀ diag(slopes) B of slopes at the attachments."""
        if self.own is not None:
            return slopes[..., None] * np.outer(self.influence[0], self.influence[0])
        return jnp.tensordot(slopes, self.influence[:, :, None] * self.influence[:, None], axes=1)

    def applied(
        self,
        of: ForceFunction,
        x: Float[Array, "time attachment"],
        v: Float[Array, "time attachment"],
    ) -> Float[Array, "time attachment"]:
        """`of(force, x, ẋ)` summed over the forces at every attachment."""
        total = jnp.zeros_like(x)
        for group in self.groups:
            values = group.values(of, group.gathered(x), group.gathered(v))
            total = total + self.summed(group, values)
        return total

    def summed(
        self, group: ForceGroup, values: Float[Array, "time force direction"]
    ) -> Float[Array, "time attachment"]:
        """The forces of a group, summed at every attachment."""
        flat, index = values.reshape(len(values), -1), group.attachments.reshape(-1)
        one_each = np.array_equal(index, np.arange(self.n_attachments))
        return flat if one_each else flat @ np.eye(self.n_attachments)[index]

    def cycle_force(
        self, x: Float[Array, "time attachment"], v: Float[Array, "time attachment"]
    ) -> Float[Array, "time attachment"]:
        """The forces over a steady cycle, in N at points."""
        return self.applied(lambda force, x, v: force.cycle_force(x, v), x, v)

    def force(
        self, x: Float[Array, "time attachment"], v: Float[Array, "time attachment"]
    ) -> Float[Array, "time attachment"]:
        """The forces at any samples; memoryless forces only."""
        return self.applied(lambda force, x, v: jax.vmap(force.force)(x, v), x, v)

    def slopes(
        self, x: Float[Array, "time attachment"], v: Float[Array, "time attachment"]
    ) -> Slopes:
        """Derivatives of the forces at any samples; memoryless forces only."""

        def along(argument: int) -> ForceFunction:
            return lambda force, x, v: jax.vmap(jax.grad(force.force, argnums=argument))(x, v)

        return Slopes(self.applied(along(0), x, v), self.applied(along(1), x, v))


def elements_of(forces: Sequence[AbstractForce], modes: LinearModes) -> Elements:
    """The forces by their attachments, with influence vectors from the mode shapes.

    Raises `ValueError` for a point at which the modes have no shape.
    """
    attachments = list(dict.fromkeys(b for force in forces for b in force.influence_vectors))
    own = modes.mode_of_interest if all(attachment is None for attachment in attachments) else None
    of_interest = np.eye(modes.n_modes)[modes.mode_of_interest]
    if own is not None:
        influence = of_interest[None][: len(attachments)]
    else:
        influence = jnp.stack(
            [
                of_interest
                if attachment is None
                else sum(weight * modes.shape_at(point) for point, weight in attachment)
                for attachment in attachments
            ]
        )
    return Elements(_groups(forces, attachments), influence, own)


def _groups(forces: Sequence[AbstractForce], attachments: list) -> tuple[ForceGroup, ...]:
    """Groups of forces of one kind with parameters of the same shapes."""
    alike: dict[object, list[tuple[AbstractForce, list[int]]]] = {}
    for force in forces:
        # Only whether it acts at points matters here, not at which.
        where = [name for name in ("at", "normal_at") if getattr(force, name, None) is not None]
        somewhere = dataclasses.replace(force, **dict.fromkeys(where, _SOMEWHERE))
        leaves, kind = jax.tree.flatten(somewhere)
        key = (kind, tuple(np.shape(leaf) for leaf in leaves))
        alike.setdefault(key, []).append(
            (somewhere, [attachments.index(b) for b in force.influence_vectors])
        )
    groups = []
    for members in alike.values():
        each = [force for force, _ in members]
        stacked = each[0] if len(each) == 1 else jax.tree.map(lambda *a: jnp.stack(a), *each)
        groups.append(ForceGroup(stacked, np.array([index for _, index in members])))
    return tuple(groups)
