"""Why a test is not diagnosed: of columns that mean something else the answer would be wrong."""

from snrmjax.doctor.doubts import doubt
from snrmjax.measure.phase_convention import wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.report.whole_test.mends import FilesOfTest, command_line


def not_diagnosed(
    data: SteadyStates, model: Structure, place: FilesOfTest | None
) -> tuple[str, ...]:
    """A sentence where phases, units or scales are not those of the model's mode, else none.

    The search would explain them by ever larger effects, which harmonic balance follows for many
    minutes. A mode that is merely far from the linear one is diagnosed: effects may be why.
    """
    said = (*wrong_phases(data, model), *doubt(data, model))
    if not said:
        return ()
    anyway = ""
    if place is not None and place.out is not None:
        found = place.out / "model.toml" if place.model is None else place.model
        measured = place.out / "measured.csv"
        to = place.out / "diagnose"
        line = command_line(("diagnose", measured, "--model", found, "--out", to))
        anyway = f" To diagnose it nevertheless: `{line}`."
    return (
        "The diagnosis was left out, as it would explain an error of the columns by effects that "
        f"the structure does not have: {said[0]}{anyway}",
    )
