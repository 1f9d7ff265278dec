"""Sentences on the consistency of static load cases."""

from snrmjax.report.sentences import Wording


def _contradiction(names: str, against_force: bool, times: float | None, **_: object) -> str:
    reason = " (displaced against the force: is the sign wrong?)" if against_force else ""
    if times is not None:
        reason = f" (displacements {times:.3g} times the linear ones: wrong unit, or snap-through?)"
    return f"inconsistent with the other load cases: {names}{reason}"


def _linear_part(modes: tuple[int, ...], ratios: tuple[float, ...]) -> str:
    listed = ", ".join(f"{r:.4g} (mode {m})" for m, r in zip(modes, ratios, strict=True))
    return (
        f"the linear stiffness fitted to the load cases is {listed} times the squared natural "
        "frequency: shapes, units, loads and frequencies are inconsistent, or the loads are too "
        "large for a polynomial of this degree"
    )


def _too_large(misfit: float, degree: int, longer: bool) -> str:
    residual = f"the residual of the fit is {100 * misfit:.2g} % of the nonlinear force"
    if longer:
        return (
            f"{residual}: the loads are too large for degree {degree}; use a smaller load scale or "
            "a higher degree"
        )
    return f"{residual}: no polynomial of this degree fits the load cases"


def _not_converged(cases: tuple[int, ...], names: str, n_all: int) -> str:
    return f"{len(cases)} of {n_all} load cases did not converge and are left out: {names}"


SENTENCES: dict[str, Wording] = {
    "not_converged": _not_converged,
    "repeated_case": "duplicate load cases: {names}",
    "inconsistent_case": _contradiction,
    "linear_part": _linear_part,
    "too_small": (
        "the residual of the fit is {misfit:%.2g} of the nonlinear force, which is only "
        "{nonlinear:.2g} of the linear force: round-off of the displacements dominates; use a "
        "larger load scale or write more digits"
    ),
    "too_large": _too_large,
    "other_regime": (
        "the tangent stiffness is no longer positive at {names}: beyond snap-through the "
        "potential mixes two regimes; use a smaller load scale"
    ),
    "not_checked": (
        "some coefficients rest on a single load case each: their standard deviation and the "
        "cross-validation error are unknown; add load levels"
    ),
    "energy": (
        "the strain energy of the reduced model differs from that of the finite elements by up to "
        "{largest:%.2g} at {names}"
    ),
}
