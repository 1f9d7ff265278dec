"""Velocities of which only the amplitude is known: what is compared of a state, and what is lost.

The force that a motion needs does not depend on where time is counted from: where the phase of a
velocity is unknown, the size of the model's force is compared with the measured one, and its phase
follows from the model. One equation is left of two for a state. Every candidate has phases of its
own: none is assumed, and nothing is iterated.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.special import ive

from snrmjax.identify.calibrate.calibration_states import CalibrationStates, ComparedColumns

_OFF = np.radians(30.0)  # beyond which a state is off resonance, and within which it is at it


class Sizes(NamedTuple):
    """The measured phasors that columns are compared with, and for which of them only the size is.

    A part is the force, over the measured one, another sensor's fundamental or a harmonic, over
    the reference velocity: two columns each.
    """

    measured: Complex[np.ndarray, "state part"]
    by_error: Complex[np.ndarray, "part input"]  # of its logarithm
    noise: Float[np.ndarray, "state part"]  # rms of the complex error of a harmonic
    alone: Bool[np.ndarray, "state part"]

    def compared(
        self,
        columns: Float[np.ndarray, "trial state column"],
        slopes: Float[np.ndarray, "trial state column direction"],
        *,
        of_errors: bool = False,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns and slopes, the difference of sizes in place of real and imaginary parts.

        `of_errors` says that directions are errors of the states, which change what was measured.
        """
        if not self.alone.any():
            return columns, slopes
        phasor, change = self.phasors(columns), _complex(slopes, 2)
        given = np.zeros((*self.measured.shape, slopes.shape[3]), dtype=complex)
        if of_errors:
            given = self.measured[:, :, None] * self.by_error
        change = change + given
        size, by_square = self._expected(np.abs(phasor))
        own = np.abs(self.measured)
        moved = by_square[..., None] * np.real(phasor.conj()[..., None] * change)
        there = np.where(own > 0, own, 1.0)[..., None]
        moved = moved - np.real(self.measured.conj()[..., None] * given) / there
        columns, slopes = columns.copy(), slopes.copy()
        columns[..., ::2] = np.where(self.alone, size - own, columns[..., ::2])
        columns[..., 1::2] = np.where(self.alone, 0.0, columns[..., 1::2])
        alone = self.alone[..., None]
        slopes[..., ::2, :] = np.where(alone, moved, slopes[..., ::2, :])
        slopes[..., 1::2, :] = np.where(alone, 0.0, slopes[..., 1::2, :])
        return columns, slopes

    def phasors(
        self, columns: Float[np.ndarray, "trial state column"]
    ) -> Complex[np.ndarray, "trial state part"]:
        """The model's phasors in place of the measured ones."""
        return _complex(columns, 2) + self.measured

    def own_std(
        self, stated: Float[np.ndarray, "state column"], phasors: Complex[np.ndarray, "state part"]
    ) -> Float[np.ndarray, "state column"]:
        """1σ of the noise that a column alone has, for a model with these phasors.

        The size of a harmonic that noise hides scatters less than one of its parts.
        """
        size = np.abs(phasors)
        variance = self.noise**2 + size**2 - self._expected(size)[0] ** 2
        least = (1 - np.pi / 4) * self.noise**2  # of noise alone
        std = np.sqrt(np.clip(variance, least, self.noise**2 / 2))
        alone = self.alone & (self.noise > 0) & np.isfinite(size)
        found = np.array(stated)
        found[:, ::2] = np.where(alone, std, found[:, ::2])
        return found

    def _expected(self, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Expected measured size for a true one, and twice its slope by the square of that.

        Rice's distribution: noise makes small harmonics larger.
        """
        noise = np.broadcast_to(self.noise, size.shape)
        there = np.where(noise > 0, noise, 1.0)
        half = 0.5 * (size / there) ** 2
        zeroth, first = ive(0, half), ive(1, half)
        mean = there * np.sqrt(np.pi) / 2 * ((1 + 2 * half) * zeroth + 2 * half * first)
        slope = np.sqrt(np.pi) / 2 / there * (zeroth + first)
        exact = np.where(size > 0, size, np.inf)
        return np.where(noise > 0, mean, size), np.where(noise > 0, slope, 1 / exact)


def sizes_of(chosen: ComparedColumns) -> Sizes:
    """The phasors that the columns of the states compare."""
    states: CalibrationStates = chosen.states
    velocity = np.asarray(states.velocity)
    n, sensors = velocity.shape
    reference = np.abs(velocity[:, :1])
    higher = np.asarray(states.harmonics).reshape(n, -1) / reference
    measured = np.concatenate([np.ones((n, 1)), velocity[:, 1:] / reference, higher], axis=1)
    whose = np.append(np.arange(1, sensors), np.repeat(np.arange(sensors), len(chosen.orders)))
    by_error = np.zeros((measured.shape[1], 2 * sensors + 1), dtype=complex)
    by_error[0, 0] = 1.0
    rows = np.arange(1, len(by_error))
    by_error[rows, 1 + whose], by_error[rows, 1 + sensors + whose] = 1.0, 1.0j
    known = np.asarray(states.known)
    noise = np.where(known[:, ::2], np.asarray(states.own_std)[:, ::2], 0.0) * np.sqrt(2)
    return Sizes(measured, by_error, noise, known[:, ::2] & ~known[:, 1::2])


def notes_without_phases(
    chosen: ComparedColumns, phase: Float[np.ndarray, " state"], levels: np.ndarray
) -> list[str]:
    """Notes on what a diagnosis cannot find without phases.

    Arguments: `phase` is that of the velocities as the model has it, rad; `levels` are the
    numbers of the levels.
    """
    unknown = chosen.phase_unknown[:, 0]
    if not chosen.phase_unknown.any():
        return []
    if not unknown.any():
        return ["the phases of some sensors are unknown: their amplitudes alone are compared."]
    notes = [
        f"the phases of {int(unknown.sum())} of {len(unknown)} states are unknown: for these only "
        "the size of the force is compared, one number in place of two, and the phases are those "
        "of the model. This hardly separates stiffness from damping: at resonance an amplitude "
        "shows the damping alone, off resonance hardly any of it."
    ]
    if unknown.all():
        notes.append(
            "an error of the sensor's phase cannot be detected: it is not among the candidates."
        )
    if chosen.orders:
        notes.append(
            "of harmonics the sizes alone are compared: their signs, which separate cubic from van "
            "der Pol damping, are lost."
        )
    level = np.asarray(chosen.states.level)
    lacking: dict[str, list[str]] = {"at": [], "off": []}
    for number, name in enumerate(levels):
        mine = np.abs(phase[(level == number) & unknown])
        if mine.size and mine.min() > _OFF:
            lacking["at"].append(str(name))
        if mine.size and mine.max() < _OFF:
            lacking["off"].append(str(name))
    for where, what in (("at", "damping"), ("off", "stiffness")):
        if lacking[where]:
            near = "within" if where == "at" else "beyond"
            notes.append(
                f"no state {near} 30° of resonance at level {', '.join(lacking[where])} (by the "
                f"model): its {what} is hardly determined."
            )
    return notes


def _complex(columns: np.ndarray, axis: int) -> np.ndarray:
    """Pairs of columns as complex numbers."""
    real, imaginary = (
        np.take(columns, np.arange(k, columns.shape[axis], 2), axis=axis) for k in (0, 1)
    )
    return np.asarray(real + 1j * imaginary)
