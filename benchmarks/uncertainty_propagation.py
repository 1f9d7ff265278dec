"""Uncertainty of peak, folds and resonance: derivatives against the members of a study.

Run: python benchmarks/uncertainty_propagation.py [--members 2048] [--case NAME]

Both numerical beams of the method paper, each at a force where its folds are far apart and at one
where they are near to merging. Uncertain and independent, 1σ at scale 1: natural frequency of
the mode of interest 0.5 %, damping ratio 5 % (lognormal), two coefficients of the potential 2.5 %
each, force 1 %. At a small scatter (scale 0.5) and a large one (scale 5): mean, standard deviation
and 95 % range of the frequency (Hz) and velocity (m/s) of the highest peak and the phase resonance
by first order, by second order and by the members of a study (a Sobol' sequence), members that
have another number of folds, and the factor on the scatter from which first order errs by 10 % (its
mean in standard deviations, its standard deviation, the ends of its 95 % range in half widths), as
second order predicts it. One JSON line each.
"""

import time
from typing import NamedTuple

import numpy as np
from harness import options, teller

import snrmjax as sj
from snrmjax.study.uncertainty.propagation import STATISTICS

tell = teller(__file__)

HERTZ = 2 * np.pi
SCALES = {"small": 0.5, "large": 5.0}


class Case(NamedTuple):
    """A beam under one force, and which of its potential's coefficients are uncertain."""

    model: sj.model.Structure
    force: float  # N
    ends_hz: tuple[float, float]
    coefficients: tuple[str, str]
    harmonic_order: int


CURVED, FLAT = ("potential.111", "potential.1111"), ("potential.1111", "potential.1122")
CASES = {
    "flat, folds far apart": Case(sj.model.flat_beam(), 1.334e-2, (60, 130), FLAT, 5),
    "flat, folds near": Case(sj.model.flat_beam(), 8.896e-3, (60, 130), FLAT, 5),
    "curved, stiffening": Case(sj.model.curved_beam(), 1e-3, (20, 160), CURVED, 9),
    "curved, softening": Case(sj.model.curved_beam(), 1.334e-4, (30, 110), CURVED, 9),
}


def varied_of(case: Case, scale: float) -> tuple:
    """What is uncertain, with its scatter times a scale."""
    own = sj.model.parameters.parameter_values(case.model)
    relative = {
        "mode_1.natural_frequency": 0.005,
        "mode_1.damping_ratio": 0.05,
        **dict.fromkeys(case.coefficients, 0.025),
    }
    numbers = {
        name: (own[name], scale * share * abs(own[name])) for name, share in relative.items()
    }
    numbers["force_n"] = case.force, scale * 0.01 * case.force
    return tuple(
        (sj.study.LogNormal if name.endswith("damping_ratio") else sj.study.Normal)(name, *number)
        for name, number in numbers.items()
    )


def study_of(case: Case, varied: tuple, sampling: sj.study.Sampling) -> sj.study.Study:
    """The peaks of a case's members."""
    low, high = (HERTZ * end for end in case.ends_hz)
    within = sj.study.ResponseRange(low, high, harmonic_order=case.harmonic_order, stability=False)
    return sj.study.Study("members", case.model, sj.study.Peaks(within), varied, sampling)


def propagated(name: str, case: Case, members: int) -> None:
    """Both scatters of a case, printed."""
    for scatter, scale in SCALES.items():
        varied = varied_of(case, scale)
        low, high = (HERTZ * end for end in case.ends_hz)
        begin = time.perf_counter()
        found = sj.study.propagate_uncertainty(
            sj.study.response_quantities(
                case.model, varied, low, high, harmonic_order=case.harmonic_order
            )
        )
        middle = time.perf_counter()
        sampling = sj.study.Sampling("sobol", members)
        study = study_of(case, varied, sampling)
        rows = study.ensemble().rows(range(members))
        end = time.perf_counter()
        for q, quantity in enumerate(found.quantities.names):
            by = dict(zip(("first order", "second order"), found.statistics[:, :, q], strict=True))
            if quantity in rows:
                values = rows[quantity][np.isfinite(rows[quantity])]
                ends = np.quantile(values, [0.025, 0.975])
                by["members"] = np.array([values.mean(), values.std(ddof=1), *ends])
            tell(
                case=name,
                scatter=scatter,
                quantity=quantity,
                **{
                    method: dict(zip(STATISTICS, row.tolist(), strict=True))
                    for method, row in by.items()
                },
                first_order_error=found.first_order_error[:, q].tolist(),
                scatter_of_10_percent_error=found.scatter_limit[:, q].tolist(),
            )
        folds = sum(one.startswith("fold") for one in found.quantities.names) // 2
        tell(
            case=name,
            scatter=scatter,
            other_number_of_folds=f"{int(np.sum(rows['n_folds'] != folds))} of {members}",
            derivative_seconds=middle - begin,
            members_seconds=end - middle,
            notes=[str(note) for note in found.notes],
        )


def main() -> None:
    """Measure and print."""
    asked = options(__doc__, members=2048, case=list(CASES))
    for name in asked.case:
        propagated(name, CASES[name], asked.members)


if __name__ == "__main__":
    main()
