"""Sentences of pipelines, in addition to those of their parts."""

from collections import Counter
from collections.abc import Sequence

from snrmjax.report.sentences import Wording, enumerated, of_levels

_NOT_LOCATED = {
    "branch": (
        "a further branch that enters from above the range, where no solution was found to start "
        "from: raise `--to-hz` until the resonance lies inside"
    ),
    "bifurcation": "a change of stability whose type or frequency was not determined",
}


def _not_located(force: float, unit: str, kinds: Sequence[str]) -> str:
    counts = Counter(_NOT_LOCATED.get(kind, f"a {kind.replace('_', ' ')}") for kind in kinds)
    each = [text if n == 1 else f"{text} ({n} times)" for text, n in counts.items()]
    return f"force {force:g} {unit}: detected but missing in response.csv: {'; '.join(each)}."


def _equilibria(
    sensor: str, rest: float, displacement: tuple[float, ...], stable: tuple[bool, ...]
) -> str:
    listed = [
        f"{'stable' if is_stable else 'unstable'} at {1e3 * position:.3g} mm"
        for position, is_stable in zip(displacement, stable, strict=True)
    ]
    several = "one further equilibrium" if len(listed) == 1 else f"{len(listed)} further equilibria"
    start = "rest" if rest == 0.0 else f"the one at {1e3 * rest:.3g} mm"
    if any(stable):
        start += ", and responses also from the stable ones that the force does not drive it out of"
    return f"the model has {several}, at {sensor}: {enumerated(listed)}. Curves start from {start}."


def _load(force: float, drive: float | None, at: str | None = None, unit: str = "N") -> str:
    newtons = f"{force:g} {unit}" if drive is None else f"{drive:.5g} V ({force:.4g} N)"
    return newtons if at is None else f"{newtons} at {at}"


def _subharmonics(
    force: float, unit: str, order: int, branches: Sequence[tuple[float, float, bool]]
) -> str:
    start, period = f"force {force:g} {unit}", f"repeat after {order} periods of the force"
    if not branches:
        return (
            f"{start}: no motions that {period} were found, from period doublings or from the free "
            f"oscillation of a mode near 1/{order} of the frequency of the force; the search can "
            "miss some."
        )
    listed = [
        f"{low:.5g} to {high:.5g} Hz ({'partly stable' if stable else 'unstable'})"
        for low, high, stable in branches
    ]
    return f"{start}: motions that {period}: {'; '.join(listed)}."


def _no_stable_response(
    force: float,
    unit: str,
    from_hz: float,
    to_hz: float,
    isolated: bool,
    wells: int = 1,
    doublings_hz: Sequence[float] = (),
) -> str:
    further = "" if isolated else "; `--isolated` searches for further responses"
    if wells > 1 and not isolated:
        further = "; motions across several wells were not searched: `--isolated` does"
    doubled = "".join(
        f" Period doubling at {hertz:.5g} Hz: `--subharmonic 2` follows the motions of twice the "
        "period that begin there."
        for hertz in doublings_hz
    )
    return (
        f"force {force:g} {unit}: no stable response with the period of the force was found from "
        f"{from_hz:.5g} to {to_hz:.5g} Hz: a sweep leaves the curves there{further}.{doubled}"
    )


def _element_idle(force: float, unit: str, element: str, slides: bool, fraction: float) -> str:
    state, more = ("sticks", "slip") if slides else ("is not reached", "reach it")
    whole = "slip displacement" if slides else "gap"
    makes = f"more force makes it {more}" if slides else f"more force would {more}"
    return (
        f"force {force:g} {unit}: {element} {state} throughout this range (the motion reaches "
        f"{100 * fraction:.3g} % of its {whole}): {makes}."
    )


def _stuck(force: float, unit: str, element: str, slides_from: float) -> str:
    if force < slides_from:
        return (
            f"force {force:g} {unit}: {element} sticks: in this range it slides only above about "
            f"{slides_from:.3g} {unit}; raise the force."
        )
    return (
        f"force {force:g} {unit}: no solution was found at the start of the range, although "
        f"{element} slides above about {slides_from:.3g} {unit}: it may stick for part of the "
        "period; raise the force, or use more --harmonics."
    )


def _load_scale(stated: float, coefficient: str, change: float, chosen: float) -> str:
    return (
        f"with `load_scale` = {stated:g} thicknesses the coefficient {coefficient} differs by "
        f"{100 * change:+.0f} % from that of {chosen:.2g} thicknesses, the scale chosen "
        "by default"
    )


def _by_import(advice: object, commands: tuple[str, ...]) -> str:
    return f"{str(advice).rstrip('.')}: {', or '.join(commands)}."


SENTENCES: dict[str, Wording] = {
    "advice_by_import": _by_import,
    "advice_at_once": "{names} together: {command}. Separately, {alone}",
    "load": _load,
    "level_missed_by_curves": (
        "level {level} has its resonance at {force:.4g} N, measured at {frequency_hz:.5g} Hz, "
        "{velocity:.3g} m/s: the curves miss this level."
    ),
    "resonance_beyond_data": ("the resonance at {load} lies beyond the measured amplitudes."),
    "response_note": "response at {load}: {note}",
    "several_resonances": (
        "{n} resonances at {load}: damping that falls with amplitude allows several."
    ),
    "force_from_drive": (
        "forces in N are drive voltage times the fitted gain ({newtons_per_volt:.4g} N/V ± "
        "{relative_std:%.2g}); an error of the model's modal mass is also one of the gain."
    ),
    "fewer_advised": "{n} of {wanted} further measurements are advised: {why}.",
    "resonances_missed": lambda *, levels: (
        "the completed model's resonances lie far from the measured ones at "
        f"{of_levels(levels)}: it does not reproduce these responses. Check the model's "
        "participation and linear frequency, and the scale of the force."
    ),
    "some_levels_simulated": (
        "the responses of {n} of {of} levels were simulated, from the smallest to the largest "
        "force."
    ),
    "responses_not_complete": lambda *, levels: (
        f"the simulated responses of {of_levels(levels)} were not traced to the end of the "
        "frequency range: a resonance may be missing there."
    ),
    "diagnosis_left_out": (
        "The diagnosis was skipped, as it would attribute an error of the columns to effects that "
        "the structure does not have: {why} `snrmjax diagnose` of measured.csv runs it anyway."
    ),
    "sensor_not_named": (
        "no sensor is named in {files}: the model's only one, {sensor}, is assumed. Name it in a "
        "column `sensor`, or by `--sensor` of the import."
    ),
    "isolated_searched": (
        "{n} further branches found at {force:g} N, of {n_starts} starts ({n_failed} failed)"
    ),
    "subharmonic_searched": _subharmonics,
    "superharmonic_resonance": (
        "force {force:g} {unit}: superharmonic resonance at {frequency_hz:.5g} Hz: harmonic "
        "{harmonic}, near mode {mode}, has up to {ratio:%.2g} of the fundamental velocity."
    ),
    "torus_not_followed": (
        "no quasi-periodic motions were followed from {frequency_hz:.5g} Hz at force {force:g}: "
        "{why}"
    ),
    "no_event_to_follow": (
        "no response has a {event} to follow in this range of frequencies: it may lie outside, or "
        "another force has it."
    ),
    "harmonics_left_out": (
        "the harmonics above {harmonics} would change the velocity by up to about {fraction:%.2g} "
        "somewhere; use more --harmonics."
    ),
    "internal_resonance": (
        "internal resonance 1:{harmonic} with mode {mode} from {from_hz:.5g} to {to_hz:.5g} Hz: "
        "harmonic {harmonic} drives it, with up to {fraction:%.3g} of the energy"
    ),
    "mode_unstable": (
        "the mode is unstable at {n} points from {from_hz:.5g} to {to_hz:.5g} Hz: free motions "
        "depart from it there"
    ),
    "mode_not_followed": (
        "the mode ends at {ends_hz:.5g} Hz instead of {to_hz:.5g} Hz: it {status.message}."
    ),
    "no_stable_response": _no_stable_response,
    "element_idle": _element_idle,
    "held_by_friction": _stuck,
    "damping_not_known": (
        "the damping ratio of mode {mode} is known only to ± {relative_std:%.1g} (1σ), and so is a "
        "peak there: as stated in the model, or from rounded entries of its damping matrix (for a "
        "fine mesh state `damping_ratio`, or a multiple of the stiffness)."
    ),
    "curve_ended": "force {force:g} {unit}: a curve {status.message}.",
    "curve_events_not_located": _not_located,
    "stability_not_computed": (
        "force {force:g} {unit}: the stability of {n} points could not be computed; response.csv "
        "has 0 there, with a mark in `event`."
    ),
    "further_equilibria": _equilibria,
    "load_scale_outside_plateau": (
        "the load scale of the model is not inside a plateau of the coefficients"
    ),
    "several_equilibria": (
        "the reduced model has {n} stable equilibria: responses may settle in one other than rest"
    ),
    "load_scale_compared": _load_scale,
    "load_scale_not_compared": (
        "`load_scale` = {stated:g} thicknesses cannot be compared with the default scale: {why}"
    ),
}
