"""What a diagnosis finds: the answer, how well it is known, and what would decide what is open."""

import dataclasses
import textwrap
from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.gains import LevelGain, level_forces_sentence
from snrmjax.diagnose.checks.residuals import HeldOut
from snrmjax.diagnose.decide import Verdict, verdict_sentence
from snrmjax.diagnose.design.discriminating_test import DiscriminatingTest
from snrmjax.diagnose.laws.law_search import DrawnLaw
from snrmjax.diagnose.search.locating import Located
from snrmjax.diagnose.search.model_search import TriedEffect
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect
from snrmjax.model.parameters import parameter_rules, with_parameters
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus
from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.numerics.rules import Rule


class CompletedStatus(StrEnum):
    """Whether there is a completed model."""

    COMPLETED = "completed"
    NOTHING_ADDED = "nothing_added"  # the model as given
    NOT_PHYSICAL = "not_physical"  # the parameters that fit best are none of a structure


class CompletedModel(NamedTuple):
    """The model with what was found, or why there is none."""

    model: Structure | None
    status: CompletedStatus
    reason: str = ""


def completed_model(
    model: Structure,
    baseline: Mapping[str, float],
    kinds: tuple[str, ...],
    values: Mapping[str, float],
) -> CompletedModel:
    """The model with effects added and its own parameters at their most likely values.

    Arguments: `baseline` has new values of the model's own parameters, `values` those of the
    added effects, both by name. Where one of them is none that a structure can have, such as a
    negative frequency, there is no model but a reason.
    """
    if not kinds:
        return CompletedModel(model, CompletedStatus.NOTHING_ADDED)
    try:
        for name, value in baseline.items():
            for rule in (Rule("finite", np.isfinite), *parameter_rules(model, name)):
                if not rule.good(value):
                    raise ValueError(f"`{name}` must be {rule.expected}, but is {value:.4g}.")
        added = tuple(
            make_effect(kind, {name: values[f"{kind}.{name}"] for name in effect_parameters(kind)})
            for kind in kinds
        )
    except ValueError as error:
        return CompletedModel(None, CompletedStatus.NOT_PHYSICAL, str(error))
    moved = with_parameters(model, tuple(baseline), jnp.array(list(baseline.values())))
    completed = dataclasses.replace(moved, effects=(*model.effects, *added))
    return CompletedModel(completed, CompletedStatus.COMPLETED)


class Estimate(NamedTuple):
    """A fitted parameter."""

    value: float
    std: float  # 1σ


class Answer(NamedTuple):
    """The effects that were found, and the model with them."""

    effects: tuple[str, ...]  # in the order added
    candidates: tuple[tuple[str, ...], ...]  # of every effect: itself, and what fits as well
    parameters: dict[str, Estimate]
    status: MinimisationStatus
    completed: Structure | None  # None where no structure can have these parameters
    completed_status: CompletedStatus
    force_gain: float  # acting force over recorded one, where a gain was free; else 1
    probabilities: dict[str, float]  # of all answers considered; effects are joined by `+`
    laws: tuple[DrawnLaw, ...] = ()  # where the verdict is `DRAWN`, the most important first


class Gap(NamedTuple):
    """Root-mean-square misfits in units of the stated noise."""

    before: float
    after: float
    interpolated: HeldOut | None  # a level between others, left out of the fit
    extrapolated: HeldOut | None  # the top level, left out of the fit


class Checks(NamedTuple):
    """How the answer fared beyond its own fit."""

    p_value: float  # of the misfit that is left
    noise_scale: float  # that neighbouring states show, over the stated noise
    completed_without: dict[int, Structure]  # by level: completed without a level's states


class ForceMisfit(NamedTuple):
    """Misfit of the force over noise, less errors that states share.

    NaN where the size alone is compared.
    """

    rows: Int[np.ndarray, " state"]  # of the data, that were used
    sensor: int  # whose velocity was prescribed
    before: Float[np.ndarray, "state part"]
    after: Float[np.ndarray, "state part"]


class Diagnosis(AbstractResult):
    """What a model lacks, how well that is known, and what would decide what is open."""

    verdict: Verdict
    answer: Answer
    decide_by: str | None
    discriminating_test: DiscriminatingTest | None  # of `decide_by`, where one was compared
    located: tuple[Located, ...]
    gap: Gap
    checks: Checks
    detection_limits: dict[str, float]
    table: tuple[tuple[TriedEffect, ...], ...]  # what each step of the search compared
    notes: tuple[Fact | str, ...]
    force_misfit: ForceMisfit
    data: SteadyStates  # as they were compared: in N, where a drive voltage was given
    # Of levels whose force was recorded in a wrong scale: the acting one over it.
    level_forces: dict[int, LevelGain] = eqx.field(default_factory=dict)

    coordinates: ClassVar[tuple[str, ...]] = ("candidate", "part", "parameter")

    @property
    def effects(self) -> tuple[str, ...]:
        """The best single answer, in the order added."""
        return self.answer.effects

    @property
    def candidates(self) -> tuple[tuple[str, ...], ...]:
        """Of every effect the class that the data cannot tell from it, itself first."""
        return self.answer.candidates

    @property
    def parameters(self) -> dict[str, Estimate]:
        """Value and 1σ of the effects' parameters."""
        return self.answer.parameters

    @property
    def probabilities(self) -> dict[str, float]:
        """Of every answer considered, the most probable first; effects are joined by `+`.

        `none`, `unknown` and, where noise is stated, `noise_rejected` are among them.
        """
        return self.answer.probabilities

    @property
    def probability(self) -> float:
        """That the answer given is right: its verdict, or an answer of effects in its classes."""
        verdict = Verdict(self.verdict)
        if not verdict.is_answer:
            return self.probabilities.get(verdict.value, 0.0)
        given = {kind for group in self.candidates for kind in group}
        return float(
            sum(p for name, p in self.probabilities.items() if set(name.split("+")) <= given)
        )

    @property
    def completed(self) -> Structure | None:
        """The model with the effects; None where `answer.completed_status` is `NOT_PHYSICAL`."""
        return self.answer.completed

    @property
    def verdict_sentence(self) -> str:
        """The verdict in one plain sentence."""
        before, after = self.gap.before, self.gap.after
        names = [[law.name] for law in self.answer.laws] or self.candidates
        sentence = verdict_sentence(Verdict(self.verdict), names, before, after)
        return f"{level_forces_sentence(self.level_forces)} {sentence}".strip()

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult.summary`."""
        gap, inner, outer = self.gap, self.gap.interpolated, self.gap.extrapolated
        lines = [f"Diagnosis: {self.verdict_sentence}"]
        lines += textwrap.wrap(f"probability: {self.most_probable()}", 98)
        for name, (value, std) in self.parameters.items():
            stated = unit_of(name)
            unit = "" if stated == "1" else stated
            lines.append(f"{name} = {value:.4g} ± {std:.2g} {unit}".rstrip())
        lines.append(f"misfit: {gap.before:.3g} before, {gap.after:.3g} after, in units of noise")
        if self.parameters and gap.after > priors.AS_NOISE:
            lines[-1] += "; the ± above holds only if the noise is as stated"
        lines += [
            f"level {out.level}, left out: {out.before:.3g} before, {out.after:.3g} after"
            for out in (inner, outer)
            if out is not None
        ]
        if self.decide_by:
            lines.append(f"to decide: {self.decide_by}")
        status = f"fit {self.answer.status.value.replace('_', ' ')}"
        if self.answer.completed_status is CompletedStatus.NOTHING_ADDED:
            status = "nothing was added to the model"
        elif self.answer.completed_status is CompletedStatus.NOT_PHYSICAL:
            status += ", but no structure can have these parameters: there is no completed model"
        lines.append(f"status: {status}")
        if self.notes:
            lines.append("notes:")
            for note in self.notes:
                lines += textwrap.wrap(str(note), 98, initial_indent="- ", subsequent_indent="  ")
        return tuple(lines)

    def most_probable(self) -> str:
        """The answers with the largest probabilities, each once."""
        least = 0.01
        listed = [
            f"{name.replace('+', ' with ')} {probability_in_words(value)}"
            for name, value in list(self.probabilities.items())[:5]
            if value >= least
        ]
        return f"{probability_in_words(self.probability)} of this verdict ({', '.join(listed)})"

    def variables(self) -> Mapping[str, Variable]:
        """See `AbstractResult.variables`."""
        tried = [(number + 1, row) for number, step in enumerate(self.table) for row in step]
        rows = [row for _, row in tried]
        powers = [
            (np.nan, np.nan) if p.exponent is None else (p.exponent, p.exponent_std)
            for p in self.located
        ]
        ranges = np.array([p.velocity_range for p in self.located]).reshape(-1, 2)
        exponent = np.array(powers, dtype=float).reshape(-1, 2)
        names = list(self.parameters)
        columns = {
            "candidate": (_texts(row.kind for row in rows), "", "effect compared"),
            "step": ([number for number, _ in tried], "1", "step of the search"),
            "gain": ([r.gain for r in rows], "1", "fall of Schwarz's criterion"),
            "chi_square": ([r.chi_square for r in rows], "1", "χ² that is left"),
            "fit_status": (_texts(r.status.value for r in rows), "", "end of the fit"),
            "part": (_texts(p.part for p in self.located), "", "part of the misfit"),
            "velocity_low_m_s": (ranges[:, 0], "m/s", "lowest velocity affected"),
            "velocity_high_m_s": (ranges[:, 1], "m/s", "highest velocity affected"),
            "p_value": ([p.p_value for p in self.located], "1", "by chance"),
            "exponent": (exponent[:, 0], "1", "power of amplitude"),
            "exponent_std": (exponent[:, 1], "1", "1σ of the power"),
            "parameter": (_texts(names), "", "parameter of an effect"),
            "value": ([p.value for p in self.parameters.values()], "unit", "in `unit`"),
            "value_std": ([p.std for p in self.parameters.values()], "unit", "1σ, in `unit`"),
            "unit": (_texts(map(unit_of, names)), "", "of the value"),
        }
        of = np.repeat(self.coordinates, (5, 6, 4)).tolist()
        return {
            name: Variable((dimension,), *column)
            for dimension, (name, column) in zip(of, columns.items(), strict=True)
        }

    def attributes(self) -> Mapping[str, str | float | int]:
        """See `AbstractResult.attributes`."""
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


def unit_of(parameter: str) -> str:
    """The unit of a parameter, named by its effect and itself; "" where none is stated."""
    kind, _, name = parameter.partition(".")
    return EFFECTS[kind].parameters()[name].unit if kind in EFFECTS else ""


def probability_in_words(probability: float) -> str:
    """A probability in per cent, never rounded to certainty.

    >>> probability_in_words(0.937), probability_in_words(0.9999)
    ('94 %', 'above 99 %')
    """
    if 0.005 <= probability <= 0.995:
        return f"{100 * probability:.0f} %"
    return "below 1 %" if probability < 0.5 else "above 99 %"


def _texts(texts: Iterable[str]) -> np.ndarray:
    """Texts as an array of texts, without any of them too."""
    return np.array(list(texts), dtype=np.str_)


class FormerAnswer(NamedTuple):
    """What a diagnosis of fewer states said."""

    verdict: str
    effects: tuple[str, ...]
    probabilities: Mapping[str, float]  # of the answers considered
    starts: Mapping[str, tuple[float, ...]]  # parameters of every effect that was compared


def what_changed(former: FormerAnswer, probabilities: Mapping[str, float]) -> str:
    """What further states did to the answers that were likely before, in one sentence."""
    least = 0.05  # of a probability that is mentioned
    likely = [name for name, p in former.probabilities.items() if p >= least]
    both = [
        f"{name} {100 * former.probabilities[name]:.0f} % → "
        f"{100 * probabilities.get(name, 0):.0f} %"
        for name in dict.fromkeys([*likely, *list(probabilities)[:1]])
        if name in former.probabilities
    ]
    new = [
        f"{name} now {100 * p:.0f} %"
        for name, p in probabilities.items()
        if p >= least and name not in former.probabilities
    ]
    before = " and ".join(former.effects) or "no effect"
    return (
        f"before the further states the verdict was {former.verdict} ({before}). Probabilities: "
        f"{', '.join([*both, *new])}."
    )
