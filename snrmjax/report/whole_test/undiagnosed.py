"""Why a test is not diagnosed: of columns that mean something else the answer would be wrong."""

from snrmjax.doctor.column_misreadings import doubt
from snrmjax.measure.phase_convention import wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure


def not_diagnosed(data: SteadyStates, model: Structure) -> tuple[str, ...]:
    """A sentence where phases, units or scales are not those of the model's mode, else none.

    The search would explain them by ever larger effects, which harmonic balance follows for many
    minutes. A mode that is merely far from the linear one is diagnosed: effects may be why.
    """
    said = (*wrong_phases(data, model), *doubt(data, model))
    if not said:
        return ()
    return (
        "The diagnosis was left out, as it would explain an error of the columns by effects that "
        f"the structure does not have: {said[0]} `snrmjax diagnose` of measured.csv does it "
        "nevertheless.",
    )
