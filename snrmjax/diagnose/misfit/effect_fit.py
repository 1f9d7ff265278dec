"""Misfits in units of noise, with everything shared or stated marginalised, and fits to them."""

import copy
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int
from scipy.linalg import solve_triangular
from scipy.special import chdtrc

from snrmjax.diagnose.misfit.candidates import SECOND_ORDER, Candidate, parameter_labels
from snrmjax.diagnose.misfit.coordinates import coordinates
from snrmjax.diagnose.misfit.predictions import (
    PLAIN,
    Group,
    Measured,
    Predicted,
    Predictions,
    scales_of,
)
from snrmjax.identify.calibrate.calibration_states import ComparedColumns, whitened_columns
from snrmjax.numerics.blocks import over_cores

_STEPS = 9  # of a fit
_SCREENED, _KEPT = 2, 2  # steps of all starts, and how many of them go on
_WEAK = 0.1  # of its strength, at which a start without a motion is looked at
_WEAKER = 3  # times a start without a motion is tried with less strength
_SETTLED = 0.02  # of χ²: a smaller change ends a fit


class Weighing(NamedTuple):
    """How misfits are weighed: noise by itself, and with all that states have in common.

    A row is a known column of a state; `lower` is Cholesky's factor of the whitened misfits'
    covariance: one for the noise, and what the levels' errors and the baseline's own uncertainty
    add.
    """

    whiten: Float[np.ndarray, "state column column"]
    known: Bool[np.ndarray, "state column"]
    shared: Float[np.ndarray, "row shared"]  # slopes times 1σ
    lower: Float[np.ndarray, "row row"]
    state: Int[np.ndarray, " row"]
    column: Int[np.ndarray, " row"]

    def noise_units(
        self, columns: Float[np.ndarray, "trial state column"]
    ) -> Float[np.ndarray, "trial row"]:
        """Known columns in units of their own noise; NaN stays."""
        return np.einsum("sij,...sj->...si", self.whiten, columns)[..., self.known]

    def decorrelated(
        self, rows: Float[np.ndarray, "*entry row"]
    ) -> Float[np.ndarray, "*entry row"]:
        """Rows of unit variance when baseline and noise are as stated."""
        good = np.all(np.isfinite(rows), axis=-1, keepdims=True)
        flat = np.where(good, rows, 0.0).reshape(-1, rows.shape[-1])
        found = solve_triangular(self.lower, flat.T, lower=True).T.reshape(rows.shape)
        return np.where(good, found, np.nan)

    def without_shared(self, rows: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        """Rows less the likeliest of what states have in common."""
        half = solve_triangular(self.lower, rows, lower=True)
        return np.asarray(solve_triangular(self.lower, half, lower=True, trans="T"))

    def likeliest(
        self, rows: Float[np.ndarray, " row"], kept: Bool[np.ndarray, " row"] | None = None
    ) -> Float[np.ndarray, " shared"]:
        """What states share, in its own 1σ, as the misfits, all or some of them, tell it."""
        if kept is not None:
            half = solve_triangular(self.of_rows(kept), rows[kept], lower=True)
            left = solve_triangular(self.of_rows(kept), half, lower=True, trans="T")
            return np.asarray(-self.shared[kept].T @ left)
        return np.asarray(-self.shared.T @ self.without_shared(rows))

    def of_rows(self, keep: Bool[np.ndarray, " row"]) -> Float[np.ndarray, "kept kept"]:
        """Cholesky's factor for some of the rows by themselves."""
        shared = self.shared[keep]
        return np.linalg.cholesky(np.eye(int(keep.sum())) + shared @ shared.T)


def weighing(
    measured: Measured,
    baseline: Float[np.ndarray, "state column prior"],
    by_linear: Float[np.ndarray, "state column two"],
    level_std: Float[np.ndarray, " four"],
) -> Weighing:
    """Arguments: `baseline` are slopes by the baseline's own parameters, times their 1σ.

    `by_linear` are slopes by natural frequency and damping ratio; `level_std` 1σ of what levels
    have of their own: gain, phase, natural frequency and damping ratio.
    """
    states, levels = measured.states, measured.chosen.n_levels
    known = measured.known
    n_sensors = np.asarray(states.velocity).shape[1]
    gain = measured.by_error[:, :, 1 : n_sensors + 1].sum(axis=2)
    phase = measured.by_error[:, :, n_sensors + 1 :].sum(axis=2)
    member = (np.asarray(states.level)[:, None] == np.arange(levels)).astype(float)
    slopes = (gain, phase, *np.moveaxis(by_linear, 2, 0))
    parts = [
        std * slope[:, :, None] * member[:, None, :]
        for slope, std in zip(slopes, level_std, strict=True)
        if std > 0
    ]
    every = np.concatenate([baseline, *parts], axis=2)
    own = np.asarray(whitened_columns(measured.whiten, every))[known]
    state, column = np.nonzero(known)
    lower = np.linalg.cholesky(np.eye(len(own)) + own @ own.T)
    return Weighing(measured.whiten, known, own, lower, state, column)


class Fit(NamedTuple):
    """One candidate, or several together, fitted."""

    kinds: tuple[str, ...]
    labels: tuple[str, ...]
    values: Float[np.ndarray, " parameter"]
    chi_square: float
    rows: Float[np.ndarray, " row"]  # in units of noise
    slopes: Float[np.ndarray, "row parameter"]
    lower: Float[np.ndarray, " parameter"]
    upper: Float[np.ndarray, " parameter"]

    def of_kind(self, kind: str) -> tuple[float, ...]:
        """The parameters of one of its kinds."""
        pairs = zip(self.labels, self.values.tolist(), strict=True)
        return tuple(value for label, value in pairs if label.startswith(f"{kind}."))

    def criterion(self, n_rows: int) -> float:
        """Schwarz's."""
        return self.chi_square + len(self.values) * float(np.log(n_rows))


_Evaluation = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class Bench:
    """All fits to one set of data."""

    def __init__(self, predictions: Predictions):
        self.predictions = predictions
        self.model = predictions.model
        group = predictions.group(PLAIN)
        found = self._by_baseline(group, group.values)
        self._columns, self._slopes = found.columns[0], found.slopes[0]
        self._baseline_slopes = self._slopes
        self.force, self.force_by_linear = found.phasors[0, :, 0], found.force_slopes[0, :, -2:]
        self._by_error, self._phasors = predictions.by_error(group, group.values)
        self._changes: dict[str, np.ndarray] = {}  # columns of every start less the baseline's
        self._weigh(self._by_error + self._of_what_is_missed(), self._phasors)

    def _by_baseline(self, group: Group, values: Float[np.ndarray, " parameter"]) -> Predicted:
        """With slopes by the baseline's parameters, times 1σ, and by the linear mode's two."""
        stated, j = self.predictions.stated, self.model.modes.mode_of_interest + 1
        two = (f"mode_{j}.natural_frequency", f"mode_{j}.damping_ratio")
        found = self.predictions.of(group, values[None], (*stated, *two))
        std = np.array([*(std for _, std in stated.values()), 1.0, 1.0])
        return found._replace(slopes=found.slopes * std, force_slopes=found.force_slopes * std)

    def _of_what_is_missed(self) -> Float[np.ndarray, "state column input"]:
        """What errors of the velocity do to the force that the baseline does not know of.

        That force turns with the velocity, and is taken to grow with it: where a baseline misses
        most of the damping, it would else pass on too little of the errors.
        """
        sensors = np.asarray(self.predictions.chosen.states.velocity).shape[1]
        missing = -(self._columns[:, 0] + 1j * self._columns[:, 1])
        change = np.zeros_like(self._by_error)
        for place, part in ((1, missing), (1 + sensors, 1j * missing)):
            change[:, 0, place], change[:, 1, place] = part.real, part.imag
        known = np.asarray(self.predictions.chosen.states.known)
        return np.where(known[:, :, None], change, 0.0)

    def _weigh(
        self,
        by_error: Float[np.ndarray, "state column input"],
        phasors: Complex[np.ndarray, "state part"],
    ) -> None:
        self._passed_on = (by_error, phasors)
        measured = self.predictions.weighed(by_error, phasors)
        std = np.array(self.model.level_stds)
        own, by_linear = self._slopes[:, :, :-2], self._slopes[:, :, -2:]
        gain = self.predictions.force_gain_std * by_error[:, :, :1]
        shared = np.concatenate([own, gain], axis=2) if np.any(gain) else own
        self.weighing = weighing(measured, shared, by_linear, std)
        self.base = self.weighing.noise_units(self._columns[None])[0]
        linear = np.moveaxis(self._slopes[:, :, -2:], 2, 0)
        self.by_linear = self.weighing.noise_units(linear).T

    def reweighed(self, fit: "Fit") -> "Bench":
        """The same with the errors passed on as the fitted model passes them.

        Those of the baseline too: what an effect turns or scales, it turns and scales of them.
        """
        known = (self._by_error, self._phasors, self._baseline_slopes)
        totals = [part.copy() for part in known]
        for group, values in self._as_fitted(fit):
            slopes = self._by_baseline(group, values).slopes[0]
            own = (*self.predictions.by_error(group, values), slopes)
            for total, part, new in zip(totals, known, own, strict=True):
                total += np.where(np.isfinite(new - part), new - part, 0.0)
        other = copy.copy(self)
        by_error, phasors, other._slopes = totals
        other._weigh(by_error, phasors)
        return other

    def turned(self, fit: "Fit") -> "Bench":
        """The same with velocities of unknown phase where a fit has them."""
        force = self.force.copy()
        for group, values in self._as_fitted(fit):
            own = self.predictions.of(group, values[None])
            force += own.phasors[0, :, 0] - self.force
        other = copy.copy(self)
        other.predictions = self.predictions.turned(-np.angle(force))
        return other

    def _as_fitted(self, fit: "Fit") -> Iterator[tuple[Group, Float[np.ndarray, " parameter"]]]:
        """The structures that have a fit's kinds, and their parameters."""
        left = list(dict.fromkeys(fit.kinds))
        while left:
            group = self.predictions.group(max(left, key=self.predictions.is_apart))
            values, mine = group.values.copy(), dict(zip(fit.labels, fit.values, strict=True))
            for label, value in mine.items():
                if label in group.names:
                    values[group.place(label)] = value
            inside = [kind for kind in left if parameter_labels(kind)[0] in group.names]
            left = [kind for kind in left if kind not in inside]
            yield group, values

    def with_errors(self, chosen: ComparedColumns) -> "Bench":
        """The same with the same states under other errors."""
        other, predictions = copy.copy(self), copy.copy(self.predictions)
        predictions.chosen = chosen
        other.predictions = predictions
        other._weigh(*self._passed_on)
        return other

    @property
    def n_rows(self) -> int:
        """Known numbers."""
        return len(self.base)

    @property
    def level_numbers(self) -> Int[np.ndarray, " level"]:
        """Numbers of the levels in the data."""
        return np.unique(self.predictions.level_numbers)

    def at_start(self, candidate: Candidate) -> Fit:
        """A candidate as it begins, not fitted."""
        group, labels = self.predictions.group(candidate.kind), parameter_labels(candidate.kind)
        values = np.array(candidate.starts[:1])
        rows, slopes = self._evaluated(group, labels, values)
        bounds = np.array(candidate.lower), np.array(candidate.upper)
        cost = self._cost(rows[0])
        return Fit((candidate.kind,), labels, values[0], cost, rows[0], slopes[0], *bounds)

    def started(self, candidate: Candidate) -> Float[np.ndarray, "trial state column"]:
        """What a candidate's starts change."""
        if candidate.kind not in self._changes:
            group, labels = self.predictions.group(candidate.kind), parameter_labels(candidate.kind)
            starts = np.array(candidate.starts)
            found = self._predicted(group, labels, starts, slopes=False)
            changes = found.columns - self._columns
            lost = ~np.isfinite(self.weighing.noise_units(changes)).all(axis=1)
            if lost.any():  # too strong to have a motion: what a weaker one does, scaled up
                starts[:, 0] *= _WEAK
                found = self._predicted(group, labels, starts[lost], slopes=False)
                weak = found.columns - self._columns
                changes[lost] = weak / _WEAK ** (2 if candidate.kind in SECOND_ORDER else 1)
            self._changes[candidate.kind] = changes
        return self._changes[candidate.kind]

    def change(self, candidate: Candidate) -> Float[np.ndarray, " row"]:
        """What a candidate's first start changes, in units of noise."""
        return self.weighing.noise_units(self.started(candidate))[0]

    def baseline(
        self, fit: "Fit", kept: Bool[np.ndarray, " row"] | None = None
    ) -> dict[str, float]:
        """The baseline's parameters that have a stated error, where that and the data put them.

        Of the data the rows `kept`, or all.
        """
        moved = self.weighing.likeliest(fit.rows, kept)
        stated = self.predictions.stated
        return {
            name: value + std * step
            for (name, (value, std)), step in zip(
                stated.items(), moved[: len(stated)].tolist(), strict=True
            )
        }

    def chi_square(self, rows: Float[np.ndarray, " row"]) -> float:
        """Of misfits in units of noise."""
        return float(np.sum(self.weighing.decorrelated(rows) ** 2))

    def nothing(self) -> Fit:
        """The baseline by itself."""
        empty = np.zeros((self.n_rows, 0))
        none = np.zeros(0)
        return Fit((), (), none, self.chi_square(self.base), self.base, empty, none, none)

    def fitted(self, candidate: Candidate, beside: Fit | None = None) -> Fit:
        """The best fit of a candidate from all its starts, on top of what is found already.

        Levenberg–Marquardt in all parameters.
        """
        before = beside or self.nothing()
        together = self._together(candidate, before)
        labels = (*parameter_labels(candidate.kind), *before.labels)
        law = coordinates(labels, scales_of(self.predictions).amplitude)
        n, m = len(candidate.unit), len(before.values)
        own = np.where(before.values, np.abs(before.values), 1)
        unit = law.inward(np.concatenate([candidate.unit, own]))
        starts = np.array(candidate.starts)
        trials = len(starts)
        every = np.concatenate([starts, np.tile(before.values, (trials, 1))], axis=1)
        point = law.inward(every) / unit
        # Of what the coordinates scale, bounds are zero and infinity.
        lower = np.concatenate([candidate.lower, before.lower])
        upper = np.concatenate([candidate.upper, before.upper])
        rows, slopes = together(every)
        damping = np.full(trials, 1e-2)
        cost = np.array([self._cost(row) for row in rows])
        for _ in range(_WEAKER):
            lost = np.flatnonzero(~np.isfinite(cost))
            if not lost.size:
                break
            point[lost, 0] *= 0.3  # too strong to have a motion
            every[lost] = law.outward(point[lost] * unit)
            rows[lost], slopes[lost] = together(every[lost])
            cost[lost] = [self._cost(row) for row in rows[lost]]
        active = np.isfinite(cost)
        for turn in range(_STEPS):
            if turn == _SCREENED:  # the most promising go on
                active &= cost <= np.sort(cost)[min(_KEPT, trials) - 1]
            at = np.flatnonzero(active)
            if not at.size:
                break
            moved = point.copy()
            for t in at:
                left = self.weighing.decorrelated(rows[t])
                by = law.slopes(every[t], slopes[t]) * unit
                arms = self.weighing.decorrelated(by.T).T
                step = _damped(arms, left, damping[t])
                moved[t] = np.clip(point[t] + step, lower / unit, upper / unit)
                promised = float(left @ left - np.sum((left + arms @ step) ** 2))
                if promised < _SETTLED and np.array_equal(moved[t], point[t] + step):
                    # So short a step is straight: what it does need not be looked at.
                    rows[t] = rows[t] + by @ step
                    point[t], cost[t], active[t] = moved[t], self._cost(rows[t]), False
                    every[t] = law.outward(moved[t] * unit)
            at = at[active[at]]
            if not at.size:
                break
            values = law.outward(moved[at] * unit)
            new_rows, new_slopes = together(values)
            for place, t in enumerate(at):
                new = self._cost(new_rows[place])
                if new < cost[t]:
                    active[t] = cost[t] - new > _SETTLED
                    point[t], every[t], cost[t] = moved[t], values[place], new
                    rows[t], slopes[t] = new_rows[place], new_slopes[place]
                    damping[t] *= 0.1
                else:
                    damping[t] *= 20.0
                    active[t] = damping[t] < 1e4
        best = int(np.argmin(np.where(np.isfinite(cost), cost, np.inf)))
        order = [*range(n, n + m), *range(n)]
        return Fit(
            (*before.kinds, candidate.kind),
            (*before.labels, *parameter_labels(candidate.kind)),
            every[best][order],
            float(cost[best]),
            rows[best],
            slopes[best][:, order],
            lower[order],
            upper[order],
        )

    def all_fitted(self, jobs: Sequence[tuple[Candidate, Fit]]) -> list[Fit]:
        """The best fit of every candidate beside what is found already, over the cores."""
        return over_cores(lambda job: self.fitted(*job), jobs)

    def _together(self, candidate: Candidate, before: Fit) -> _Evaluation:
        """Rows and slopes by a candidate's parameters and those of what is there before.

        One program answers for both where it has both. Else what they change adds up, which
        leaves out what one changes in what the other does: of second order in both.
        """
        labels = (*parameter_labels(candidate.kind), *before.labels)
        kinds = (candidate.kind, *before.kinds)
        for kind in kinds:
            group = self.predictions.group(kind)
            if set(labels) <= set(group.names):
                return lambda values: self._evaluated(group, labels, values)
        group, n = self.predictions.group(candidate.kind), len(candidate.unit)

        def added(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            rows, slopes = self._evaluated(group, labels[:n], values[:, :n])
            moved = (values[:, n:] - before.values) @ before.slopes.T
            others = np.broadcast_to(before.slopes, (len(values), *before.slopes.shape))
            rows = rows + before.rows - self.base + moved
            return rows, np.concatenate([slopes, others], axis=2)

        return added

    def _cost(self, rows: np.ndarray) -> float:
        value = self.chi_square(rows)
        return value if np.isfinite(value) else np.inf

    def _evaluated(
        self, group: Group, labels: Sequence[str], values: Float[np.ndarray, "trial parameter"]
    ) -> tuple[Float[np.ndarray, "trial row"], Float[np.ndarray, "trial row parameter"]]:
        found = self._predicted(group, labels, values, slopes=True)
        rows = self.weighing.noise_units(found.columns)
        slopes = self.weighing.noise_units(np.moveaxis(found.slopes, 3, 0))
        return rows, np.moveaxis(slopes, 0, 2)

    def _predicted(
        self,
        group: Group,
        labels: Sequence[str],
        values: Float[np.ndarray, "trial parameter"],
        *,
        slopes: bool,
    ) -> Predicted:
        every = np.tile(group.values, (len(values), 1))
        every[:, [group.place(label) for label in labels]] = values
        return self.predictions.of(group, every, labels if slopes else ())


def _damped(arms: np.ndarray, left: np.ndarray, damping: float) -> np.ndarray:
    size = np.linalg.norm(arms, axis=0)
    size = np.where(size > 0, size, 1.0)
    scaled = arms / size
    matrix = scaled.T @ scaled + damping * np.eye(len(size))
    return -np.linalg.solve(matrix, scaled.T @ left) / size


def unlikely(chi_square: float, freedom: int) -> float:
    """Probability of at least this χ²; rounding may have made it negative."""
    return float(chdtrc(max(freedom, 1), np.maximum(chi_square, 0.0)))
