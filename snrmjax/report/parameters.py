"""Parameters of effects as reports print them: value, 1σ and unit, name and meaning."""

from collections.abc import Mapping

from snrmjax.model.attachment import InfluenceVector, unit_at
from snrmjax.model.effects import effect_class
from snrmjax.numerics.units import unit_in_print
from snrmjax.report.html import number, with_error


def own_parameters(kind: str, parameters: Mapping[str, tuple[float, float]]) -> dict:
    """The parameters of one effect by their own names."""
    start = f"{kind}."
    return {k.removeprefix(start): v for k, v in parameters.items() if k.startswith(start)}


def values_in_words(
    kind: str, parameters: Mapping[str, tuple[float, float]], row: InfluenceVector | None = None
) -> str:
    """The parameters of one effect, at an influence vector if given, with value, 1σ and unit."""
    return ", ".join(
        " ".join((parameter_words(name), *value_and_unit(kind, name, pair, row))).strip()
        for name, pair in own_parameters(kind, parameters).items()
    )


def value_and_unit(
    kind: str, name: str, pair: tuple[float, float], row: InfluenceVector | None = None
) -> tuple[str, str]:
    """A value with its 1σ and the unit; stated as not determined where it has no 1σ."""
    value, std = pair
    if std > 0:
        return with_error(value, std), printed_unit(kind, name, row)
    return f"{number(value)} (1σ not determined by these data)", printed_unit(kind, name, row)


def printed_unit(kind: str, name: str, row: InfluenceVector | None = None) -> str:
    """The unit of a parameter of an effect on the mode, or at an influence vector."""
    return unit_in_print(unit_at(row, effect_class(kind).parameters()[name].unit))


def parameter_meaning(kind: str, name: str) -> str:
    """What a parameter is, in a few words."""
    return effect_class(kind).parameters()[name].meaning or parameter_words(name)


def parameter_words(name: str) -> str:
    """A parameter's name in words."""
    return name.removesuffix("_hz").removesuffix("_deg").replace("_", " ")
