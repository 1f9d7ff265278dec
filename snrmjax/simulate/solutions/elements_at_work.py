"""Nonlinear elements that stay inactive: stops that are not reached, friction that sticks."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.model.attachment import influence_text
from snrmjax.model.effect_base import AbstractForce, AbstractNonsmooth
from snrmjax.model.elements import elements_of
from snrmjax.model.library.friction import CoulombFriction, JenkinsSlider
from snrmjax.model.moving_base import newtons
from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.simulate.balance.harmonics import harmonic_basis
from snrmjax.simulate.continuation.response_curve import ResponseCurve

_SAMPLES, _FREQUENCIES = 128, 201


class IdleElement(NamedTuple):
    """An element whose threshold no motion of the curves reaches."""

    element: str
    slides: bool  # a slider that sticks; else a contact that never opens or closes
    fraction: float  # of the threshold that the largest motion reaches


class Hold(NamedTuple):
    """Friction that sticks while the excitation force is below a threshold."""

    element: str
    slides_from: float  # N, smallest over the frequency range


def idle_elements(model: Structure, curves: Sequence[ResponseCurve]) -> Iterator[IdleElement]:
    """Sliders that never slip and contacts that never open or close on any of the curves."""
    model = simulated_structure(model)
    motions = [np.asarray(curve.coefficients) for curve in curves if len(curve.frequency)]
    if not motions:
        return
    for slider, influence in _forces(model, JenkinsSlider):
        x = np.concatenate([_over_a_period(motion @ influence) for motion in motions])
        reach = float(np.max(0.5 * np.ptp(x, axis=1)))
        fraction = reach / float(slider.slip_displacement)
        if fraction < 1:
            yield IdleElement(_name(slider), True, fraction)
    for contact, influence in _forces(model, AbstractNonsmooth):
        x = np.concatenate([_over_a_period(motion @ influence) for motion in motions])
        thresholds = np.atleast_1d(np.asarray(contact.nonsmooth_points().displacement))
        if np.any(thresholds == 0):  # crossed by every motion
            continue
        fraction = float(np.max(np.where(thresholds > 0, x.max(), x.min()) / thresholds))
        if fraction < 1:
            yield IdleElement(_name(contact), False, fraction)


def friction_hold(model: Structure, from_frequency: float, to_frequency: float) -> Hold | None:
    """The friction element that slides first, and the excitation force at which it does.

    While friction with the influence vector r sticks, the structure is linear and the reaction is
    (Σ r φᵀb F/d)/(Σ r²/d), d being the modal dynamic stiffnesses. It slides when the reaction
    exceeds the friction force.

    Arguments: frequencies in rad/s. Returns None for a model without dry friction.
    """
    model = simulated_structure(model)
    terms = model.linear_terms()
    omega = np.linspace(from_frequency, to_frequency, _FREQUENCIES)[:, None]
    dynamic = np.asarray(terms.stiffness) - omega**2 * np.asarray(terms.mass)
    dynamic = dynamic + 1j * omega * np.asarray(terms.damping)
    holds = []
    for friction, influence in _forces(model, CoulombFriction):
        free = (newtons(model.modes.unbalance, omega, 1.0) / dynamic) @ (
            influence * np.asarray(model.modes.participation)
        )
        reaction = np.abs(free / ((1 / dynamic) @ influence**2))
        if reaction.max() > 0:
            holds.append(Hold(_name(friction), float(friction.force) / float(reaction.max())))
    return min(holds, key=lambda one: one.slides_from, default=None)


def _forces(model: Structure, kind: Any) -> Iterator[tuple[Any, Float[np.ndarray, " mode"]]]:
    """The forces of a kind that act on one displacement x = r·q, and their influence vectors r."""
    for effect in model.effects:
        if isinstance(effect, kind) and len(effect.influence_vectors) == 1:
            elements = elements_of([effect], model.modes)
            own = elements.own is not None
            yield effect, model.own_mode if own else np.asarray(elements.influence)[0]


def _over_a_period(x: Float[np.ndarray, "point coefficient"]) -> Float[np.ndarray, "point time"]:
    return x @ harmonic_basis((x.shape[1] - 1) // 2, _SAMPLES).synthesis.T


def _name(effect: AbstractForce) -> str:
    (row,) = effect.influence_vectors
    return effect.kind.replace("_", " ") + ("" if row is None else f" at {influence_text(row)}")
