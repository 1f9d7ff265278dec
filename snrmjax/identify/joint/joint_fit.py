"""Smooth curves of ω̃² and 2ζ̃ω̃ fitted jointly to all states, levels and sensors."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.joint.fitting import Fitted, NotFinite, fitted
from snrmjax.identify.joint.force_balance import (
    BalanceData,
    Motion,
    Spread,
    Unknowns,
    balance_data,
    recorded_motion,
    stated_level_std,
)
from snrmjax.identify.joint.free_unknowns import (
    FREE,
    Programmed,
    Restore,
    in_one_form,
    named_unknowns,
    programmed,
)
from snrmjax.identify.joint.initial_guess import pilot_start
from snrmjax.identify.joint.notes import notes_on_neighbours, notes_on_noise, notes_on_reach
from snrmjax.identify.joint.selection import (
    Candidate,
    Selection,
    parse_family,
    select_families,
)
from snrmjax.identify.joint.variance_components import Scatter, few_levels_factor
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes
from snrmjax.model.structures import Structure, modes_of
from snrmjax.numerics.blocks import on_one_core

_ROUNDS = 2, 12  # of fitting and estimating the noise anew: at least, at most
_ROUGHLY = 2, 6  # the same, of a fit that is but the pilot of another
_CLEARLY_LESS = 0.9  # of the noise, that a fit from another start must find


class Rival(NamedTuple):
    """The same data fitted with another family of one of the curves, that they could mean too."""

    curve: str  # "backbone" or "damping": the one of another family
    weight: float  # among all families tried, by how they predict what is left out
    fit: "JointFit"


class JointFit(eqx.Module):
    """Two curves, what else was unknown, and how well all of it is known.

    `covariance` belongs to the free unknowns in the order of `names`, and includes what the
    residuals of neighbouring states have in common; `level_std` to `LEVEL_ERRORS`, stated or found:
    what was found from few levels counts for more in `spread`, as Student's t does.
    `rivals` are fits with other families that predict left-out levels about as well: bands of
    curves and responses include what is left open by the choice, the covariance does not.
    """

    unknowns: Unknowns
    covariance: Float[np.ndarray, "unknown unknown"]
    spread: Spread
    data: BalanceData
    modes: LinearModes
    noise_scale: float  # by which residuals exceed the stated noise; the noise where none is
    noise_scale_std: float
    level_std: Float[np.ndarray, " error"]  # gain, phase (rad), relative stiffness and damping
    residuals: Float[np.ndarray, "state part"]  # whitened, of unit variance if all is right
    neighbour_correlation: Float[np.ndarray, " part"]  # of residuals, 0 where it may be chance
    drive_known_only: bool = eqx.field(static=True)
    noise_stated: bool = eqx.field(static=True)
    free: tuple[str, ...] = eqx.field(static=True)
    candidates: tuple[Candidate, ...] = eqx.field(static=True)
    rivals: tuple[Rival, ...]
    notes: tuple[str, ...] = eqx.field(static=True)
    converged: bool = eqx.field(static=True)

    @property
    def largest(self) -> tuple[float, float]:
        """Largest displacement (m) and velocity (m/s) that the fit has seen."""
        motion = self.motion()
        speed = np.abs(np.asarray(motion.velocity))
        return float(np.max(np.asarray(motion.displacement))), float(np.max(speed))

    @property
    def freed(self) -> bool:
        """Whether states are freed of their likeliest errors, as the noise was believed."""
        return bool(np.any(np.asarray(self.data.correction) != 0))

    def motion(self) -> Motion:
        """The nonlinear mode's motion in the states as the fit sees it."""
        return recorded_motion(in_one_form(self.unknowns), self.data, self.modes, self.spread)

    def recorded_force(self, force: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """What the test records of a force in N: in N, or in V where only the drive is known."""
        gain = float(jnp.exp(self.unknowns.log_force_gain))
        offset = float(self.unknowns.force_offset) * float(jnp.min(self.data.force))
        return (np.asarray(force) - offset) / gain

    def force_of_drive(self, drive: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """The force in N that belongs to what a test records (`recorded_force`)."""
        gain = float(jnp.exp(self.unknowns.log_force_gain))
        offset = float(self.unknowns.force_offset) * float(jnp.min(self.data.force))
        return np.asarray(drive) * gain + offset

    def vector(self) -> tuple[Float[Array, " unknown"], Restore]:
        """The free unknowns as a vector, and the way back to all of them."""
        restore = Restore(self.unknowns, self.free)
        return restore.vector(), restore

    def programmed(self) -> Programmed:
        """The free unknowns as compiled programs take them."""
        return programmed(self.unknowns, self.free)

    def names(self) -> tuple[str, ...]:
        """What the free unknowns are called."""
        return tuple(name for name, _ in named_unknowns(self.unknowns, self.data, self.free))

    def units(self) -> tuple[str, ...]:
        """Units of the free unknowns; a curve's terms count at the largest amplitude."""
        return tuple(unit for _, unit in named_unknowns(self.unknowns, self.data, self.free))


@on_one_core
def fit_jointly(
    data: SteadyStates,
    modes: LinearModes | Structure,
    *,
    backbone: str = "auto",
    damping: str = "auto",
    free: Sequence[str] = (),
    level_gain_std: float | None = None,
    level_phase_std: float | None = None,
    robust: bool = False,
) -> JointFit:
    """Fit both curves to the complex force balance of all states at once.

    Levenberg–Marquardt on residuals whitened with the stated noise. Gain and phase errors that a
    level shares are unknowns with the stated 1σ; where levels scatter more than that allows, a
    deviation of stiffness and damping from level to level is estimated too (restricted maximum
    likelihood) and enters the bands. Both families and that scatter are chosen at a first fit that
    knows no scatter, or at the pilot where that leads to clearly less noise. Where the stated noise
    is believed, every step frees the states of their likeliest errors (orthogonal distance
    regression), and what is small in the end are those. The other modes' frequencies and
    dampings stay inside their stated errors.

    Arguments: `backbone` and `damping` name a family of `FAMILIES`, with a size if wanted
    ("polynomial:2", "spline:5") and the amplitude ("polynomial:2@velocity"); what is left out is
    chosen by predicting left-out levels, and so is the family itself for "auto". `free` may name
    "force_gain", "force_offset" and "instrument_phase"; the gain is always free where only the
    drive is known. `modes` may be a structure, which also states the 1σ of what the states of a
    level share: gain, phase, natural frequency and damping ratio. `level_gain_std` (relative) and
    `level_phase_std` (rad), where given, stand in place of the first two.
    Returns a `JointFit`. Raises `ValueError` for too few states, an unknown family or name, and a
    family with more parameters than there are data.
    Validity: one nonlinear mode whose ω̃ and 2ζ̃ω̃ are functions of amplitude alone.
    """
    level_std = stated_level_std(modes)
    for k, std in enumerate((level_gain_std, level_phase_std)):
        level_std[k] = level_std[k] if std is None else std
    modes = modes_of(modes)
    unknown = [name for name in free if name not in FREE]
    if unknown:
        raise ValueError(f"`free` knows {', '.join(FREE)}, not {unknown[0]!r}.")
    if data.sensors != modes.sensors:
        raise ValueError(
            f"`data` has the sensors {list(data.sensors)}, but `modes` has {list(modes.sensors)}."
        )
    measured, stated = balance_data(data, modes)
    n = len(measured.level)
    if n < 3:
        raise ValueError(f"a joint fit needs at least 3 steady states, but only {n} are usable.")
    driven = not np.any(np.isfinite(np.asarray(data.force)))
    released = tuple(name for name in FREE if name in free or (driven and name == "force_gain"))
    keep = np.asarray(modes.residual_modes, dtype=int)
    linear_std = np.concatenate(
        [np.asarray(modes.natural_frequency_std)[keep], np.asarray(modes.damping_ratio_std)[keep]]
    )
    spread = Spread(jnp.asarray(level_std), jnp.asarray(linear_std))
    wanted = parse_family(backbone), parse_family(damping)

    def select(pilot: Unknowns, data: BalanceData, *, scatter_too: bool) -> Selection:
        # Where no noise is stated a smooth curve would bend for levels whose gains differ.
        smooth, settings = stated or scatter_too, (*wanted, released)
        given = (data, modes, spread, pilot, *settings)
        return select_families(*given, scatter_too=scatter_too, smooth=smooth)

    def fit_from(
        chosen: Selection, pilot: Unknowns, data: BalanceData, rounds: tuple[int, int]
    ) -> Fitted:
        noisy = eqx.tree_at(lambda d: d.std, data, data.std.at[:, 3].set(chosen.jitter))
        level = _with_scatter(spread, chosen.scatter, data.n_levels)
        start = _started(pilot, chosen, level)
        settings = (modes, level, released, chosen.scatter)
        return fitted(start, noisy, *settings, stated=stated, robust=robust, rounds=rounds)

    # What the rough pilot misses would pass for levels that differ: a fit without that comes first.
    rough = pilot_start(measured, modes, spread, released)
    begun = fit_from(select(rough, measured, scatter_too=False), rough, measured, _ROUGHLY)
    pilot, corrected = _as_pilot(begun, measured)
    chosen = select(pilot, corrected, scatter_too=True)
    best = fit_from(chosen, pilot, corrected, _ROUNDS)
    if not best.converged or (stated and best.scatter.contradicts_upward):
        # Where levels differ so much that no fit without that comes near, the pilot knows better.
        other = select(rough, measured, scatter_too=True)
        again = fit_from(other, rough, measured, _ROUNDS)
        if again.scatter.noise < _CLEARLY_LESS * best.scatter.noise:
            chosen, best = other, again

    def told(found: Fitted, rivals: tuple[Rival, ...]) -> JointFit:
        notes: tuple[str, ...] = ()
        if not found.converged:
            notes = ("the fit did not converge: try a simpler family.",)
        noise = (found.scatter, chosen.jitter, np.asarray(spread.level), measured.n_levels)
        notes += notes_on_noise(*noise, stated=stated, alike=bool(found.neighbours.any()))
        notes += notes_on_neighbours(found.neighbours)
        motion = recorded_motion(in_one_form(found.unknowns), found.data, modes, found.spread)
        notes += notes_on_reach(motion, np.asarray(found.data.level))
        return JointFit(
            unknowns=found.unknowns,
            covariance=found.covariance,
            spread=found.spread,
            data=found.data,
            modes=modes,
            noise_scale=found.scatter.noise,
            noise_scale_std=found.scatter.noise_std,
            level_std=np.asarray(found.scatter.level),
            residuals=found.residuals,
            neighbour_correlation=found.neighbours,
            drive_known_only=driven,
            noise_stated=stated,
            free=released,
            candidates=chosen.table,
            rivals=rivals,
            notes=notes,
            converged=found.converged,
        )

    rivals, (pilot, corrected) = [], _as_pilot(best, measured)
    for one in chosen.contenders:
        pair = [best.unknowns.squared_frequency, best.unknowns.modal_damping]
        pair[one.curve == "damping"] = one.family
        other = chosen._replace(squared_frequency=pair[0], modal_damping=pair[1])
        try:
            found = fit_from(other, pilot, corrected, _ROUGHLY)
        except NotFinite:
            continue  # a family that cannot be fitted is no rival
        if found.converged:
            rivals.append(Rival(one.curve, one.weight, told(found, ())))
    return told(best, tuple(rivals))


def _as_pilot(found: Fitted, measured: BalanceData) -> tuple[Unknowns, BalanceData]:
    """A fit as another one starts from it: levels in their own units, its states' errors."""
    raw = found.unknowns.level * found.spread.level
    pilot = eqx.tree_at(lambda u: u.level, found.unknowns, raw)
    return pilot, eqx.tree_at(lambda d: d.correction, measured, found.data.correction)


def _started(pilot: Unknowns, chosen: Selection, spread: Spread) -> Unknowns:
    """The chosen curves, and the pilot's deviations of levels in units of their new 1σ."""
    unit = jnp.where(spread.level > 0, spread.level, 1.0)
    level = jnp.where(spread.level > 0, pilot.level / unit, 0.0)
    pair = (chosen.squared_frequency, chosen.modal_damping)
    return eqx.tree_at(
        lambda u: (u.squared_frequency, u.modal_damping, u.level), pilot, (*pair, level)
    )


def _with_scatter(spread: Spread, scatter: Scatter, n_levels: int) -> Spread:
    """Levels' errors as stated, or as found and as much wider as few levels leave open."""
    found = few_levels_factor(n_levels) * jnp.array(scatter.level)
    return Spread(jnp.where(spread.level > 0, spread.level, found), spread.linear)
