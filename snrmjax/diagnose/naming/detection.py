"""Detection limits of further effects, from the rows of the same problem."""

import itertools
from collections.abc import Collection

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.kinds.registry import hypothesis_of, starts_of
from snrmjax.diagnose.naming.columns import hypothesis_columns, parameters_of
from snrmjax.diagnose.naming.evidence import detectable_strengths
from snrmjax.diagnose.naming.parts import Naming
from snrmjax.diagnose.naming.rows import Problem
from snrmjax.model.effect_metadata import VISIBLE_CHANGE, MotionScales
from snrmjax.model.effect_shape import shape_of
from snrmjax.model.effects import EFFECTS, effect_class, effect_parameters


def detection_limits(
    problem: Problem, naming: Naming, excluded: Collection[str]
) -> dict[str, float]:
    """The smallest detectable strength of every further effect, in its own unit.

    By parameter, at the most detectable shape. Left out are the effects of the answer, those
    `excluded`, and those to which the data are insensitive.
    """
    known = [problem.columns[k] for k in naming.cell.columns]
    tried = {column.kind for column in problem.columns} - {*excluded, *naming.effects}
    kinds = (kind for kind in EFFECTS if kind in tried and hypothesis_of(kind).searched)
    # All shapes, not only those refined for these rows.
    problem = problem.with_columns([*known, *hypothesis_columns(problem.readings, kinds)])
    cell = naming.cell._replace(columns=tuple(range(len(known))))
    strength = detectable_strengths(problem, cell, priors.DETECTED)
    smallest = 2 * priors.BELOW_BANDWIDTH * problem.readings.damping_ratio  # relevant change
    limits: dict[str, float] = {}
    further = zip(problem.columns, strength.tolist(), strict=True)
    for column, by_rows in itertools.islice(further, len(known), None):
        kind, detectable = column.kind, by_rows
        if not (hypothesis_of(kind).of_instrument or np.any(column.higher)):
            detectable = max(by_rows, smallest / float(np.max(np.abs(column.change))))
        sign = -1 if column.limits[1] <= 0 else 1
        values = parameters_of(problem.readings, column, sign * detectable)
        if values is None or not np.isfinite(detectable):
            continue
        first = effect_parameters(kind)[0]
        name, value = f"{kind}.{first}", abs(values[first])
        if value > 0:
            limits[name] = min(value, limits.get(name, np.inf))
    return limits


def beyond_data(kind: str, limit: float, scales: MotionScales | None) -> bool:
    """Whether the change by an effect at its detection limit exceeds ten times all measured.

    Arguments: `limit`: of its strength, in its own unit; `scales`: of the measured motions, without
    which only relative strengths are assessed.
    """
    effect = effect_class(kind)
    unit = next(iter(effect.parameters().values())).unit
    if not np.isfinite(limit) or (unit == "1" and limit > priors.BEYOND_DATA):
        return True
    starts = [] if scales is None else starts_of(kind, scales)
    if not starts or not starts[0][0]:
        return False
    shape = shape_of(effect)
    order = 1 if shape is None else shape.strength_order
    return bool(VISIBLE_CHANGE * (limit / abs(starts[0][0])) ** order > priors.BEYOND_DATA)
