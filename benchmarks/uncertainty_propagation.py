"""Uncertainty of peak, folds and resonance: derivatives against members, and where they part.

Run: python benchmarks/uncertainty_propagation.py [--members 2048] [--case NAME] [--figures DIR]

Both numerical beams of the method paper, each at a force where its folds are far apart and at one
where they are near to merging. Uncertain and independent, 1σ at scale 1: natural frequency of
the mode of interest 0.5 %, damping ratio 5 % (lognormal), two coefficients of the potential 2.5 %
each, force 1 %. At a small scatter (scale 0.5) and a large one (scale 5): mean, standard deviation
and 95 % range of the frequency (Hz) and velocity (m/s) of the highest peak, every fold and the
phase resonance by first order, second order, Monte Carlo and quasi-Monte Carlo (8 scramblings),
1σ of the latter two, members at which the motion ceases to exist, and members whose whole response
curve, traced by continuation, has another event in its place; and the factor on the scatter from
which first order errs by 10 % (its mean in standard deviations, its standard deviation, the ends of
its 95 % range in half widths), as second order predicts it. Last total Sobol' indices at the small
scatter. One JSON line each.
"""

import argparse
import json
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

import snrmjax as sj
from snrmjax.study.uncertainty.moments import STATISTICS
from snrmjax.study.uncertainty.propagation import METHODS
from snrmjax.study.uncertainty.quantities import MemberStatus

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


def tell(**fields: object) -> None:
    """One JSON line with numbers of five digits."""

    def short(value: object) -> object:
        if isinstance(value, float):
            return float(f"{value:.5g}") if np.isfinite(value) else str(value)
        if isinstance(value, list):
            return [short(one) for one in value]
        if isinstance(value, dict):
            return {name: short(one) for name, one in value.items()}
        return value

    rounded = {name: short(value) for name, value in fields.items()}
    print(json.dumps({"benchmark": "uncertainty_propagation", **rounded}), flush=True)


def quantities(case: Case, scale: float) -> sj.study.ResponseQuantities:
    """Peak, folds and resonance of a case with its scatter times a scale."""
    own = sj.model.parameters.parameter_values(case.model)
    relative = {
        "mode_1.natural_frequency": 0.005,
        "mode_1.damping_ratio": 0.05,
        **dict.fromkeys(case.coefficients, 0.025),
    }
    std = {name: scale * share * abs(own[name]) for name, share in relative.items()}
    inputs = sj.study.uncertain_inputs(
        case.model,
        {**std, "force_n": scale * 0.01 * case.force},
        force=case.force,
        marginals={"mode_1.damping_ratio": "lognormal"},
    )
    low, high = (HERTZ * end for end in case.ends_hz)
    return sj.study.response_quantities(
        case.model, inputs, low, high, harmonic_order=case.harmonic_order
    )


def propagated(name: str, case: Case, members: int) -> dict[str, sj.study.Propagation]:
    """Both scatters of a case, printed."""
    found = {}
    settings = sj.study.PropagationSettings(members=members)
    for scatter, scale in SCALES.items():
        begin = time.perf_counter()
        result = sj.study.propagate_uncertainty(quantities(case, scale), settings)
        seconds = time.perf_counter() - begin
        for q, quantity in enumerate(result.names):
            rows = {
                method: dict(zip(STATISTICS, result.statistics[m, :, q].tolist(), strict=True))
                for m, method in enumerate(METHODS)
            }
            for m, method in enumerate(METHODS[2:]):
                rows[method]["1σ of each"] = result.standard_error[m, :, q].tolist()
            counts = result.status_counts[:, q]
            tell(
                case=name,
                scatter=scatter,
                quantity=quantity,
                nominal=float(result.expansion.value[q]),
                **rows,
                first_order_error=result.first_order_error[:, q].tolist(),
                scatter_of_10_percent_error=result.scatter_limit[:, q].tolist(),
                members=int(counts.sum()),
                replaced=int(counts[MemberStatus.REPLACED]),
                ceased=int(counts[MemberStatus.CEASED]),
                impossible=int(counts[MemberStatus.IMPOSSIBLE]),
                traced_differ=f"{result.traced.differ[q]} of {result.traced.members}",
            )
        tell(case=name, scatter=scatter, seconds=seconds, notes=list(result.notes))
        found[scatter] = result
    return found


def indices(name: str, case: Case, members: int) -> None:
    """Total Sobol' indices at the small scatter, printed."""
    some = quantities(case, SCALES["small"])
    begin = time.perf_counter()
    shares = sj.study.sobol_indices(some, base_rows=max(members // 8, 64))
    seconds = time.perf_counter() - begin
    for q, quantity in enumerate(some.names):
        tell(
            case=name,
            quantity=quantity,
            inputs=list(shares.input_names),
            total=shares.total[q].tolist(),
            total_half_width=shares.total_half_width[q].tolist(),
        )
    tell(case=name, sobol_seconds=seconds)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, default=2048, help="of each sampling")
    parser.add_argument("--case", choices=CASES, action="append", help="all by default")
    parser.add_argument("--figures", type=Path, help="folder to draw into")
    asked = parser.parse_args()
    for name in asked.case or CASES:
        results = propagated(name, CASES[name], asked.members)
        indices(name, CASES[name], asked.members)
        if asked.figures is not None:
            asked.figures.mkdir(parents=True, exist_ok=True)
            stem = name.replace(",", "").replace(" ", "_")
            sj.plot.save_figure(asked.figures / f"{stem}_members.png", results["large"].plot())


if __name__ == "__main__":
    main()
