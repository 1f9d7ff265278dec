"""What static load cases show against themselves."""

from snrmjax.report.sentences import Wording


def _contradiction(names: str, against_force: bool, times: float | None, **_: object) -> str:
    reason = " (against their force: is the sign wrong?)" if against_force else ""
    if times is not None:
        reason = (
            f" (displacements {times:.3g} times the linear ones: another unit, or a snap-through?)"
        )
    return f"the other load cases contradict {names}{reason}"


def _linear_part(modes: tuple[int, ...], ratios: tuple[float, ...]) -> str:
    said = ", ".join(f"{r:.4g} (mode {m})" for m, r in zip(modes, ratios, strict=True))
    return (
        f"the load cases show a linear stiffness of {said} times the squared natural frequency: "
        "shapes, units, loads and frequencies do not belong together, or the loads are too large "
        "for a polynomial of this degree"
    )


def _too_large(misfit: float, degree: int, longer: bool) -> str:
    said = f"the potential leaves {100 * misfit:.2g} % of the nonlinear force"
    if longer:
        return (
            f"{said}: the loads are too large for degree {degree}; take a smaller load scale or a "
            "higher degree"
        )
    return f"{said}: no polynomial of this degree fits the load cases"


def _not_converged(cases: tuple[int, ...], names: str, n_all: int) -> str:
    return f"{len(cases)} of {n_all} load cases have no solution and are left out: {names}"


SENTENCES: dict[str, Wording] = {
    "not_converged": _not_converged,
    "repeated_case": "the same load twice: {names}",
    "inconsistent_case": _contradiction,
    "linear_part": _linear_part,
    "too_small": (
        "the potential leaves {misfit:%.2g} of the nonlinear force, which is only {nonlinear:.2g} "
        "of the linear force: round-off of the displacements dominates; take a larger load scale "
        "or write more digits"
    ),
    "too_large": _too_large,
    "other_regime": (
        "the tangent stiffness is no longer positive at {names}: beyond a snap-through the "
        "potential mixes two regimes; take a smaller load scale"
    ),
    "not_checked": (
        "some coefficients rest on a single load case each: their standard deviation and the "
        "cross-validated error are not known; add load levels"
    ),
    "energy": (
        "the strain energy of the reduced model is off by up to {largest:%.2g} from the finite "
        "elements' at {names}"
    ),
}
