"""What dry friction does where it sticks: it holds any force up to its limit.

Along a motion that errs by more than itself a law of friction would make a force of full size in
the direction of the error.
"""

import numpy as np
from jaxtyping import Complex

from snrmjax.diagnose.location.element_motion import ElementForces, SurroundedElement

_FIRST_OF_SQUARE = 4 / np.pi  # fundamental of a square wave over its height


def held_forces(
    limit: float, asked: Complex[np.ndarray, " state"], element: SurroundedElement
) -> ElementForces:
    """The forces of stuck friction: those asked for, up to the fundamental of full sliding.

    Arguments: `limit` of the force in N; `asked` is the fundamental of the force that the sensors
    ask for in each state. The motion is left as it is, without harmonics.
    """
    most, size = _FIRST_OF_SQUARE * limit, np.abs(asked)
    over = size > most
    direction = asked / np.where(size > 0, size, 1.0)
    n_states, n_orders = element.motion.shape
    force = np.zeros((n_states, n_orders), dtype=complex)
    force[:, 1] = np.where(over, most * direction, asked)
    by_parameter = np.zeros((n_states, n_orders, 1), dtype=complex)
    by_parameter[:, 1, 0] = np.where(over, _FIRST_OF_SQUARE * direction, 0.0)
    return ElementForces(
        force,
        element.motion,
        by_parameter,
        by_motion=np.zeros((n_states, n_orders, 2), dtype=complex),
        slopes=np.zeros((n_states, 2 * n_orders - 1, 2 * n_orders - 3)),
        settled=np.ones(n_states, dtype=bool),
    )
