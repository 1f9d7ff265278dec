"""Result of a diagnosis: the answer, its uncertainty, and the measurement that would decide."""

import dataclasses
import itertools
from collections.abc import Iterable, Mapping
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.residuals import WithheldLevel
from snrmjax.diagnose.design.discriminating_test import DiscriminatingTest
from snrmjax.diagnose.fitted_effects import TriedEffect
from snrmjax.diagnose.misfit.locating import Located
from snrmjax.diagnose.naming.assessed import DRAWN
from snrmjax.diagnose.naming.parts import PartAnswer
from snrmjax.diagnose.verdict import Kinds, Verdict
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect
from snrmjax.model.parameters import parameter_rules, with_parameters
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus
from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.numerics.rules import InputError, Rule


class CompletedModel(NamedTuple):
    """The completed model, or the reason why there is none."""

    model: Structure | None
    extended: bool  # whether effects were added
    reason: str = ""


def completed_model(
    model: Structure,
    baseline: Mapping[str, float],
    kinds: tuple[str, ...],
    values: Mapping[str, float],
) -> CompletedModel:
    """The model with effects added and its own parameters at their most likely values.

    Arguments: `baseline`: new values of the model's own parameters; `values`: those of the added
    effects, both by name. An unphysical value, such as a negative frequency, gives a reason in
    place of a model.
    """
    if not kinds:
        return CompletedModel(model, extended=False)
    try:
        for name, value in baseline.items():
            for rule in (Rule("finite", np.isfinite), *parameter_rules(model, name)):
                if not rule.good(value):
                    raise InputError(f"`{name}` must be {rule.expected}, but is {value:.4g}.")
        added = tuple(
            make_effect(kind, {name: values[f"{kind}.{name}"] for name in effect_parameters(kind)})
            for kind in kinds
        )
    except InputError as error:
        return CompletedModel(None, extended=False, reason=str(error))
    updated = with_parameters(model, tuple(baseline), jnp.array(list(baseline.values())))
    completed = dataclasses.replace(updated, effects=(*model.effects, *added))
    return CompletedModel(completed, extended=True)


class Estimate(NamedTuple):
    """A fitted parameter."""

    value: float
    std: float  # 1σ


class DrawnLaw(NamedTuple):
    """A remainder as an equivalent force at the reference sensor, for lack of a library law.

    `at` is the displacement (m) of that sensor; `force` (N), with its 1σ, is that of a spring or a
    damper between the sensor's point and the ground, in addition to the linear model. With the mode
    shape φ at the sensor x = φq, and φ times the force is the modal force. For damping it is the
    force at the velocity `passing`.
    """

    law: str  # "spring" or "displacement_damping"
    at: Float[np.ndarray, " knot"]
    force: Float[np.ndarray, " knot"]
    force_std: Float[np.ndarray, " knot"]
    largest: float  # measured value of `at`; beyond it the law is extrapolated
    passing: float | None = None  # m/s

    @property
    def name(self) -> str:
        """Its class in words."""
        return str(Fact("law_class", law=self.law))


class Answer(NamedTuple):
    """The identified effects, and the model completed with them."""

    effects: tuple[str, ...]  # in the order added
    candidates: tuple[tuple[str, ...], ...]  # of every effect: itself, and what fits equally well
    parameters: dict[str, Estimate]
    status: MinimisationStatus
    completed: Structure | None  # None where these parameters are not physical
    extended: bool  # whether it has effects that the given model lacks
    force_gain: float  # acting over recorded force, where a gain was free; else 1
    probabilities: dict[Kinds, float]  # of all answers considered
    laws: tuple[DrawnLaw, ...] = ()  # where the verdict is `DRAWN`, the most important first


class Gap(NamedTuple):
    """Root-mean-square misfits in units of the stated noise."""

    before: float
    after: float
    interpolated: WithheldLevel | None  # a level between others, left out of the fit
    extrapolated: WithheldLevel | None  # the top level, left out of the fit


class Checks(NamedTuple):
    """Checks of the answer beyond its own fit."""

    p_value: float  # of the remaining misfit
    noise_scale: float  # scatter of neighbouring states over the stated noise
    completed_without: dict[int, Structure]  # by level: model completed without its states


class ForceMisfit(NamedTuple):
    """Misfit of the force over noise, less shared errors.

    NaN where only the magnitude is compared.
    """

    rows: Int[np.ndarray, " state"]  # rows of the data that were used
    sensor: int  # of the prescribed velocity
    before: Float[np.ndarray, "state part"]
    after: Float[np.ndarray, "state part"]


class Diagnosis(AbstractResult):
    """What a model lacks, with its uncertainty and the measurement that would decide.

    Its effects act on the mode of interest. For a force at a point the verdict may be `UNKNOWN`
    here and `NAMED` for the whole test: see `snrmjax.pipelines.diagnose_test`, whose result has
    the verdict of `diagnosis.json`.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("candidate", "part", "parameter")

    verdict: Verdict
    answer: Answer
    recommended: Fact | None  # the measurements that would decide
    discriminating_test: DiscriminatingTest | None  # the compared test among these, if any
    located: tuple[Located, ...]
    gap: Gap
    checks: Checks
    detection_limits: dict[str, float]
    table: tuple[TriedEffect, ...]  # effects compared, the answer first
    notes: tuple[Fact | str, ...]
    force_misfit: ForceMisfit
    data: SteadyStates  # as compared: in N, also where a drive voltage was given
    parts: tuple[
        PartAnswer, ...
    ] = ()  # what changes stiffness, damping and harmonics, and by how much

    @property
    def effects(self) -> tuple[str, ...]:
        """The best single answer, in the order added."""
        return self.answer.effects

    @property
    def candidates(self) -> tuple[tuple[str, ...], ...]:
        """For every effect the class that the data cannot distinguish from it, itself first."""
        return self.answer.candidates

    @property
    def parameters(self) -> dict[str, Estimate]:
        """Value and 1σ of the effects' parameters."""
        return self.answer.parameters

    @property
    def probabilities(self) -> dict[str, float]:
        """Of all answers considered, the most probable first; effects are joined by `+`.

        `none`, `unknown` and, where noise is stated, `noise_rejected` are among them.
        """
        return {"+".join(kinds): p for kinds, p in self.answer.probabilities.items()}

    @property
    def probability(self) -> float:
        """Of the given answer: its verdict, or any answer of effects in its classes."""
        verdict = Verdict(self.verdict)
        if not verdict.is_answer:
            return self.answer.probabilities.get((verdict.value,), 0.0)
        allowed = {kind for group in self.candidates for kind in group}
        if verdict is Verdict.DRAWN:
            allowed |= {*DRAWN.values()}
        return float(
            sum(p for kinds, p in self.answer.probabilities.items() if allowed >= {*kinds})
        )

    @property
    def completed(self) -> Structure | None:
        """The model with the effects; None where their parameters are not physical."""
        return self.answer.completed

    @property
    def decide_by(self) -> str | None:
        """The measurements that would decide, in words."""
        return None if self.recommended is None else str(self.recommended)

    @property
    def verdict_sentence(self) -> str:
        """The verdict in one plain sentence."""
        if self.parts and Verdict(self.verdict).is_answer:
            changed = [one for one in self.parts if one.verdict != "none"]
            falls = Fact("misfit_falls", before=self.gap.before, after=self.gap.after)
            return " ".join(map(str, (*map(_fact_of, changed), falls)))
        verdict = Fact(
            "verdict",
            verdict=Verdict(self.verdict).value,
            classes=self.candidates,
            laws=tuple(law.name for law in self.answer.laws),
            misfit_before=self.gap.before,
            misfit=self.gap.after,
        )
        return str(verdict)

    def most_probable(self) -> Fact:
        """The answers with the largest probabilities, each once."""
        first = itertools.islice(self.answer.probabilities.items(), 5)
        listed = tuple((kinds, p) for kinds, p in first if p >= 0.01)
        return Fact("most_probable", verdict=self.probability, answers=listed)

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        gap, inner, outer = self.gap, self.gap.interpolated, self.gap.extrapolated
        unsure = bool(self.parameters) and gap.after > priors.AS_NOISE
        added = "completed" if self.answer.extended else "nothing_added"
        completion = "not_physical" if self.completed is None else added
        lines = [
            Fact("probability_of_verdict", probability=self.most_probable()),
            *(
                Fact("parameter_found", name=name, unit=unit_of(name), **pair._asdict())
                for name, pair in self.parameters.items()
            ),
            Fact("misfits", before=gap.before, after=gap.after, unsure=unsure),
            *(
                Fact("level_left_out", level=out.level, before=out.before, after=out.after)
                for out in (inner, outer)
                if out is not None
            ),
            *([] if self.recommended is None else [Fact("to_decide", by=self.recommended)]),
            Fact("diagnosis_ended", fit=self.answer.status.value, completed=completion),
            *(Fact("diagnosis_note", note=note) for note in self.notes),
        ]
        return (f"Diagnosis: {self.verdict_sentence}", *map(str, lines))

    def variables(self) -> Mapping[str, Variable]:
        """See `AbstractResult`."""
        rows = self.table
        ranges = np.array([p.velocity_range for p in self.located]).reshape(-1, 2)
        names = list(self.parameters)
        columns = {
            "candidate": (_texts(row.kind for row in rows), "", "effect compared"),
            "gain": ([r.gain for r in rows], "1", "decrease of Schwarz's criterion"),
            "chi_square": ([r.chi_square for r in rows], "1", "remaining χ²"),
            "fit_status": (_texts(r.status.value for r in rows), "", "status of the fit"),
            "part": (_texts(p.part for p in self.located), "", "part of the misfit"),
            "velocity_low_m_s": (ranges[:, 0], "m/s", "lowest velocity affected"),
            "velocity_high_m_s": (ranges[:, 1], "m/s", "highest velocity affected"),
            "p_value": ([p.p_value for p in self.located], "1", "p-value"),
            "parameter": (_texts(names), "", "parameter of an effect"),
            "value": ([p.value for p in self.parameters.values()], "unit", "in `unit`"),
            "value_std": ([p.std for p in self.parameters.values()], "unit", "1σ, in `unit`"),
            "unit": (_texts(map(unit_of, names)), "", "of the value"),
        }
        of = np.repeat(self.coordinates, (4, 4, 4)).tolist()
        return {
            name: Variable((dimension,), *column)
            for dimension, (name, column) in zip(of, columns.items(), strict=True)
        }

    def attributes(self) -> Mapping[str, str | float | int]:
        """See `AbstractResult`."""
        return {
            "verdict": self.verdict.value,
            "verdict_sentence": self.verdict_sentence,
            "effects": ", ".join(self.effects),
            "decide_by": self.decide_by or "",
            "probability": self.probability,
            "gap_before": self.gap.before,
            "gap_after": self.gap.after,
            "p_value_of_fit": self.checks.p_value,
            "notes": " ".join(map(str, self.notes)),
        }


def _fact_of(part: PartAnswer) -> Fact:
    """The laws of one part of the change, as a fact to report."""
    return Fact(
        "part_of_change",
        part=part.part,
        verdict=part.verdict,
        classes=part.candidates,
        probability=part.probability,
        explained=None if part.explained is None else tuple(part.explained),
        left=part.remainder is not None and part.remainder.significant,
    )


def unit_of(parameter: str) -> str:
    """The unit of a parameter `effect.name`; "" where none is stated."""
    kind, _, name = parameter.partition(".")
    return EFFECTS[kind].parameters()[name].unit if kind in EFFECTS else ""


def _texts(texts: Iterable[str]) -> np.ndarray:
    """Texts as an array of strings, also if empty."""
    return np.array(list(texts), dtype=np.str_)


class FormerAnswer(NamedTuple):
    """The answer of a former diagnosis, of fewer states."""

    verdict: str
    effects: tuple[str, ...]
    probabilities: Mapping[Kinds, float]  # of the answers considered

    def changed_to(self, probabilities: Mapping[Kinds, float]) -> Fact:
        """The change, by further states, of the answers that were likely before or are now."""
        least, before = 0.05, self.probabilities
        likely = [kinds for kinds, p in before.items() if p >= least]
        likely += [kinds for kinds in list(probabilities)[:1] if kinds in before]
        likely += [one for one, p in probabilities.items() if p >= least and one not in before]
        return Fact(
            "answer_before",
            verdict=self.verdict,
            effects=self.effects,
            probabilities=tuple(
                (kinds, before.get(kinds), probabilities.get(kinds, 0.0))
                for kinds in dict.fromkeys(likely)
            ),
        )
