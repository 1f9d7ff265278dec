"""One million inversions of the SNRM function: vmapped Newton against the closed form.

Run: python benchmarks/inversion_speed.py [number of measurements]

Random measurements, a residual linear part between 0 and 3 times the response, both signs of the
modal constant. One in ten is an edge case: a phase within 1e-9° of 0°, −90° or −180° in the paper's
reference, no force, NaN. Every answer is put back into Eqs. (12) and (17) of the paper, written
here in NumPy. One JSON line: sizes, seconds (median of 7, compilation apart), largest errors, and
for how many members value and status disagree.
"""

import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import snrmjax as sj
from snrmjax.identify.pointwise.inversion_result import SnrmPoints


def measurements(n: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random modes, frequencies, forces and residual parts, and the velocities they give."""
    rng = np.random.default_rng(seed)
    natural = 2 * np.pi * 10 ** rng.uniform(0, 3.5, n)
    damping = 10 ** rng.uniform(-4, -0.7, n)
    frequency = natural * (1 + rng.normal(size=n) * np.maximum(3 * damping, 0.02)).clip(0.5, 2)
    constant = rng.choice([-1.0, 1.0], n) * 10 ** rng.uniform(-3, 3, n)
    dynamic = natural**2 - frequency**2 + 2j * damping * natural * frequency
    mode = 1j * frequency * constant / dynamic
    size = np.abs(mode) * rng.choice([0.0, 0.01, 0.5, 3.0], n)
    residual = size * np.exp(2j * np.pi * rng.uniform(size=n))
    return {
        "natural": natural,
        "damping": damping,
        "frequency": frequency,
        "constant": constant,
        "mode": mode,
        "residual": residual,
    }


def with_edge_cases(sample: dict[str, np.ndarray], seed: int = 1) -> dict[str, np.ndarray]:
    """The same with every tenth member at an edge; `edge` marks them."""
    rng = np.random.default_rng(seed)
    sample = {name: values.copy() for name, values in sample.items()}
    n = len(sample["mode"])
    kind = np.where(np.arange(n) % 10 == 0, rng.integers(0, 5, n), -1)
    for number, degrees in enumerate((90.0, 0.0, -90.0)):  # the paper's 0°, −90°, −180°
        here = kind == number
        angle = np.radians(degrees + rng.uniform(-1e-9, 1e-9, here.sum()))
        turn = np.exp(1j * angle) * np.sign(sample["constant"][here])
        sample["mode"][here] = np.abs(sample["mode"][here]) * turn
    sample["constant"][kind == 3] = 0.0
    sample["mode"][kind == 4] = np.nan
    return sample | {"edge": kind >= 0}


def closed_form_with_roots(
    constant: jax.Array, frequency: jax.Array, amplitude: jax.Array, phase: jax.Array, w: jax.Array
) -> tuple[jax.Array, ...]:
    """What the Newton solve answers, both roots, by formula: the limit of its speed."""
    half = jnp.cos(phase) * w.real + jnp.sin(phase) * w.imag
    root = jnp.sqrt(half**2 - jnp.abs(w) ** 2 + amplitude**2)
    direction = jnp.exp(1j * phase)
    far = sj.identify.closed_form(constant, frequency, (-half + root) * direction)
    near = sj.identify.closed_form(constant, frequency, (-half - root) * direction)
    return (*far, *near)


def median_time(function, *args: jax.Array) -> float:
    """Median of seven runs after one that compiles."""
    jax.block_until_ready(function(*args))
    times = []
    for _ in range(7):
        begin = time.perf_counter()
        jax.block_until_ready(function(*args))
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def worst_residuals(points: SnrmPoints, sample: dict[str, np.ndarray]) -> tuple[float, float]:
    """Largest relative errors of Eq. (12) and of Eq. (17) among the answers, in NumPy."""
    good = np.isfinite(np.asarray(points.natural_frequency))
    omega, zeta = (np.asarray(p)[good] for p in (points.natural_frequency, points.damping_ratio))
    frequency, constant = sample["frequency"][good], sample["constant"][good]
    velocity = (sample["mode"] + sample["residual"])[good]
    own = velocity - sample["residual"][good]
    model = 1j * frequency * constant / (omega**2 - frequency**2 + 2j * zeta * omega * frequency)
    amplitude = np.abs(model + sample["residual"][good]) / np.abs(velocity) - 1
    # Eq. (17) with the paper's phase, ours − 90°: cot φ = −tan(ours) = −Im V / Re V.
    cotangent = -own.imag / own.real
    shifted = zeta * cotangent
    # −s + √(s² + 1) without the cancellation that a large positive s would bring.
    formula = np.where(
        shifted > 0, 1 / (shifted + np.hypot(shifted, 1)), np.hypot(shifted, 1) - shifted
    )
    return float(np.max(np.abs(amplitude))), float(np.max(np.abs(formula * frequency / omega - 1)))


def main() -> None:
    """Measure and print."""
    n = int(float(sys.argv[1])) if len(sys.argv) > 1 else 1_000_000
    sample = with_edge_cases(measurements(n))
    constant, frequency, residual, mode = (
        jnp.asarray(sample[k]) for k in ("constant", "frequency", "residual", "mode")
    )
    velocity, phase = mode + residual, jnp.angle(mode)
    phasor = (constant, frequency, velocity, residual)
    triple = (constant, frequency, jnp.abs(velocity), phase, residual)
    points = sj.identify.invert_phasor(*phasor)
    names, counts = np.unique(np.asarray(points.status), return_counts=True)
    amplitude, natural = worst_residuals(points, sample)
    solved = np.isfinite(points.natural_frequency) & np.isfinite(points.damping_ratio)
    answered = np.isin(
        points.status,
        [
            sj.identify.PointStatus.OK,
            sj.identify.PointStatus.TWO_ROOTS,
            sj.identify.PointStatus.NEGATIVE_DAMPING,
        ],
    )
    error = np.abs(np.asarray(points.natural_frequency) / sample["natural"] - 1)
    seconds = {
        "closed_form_triple_s": median_time(jax.jit(closed_form_with_roots), *triple),
        "newton_triple_s": median_time(sj.identify.invert_amplitude_phase, *triple),
        "newton_phasor_s": median_time(sj.identify.invert_phasor, *phasor),
        "closed_form_one_root_s": median_time(
            jax.jit(sj.identify.closed_form), constant, frequency, mode
        ),
    }
    print(
        json.dumps(
            {
                "benchmark": "inversion_speed",
                "measurements": n,
                "device": jax.devices()[0].device_kind,
                "status": {
                    sj.identify.PointStatus(int(k)).name: int(c)
                    for k, c in zip(names, counts, strict=True)
                },
                "worst_relative_error_eq12": amplitude,
                "worst_relative_error_eq17": natural,
                "status_and_value_disagree": int(np.sum(solved != answered)),
                "worst_frequency_error": float(np.nanmax(error[~sample["edge"]])),
                **{k: round(v, 4) for k, v in seconds.items()},
                "newton_over_closed_form": round(
                    seconds["newton_triple_s"] / seconds["closed_form_triple_s"], 2
                ),
            }
        )
    )


if __name__ == "__main__":
    main()
