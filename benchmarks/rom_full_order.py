"""Where a condensed model ends to hold: its normal mode against that of all finite elements.

The full model (20 elements, 57 degrees of freedom) is balanced in its own coordinates by
`full_order.py` for u = Σ a_h cos hΩt, h = 0…9, without force and damping, for given fundamental q₁
of the first mode. Each answer is integrated over one period from rest by Newmark's rule:
`period_error` is how far it is from where it began, over the amplitude (the rule's own error
included). The reduced model's mode is `nonlinear_normal_mode`. Amplitudes: fundamental at midspan
over the thickness.
One JSON line a case.

The curved beam's reduced mode leaves its backbone for an internal resonance at 0.87 thicknesses:
no frequency is compared beyond.

    python benchmarks/rom_full_order.py [--out FOLDER]
"""

import argparse
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from full_order import (
    CURVED,
    FLAT,
    ORDER,
    Closing,
    balanced,
    condensed,
    cosines,
    integrated,
)

import snrmjax as sj
from snrmjax.condense.elements.strain_energy import shape_rows

_PERIOD_STEPS = 1200
_GAP = 0.15  # thicknesses between points of a curve: there an internal resonance was left out
_CASES = {
    "flat": (FLAT, (0.1, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5), ((1,), (1, 3), (1, 3, 5, 7))),
    "curved": (CURVED, (0.1, 0.25, 0.5, 0.75, 0.8, 0.85, 0.9), ((1,), (1, 3), (1, 3, 5))),
}


def full_backbone(beam, thicknesses):
    """Midspan fundamental (m), frequency (rad/s) and error over a period, at amplitudes of q₁."""
    basis = sj.condense.beam_modes(beam, (1,))
    free, middle, waves = beam.free, shape_rows(beam, 0.5)[1], cosines()
    shape = float(sj.condense.shape_at(beam, basis, 0.5)[0])
    n = free.size
    undamped, unloaded = jnp.zeros((n, n)), jnp.zeros(n)
    row = jnp.zeros((ORDER + 1, n)).at[1].set(basis.filter[0, free])
    a = jnp.zeros((ORDER + 1, n))
    omega, last, rows = basis.frequency[0], 0.0, []
    targets = np.asarray(thicknesses) * float(beam.thickness) / shape
    fine = np.unique(np.concatenate([targets, np.linspace(0, targets[-1], 25)[1:]]))
    for q in fine:
        a = a * q / last if last else a.at[1].set(q * basis.shapes[free, 0])
        a, omega, moved = balanced(beam, undamped, unloaded, waves, (a, omega), Closing(row, q))
        last = q
        if not moved < 1e-8:
            break
        if q in targets:
            start = a.sum(axis=0), unloaded
            after = integrated(beam, undamped, unloaded, start, omega, _PERIOD_STEPS, 1)[-1]
            error = jnp.linalg.norm(after - start[0]) / jnp.linalg.norm(a[1])
            at_middle = abs(float(middle[free] @ a[1]))
            rows.append((at_middle, float(omega), float(error)))
    return np.array(rows)


def reduced_backbone(beam, modes, highest, lowest):
    """Midspan fundamental (m) and frequency (rad/s) of the condensed model, its time and loads."""
    model, seconds, _ = condensed(beam, modes, 0.01)
    first = float(model.modes.natural_frequency[0])
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
