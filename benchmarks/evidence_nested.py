"""Is Laplace's evidence of an answer that of nested sampling, where that is doubtful?

Run: python benchmarks/evidence_nested.py --sets DIR/sets --cases SET:KIND[+KIND] … [--live 100]
with sets of `blind_sets/generate.py`; needs `pip install dynesty`.

Evidence of an effect with thresholds, exponents or a further mode is an integral over parameters
that data may hardly determine. Its logarithm by Laplace's approximation, as diagnoses use it, is
compared with that of dynesty (Speagle 2020, doi:10.1093/mnras/staa278) under the same priors:
Cauchy's of strengths, flat ones of what is bounded. One JSON line a case: both, the sampler's 1σ,
its likelihood calls and seconds, and the odds of the effect to `none`.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from harness import options, teller

from snrmjax.diagnose.evidence import marginal_of
from snrmjax.diagnose.misfit.candidates import (
    EffectCandidate,
    candidate,
    coordinates,
    parameter_labels,
)
from snrmjax.diagnose.misfit.effect_fit import (
    EffectFit,
    baseline_fit,
    fit_effect,
    with_errors_passed_on,
)
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.reference import with_reference
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit, weighted_misfit
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states
from snrmjax.model.effect_metadata import MotionScales

tell = teller(__file__)

_FARTHEST = 0.4999  # of a Cauchy distribution on each side


def prior_transform(
    misfit: WeightedMisfit, kinds: list[str]
) -> tuple[tuple[str, ...], Callable[[np.ndarray], np.ndarray]]:
    """From the unit cube to parameters, by the stated priors of every effect in turn."""
    scales = scales_of(misfit.predictions)
    ones = [candidate(kind, scales) for kind in kinds]
    labels = tuple(label for kind in kinds for label in parameter_labels(kind))
    law = coordinates(labels, scales.amplitude)
    starts = np.concatenate([np.median(np.abs(_inward(one, scales)), axis=0) for one in ones])
    lower = np.concatenate([one.lower for one in ones])
    upper = np.concatenate([one.upper for one in ones])
    first = np.cumsum([0, *[len(one.unit) for one in ones]])[:-1]

    def transform(unit: np.ndarray) -> np.ndarray:
        values = np.zeros(len(unit))
        for k, u in enumerate(unit):
            flat = np.isfinite(upper[k] - lower[k]) and k not in first
            if flat:
                values[k] = lower[k] + u * (upper[k] - lower[k])
            elif lower[k] == 0:
                values[k] = starts[k] * np.tan(np.pi * _FARTHEST * u)
            else:
                values[k] = starts[k] * np.tan(np.pi * 2 * _FARTHEST * (u - 0.5))
        return law.outward(values)

    return labels, transform


def _inward(one: EffectCandidate, scales: MotionScales) -> np.ndarray:
    law = coordinates(parameter_labels(one.kind), scales.amplitude)
    return law.inward(np.array(one.starts))


def compared(folder: Path, name: str, kinds: list[str], live: int) -> dict:
    """Both evidences of one answer, beside that of the baseline, in nats."""
    import dynesty

    model = read_model(folder / f"{name}.toml")
    data = read_steady_states(folder / f"{name}.csv", model)
    misfit = weighted_misfit(with_reference(predictions_of(model, data)))
    scales = scales_of(misfit.predictions)

    def fitted() -> EffectFit:
        fit = baseline_fit(misfit)
        for kind in kinds:
            fit = fit_effect(misfit, candidate(kind, scales), fit)
        return fit

    misfit = with_errors_passed_on(misfit, fitted())
    fit = fitted()

    def log_evidence(one: EffectFit) -> float:
        """With the noise as it is stated, and sizes of levels' errors as the misfit has them."""
        marginal = marginal_of(misfit, one)
        if marginal is None:
            return -np.inf
        return marginal.rows.log_likelihood(1.0, np.ones(len(marginal.group)))[0] - marginal.penalty

    laplace, none = log_evidence(fit), log_evidence(baseline_fit(misfit))
    # Of rows made independent, which have the ln determinant and the units of all answers alike.
    alike = none + 0.5 * misfit.chi_square(misfit.base)
    labels, transform = prior_transform(misfit, kinds)
    calls = 0

    def log_likelihood(values: np.ndarray) -> float:
        nonlocal calls
        calls += 1
        predictions = misfit.predictions
        found = predictions.of(predictions.group.at(labels, values)[None])
        rows = misfit.noise.noise_units(found.columns)
        square = misfit.chi_square(rows[0])
        return -0.5 * square if np.isfinite(square) else -1e100

    begin = time.perf_counter()
    # Random walks: the posterior of a further mode is a narrow, bent valley.
    sampler = dynesty.NestedSampler(
        log_likelihood,
        transform,
        len(labels),
        nlive=live,
        sample="rwalk",
        rstate=np.random.default_rng(1),
    )
    sampler.run_nested(dlogz=0.1, print_progress=False)
    found = sampler.results
    return {
        "set": name,
        "answer": "+".join(kinds),
        "fit": fit.status.value,
        "laplace": round(laplace - none, 2),
        "nested": round(float(found.logz[-1]) + alike - none, 2),
        "nested_std": round(float(found.logzerr[-1]), 2),
        "calls": calls,
        "seconds": round(time.perf_counter() - begin, 1),
    }


def main() -> None:
    """One line a case."""
    chosen = options(__doc__, sets=Path, live=100, cases=[""])
    for case in chosen.cases:
        name, _, kinds = case.partition(":")
        tell(**compared(chosen.sets, name, kinds.split("+"), chosen.live))


if __name__ == "__main__":
    main()
