"""The inverse of the SNRM function: natural frequency and damping from one steady state.

Every steady state gives two equations, |V_nl + V_lin + V_RB| = v and the phase of V_nl, for two
unknowns, ω̃ and ζ̃. With φ the phase of the nonlinear mode's velocity relative to the force, the
paper's Eq. (17) reads (ω̃² − Ω²) = 2ζ̃ω̃Ω tan φ, and is used multiplied by cos φ: regular at
resonance (φ = 0) and at ±90° alike.
"""

from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import AbstractResult, Variable, quantity
from snrmjax.numerics.status import Status

_CHUNK = 1 << 14  # members solved at a time on a CPU: they fit into its cache


class PointStatus(Status):
    """Outcome of one inversion."""

    OK = 0, "ok"
    TWO_ROOTS = 1, "two roots: the residual response exceeds the measured one"
    NEGATIVE_DAMPING = 2, "negative damping: phase beyond 90° of resonance"
    NO_ROOT = 3, "no root: amplitude and phase contradict the residual modes"
    NO_REAL_FREQUENCY = 4, "no real natural frequency"
    ZERO_FORCE = 5, "zero force or participation"
    NOT_FINITE = 6, "measurement is zero or not finite"
    NOT_CONVERGED = 7, "Newton's method did not converge"


_TOO_LARGE = (
    "Where all states have it, the force or the other modes' participations are too large for the "
    "motion: is the force in newtons, and the velocity in m/s?"
)
_USUAL_CAUSE: dict[PointStatus, str] = {
    PointStatus.NEGATIVE_DAMPING: (
        "Where all states have it, `participation`, the shape at the sensor, the sensor or the "
        "force has the wrong sign, or the phases are not those of a velocity relative to the force"
    ),
    PointStatus.TWO_ROOTS: _TOO_LARGE,
    PointStatus.NO_ROOT: _TOO_LARGE,
    PointStatus.NO_REAL_FREQUENCY: _TOO_LARGE,
}


def reasons_in_words(status: Int[np.ndarray | Array, " state"]) -> str:
    """Why states have no point, the most frequent reason first with its usual cause."""
    kinds, counts = np.unique(np.asarray(status), return_counts=True)
    order = [k for k in np.argsort(-counts, kind="stable") if kinds[k] != PointStatus.OK]
    reasons = [(PointStatus(int(kinds[k])), int(counts[k])) for k in order]
    listed = "; ".join(f"{count} have {kind.message}" for kind, count in reasons)
    causes = [_USUAL_CAUSE[kind] for kind, _ in reasons[:1] if kind in _USUAL_CAUSE]
    return ". ".join([listed, *causes])


class SnrmPoints(AbstractResult):
    """ω̃ and ζ̃ of a batch of steady states; NaN where the inversion failed (see `status`).

    `alternative_…` is the second root that amplitude and phase alone would allow, NaN where there
    is none.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("member",)

    natural_frequency: Float[Array, "*batch"] = quantity("member", "Hz", "natural frequency")
    damping_ratio: Float[Array, "*batch"] = quantity("member", "1", "damping ratio")
    alternative_natural_frequency: Float[Array, "*batch"] = quantity("member", "Hz", "other root")
    alternative_damping_ratio: Float[Array, "*batch"] = quantity("member", "1", "other root")
    status: Int[Array, "*batch"] = quantity("member", "", "outcome", of=PointStatus)

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, the batch in one row."""
        number = np.arange(np.size(self.status))
        rows = super().variables().items()
        return {
            "member": Variable(("member",), number, "1", "member of the batch"),
            **{name: row._replace(values=np.ravel(row.values)) for name, row in rows},
        }


def closed_form(
    modal_constant: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
    mode_velocity: Complex[Array, "*batch"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """ω̃ and ζ̃ from the velocity phasor V of the nonlinear mode alone, in closed form.

    c = iΩA/V = ω̃² − Ω² + 2iζ̃ω̃Ω, so ω̃² = Ω² + Re c and ζ̃ = Im c/(2ω̃Ω).

    Arguments: `modal_constant` A = Φ_r Φᵀb F in m/s², `frequency` Ω in rad/s, `mode_velocity` in
    m/s relative to the force. Returns rad/s and a ratio; NaN where ω̃² is not positive.
    Differentiable; a member without a solution does not affect the derivatives of the others.
    It starts and checks the Newton solve. Reference: Kwarta & Allen, Eq. (18).

    >>> omega, zeta = closed_form(jnp.array(6.0), jnp.array(500.0), jnp.array(0.6 + 0.0j))
    >>> float(omega), float(zeta)
    (500.0, 0.01)
    """
    given = jnp.asarray(modal_constant), jnp.asarray(frequency)
    return _from_polar(*given, _length(mode_velocity), *_direction(mode_velocity))


def invert_phasor(
    modal_constant: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
    velocity: Complex[Array, "*batch"],
    residual_velocity: Complex[Array, "*batch"],
) -> SnrmPoints:
    """ω̃ and ζ̃ of steady states measured in amplitude and phase at one sensor.

    Solves Eqs. (12) and (17) for every member by Newton's method (optimistix, vmapped), started
    from the closed form, in (ω̃² − Ω²)/Ω² and 2ζ̃ω̃/Ω. The phase of the nonlinear mode is that of
    V − V_lin − V_RB; the amplitude of this difference selects one of two roots, and
    the other one, which amplitude |V| and phase alone would also allow, is reported in
    `alternative_…`.

    Arguments: `modal_constant` A = Φ_r Φᵀb F in m/s²; `frequency` Ω in rad/s; `velocity` V and
    `residual_velocity` V_lin + V_RB in m/s, phasors relative to the force.
    Returns `SnrmPoints`. Differentiable in forward and reverse mode (by the implicit function
    theorem); a member without a solution does not affect the derivatives of the others.
    Reference: Kwarta & Allen, Eqs. (12), (17), (18).
    """
    given = (modal_constant, frequency, velocity, residual_velocity)
    return _invert_phasor(*map(jnp.asarray, given))


@compiled
def _invert_phasor(
    modal_constant: Array, frequency: Array, velocity: Array, residual: Array
) -> SnrmPoints:
    of_mode = velocity - residual
    measured = (modal_constant, frequency, _length(velocity), *_direction(of_mode), residual)
    return _invert(_Member(*measured, _length(of_mode)))


def invert_amplitude_phase(
    modal_constant: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
    amplitude: Float[Array, "*batch"],
    mode_phase: Float[Array, "*batch"],
    residual_velocity: Complex[Array, "*batch"],
) -> SnrmPoints:
    """ω̃ and ζ̃ from the paper's triple: amplitude v, frequency Ω, phase of the nonlinear mode.

    As `invert_phasor`, but |V_nl| is unknown: |r e^{iφ} + V_lin + V_RB| = v is a quadratic in r.
    Where it has two positive roots, the larger response is returned with the status TWO_ROOTS
    and the smaller in `alternative_…`.

    Arguments: `amplitude` v = |V| in m/s, `mode_phase` φ in rad relative to the force (0 at
    resonance; the paper's angle plus 90°). Others as `invert_phasor`. Differentiable as that is.
    Reference: Kwarta & Allen, Eqs. (12), (17), (18).

    >>> a = jnp.array
    >>> p = invert_amplitude_phase(a([6.0]), a([500.0]), a([0.6]), a([0.0]), a([0.0 + 0.0j]))
    >>> p.natural_frequency, p.damping_ratio
    (Array([500.], dtype=float64), Array([0.01], dtype=float64))
    """
    magnitude, phase = jnp.asarray(amplitude), jnp.asarray(mode_phase)
    constant, omega, residual = map(jnp.asarray, (modal_constant, frequency, residual_velocity))
    unknown = jnp.full(magnitude.shape, jnp.nan)
    direction = jnp.cos(phase), jnp.sin(phase)
    return _invert(_Member(constant, omega, magnitude, *direction, residual, unknown))


class _Member(NamedTuple):
    """Known quantities of one steady state, or of a batch."""

    constant: Array  # m/s²
    frequency: Array
    amplitude: Array  # of the whole velocity
    cosine: Array  # of the phase of the mode's own velocity
    sine: Array
    residual: Array  # m/s
    length: Array  # of the mode's own velocity; NaN where it is not measured


# Placeholder for members that cannot be solved; their results are masked afterwards.
_PLACEHOLDER = (1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0)


def _masked(members: _Member, selected: Array) -> _Member:
    """The selected members, and placeholders for the others."""
    pairs = zip(members, _PLACEHOLDER, strict=True)
    return _Member(*(jnp.where(selected, value, safe) for value, safe in pairs))


def _direction(phasor: Complex[Array, "*batch"]) -> tuple[Array, Array]:
    """Cosine and sine of the phase, without the rounding of an arctangent; NaN where undefined."""
    phasor = jnp.asarray(phasor)
    known = _is_known(phasor)
    safe = jnp.where(known, phasor, 1.0)
    length = jnp.abs(safe)
    return jnp.where(known, safe.real / length, jnp.nan), jnp.where(
        known, safe.imag / length, jnp.nan
    )


def _length(phasor: Complex[Array, "*batch"]) -> Float[Array, "*batch"]:
    """|phasor|, without derivatives where it is zero or not finite."""
    phasor = jnp.asarray(phasor)
    known = _is_known(phasor)
    plain = jax.lax.stop_gradient(jnp.abs(phasor))
    return jnp.where(known, jnp.abs(jnp.where(known, phasor, 1.0)), plain)


def _is_known(phasor: Complex[Array, "*batch"]) -> Bool[Array, "*batch"]:
    return jnp.isfinite(phasor) & (phasor != 0)


def _from_polar(
    modal_constant: Array, frequency: Array, length: Array, cosine: Array, sine: Array
) -> tuple[Array, Array]:
    moving = (length > 0) & jnp.isfinite(length)
    ratio = jnp.where(moving, frequency * modal_constant / jnp.where(moving, length, 1.0), jnp.nan)
    squared = frequency**2 + ratio * sine
    real = squared > 0
    natural_frequency = jnp.sqrt(jnp.where(real, squared, 1.0))
    damping_ratio = ratio * cosine / (2 * natural_frequency * frequency)
    return (
        jnp.where(real, natural_frequency, jnp.nan),
        jnp.where(real, damping_ratio, jnp.nan),
    )


def _equations(unknowns: Array, args: tuple) -> Array:
    """Eq. (17) times cos φ, and Eq. (12) squared, both scaled so that no term exceeds one."""
    real, imag = unknowns
    cosine, sine, constant, w_real, w_imag, amplitude = args
    phase = real * cosine - imag * sine
    # |iA/(ΩD) + W| = v with D = (real + i imag), times |D|².
    top_real = w_real * real - w_imag * imag
    top_imag = constant + w_real * imag + w_imag * real
    balance = top_real**2 + top_imag**2 - amplitude**2 * (real * real + imag * imag)
    return jnp.stack([phase, balance])


def _newton(member: _Member) -> tuple[Array, Array, Array]:
    """One member: the Newton solve from the closed form at |V_nl| = `length`."""
    # Imported here so that a program cached on disk runs without importing its solver; the import
    # itself must not be traced.
    with jax.ensure_compile_time_eval():
        from snrmjax.identify.pointwise.two_equations import root_of_two

    modal_constant, frequency, amplitude, cosine, sine, residual, length = member
    # The unknown is D = scale·((x² − 1) + 2iζ̃x), x = ω̃/Ω, with |D| = 1 at the closed form: x
    # itself would lose a lightly damped resonance to rounding of Ω.
    # Scale factors only: no derivative goes through them.
    fixed = jax.lax.stop_gradient
    start = fixed(jnp.sign(modal_constant) * jnp.stack([sine, cosine]))
    unit = fixed(1.0 / (length + jnp.abs(residual)))
    scale = fixed(jnp.abs(frequency * length / modal_constant))
    args = (
        cosine,
        sine,
        modal_constant * unit * scale / frequency,
        residual.real * unit,
        residual.imag * unit,
        amplitude * unit,
    )
    value, good = root_of_two(_equations, start, args)
    squared = 1.0 + value[0] / scale
    real = squared > 0
    # NaN only at the end: inside it would pass every `where` in reverse mode.
    x = jnp.sqrt(jnp.where(real, squared, 1.0))
    natural = jnp.where(real, x * frequency, jnp.nan)
    damping = jnp.where(real, value[1] / (2.0 * scale * x), jnp.nan)
    return natural, damping, good


@compiled
def _invert(members: _Member) -> SnrmPoints:
    shape = jnp.broadcast_shapes(*(jnp.shape(a) for a in members))
    flat = jax.tree.map(lambda a: jnp.broadcast_to(a, shape).reshape(-1), members)
    n = flat.constant.shape[0]
    if n <= _CHUNK or jax.default_backend() != "cpu":
        return jax.tree.map(lambda a: a.reshape(shape), _invert_flat(flat))
    # In chunks: a member that needs more steps delays only its own chunk.
    padded = jax.tree.map(lambda a: jnp.pad(a, (0, -n % _CHUNK)).reshape(-1, _CHUNK), flat)
    answers = jax.lax.map(_invert_flat, padded)
    return jax.tree.map(lambda a: a.reshape(-1)[:n].reshape(shape), answers)


def _invert_flat(members: _Member) -> SnrmPoints:
    known = jnp.isfinite(members.length)
    finite = (
        jnp.isfinite(members.constant)
        & jnp.isfinite(members.frequency)
        & jnp.isfinite(members.amplitude)
        & jnp.isfinite(members.cosine + members.sine)
        & jnp.isfinite(jnp.abs(members.residual))
        & (members.amplitude > 0)
        & (members.frequency > 0)
    )
    # Non-finite values are kept out of every step: in a derivative `where` does not stop a NaN.
    members = members._replace(length=jnp.where(known, members.length, 1.0))
    members = _masked(members, finite)
    known_length, amplitude, residual = members.length, members.amplitude, members.residual
    # r² + 2br + d = 0 with b = Re(e^{−iφ} W), d = |W|² − v²; the root far from zero first.
    half = members.cosine * residual.real + members.sine * residual.imag
    product = (jnp.abs(residual) - amplitude) * (jnp.abs(residual) + amplitude)
    discriminant = half * half - product
    several = discriminant > 0
    root = jnp.where(several, jnp.sqrt(jnp.where(several, discriminant, 1.0)), 0.0)
    far = -(half + jnp.copysign(root, half))
    near = jnp.where(far == 0, jnp.nan, product / jnp.where(far == 0, 1.0, far))
    larger, smaller = jnp.fmax(far, near), jnp.fmin(far, near)
    # With the phasor measured, r is known and the other root follows from the sum −2b.
    length = jnp.where(known, known_length, larger)
    other = jnp.where(known, -2.0 * half - known_length, smaller)
    has_root = known | ((discriminant >= 0) & (length > 0))
    has_other = (other > 0) & (jnp.abs(other - length) > 1e-12 * length)

    forced = members.constant != 0
    solvable = finite & forced & has_root

    def solve(r: Array, selected: Array) -> tuple[Array, Array, Array, Array]:
        own = _masked(members._replace(length=r), selected)
        squared = own.frequency**2 + own.frequency * own.constant / own.length * own.sine
        real = squared > 0
        natural, damping, good = jax.vmap(_newton)(own)
        answer = selected & real & good
        nan = jnp.nan
        return jnp.where(answer, natural, nan), jnp.where(answer, damping, nan), real, good

    natural, damping, real, good = solve(length, solvable)

    def no_alternative(_: None) -> tuple[Array, Array]:
        return jnp.full_like(natural, jnp.nan), jnp.full_like(natural, jnp.nan)

    def alternative(_: None) -> tuple[Array, Array]:
        return solve(other, solvable & has_other)[:2]

    other_natural, other_damping = jax.lax.cond(
        jnp.any(solvable & has_other), alternative, no_alternative, None
    )
    ambiguous = ~known & has_other & jnp.isfinite(other_natural)
    status = jnp.select(
        [~finite, ~forced, ~has_root, ~real, ~good, damping < 0, ambiguous],
        [
            int(PointStatus.NOT_FINITE),
            int(PointStatus.ZERO_FORCE),
            int(PointStatus.NO_ROOT),
            int(PointStatus.NO_REAL_FREQUENCY),
            int(PointStatus.NOT_CONVERGED),
            int(PointStatus.NEGATIVE_DAMPING),
            int(PointStatus.TWO_ROOTS),
        ],
        int(PointStatus.OK),
    )
    return SnrmPoints(natural, damping, other_natural, other_damping, status)
