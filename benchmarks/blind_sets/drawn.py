"""Is a drawn law the true one? Its table against the force that the generator integrated.

A drawn law is `right` where the true force is inside its 95 % band over at least 90 % of the range
that was measured, and where one law alone was drawn of what the true one is a function of;
`class open` where it is of another class and the answer names the true class as one that would do
as well; `wrong` otherwise: what acts through the instruments, a further mode or the order of the
test is no law of the motion. The truth may be an effect of the library, several of one class, or a
law outside the library. Without harmonics the odd part of a force is compared, all that such data
show.
"""

from collections.abc import Mapping

import forces
import jax.numpy as jnp
import laws
import numpy as np

BAND = 1.96
INSIDE = 0.9
RIGHT, OPEN, WRONG = "drawn right", "class open", "drawn wrong"
AT_ONCE = 1e-9  # speed over which a sign of the velocity is rounded, over the largest speed

OF: dict[str, str] = {
    **laws.OF,
    **dict.fromkeys(
        ("cubic_stiffness", "quadratic_stiffness", "quintic_stiffness"), "displacement"
    ),
    **dict.fromkeys(("bilinear_stiffness", "gap_stiffness", "one_sided_stop"), "displacement"),
    **dict.fromkeys(("hertz_clearance", "magnet_stiffness"), "displacement"),
    **dict.fromkeys(("coulomb_friction", "quadratic_damping", "cubic_damping"), "velocity"),
    **dict.fromkeys(("square_root_damping", "asymmetric_damping"), "velocity"),
    "van_der_pol_damping": "damping by displacement",
    **dict.fromkeys(("jenkins_slider", "iwan_microslip"), "slip"),
}
"""What each force is a function of; kinds that are not here are no such function."""


def class_of(kind: str) -> str:
    """What an effect of a drawn model is a function of."""
    if kind == "displacement_damping_law":
        return "damping by displacement"
    if kind == "slip_law":
        return "slip"
    return "displacement" if kind.endswith("stiffness_law") else "velocity"


def true_kinds(key: dict) -> list[str]:
    """Everything that the baseline lacks."""
    return [key["outside"]] if key["outside"] else list(key["effects"])


def curve_of(kind: str, parameters: Mapping[str, float], x: np.ndarray) -> np.ndarray:
    """A law at displacements or velocities in the units of its parameters (`laws.true_curve`)."""
    if kind in laws.OF:
        return laws.true_curve(kind, parameters, x)
    if kind == "jenkins_slider":
        slip = parameters["jenkins_slider.slip_displacement"]
        return -parameters["jenkins_slider.stiffness"] * np.maximum(x - slip, 0.0)
    if kind == "iwan_microslip":
        power = parameters["iwan_microslip.exponent"]
        return -parameters["iwan_microslip.coefficient"] * np.maximum(x, 0.0) ** power
    p = {name: jnp.asarray(value) for name, value in parameters.items()}
    p["lane.speed"] = jnp.asarray(AT_ONCE * np.max(np.abs(x)))
    at, zero = jnp.asarray(x), jnp.zeros(len(x))
    pair = {
        "displacement": (at, zero),
        "velocity": (zero, at),
        "damping by displacement": (at, zero + 1),
    }[OF[kind]]
    return np.asarray(forces.MEMORYLESS[kind](*pair, p))


def true_force(key: dict, at: np.ndarray, law: dict) -> np.ndarray:
    """The true force at the sensor, N, where a drawn law has its table."""
    base, kinds = key["baseline"], true_kinds(key)
    omega, size, unit_force, speed = 1.0, 1.0, 1.0, 1.0
    if key["parameters_scaled"]:
        omega, size = 2 * np.pi * base["frequency_hz"], base["displacement_scale"]
        unit_force, speed = omega**2 * size, omega * size
    of = OF[kinds[0]]
    unit = speed if of == "velocity" else size  # kg^1/2 m or kg^1/2 m/s

    def curve(x: np.ndarray) -> np.ndarray:
        return sum(curve_of(k, key["parameters"], x / base["shape"] / unit) for k in kinds)

    if of == "damping by displacement":
        return (
            curve(at) * law["at_velocity_m_s"] / base["shape"] / speed * unit_force / base["shape"]
        )
    force = curve(np.abs(at)) * np.sign(at) if of == "slip" else curve(at)
    if of != "slip" and not key["harmonics"]:
        force = 0.5 * (force - curve(-at))
    return force * unit_force / base["shape"]


def fraction_inside(key: dict, law: dict) -> float:
    """Share of the measured range over which the true force is inside the 95 % band."""
    at = np.array(law.get("velocity_m_s", law.get("displacement_m")))
    force, std = np.array(law["force_n"]), np.array(law["force_std_n"])
    true = true_force(key, at, law)
    inside = np.abs(true - force) <= BAND * std + 1e-9 * np.abs(true).max()
    length = np.gradient(at) * (np.abs(at) <= 1.03 * law["measured_up_to"])
    return float(np.sum(length * inside) / np.sum(length))


def judged_drawing(key: dict, answer: dict) -> tuple[str, float | None]:
    """How a drawn answer counts, and the share of the range where the truth is inside its band."""
    of = {OF.get(kind, "") for kind in true_kinds(key)}
    if len(of) != 1 or "" in of:
        return WRONG, None
    classes = [class_of(kind) for kind in answer["candidates"][0]]
    if classes[0] not in of:
        return (OPEN if of & set(classes) else WRONG), None
    fraction = fraction_inside(key, answer["law"])
    alone = "further" not in answer["law"]
    return (RIGHT if fraction >= INSIDE and alone else WRONG), fraction
