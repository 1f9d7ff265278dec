"""Each method against its own source: data, claims or formulas that its authors published.

Run: python benchmarks/methods_sources.py [--pff FOLDER]
         [--only METHOD ...]

The folder is a copy of github.com/JustinPorter88/pff-analysis, whose program and data are used
where they lie (they are not part of this project). One JSON line a method, `kind` says what it was
held against:

- own_result: the authors' own numbers for the authors' own record (their Python program, run
  beside, and the stored result of their MATLAB program, which are also held against each other);
- own_claim: a figure that the source's text states, in the virtual laboratory;
- public_example: an example with numbers that others published for the method;
- independent_program: a program of others, run on the same data;
- own_formula: the source's formula, written out here a second time, on the same data;
- physics_only: no numbers of the source could be had; the method's central claim against harmonic
  balance, which it does not use.

What could not be had: the worked examples of Arslan, Aykan & Özgüven (2011), of Özer, Özgüven &
Royston (2009), of Karaağaçlı & Özgüven (2020, 2021) and of Carrella & Ewins (2011).
"""

import importlib.util
from pathlib import Path

import numpy as np
from contourpy import contour_generator
from harness import options, teller
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

import snrmjax as sj
from snrmjax.methods.one_sensor import sensor_states
from snrmjax.methods.steady.arslan_ozguven import describing_function

tell = teller(__file__)

METHODS = (
    *("resonant_decay", "pll", "cbc", "rct", "harmonic_force_surface"),
    *("concerto", "arslan_ozguven"),
)


def said(method: str, kind: str, source: str, **numbers: object) -> None:
    """One line."""
    tell(method=method, kind=kind, source=source, **numbers)


HERTZ = 2 * np.pi
REST, RATIO, MASS, CUBIC = 40 * HERTZ, 0.01, 0.8, 3e9  # cubic per modal mass, 1/(m² s²)


def duffing() -> sj.model.Structure:
    """An oscillator with a cubic spring."""
    shape = 1 / np.sqrt(MASS)
    modes = sj.model.linear_modes([REST], [RATIO], [[shape]], [shape])
    potential = sj.model.polynomial_potential({"1111": CUBIC * shape**2 / 4}, 1)
    return sj.model.structure(modes, potential)


def resonant_decay(folder: Path | None) -> None:
    """The authors' record of a bolted beam, band of their settings, against their result."""
    source = "Jin et al., J. Vib. Acoust. 142 (2020) 051111, doi:10.1115/1.4047416"
    if folder is None:
        said("resonant_decay", "own_result", source, not_run="--pff FOLDER is missing")
        return
    from scipy.io import loadmat

    beside = importlib.util.spec_from_file_location("pff", folder / "pff.py")
    pff = importlib.util.module_from_spec(beside)
    beside.loader.exec_module(pff)
    record = loadmat(folder / "data" / "Sample_LMS_Data.mat")
    stored = loadmat(folder / "data" / "Sample_LMS_Results.mat")
    time, signal = record["t"][:, 0], record["x"][:, 0]
    # Their settings: 153.9 Hz ± 10 Hz, from 0.05 s behind the largest sample to 2 s.
    start = time[np.argmax(signal)] + 0.05
    part = (time >= start) & (time <= 2.0)
    run = pff.pff_analysis(time, record["x"], 153.9, start, 2.0, 10 / 153.9, remove_end=20)
    laws = {
        "their_python": (np.abs(run[3][0]), run[0][0] / HERTZ, run[1][0]),
        "their_matlab": tuple(stored[name][:, 0] for name in ("Amp", "Freq", "Damp")),
    }
    largest = stored["Amp"].max()
    answers = {
        reading: _answer(
            sj.methods.resonant_decay(
                time[part], signal[part], reading=reading, band=(143.9, 163.9), window=8
            )
        )
        for reading in ("peaks", "zero_crossings", "hilbert")
    }
    for name, answer in {**answers, "their_python": laws["their_python"]}.items():
        numbers = {}
        for other, law in laws.items():
            if other == name:
                continue
            order = np.argsort(law[0])
            inside = (answer[0] < 0.4 * largest) & (answer[0] > 0.05 * largest)
            for quantity, k in (("frequency", 1), ("damping", 2)):
                expected = np.interp(answer[0][inside], law[0][order], law[k][order])
                off = np.abs(answer[k][inside] / expected - 1)
                numbers[f"{quantity}_from_{other}_median"] = float(np.median(off))
                numbers[f"{quantity}_from_{other}_90"] = float(np.percentile(off, 90))
        said("resonant_decay", "own_result", source, reading=name, **numbers)


def _answer(result) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Amplitude, frequency (Hz) and damping ratio where there is an answer."""
    good = result.has_result
    return (
        np.asarray(result.velocity)[good],
        np.asarray(result.natural_frequency)[good] / HERTZ,
        np.asarray(result.damping_ratio)[good],
    )


def phase_locked_loop() -> None:
    """A clamped beam, 20 % up from its linear frequency with gains of the linear regime."""
    model = sj.model.flat_beam()
    shaker = sj.simulate.Shaker(3.0, 0.005, mass=1e-7, damping=1e-7, stiffness=1e-3)
    laboratory = sj.simulate.Laboratory(
        model, shaker, sj.simulate.Instruments(velocity_noise=1e-4), 10000.0, substeps=4
    )
    voltages = np.linspace(0.5, 8.5, 15)
    found = sj.methods.phase_locked_loop(
        *(laboratory, voltages),
        gains=sj.simulate.LoopGains(100.0, 40.0),
        settle_cycles=70,
        record_cycles=30,
    )
    truth = sj.simulate.phase_controlled(model, 1.7e-2)
    speed = np.abs(truth.velocity[:, 1, 0])
    order = np.argsort(speed)
    good = found.has_result
    true = np.interp(found.velocity[good], speed[order], truth.frequency[order])
    omega = np.asarray(found.natural_frequency)[good]
    said(
        *("pll", "own_claim"),
        "Hippold et al., Mech. Syst. Signal Process. 220 (2024) 111670, arXiv:2403.06639: fixed "
        "gains of the linear regime, a shift of 20 %, about 100 periods a point",
        locked=int(good.sum()),
        of=len(voltages),
        periods_a_point=100,
        shift=float(omega.max() / float(model.modes.natural_frequency[0]) - 1),
        frequency_error_max=float(np.abs(omega / true - 1).max()),
    )


def continuation() -> None:
    """x'' + 0.1 x' + x + 0.04 x³ = cos ωt, tracked through its unstable branch."""
    modes = sj.model.linear_modes([1.0], [0.05], [[1.0]], [1.0])
    model = sj.model.structure(modes, sj.model.polynomial_potential({"1111": 0.01}, 1))
    shaker = sj.simulate.Shaker(1.0, 1e-3)
    laboratory = sj.simulate.Laboratory(model, shaker, sj.simulate.Instruments(), 40.0)
    settings = sj.simulate.FeedbackSettings(1500.0)
    errors, exact, falling = [], [], 0
    for omega in (1.3, 1.5, 1.7):
        curve = sj.simulate.s_curve(laboratory, omega, omega * np.linspace(0.5, 7.5, 15), settings)
        held = np.isfinite(curve.force)
        size = curve.velocity[held] / omega
        needed = size * np.hypot(1 + 0.03 * size**2 - omega**2, 0.1 * omega)
        errors += list(np.abs(curve.force[held] - needed) / needed.max())
        falling += int(np.sum(np.diff(curve.force[held]) < 0))
        for speed, force in zip(curve.velocity[held], curve.force[held], strict=True):
            law = sj.simulate.response_controlled(model, speed, 0.9 * omega, 1.1 * omega)
            true = np.interp(omega, law.frequency, np.abs(law.force))
            exact.append(abs(force - true) / needed.max())
    said(
        *("cbc", "public_example"),
        "a public script of control-based continuation: forced Duffing equation with α = γ = 1, "
        "β = 0.04, δ = 0.1 and its one-term amplitudes; method of Sieber & Krauskopf 2008",
        points=len(errors),
        on_falling_force=falling,
        force_from_one_term_median=float(np.median(errors)),
        force_from_one_term_max=float(np.max(errors)),
        force_from_nine_harmonics_max=float(np.max(exact)),
    )


def held_displacements(model, sizes, frequencies=None):
    """Response-controlled stepped sines by inverse harmonic balance, one level a displacement."""
    tables = []
    for level, size in enumerate(sizes, 1):
        middle = np.sqrt(REST**2 + 0.75 * CUBIC * size**2)
        omega = middle * np.linspace(0.975, 1.025, 13) if frequencies is None else frequencies
        asked = sj.measure.steady_states(
            np.full(len(omega), level), omega, np.ones(len(omega)), omega * size + 0j
        )
        force = np.asarray(sj.identify.inverse_force(model, asked).force)
        velocity = omega * size * np.conj(force) / np.abs(force)
        tables.append(
            sj.measure.steady_states(np.full(len(omega), level), omega, np.abs(force), velocity)
        )
    return sj.measure.join_steady_states(tables)


def response_controlled() -> None:
    """Modal analysis of held levels: the line of inverse receptance beside a circle fit."""
    model, sizes = duffing(), np.array([4e-4, 8e-4, 1.2e-3, 1.6e-3])
    data = held_displacements(model, sizes)
    found = sj.methods.rct(data, model.modes)
    good = found.has_result
    size = np.asarray(found.velocity)[good] / np.asarray(found.natural_frequency)[good]
    true = np.sqrt(REST**2 + 0.75 * CUBIC * size**2)
    ratios = np.array([_circle(data, level) for level in np.asarray(found.level)[good]])
    ours = np.asarray(found.damping_ratio)[good]
    said(
        *("rct", "own_formula"),
        "Karaağaçlı & Özgüven, Vibration 3 (2020) 266, doi:10.3390/vibration3030019; circle fit of "
        "Maia & Silva (1997), which NLtest uses for such tests, written out here",
        levels=int(good.sum()),
        frequency_error_max=float(
            np.abs(np.asarray(found.natural_frequency)[good] / true - 1).max()
        ),
        damping_error_max=float(np.abs(ours * true / (RATIO * REST) - 1).max()),
        circle_damping_error_max=float(np.abs(ratios * true / (RATIO * REST) - 1).max()),
        damping_difference_max=float(np.abs(ours / ratios - 1).max()),
    )


def harmonic_force_surface() -> None:
    """The surface of held levels cut at one force, against the response of that force."""
    model, force = duffing(), 1.5
    frequencies = HERTZ * np.linspace(39.4, 42.2, 29)
    data = held_displacements(model, np.linspace(2e-4, 1.6e-3, 9), frequencies)
    surface = sj.methods.force_surface(data, model.modes)
    omega, cut = surface.cut(force)
    (exact,) = sj.forced_response(model, [force], 38 * HERTZ, 43 * HERTZ)
    height = np.abs(exact.velocity[:, 1, 0]) / exact.frequency
    # The exact curve at each point's frequency: the branch that is nearest.
    distance, unstable = [], 0
    for at, one in zip(omega, cut, strict=True):
        k = np.flatnonzero((exact.frequency[:-1] - at) * (exact.frequency[1:] - at) <= 0)
        fraction = (at - exact.frequency[k]) / (exact.frequency[k + 1] - exact.frequency[k])
        each = height[k] + fraction * (height[k + 1] - height[k])
        nearest = int(np.argmin(np.abs(each - one)))
        distance.append(abs(each[nearest] - one) / height.max())
        unstable += bool(exact.is_unstable[k[nearest]])
    said(
        *("harmonic_force_surface", "physics_only"),
        "Karaağaçlı & Özgüven, Vibration 3 (2020) 266: unstable branches are ordinary points of "
        "the surface (no table of their structures was found)",
        points=len(cut),
        on_unstable_branch=unstable,
        amplitude_error_median=float(np.median(distance)),
        amplitude_error_max=float(np.max(distance)),
    )
    # Frequencies in half-power widths, amplitudes in that of the peak: distances from the line.
    unit = np.array([2 * RATIO * REST, height.max()])
    drawn = contour_generator(surface.frequency, surface.amplitude, np.abs(surface.force))
    lines = [one / unit for one in drawn.lines(force)]
    apart = [min(_distance(at, line) for line in lines) for at in np.stack([omega, cut], 1) / unit]
    said(
        *("harmonic_force_surface", "independent_program"),
        "ContourPy: contour lines of the sizes of the forces, on the same levels; distances in "
        "half-power widths and peak heights",
        points=len(cut),
        distance_median=float(np.median(apart)),
        distance_max=float(np.max(apart)),
        peak_from_exact=float(cut.max() / height.max() - 1),
        their_peak_from_exact=float(max(one[:, 1].max() for one in lines) - 1),
    )


def _distance(point: np.ndarray, line: np.ndarray) -> float:
    """From a point to a line of straight pieces."""
    start, along = line[:-1], np.diff(line, axis=0)
    fraction = np.sum((point - start) * along, axis=1) / np.sum(along**2, axis=1)
    nearest = start + np.clip(fraction, 0, 1)[:, None] * along
    return float(np.hypot(*(nearest - point).T).min())


def _circle(data, level: int) -> float:
    """Damping ratio of a level by the angles of a fitted circle, hysteretic as in the source."""
    rows = np.flatnonzero(np.asarray(data.level) == level)
    omega = np.asarray(data.frequency)[rows]
    velocity = np.asarray(data.velocity)[rows, 0]
    receptance = velocity / (1j * omega) / np.asarray(data.force)[rows]
    x, y = receptance.real, receptance.imag
    scale = np.abs(receptance).max()
    design = np.stack([x, y, np.full_like(x, scale)], axis=1) / scale
    solved = np.linalg.lstsq(design, -(x**2 + y**2) / scale**2, rcond=None)[0] * scale
    turned = receptance + (solved[0] + 1j * solved[1]) / 2
    angle = np.unwrap(np.angle(turned)) + np.pi / 2  # zero at resonance, falling
    natural = np.interp(0.0, -angle, omega)
    above, below = omega > natural, omega < natural
    each = [
        (a**2 - b**2) / (2 * natural**2) / (np.tan(abs(p) / 2) + np.tan(abs(q) / 2))
        for a, p in zip(omega[above], angle[above], strict=True)
        for b, q in zip(omega[below], angle[below], strict=True)
    ]
    return float(np.median(each))


def concerto() -> None:
    """Real formulas of the source for pairs of equal amplitude, on a whole exact response."""
    model = duffing()
    test = sj.phase_resonance_test(
        *(model, [1.5], 37 * HERTZ, 44 * HERTZ), appropriation=(0.05, 1.0), points_per_level=24
    )
    data = test.steady_states
    found = sj.methods.concerto(data, model.modes)
    good = found.has_result
    size = np.asarray(found.velocity)[good] / np.asarray(found.natural_frequency)[good]
    omega = np.asarray(data.frequency)
    alpha = np.asarray(data.velocity)[:, 0] / (1j * omega) / np.asarray(data.force)
    high = np.abs(alpha) * np.asarray(data.force)
    lead = np.angle(np.asarray(data.velocity)[:, 0]) >= 0
    theirs = []
    for one in size:
        pair = []
        for rows in (np.flatnonzero(lead), np.flatnonzero(~lead)):
            rows = rows[np.argsort(high[rows])]
            pair.append(
                (
                    np.interp(one, high[rows], omega[rows] ** 2),
                    np.interp(one, high[rows], alpha[rows].real),
                    np.interp(one, high[rows], alpha[rows].imag),
                )
            )
        (w1, r1, i1), (w2, r2, i2) = pair
        bottom = (r2 - r1) ** 2 + (i2 - i1) ** 2
        square = ((r2 - r1) * (r2 * w2 - r1 * w1) + (i2 - i1) * (i2 * w2 - i1 * w1)) / bottom
        lost = ((r2 - r1) * (i2 * w2 - i1 * w1) - (i2 - i1) * (r2 * w2 - r1 * w1)) / bottom
        theirs.append((np.sqrt(square), lost / square / 2))
    theirs = np.array(theirs)
    true = np.sqrt(REST**2 + 0.75 * CUBIC * size**2)
    ours = np.asarray(found.natural_frequency)[good], np.asarray(found.damping_ratio)[good]
    said(
        *("concerto", "own_formula"),
        "Carrella & Ewins, Mech. Syst. Signal Process. 25 (2011) 1011, "
        "doi:10.1016/j.ymssp.2010.09.011: their real formulas, written out here (their example's "
        "numbers were not found)",
        points=int(good.sum()),
        frequency_difference_max=float(np.abs(ours[0] / theirs[:, 0] - 1).max()),
        damping_difference_max=float(np.abs(ours[1] / theirs[:, 1] - 1).max()),
        frequency_error_median=float(np.median(np.abs(ours[0] / true - 1))),
        damping_error_median=float(np.median(np.abs(ours[1] * true / (RATIO * REST) - 1))),
    )


def spring_in_a_chain() -> None:
    """Four masses with a cubic spring from the last to the ground, by time integration.

    The source's step is written out in matrices: N = F − Z X from the motion of all masses, where
    snrmjax has modes and one sensor; and the mode from the matrices with N/X added. What the
    coefficient is off is the describing function's own: it has no third harmonic, here near the
    second mode.
    """
    count, tip, cubic = 4, 3, 2e9  # N/m³
    stiffness = 1e6 * (2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1))
    stiffness[tip, tip] = 1e6
    mass = np.diag([1.0, 1.2, 0.9, 1.1])
    squares, shapes = eigh(stiffness, mass)
    ratios = np.array([0.02, 0.015, 0.01, 0.01])
    damping = mass @ shapes @ np.diag(2 * ratios * np.sqrt(squares)) @ shapes.T @ mass
    states = [
        (level, omega, force, _steady_motion(stiffness, damping, mass, cubic, force, omega))
        for level, force in ((1, 60.0), (2, 120.0))
        for omega in np.sqrt(squares[0]) * np.array([0.93, 0.98, 1.02, 1.06, 1.12])
    ]
    level, omega, force, motion = (np.array(one) for one in zip(*states, strict=True))
    names = tuple(f"mass {k + 1}" for k in range(count))
    modes = sj.model.linear_modes(np.sqrt(squares), ratios, shapes, shapes[0], sensors=names)
    data = sj.measure.steady_states(
        *(level, omega, force, 1j * omega[:, None] * motion), sensors=names
    )
    v = describing_function(sensor_states(data, modes), modes)
    theirs, elsewhere, mode = [], [], []
    end = np.eye(count)[tip]
    for at, push, moved in zip(omega, force, motion, strict=True):
        dynamic = stiffness - at**2 * mass + 1j * at * damping
        pull = push * np.eye(count)[0] - dynamic @ moved
        theirs.append(pull[tip] / moved[tip])
        elsewhere.append(np.abs(pull[:tip]).max() / np.abs(pull[tip]))
        added = stiffness + theirs[-1].real * np.outer(end, end)
        found, shape = (one[..., 0] for one in eigh(added, mass))
        loss = shape @ damping @ shape + theirs[-1].imag / at * shape[tip] ** 2
        mode.append((np.sqrt(found), loss / (2 * np.sqrt(found))))
    theirs, mode, size = np.array(theirs), np.array(mode), np.abs(motion[:, tip])
    mode = mode[np.argsort(mode[:, 0] * size)]  # as snrmjax's answers: by velocity
    result = sj.methods.arslan_ozguven(data, modes)
    ours = np.stack([result.natural_frequency, result.damping_ratio], axis=1)
    apart = np.abs(ours / mode - 1).max(axis=0)
    fitted = [float(np.sum(one.real * size**2) / np.sum(0.75 * size**4)) for one in (v, theirs)]
    said(
        *("arslan_ozguven", "own_formula"),
        "Arslan, Aykan & Özgüven, Mech. Syst. Signal Process. 25 (2011) 1112, "
        "doi:10.1016/j.ymssp.2010.10.010: nonlinearity matrix and describing function, written out "
        "here in matrices (their examples' numbers were not found)",
        states=int(np.sum(result.has_result)),
        of=len(omega),
        largest_shift=float(mode[:, 0].max() / np.sqrt(squares[0]) - 1),
        describing_function_difference_max=float(np.abs(v - theirs).max() / np.abs(theirs).max()),
        frequency_difference_max=float(apart[0]),
        damping_difference_max=float(apart[1]),
        force_elsewhere_max=float(np.max(elsewhere)),
        cubic_coefficient_error=fitted[0] / cubic - 1,
        cubic_coefficient_error_in_matrices=fitted[1] / cubic - 1,
    )


def _steady_motion(stiffness, damping, mass, cubic, force, omega) -> np.ndarray:
    """Fundamental of the displacements under a force cos ωt on the first mass."""
    count = len(mass)
    inverse = np.linalg.inv(mass)

    def rate(at, state):
        q, v = state[:count], state[count:]
        pull = stiffness @ q + damping @ v
        pull[-1] += cubic * q[-1] ** 3
        pull[0] -= force * np.cos(omega * at)
        return np.concatenate([v, -inverse @ pull])

    at = 2 * np.pi / omega * (120 + np.arange(64) / 64)  # at 2 % damping 3e-7 of the start is left
    found = solve_ivp(
        rate, (0, at[-1]), np.zeros(2 * count), t_eval=at, rtol=1e-8, atol=1e-12, method="DOP853"
    )
    return np.fft.fft(found.y[:count], axis=1)[:, 1] / 32


def main() -> None:
    """All methods in turn."""
    given = options(__doc__, only=METHODS, pff=Path)
    runs = {
        "resonant_decay": lambda: resonant_decay(given.pff),
        "pll": phase_locked_loop,
        "cbc": continuation,
        "rct": response_controlled,
        "harmonic_force_surface": harmonic_force_surface,
        "concerto": concerto,
        "arslan_ozguven": spring_in_a_chain,
    }
    for name in given.only:
        runs[name]()


if __name__ == "__main__":
    main()
