"""A study in numbers: its outputs, their distributions and main effects, its failures."""

import json
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from snrmjax.numerics.facts import Fact
from snrmjax.study.analysis.failures import Failures, failures_of
from snrmjax.study.analysis.outputs import (
    Scalar,
    ScalarSummary,
    scalars,
    summarized,
    varied_quantities,
)
from snrmjax.study.uncertainty.sensitivity import (
    FEWEST,
    MainEffect,
    correlated_pairs,
    main_effect,
)

if TYPE_CHECKING:
    import xarray

_UNSURE = 0.1  # half width from which a fraction is reported as uncertain
_OVERLAP = 0.02  # tolerated excess of the sum of fractions over one

Effects = dict[str, MainEffect | None]  # by quantity; None where there are too few members


class OutputEffects(NamedTuple):
    """One output, for every force, and its main effects."""

    outputs: Sequence[Scalar]
    effects: Sequence[Effects]


class StudyDigest(NamedTuple):
    """A study in numbers."""

    quantities: dict[str, Float[np.ndarray, " member"]]  # those that vary
    units: dict[str, str]  # of the quantities
    outputs: list[list[Scalar]]  # each for every force
    summaries: list[ScalarSummary]
    effects: list[OutputEffects]  # of the outputs that vary
    failures: Failures
    sampling: str  # sampling method; empty if not in the data set
    sensor: str  # of peaks and velocities; empty likewise

    @property
    def n_members(self) -> int:
        """Number of members."""
        return len(self.failures.failed)

    @property
    def each_effect(self) -> Iterator[tuple[Scalar, Effects]]:
        """Every output and force with its effects."""
        for effect in self.effects:
            yield from zip(effect.outputs, effect.effects, strict=True)

    @property
    def facts(self) -> tuple[Fact, ...]:
        """Notes on the numbers."""
        facts = []
        if self.sampling in ("grid", "list"):
            facts.append(Fact("members_chosen", method=self.sampling))
        if self.quantities and self.effects:
            facts += self._on_fractions()
        missing = [s for s in self.summaries if s.missing]
        for s in (s for s in self.summaries if s.outside):
            sides = {"ends": s.scalar.ends, "below": s.below, "above": s.above}
            named = {"output": _named(s.scalar), "members": s.described}
            facts.append(Fact("values_outside", **named, **sides))
        if missing:
            counts = tuple((*_named(s.scalar), s.missing, s.members) for s in missing)
            facts.append(Fact("values_missing", outputs=counts))
        if any(s.scalar.name == "n_not_located" and s.most > 0 for s in self.summaries):
            facts.append(Fact("events_not_located"))
        return (*facts, *self.failures.facts)

    def _on_fractions(self) -> list[Fact]:
        pairs = [(out, effect) for out, effects in self.each_effect for effect in effects.values()]
        few = {_named(out) for out, one in pairs if one is None and out.varies}
        unsure = {_named(out) for out, one in pairs if one and one.half_width > _UNSURE}
        facts = []
        if few:
            facts.append(Fact("too_few_for_fractions", fewest=FEWEST, outputs=tuple(sorted(few))))
        if unsure:
            facts.append(Fact("fractions_uncertain", limit=_UNSURE, outputs=tuple(sorted(unsure))))
        pairs_varied = correlated_pairs(self.quantities)
        if pairs_varied:
            facts.append(Fact("varied_together", pairs=tuple(pairs_varied)))
        elif any(_least_sum(effects) > 1 + _OVERLAP for _, effects in self.each_effect):
            facts.append(Fact("fractions_above_one"))
        return facts


def digest(data: "xarray.Dataset") -> StudyDigest:
    """The numbers of a study's data set; outputs are read one after another."""
    quantities = {k: v for k, v in varied_quantities(data).items() if np.ptp(v) > 0}
    outputs = [list(group) for _, group in groupby(scalars(data), key=lambda one: one.name)]
    effects = [
        OutputEffects(
            output,
            [{name: main_effect(x, y.values) for name, x in quantities.items()} for y in output],
        )
        for output in outputs
        if not output[0].is_count and any(one.varies for one in output)
    ]
    described = json.loads(data.attrs.get("study", "{}")).get("study", {})
    return StudyDigest(
        quantities=quantities,
        units={name: str(data[name].attrs.get("units", "")) for name in quantities},
        outputs=outputs,
        summaries=[summarized(one) for output in outputs for one in output],
        effects=effects,
        failures=failures_of(data),
        sampling=str(described.get("sampling", {}).get("method", "")),
        sensor=str(data.attrs.get("sensor", "")),
    )


def ranked_effects(effects: Effects) -> list[tuple[str, MainEffect]]:
    """The quantities by their fraction of the variance, the largest first."""
    known = [(name, one) for name, one in effects.items() if one is not None]
    return sorted(known, key=lambda pair: -pair[1].fraction)


def effects_frame(study: StudyDigest) -> pd.DataFrame:
    """The table main_effects.csv: fractions of variance over members with a value."""
    return pd.DataFrame(
        {
            "variable": output.name,
            **({} if output.force is None else {"force_n": output.force}),
            "members": output.n_known,
            "varied": name,
            "first_order_fraction": one.fraction,
            "half_width_95": one.half_width,
        }
        for output, effects in study.each_effect
        for name, one in ranked_effects(effects)
    )


def _named(scalar: Scalar) -> tuple[str, float | None]:
    return scalar.name, scalar.force


def _least_sum(effects: Effects) -> float:
    """Lower bound of the sum of the fractions."""
    return sum(
        effect.fraction - effect.half_width for effect in effects.values() if effect is not None
    )
