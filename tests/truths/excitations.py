"""A Duffing oscillator excited in three ways, integrated in time by SciPy's DOP853.

A mass of 0.4 kg on a spring with a cubic part and a dashpot (50 Hz, 2 %), until it is periodic;
then the fundamental of what sensors see: a `point` force; a shaker table (`base`); a free rigid
`fixture` of 1.5 kg that a stinger forces (the paper's section 4). The truth is the closed form of
the relative motion, ω̃² = ω²(1 + ¾e + 3e²/128), e = γa²/k.
"""

import numpy as np
from scipy.integrate import solve_ivp

import snrmjax as sj

HERTZ = 2 * np.pi
MASS, FIXTURE = 0.4, 1.5  # kg
STIFFNESS = MASS * (50 * HERTZ) ** 2  # N/m
DAMPING = 2 * 0.02 * MASS * 50 * HERTZ  # N s/m
CUBIC = 6e10  # N/m³
CYCLES, SAMPLES = 140, 64


def internal(stretch, rate):
    """Force of spring and dashpot on the mass, less its sign."""
    return STIFFNESS * stretch + CUBIC * stretch**3 + DAMPING * rate


def fundamental(time, values, omega):
    """Complex amplitude of e^{iΩt} over whole cycles."""
    return 2 * np.mean(values * np.exp(-1j * omega * time))


def settled(equations, omega, start):
    """The last cycle of a long integration: times and states."""
    period = 2 * np.pi / omega
    end = CYCLES * period
    last = end - period + period * np.arange(SAMPLES) / SAMPLES
    found = solve_ivp(
        equations, (0, end), start, t_eval=last, method="DOP853", rtol=1e-9, atol=1e-13
    )
    return last, found.y


def level_of(way, size, omegas):
    """Rows (frequency, load phasor, velocity phasor) of one level, `size` in N or m/s²."""
    rows = []
    for omega in omegas:
        if way == "point":

            def equations(t, y, omega=omega):
                return y[1], (size * np.cos(omega * t) - internal(y[0], y[1])) / MASS

            time, y = settled(equations, omega, (0.0, 0.0))
            rows.append((omega, size, fundamental(time, y[1], omega)))
        elif way == "base":

            def equations(t, y, omega=omega):  # y: relative motion
                return y[1], -size * np.cos(omega * t) - internal(y[0], y[1]) / MASS

            time, y = settled(equations, omega, (0.0, 0.0))
            absolute = y[1] + size / omega * np.sin(omega * time)
            rows.append((omega, size, fundamental(time, absolute, omega)))
        else:

            def equations(t, y, omega=omega):  # y: mass, fixture; both relative to the mean drift
                pull = internal(y[0] - y[1], y[2] - y[3])
                force = size * np.cos(omega * t)
                return y[2], y[3], -pull / MASS, (force + pull) / FIXTURE

            # Started so that the common motion has no drift: −F cos Ωt/(MΩ²).
            away = -size / ((MASS + FIXTURE) * omega**2)
            time, y = settled(equations, omega, (away, away, 0.0, 0.0))
            rows.append((omega, size, fundamental(time, y[2], omega)))
    return rows


def ways():
    """Each way: linear model, loads of the levels, μ and ω of the relative motion."""
    modes = sj.model.linear_modes
    shape = MASS**-0.5
    own = np.sqrt(STIFFNESS / MASS)
    ratio = DAMPING / (2 * MASS * own)
    point = modes([own], [ratio], [[shape]], [shape])
    reduced = MASS * FIXTURE / (MASS + FIXTURE)
    free = np.sqrt(STIFFNESS / reduced)
    elastic = reduced**-0.5
    rigid = (MASS + FIXTURE) ** -0.5
    fixture = modes(
        [free],
        [DAMPING / (2 * reduced * free)],
        [[elastic * FIXTURE / (MASS + FIXTURE)]],
        [-elastic * reduced / FIXTURE],
        rigid_body=sj.model.RigidBodyModes([[rigid]], [rigid]),
    )
    base = modes([own], [ratio], [[shape]], [-(MASS**0.5)])
    return {
        "point": (point, (1.0, 3.0, 6.0), MASS, own),
        "base": (base, (2.5, 7.5, 15.0), MASS, own),
        "fixture": (fixture, (4.0, 11.0, 22.0), reduced, free),
    }


def measured_test(way, n_states):
    """Steady states of one way, as a laboratory would have them, and its model."""
    modes, loads, reduced, _ = ways()[way]
    rows = []
    for level, size in enumerate(loads, start=1):
        # The states: where the closed form has these phases.
        phases = np.radians(np.linspace(55, -55, n_states))
        per_load = abs(
            float(modes.participation[0] / modes.mode_shape[0, 0])
            * (FIXTURE / (MASS + FIXTURE) if way == "fixture" else 1.0)
        )
        force = (
            size
            * per_load
            * (
                float(modes.mode_shape[0, 0]) ** 2
                * reduced
                * ((MASS + FIXTURE) / FIXTURE if way == "fixture" else 1.0) ** 2
            )
        )
        omegas = [frequency_at(phase, force, reduced) for phase in phases]
        rows += [(level, *row) for row in level_of(way, size, omegas)]
    level, omega, load, velocity = (np.array(column) for column in zip(*rows, strict=True))
    level = level.astype(int)
    if way == "base":
        return modes, sj.measure.base_excited_states(level, omega, load + 0j, velocity[:, None])
    return modes, sj.measure.steady_states(level, omega, load, velocity)


def frequency_at(phase, force, reduced):
    """Frequency (rad/s) at which the one-term balance has this phase under a relative force."""
    amplitude = force * np.cos(phase) / (DAMPING * np.sqrt(STIFFNESS / reduced))
    for _ in range(200):
        stiffness = STIFFNESS + 0.75 * CUBIC * amplitude**2
        side = DAMPING / reduced * np.tan(phase)
        omega = 0.5 * (-side + np.sqrt(side**2 + 4 * stiffness / reduced))
        amplitude = 0.5 * (amplitude + force * np.cos(phase) / (DAMPING * omega))
    return omega


def errors_of(way, n_states):
    """Relative errors of frequency and modal damping of every usable state, and its amplitude."""
    modes, data = measured_test(way, n_states)
    found = sj.identify.identify_points(data, modes)
    _, _, reduced, _ = ways()[way]
    # Amplitude of the relative motion: the mode's coordinate over the square root of its mass.
    shape = float(modes.mode_shape[0, 0])
    stretch = np.asarray(found.amplitude) / abs(shape) * reduced**-0.5
    usable = np.asarray(found.usable)
    part = CUBIC * stretch**2 / STIFFNESS
    true = np.sqrt(STIFFNESS / reduced * (1 + 0.75 * part + 3 / 128 * part**2))
    omega = np.asarray(found.natural_frequency)
    damping = 2 * np.asarray(found.damping_ratio) * omega
    return (
        np.asarray(found.backbone_velocity)[usable],
        (omega / true - 1)[usable],
        (damping * reduced / DAMPING - 1)[usable],
        int((~usable).sum()),
    )
