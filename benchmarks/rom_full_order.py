"""Where a condensed model ends to hold: its normal mode against that of all finite elements.

The full model (20 elements, 57 degrees of freedom) is balanced in its own coordinates:
M ü + f(u) = 0 for u = Σ a_h cos hΩt, h = 0…H, with f the elements' internal force at samples of
the period (alternating frequency-time), for given fundamental q₁ of the first mode. It shares the
elements with the condensation, but neither modes, potential nor solver. Each answer is integrated
over one period from rest by Newmark's rule: `period_error` is how far it is from where it began,
over the amplitude (the rule's own error included). The reduced model's mode is
`nonlinear_normal_mode`. Amplitudes: fundamental at midspan over the thickness.
One JSON line a case.

The curved beam's reduced mode leaves its backbone for an internal resonance at 0.87 thicknesses:
no frequency is compared beyond.

    python benchmarks/rom_full_order.py [--out FOLDER]
"""

import argparse
import json
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import snrmjax as sj
from snrmjax.condense.elements.strain_energy import (
    internal_force,
    mass_matrix,
    shape_rows,
    tangent_stiffness,
)

_ORDER, _SAMPLES, _PERIOD_STEPS = 9, 40, 1200
_GAP = 0.15  # thicknesses between points of a curve: there an internal resonance was left out
_FLAT = (
    sj.condense.Beam(0.2286, 0.0127, 0.787e-3, young=204.8e9, density=7870.0, elements=20),
    (0.1, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5),
)
_CURVED = (
    sj.condense.Beam(
        *(0.3048, 0.0127, 0.508e-3),
        rise=sj.condense.rise_of_radius(0.3048, 11.43),
        young=204e9,
        density=7860.0,
        elements=20,
    ),
    (0.1, 0.25, 0.5, 0.75, 0.8, 0.85, 0.9),
)
_CASES = {
    "flat": (*_FLAT, ((1,), (1, 3), (1, 3, 5, 7))),
    "curved": (*_CURVED, ((1,), (1, 3), (1, 3, 5))),
}


@eqx.filter_jit
def balanced(beam, basis, start, frequency, amplitude):
    """Newton's method on all harmonics and the frequency, for a fundamental q₁ = amplitude."""
    free = beam.free
    mass = mass_matrix(beam)[free[:, None], free]
    row = basis.filter[0, free]
    phase = 2 * jnp.pi * jnp.arange(_SAMPLES) / _SAMPLES
    orders = jnp.arange(_ORDER + 1)
    wave = jnp.cos(orders[:, None] * phase)  # (harmonic, sample)
    weight = jnp.where(orders == 0, 1.0, 2.0)[:, None] * wave / _SAMPLES
    n = free.size

    def whole(u):
        return jnp.zeros(beam.n_dof).at[free].set(u)

    def step(_, carry):
        a, omega, _ = carry
        u = wave.T @ a
        force = jax.vmap(lambda one: internal_force(beam, whole(one))[free])(u)
        tangent = jax.vmap(lambda one: tangent_stiffness(beam, whole(one))[free[:, None], free])(u)
        inertia = (orders * omega) ** 2
        residual = weight @ force - inertia[:, None] * (a @ mass)
        jacobian = jnp.einsum("hs,gs,sij->higj", weight, wave, tangent)
        jacobian -= jnp.einsum("hg,ij->higj", jnp.diag(inertia), mass)
        size = n * (_ORDER + 1)
        by_omega = (-2 * omega * orders[:, None] ** 2 * (a @ mass)).reshape(size, 1)
        last = jnp.zeros((_ORDER + 1, n)).at[1].set(row).reshape(1, size)
        top = jnp.concatenate([jacobian.reshape(size, size), by_omega], axis=1)
        matrix = jnp.concatenate([top, jnp.append(last, 0.0)[None]])
        right = jnp.append(residual.ravel(), row @ a[1] - amplitude)
        change = jnp.linalg.solve(matrix, right)
        new = a - change[:-1].reshape(a.shape)
        moved = jnp.max(jnp.abs(change[:-1])) / jnp.max(jnp.abs(new))
        return new, omega - change[-1], moved

    return jax.lax.fori_loop(0, 8, step, (start, frequency, jnp.inf))


@eqx.filter_jit
def after_a_period(beam, u, omega):
    """Displacement one period after rest at `u`, by Newmark's rule of constant acceleration."""
    free = beam.free
    mass = mass_matrix(beam)[free[:, None], free]
    dt = 2 * jnp.pi / omega / _PERIOD_STEPS

    def whole(u):
        return jnp.zeros(beam.n_dof).at[free].set(u)

    def force(u):
        return internal_force(beam, whole(u))[free]

    def step(carry, _):
        u, v, a = carry
        known = u + dt * v + 0.25 * dt**2 * a

        def newton(_, new):
            residual = mass @ (new - known) * 4 / dt**2 + force(new)
            tangent = tangent_stiffness(beam, whole(new))[free[:, None], free]
            return new - jnp.linalg.solve(tangent + 4 / dt**2 * mass, residual)

        new = jax.lax.fori_loop(0, 3, newton, known)
        later = (new - known) * 4 / dt**2
        return (new, v + 0.5 * dt * (a + later), later), None

    start = (u, jnp.zeros_like(u), -jnp.linalg.solve(mass, force(u)))
    return jax.lax.scan(step, start, None, length=_PERIOD_STEPS)[0][0]


def full_backbone(beam, thicknesses):
    """Midspan fundamental (m), frequency (rad/s) and error over a period, at amplitudes of q₁."""
    basis = sj.condense.beam_modes(beam, (1,))
    free, middle = beam.free, shape_rows(beam, 0.5)[1]
    shape = float(sj.condense.shape_at(beam, basis, 0.5)[0])
    a = jnp.zeros((_ORDER + 1, free.size))
    omega, last, rows = basis.frequency[0], 0.0, []
    targets = np.asarray(thicknesses) * float(beam.thickness) / shape
    fine = np.unique(np.concatenate([targets, np.linspace(0, targets[-1], 25)[1:]]))
    for q in fine:
        a = a * q / last if last else a.at[1].set(q * basis.shapes[free, 0])
        a, omega, moved = balanced(beam, basis, a, omega, q)
        last = q
        if not moved < 1e-8:
            break
        if q in targets:
            u = a.sum(axis=0)
            error = jnp.linalg.norm(after_a_period(beam, u, omega) - u) / jnp.linalg.norm(a[1])
            at_middle = abs(float(middle[free] @ a[1]))
            rows.append((at_middle, float(omega), float(error)))
    return np.array(rows)


def reduced_backbone(beam, modes, highest, lowest):
    """Midspan fundamental (m) and frequency (rad/s) of the condensed model, its time and loads."""
    begin = time.perf_counter()
    basis = sj.condense.beam_modes(beam, modes)

    def solve(force):
        return sj.condense.static_cases(beam, basis, force)

    wanted = sj.condense.displacement_for_ratio(basis, solve, start=float(beam.thickness) / 4)
    found = sj.condense.condense(basis, solve(sj.condense.modal_loads(basis, wanted).force))
    seconds = time.perf_counter() - begin
    model = found.structure(
        0.01,
        sensors={"midspan": sj.condense.shape_at(beam, basis, 0.5)},
        participation=np.asarray(sj.condense.participation(beam, basis)),
    )
    first = float(basis.frequency[0])
    to = highest * 1.03 if highest > first else lowest * 0.9
    mode = sj.nonlinear_normal_mode(model, to, harmonic_order=9, tongues="skip")
    moved = np.abs(mode.velocity[:, 1, 0]) / mode.frequency
    return moved, mode.frequency, seconds


def on_backbone(moved, frequency, wanted):
    """Frequency at wanted amplitudes (thicknesses), and how far the curve goes without a gap.

    NaN beyond its largest amplitude and where points of an internal resonance were left out.
    """
    outwards = np.argsort(moved[: int(np.argmax(moved)) + 1])
    moved, frequency = moved[outwards], frequency[outwards]
    found = np.interp(wanted, moved, frequency, right=np.nan)
    after = np.clip(np.searchsorted(moved, wanted), 1, len(moved) - 1)
    gaps = np.flatnonzero(np.diff(moved) > _GAP)
    reach = moved[gaps[0]] if gaps.size else moved[-1]
    return np.where(moved[after] - moved[after - 1] > _GAP, np.nan, found), float(reach)


def main() -> None:
    """Both beams, with one mode and with more."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, help="folder for a figure")
    options = parser.parse_args()
    curves = {}
    for name, (beam, thicknesses, sets) in _CASES.items():
        full = full_backbone(beam, thicknesses)
        thickness = float(beam.thickness)
        curves[name] = {"all elements": (full[:, 0] / thickness, full[:, 1])}
        for modes in sets:
            reduced = reduced_backbone(beam, modes, full[:, 1].max(), full[:, 1].min())
            moved, frequency, seconds = reduced
            curves[name][f"modes {modes}"] = moved / thickness, frequency
            there, reach = on_backbone(moved / thickness, frequency, full[:, 0] / thickness)
            line = {
                "benchmark": "rom_full_order",
                "beam": name,
                "modes": modes,
                "amplitude_thicknesses": np.round(full[:, 0] / thickness, 3).tolist(),
                "full_hz": np.round(full[:, 1] / (2 * np.pi), 3).tolist(),
                "relative_frequency_error": [
                    None if np.isnan(e) else float(f"{e:.2g}") for e in there / full[:, 1] - 1
                ],
                "period_error": [float(f"{e:.2g}") for e in full[:, 2]],
                "reduced_reaches_thicknesses": round(reach, 3),
                "condensation_s": round(seconds, 2),
            }
            print(json.dumps(line), flush=True)
    if options.out:
        draw(curves, options.out)


def draw(curves, folder: Path) -> None:
    """Backbones of both beams, full and reduced."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(curves), figsize=(10, 4))
    for axis, (name, lines) in zip(axes, curves.items(), strict=True):
        for label, (moved, frequency) in lines.items():
            style = "ok" if label == "all elements" else "-"
            axis.plot(frequency / (2 * np.pi), moved, style, label=label)
        axis.set(title=name, xlabel="Frequency (Hz)", ylabel="Midspan amplitude (thicknesses)")
        axis.legend()
    figure.tight_layout()
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "rom_full_order.png", dpi=150)


if __name__ == "__main__":
    main()
