"""Forces of stuck dry friction: any reaction up to the friction limit.

Evaluated along a motion below its measurement error, a friction law would give its full force in
the direction of that error.
"""

import numpy as np
from jaxtyping import Complex

from snrmjax.diagnose.location.element_motion import ElementForces, SurroundedElement

_FIRST_OF_SQUARE = 4 / np.pi  # fundamental of a square wave of height 1


def stuck_forces(
    limit: float, required: Complex[np.ndarray, " state"], element: SurroundedElement
) -> ElementForces:
    """The forces of stuck friction: the required ones, up to the fundamental of full sliding.

    Arguments: `limit`: friction limit in N; `required`: fundamental of the force that the sensors
    require in each state. The motion is unchanged, and the force has no other harmonics.
    """
    capacity, magnitude = _FIRST_OF_SQUARE * limit, np.abs(required)
    sliding = magnitude > capacity
    direction = required / np.where(magnitude > 0, magnitude, 1.0)
    n_states, n_orders = element.motion.shape
    force = np.zeros((n_states, n_orders), dtype=complex)
    force[:, 1] = np.where(sliding, capacity * direction, required)
    by_parameter = np.zeros((n_states, n_orders, 1), dtype=complex)
    by_parameter[:, 1, 0] = np.where(sliding, _FIRST_OF_SQUARE * direction, 0.0)
    return ElementForces(
        force,
        element.motion,
        by_parameter,
        by_motion=np.zeros((n_states, n_orders, 2), dtype=complex),
        slopes=np.zeros((n_states, 2 * n_orders - 1, 2 * n_orders - 3)),
        settled=np.ones(n_states, dtype=bool),
    )
