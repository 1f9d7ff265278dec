"""The inverse against the paper's own two equations, evaluated in plain NumPy.

The paper forces with a sine: its phasors are ours times −i, its angles ours minus 90°.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snrmjax.identify.pointwise.inversion import (
    PointStatus,
    SnrmPoints,
    closed_form,
    invert_amplitude_phase,
    invert_phasor,
)
from snrmjax.identify.pointwise.two_equations import CramersRule
from snrmjax.model.modes import LinearModes, residual_velocity

N = 20500  # more than the package solves at a time
EPS = np.finfo(float).eps
leaves = jax.tree.leaves
STATUS = PointStatus


class Measured:
    """Random steady states whose ω̃ and ζ̃ are known, phasors relative to the force."""

    def __init__(self, seed, n=N):
        rng = np.random.default_rng(seed)
        self.natural = 10.0 ** rng.uniform(-2, 6, n)
        self.damping = 10.0 ** rng.uniform(-6, np.log10(0.3), n)
        frequency = self.natural * 2.0 ** rng.uniform(-1, 1, n)
        # Every other one near resonance, where tests are made: phases up to 85° from it, from
        # x − 1/x = 2ζ tan φ with x = ω/Ω.
        offset = self.damping * np.tan(np.radians(rng.uniform(-85, 85, n)))
        near = self.natural / (offset + np.sqrt(offset**2 + 1))
        self.frequency = np.where(np.arange(n) % 2, frequency, near)
        self.constant = 10.0 ** rng.uniform(-6, 6, n) * rng.choice([-1, 1], n)
        self.c = (
            self.natural**2 - self.frequency**2 + 2j * self.damping * self.natural * self.frequency
        )
        self.mode_velocity = 1j * self.constant * self.frequency / self.c
        phase_factor = np.exp(2j * np.pi * rng.uniform(0, 1, n))
        self.residual = np.abs(self.mode_velocity) * rng.uniform(0, 3, n) * phase_factor
        self.velocity = self.mode_velocity + self.residual
        # What the subtraction of the residual leaves in double precision.
        self.difference = self.velocity - self.residual
        self.amplitude = np.abs(self.velocity)
        self.phase = np.angle(self.difference)
        # How much rounding of V and V_res grows in their difference, and how steeply |V| rises
        # with |V_nl| at a given phase: the two roots meet where it does not.
        self.growth = (self.amplitude + np.abs(self.residual)) / np.abs(self.mode_velocity)
        across = self.difference * self.velocity.conj()
        self.slope = np.abs(across.real) / np.abs(across)

    def phasors(self):
        return self.constant, self.frequency, self.velocity, self.residual

    def triples(self):
        return self.constant, self.frequency, self.amplitude, self.phase, self.residual


@pytest.fixture(scope="module")
def measured():
    return Measured(0)


def arrays(points: SnrmPoints):
    return jax.tree.map(np.asarray, points)


def few_of(function, *arguments):
    """Up to 64 members, filled up to 64: one compilation serves all the small tests."""
    columns = np.broadcast_arrays(*arguments)
    shape = columns[0].shape
    dtypes = [float] * (len(columns) - 1) + [complex]
    if function is invert_phasor:
        dtypes[2] = complex
    full = [np.resize(a.ravel(), 64).astype(d) for a, d in zip(columns, dtypes, strict=True)]
    points = function(*full)
    return jax.tree.map(lambda f: np.asarray(f)[: columns[0].size].reshape(shape), points)


def eq_12(natural, damping, constant, frequency, amplitude, residual):
    """Relative error of |V_nl + V_lin + V_RB| = v, Eqs. (10b) and (12), the paper's phase."""
    own = constant * frequency / (natural**2 - frequency**2 + 2j * damping * natural * frequency)
    return np.abs(own - 1j * residual) / amplitude - 1


def eq_17(natural, damping, frequency, cotangent):
    """Relative error of Eq. (17); −t + √(t² + 1) = exp(−arsinh t) is free of cancellation."""
    return np.exp(-np.arcsinh(damping * cotangent)) * frequency / natural - 1


def paper_cotangent(difference):
    """1/tan φ of Eq. (13), from the phasor: an angle would lose digits near −180°."""
    paper = -1j * difference
    return paper.real / paper.imag


def assert_equations(natural, damping, constant, frequency, amplitude, residual, cotangent):
    """Both equations hold wherever there is a value."""
    has = np.isfinite(natural)
    assert (has == np.isfinite(damping)).all()
    given_ = natural, damping, constant, frequency, amplitude, residual, cotangent
    natural, damping, constant, frequency, amplitude, residual, cotangent = (
        np.broadcast_to(a, has.shape)[has] for a in given_
    )
    c = natural**2 - frequency**2 + 2j * damping * natural * frequency
    # ω̃ has 53 bits: ω̃² − Ω², and with it V_nl, is known to ε Ω²/|c| only, however good it is.
    # Four roundings of it, in addition to the required 1e-10.
    fraction = np.abs(constant * frequency / c) / amplitude
    rounding = 4 * EPS * np.maximum(natural, frequency) ** 2 / np.abs(c) * fraction
    error = eq_12(natural, damping, constant, frequency, amplitude, residual)
    assert (np.abs(error) <= 1e-10 + rounding).all()
    assert (np.abs(eq_17(natural, damping, frequency, cotangent)) <= 1e-10).all()
    return int(has.sum())


class TestRandomMeasurements:
    def test_phasors_give_what_satisfies_the_papers_equations(self, measured):
        points = arrays(invert_phasor(*measured.phasors()))
        # Where the two roots nearly meet, Eq. (12) is ill-conditioned.
        regular = measured.slope > 1e-6
        assert (points.status[regular] == STATUS.OK).all()
        assert np.isin(points.status, [STATUS.OK, STATUS.NOT_CONVERGED]).all()
        solved = points.status == STATUS.OK
        assert (np.isfinite(points.natural_frequency) == solved).all()
        cotangent = paper_cotangent(measured.difference)
        rest = (
            measured.constant,
            measured.frequency,
            measured.amplitude,
            measured.residual,
            cotangent,
        )
        first = assert_equations(points.natural_frequency, points.damping_ratio, *rest)
        second = assert_equations(
            points.alternative_natural_frequency, points.alternative_damping_ratio, *rest
        )
        assert first >= N - 5
        assert second > N / 10

    def test_phasors_recover_the_truth(self, measured):
        points = arrays(invert_phasor(*measured.phasors()))
        # A relative rounding `growth`·ε of V_nl moves ω̃² by |c| times it and 2ζ̃ω̃Ω likewise;
        # ω̃ itself rounds once more. Newton's equation (12) knows |V_nl| worse by 1/slope.
        moved = 8 * EPS * measured.growth * np.abs(measured.c) / measured.slope
        error = points.natural_frequency / measured.natural - 1
        solved = points.status == STATUS.OK
        allowed = moved / measured.natural**2 + 4 * EPS
        assert (np.abs(error) <= allowed)[solved].all()
        error = points.damping_ratio - measured.damping
        allowed = moved / (2 * measured.natural * measured.frequency) + 8 * EPS * measured.damping
        assert (np.abs(error) <= allowed)[solved].all()

    def test_triples_give_all_roots(self, measured):
        points = arrays(invert_amplitude_phase(*measured.triples()))
        cotangent = -np.tan(measured.phase)  # 1/tan(φ − 90°)
        rest = (
            measured.constant,
            measured.frequency,
            measured.amplitude,
            measured.residual,
            cotangent,
        )
        assert_equations(points.natural_frequency, points.damping_ratio, *rest)
        assert_equations(
            points.alternative_natural_frequency, points.alternative_damping_ratio, *rest
        )
        # One root is |V_nl|. Vieta: the product of both is |V_res|² − v².
        known = np.abs(measured.mode_velocity)
        other = (np.abs(measured.residual) ** 2 - measured.amplitude**2) / known
        larger, smaller = np.maximum(known, other), np.minimum(known, other)
        regular = measured.slope > 1e-6

        def real_frequency(length):
            # ω̃² = Ω² + Re(AΩ/V) in the paper's phase.
            rotated = AS_PAPER * np.exp(1j * measured.phase)
            with np.errstate(divide="ignore"):
                shift = (measured.constant * measured.frequency / (length * rotated)).real
            return measured.frequency**2 + shift > 0

        two = (smaller > 0) & real_frequency(smaller)
        expected = np.where(two, STATUS.TWO_ROOTS, STATUS.OK)
        assert (points.status == expected)[regular].all()
        assert two.sum() > N / 10
        assert (np.isfinite(points.alternative_natural_frequency) == two)[regular].all()
        # The larger response first: Ω|A|/|c|.
        c = (
            points.natural_frequency**2
            - measured.frequency**2
            + 2j * points.damping_ratio * points.natural_frequency * measured.frequency
        )
        length = np.abs(measured.constant) * measured.frequency / np.abs(c)
        clear = regular & (larger - smaller > 1e-3 * larger)
        resolution = 8 * EPS * measured.natural**2 / np.abs(measured.c)
        # Roots that are 0.1 % apart amplify rounding by up to a thousand, ω̃ − Ω by ω²/|c|.
        allowed = 1e-10 + 1e3 * resolution + 1e3 * EPS * measured.growth / measured.slope
        assert (np.abs(length / larger - 1) <= allowed)[clear].all()

    def test_arbitrary_triples_give_values_that_fit_or_a_status_and_nan(self):
        rng = np.random.default_rng(3)
        frequency = 10.0 ** rng.uniform(-1, 5, N)
        constant = 10.0 ** rng.uniform(-3, 3, N) * rng.choice([-1, 1], N)
        phase = rng.uniform(-np.pi, np.pi, N)
        amplitude = np.abs(constant) / frequency * 10.0 ** rng.uniform(-1, 4, N)
        phase_factor = np.exp(2j * np.pi * rng.uniform(0, 1, N))
        residual = amplitude * 10.0 ** rng.uniform(-2, 0.5, N) * phase_factor
        points = arrays(invert_amplitude_phase(constant, frequency, amplitude, phase, residual))
        rest = constant, frequency, amplitude, residual, -np.tan(phase)
        assert_equations(points.natural_frequency, points.damping_ratio, *rest)
        assert_equations(
            points.alternative_natural_frequency, points.alternative_damping_ratio, *rest
        )
        # |r e^{iφ} + V_res| = v: a circle of radius v about −V_res, cut by a ray from the origin.
        half = (np.exp(-1j * phase) * residual).real
        inside = np.abs(residual) < amplitude
        chord = amplitude**2 - (np.exp(-1j * phase) * residual).imag ** 2
        has_root = inside | ((chord > 0) & (half < 0))
        length = -half + np.sqrt(np.where(chord > 0, chord, np.nan))
        squared = frequency**2 + frequency * constant * np.sin(phase) / length
        expected = np.select(
            [~has_root, ~(squared > 0), constant * np.cos(phase) < 0],
            [STATUS.NO_ROOT, STATUS.NO_REAL_FREQUENCY, STATUS.NEGATIVE_DAMPING],
            STATUS.OK,
        )
        actual = np.where(points.status == STATUS.TWO_ROOTS, STATUS.OK, points.status)
        # Both roots equal, ω̃ = 0 and a phase of exactly 90° are drawn with probability zero;
        # 1e-6 keeps clear of rounding at these limits.
        clear = np.abs(chord) > 1e-6 * amplitude**2
        assert (actual == expected)[clear].all()
        kinds, counts = np.unique(points.status, return_counts=True)
        assert (counts > 100).all()
        assert {*kinds} >= {
            STATUS.OK,
            STATUS.TWO_ROOTS,
            STATUS.NEGATIVE_DAMPING,
            STATUS.NO_ROOT,
            STATUS.NO_REAL_FREQUENCY,
        }
        nothing = np.isin(actual, [STATUS.NO_ROOT, STATUS.NO_REAL_FREQUENCY])
        assert (np.isnan(points.natural_frequency) == nothing).all()
        assert (points.damping_ratio[actual == STATUS.NEGATIVE_DAMPING] < 0).all()
        assert (points.damping_ratio[actual == STATUS.OK] >= 0).all()

    def test_the_closed_form_is_the_answer_without_residual(self, measured):
        natural, damping = closed_form(
            jnp.asarray(measured.constant),
            jnp.asarray(measured.frequency),
            jnp.asarray(measured.mode_velocity),
        )
        # c carries the rounding of V_nl; ω̃² = Ω² + Re c rounds once more.
        moved = 8 * EPS * np.abs(measured.c)
        error = np.abs(natural / measured.natural - 1)
        assert (error <= moved / measured.natural**2 + 4 * EPS).all()
        allowed = moved / (2 * measured.natural * measured.frequency) + 8 * EPS * measured.damping
        assert (np.abs(damping - measured.damping) <= allowed).all()


AS_PAPER = -1j


class TestEdges:
    @pytest.mark.parametrize("constant", [6.0, -6.0])
    @pytest.mark.parametrize("paper_degrees", [0.0, -90.0, -180.0])
    def test_phases_where_the_tangent_is_zero_or_infinite(self, paper_degrees, constant):
        offset = np.array([-1e-9, -1e-12, -1e-15, 0.0, 1e-15, 1e-12, 1e-9])
        centre = math.radians(paper_degrees + 90) + (np.pi if constant < 0 else 0.0)
        phase, omega, v = centre + offset, 500.0, 0.06
        points = few_of(invert_amplitude_phase, constant, omega, v, phase, 0.0)
        size = constant * omega / v
        squared = omega**2 + size * np.array([math.sin(p) for p in phase])
        imaginary = size * np.array([math.cos(p) for p in phase])
        # The phase is given in double precision; from there a few roundings.
        np.testing.assert_allclose(points.natural_frequency, np.sqrt(squared), rtol=4 * EPS)
        np.testing.assert_allclose(
            points.damping_ratio, imaginary / (2 * omega * np.sqrt(squared)), rtol=1e-12, atol=EPS
        )
        clear = np.abs(imaginary) > 1e-18 * abs(size)
        expected = np.where(imaginary < 0, STATUS.NEGATIVE_DAMPING, STATUS.OK)
        assert (points.status == expected)[clear].all()
        assert np.isnan(points.alternative_natural_frequency).all()

    @pytest.mark.parametrize("direction", [1, 1j, -1j])
    def test_phasors_exactly_along_an_axis(self, direction):
        point = few_of(invert_phasor, 6.0, 500.0, 0.06 * direction, 0.0)
        assert int(point.status) == STATUS.OK
        squared = 500.0**2 + 6.0 * 500.0 / 0.06 * complex(direction).imag
        np.testing.assert_allclose(point.natural_frequency, np.sqrt(squared), rtol=4 * EPS)
        expected = 0.1 if direction == 1 else 0.0  # A/(2Ωv) at resonance
        np.testing.assert_allclose(point.damping_ratio, expected, rtol=4 * EPS, atol=EPS)

    def test_light_damping_near_resonance(self):
        # Unit-sized ω̃/Ω resolves half-widths of 1e-7 to 9 digits: nothing to give up for.
        phase = np.radians(np.linspace(-80, 80, 64))
        for damping in (1e-4, 1e-5, 1e-6, 1e-7):
            offset = damping * np.tan(phase)
            frequency = 500.0 / (offset + np.sqrt(offset**2 + 1))
            c = 500.0**2 - frequency**2 + 2j * damping * 500.0 * frequency
            velocity = 6j * frequency / c
            points = few_of(invert_phasor, 6.0, frequency, velocity, 0.0)
            assert (points.status == STATUS.OK).all()
            # ω² − Ω² of the truth is known to ε·ω², that is to ε/(2ζ) of the half-width.
            np.testing.assert_allclose(points.damping_ratio, damping, rtol=8 * EPS / damping)
            np.testing.assert_allclose(points.natural_frequency, 500.0, rtol=4 * EPS)

    def test_a_residual_larger_than_the_response_has_two_roots(self):
        # v = 1, V_res = −2 at φ = 0: |r − 2| = 1 has r = 3 and r = 1; ζ̃ = A/(2Ωr) there.
        points = few_of(invert_amplitude_phase, 6.0, 500.0, 1.0, 0.0, -2.0)
        assert int(points.status) == STATUS.TWO_ROOTS
        np.testing.assert_allclose(points.damping_ratio, 6 / 3000, rtol=1e-14)
        np.testing.assert_allclose(points.alternative_damping_ratio, 6 / 1000, rtol=1e-14)
        for velocity, own, other in ((1.0, 3, 1), (-1.0, 1, 3)):
            # The phasor selects the root; the other one is still reported.
            point = few_of(invert_phasor, 6.0, 500.0, velocity, -2.0)
            assert int(point.status) == STATUS.OK
            np.testing.assert_allclose(point.damping_ratio, 6 / (1000 * own), rtol=1e-14)
            np.testing.assert_allclose(
                point.alternative_damping_ratio, 6 / (1000 * other), rtol=1e-14
            )

    def test_no_wrong_value_where_the_two_roots_meet(self):
        # V at right angles to V_nl: |V| does not change with |V_nl| to first order.
        tilt = np.array([0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-4, 1e-3])
        velocity, residual = 1.0, 1.0 - (0.5j + 0.5 * tilt)
        points = few_of(invert_phasor, 6.0, 500.0, velocity, residual)
        refused = points.status == STATUS.NOT_CONVERGED
        assert np.isnan(points.natural_frequency[refused]).all()
        assert np.isnan(points.damping_ratio[refused]).all()
        assert refused[0]
        assert (points.status[-2:] == STATUS.OK).all()
        truth = 6j * 500.0 / (velocity - residual)
        actual = points.natural_frequency**2 - 500.0**2
        # A root of multiplicity two is known to the square root of rounding.
        np.testing.assert_allclose(actual[~refused], truth.real[~refused], rtol=1e-7)

    @pytest.mark.parametrize(
        ("arguments", "status"),
        [
            ((0.0, 500.0, 0.6, 0.1, 0.1j), STATUS.ZERO_FORCE),
            ((6.0, 0.0, 0.6, 0.1, 0.1j), STATUS.NOT_FINITE),
            ((6.0, -500.0, 0.6, 0.1, 0.1j), STATUS.NOT_FINITE),
            ((6.0, 500.0, 0.0, 0.1, 0.1j), STATUS.NOT_FINITE),
            ((6.0, 500.0, -0.6, 0.1, 0.1j), STATUS.NOT_FINITE),
            ((6.0, 500.0, 0.6, 2.0, 0.1j), STATUS.NEGATIVE_DAMPING),
            ((6.0, 500.0, 0.6, 0.1, 0.7j), STATUS.NO_ROOT),  # the circle misses the ray
            ((6.0, 500.0, 0.6, 0.1, 0.7 + 0j), STATUS.NO_ROOT),  # r would be negative
            ((6.0, 500.0, 0.001, -1.57, 0j), STATUS.NO_REAL_FREQUENCY),  # Ω² < |A|Ω/v
        ],
    )
    def test_every_failure_has_its_status(self, arguments, status):
        point = few_of(invert_amplitude_phase, *arguments)
        assert int(point.status) == status
        solved = status == STATUS.NEGATIVE_DAMPING
        for value in leaves(point)[:2]:
            assert np.isfinite(value) == solved
        assert np.isnan(leaves(point)[2:4]).all()
        if solved:
            assert point.damping_ratio < 0

    def test_nan_or_infinity_in_any_argument(self):
        bad = [np.nan, np.inf, -np.inf]
        complex_bad = [complex(np.nan, 0), complex(0, np.nan), complex(np.inf, 1)]
        triple = [6.0, 500.0, 0.6, 0.1, 0.1j]
        phasor = [6.0, 500.0, 0.6 + 0.1j, 0.1j]
        rows = [
            [*triple[:k], value, *triple[k + 1 :]]
            for k in range(5)
            for value in (complex_bad if k == 4 else bad)
        ]
        points = few_of(invert_amplitude_phase, *(np.array(c) for c in zip(*rows, strict=True)))
        assert (points.status == STATUS.NOT_FINITE).all()
        assert np.isnan(np.stack(leaves(points)[:4])).all()
        rows = [
            [*phasor[:k], value, *phasor[k + 1 :]]
            for k in range(4)
            for value in (complex_bad if k > 1 else bad)
        ]
        rows.append([6.0, 500.0, 0.0j, 0.1j])  # no velocity
        rows.append([6.0, 500.0, 0.1j, 0.1j])  # nothing left for the mode
        points = few_of(invert_phasor, *(np.array(c) for c in zip(*rows, strict=True)))
        assert (points.status == STATUS.NOT_FINITE).all()
        assert np.isnan(np.stack(leaves(points)[:4])).all()


class TestShapes:
    def test_scalars_and_broadcasting(self):
        rows = np.array([[6.0], [5.0]]), np.array([490.0, 500.0, 510.0])
        residual, phase = np.array([[0.0], [0.1j]]), np.array([-0.1, 0.0, 0.1])
        # Any of the arguments may be the batch, the residual and the phase as well.
        for function, arguments in (
            (invert_phasor, (*rows, 0.5 + 0.1j, 0j)),
            (invert_phasor, (6.0, 500.0, 0.6 + 0.1j * phase, residual)),
            (invert_amplitude_phase, (6.0, 500.0, 0.6, phase, residual)),
        ):
            points = arrays(function(*arguments))
            assert {field.shape for field in leaves(points)} == {(2, 3)}
            for actual, expected in zip(
                leaves(points), leaves(few_of(function, *arguments)), strict=True
            ):
                # The compiler may contract operations in one of them.
                np.testing.assert_allclose(actual, expected, rtol=1e-13)
        one = invert_phasor(6.0, 500.0, 0.6 + 0j, 0j)
        assert {field.shape for field in leaves(one)} == {()}
        np.testing.assert_allclose(one.damping_ratio, 0.01, rtol=4 * EPS)
        whole = invert_amplitude_phase(6, 500, 1, 0, 0)
        assert int(whole.status) == STATUS.OK
        np.testing.assert_allclose(whole.damping_ratio, 0.006, rtol=4 * EPS)

    def test_empty_batches(self):
        empty = np.zeros(0)
        for points in (
            invert_phasor(empty, empty, empty + 0j, empty + 0j),
            invert_amplitude_phase(empty, empty, empty, empty, empty + 0j),
        ):
            assert all(field.shape == (0,) for field in leaves(points))

    def test_jit_and_vmap_agree_and_trace_once(self, measured):
        few = [a[:64] for a in measured.triples()]
        few[2] = few[2].copy()
        few[2][7] = np.nan  # a failing member
        few[0] = few[0].copy()
        few[0][9] = 0.0
        plain = arrays(invert_amplitude_phase(*few))
        traces = []

        @jax.jit
        def counted(*args):
            traces.append(1)
            return invert_amplitude_phase(*args)

        results = [counted(*few), counted(*few), jax.jit(jax.vmap(invert_amplitude_phase))(*few)]
        assert len(traces) == 1
        for points in results:
            np.testing.assert_array_equal(points.status, plain.status)
            for actual, expected in zip(leaves(points)[:4], leaves(plain)[:4], strict=True):
                # Another order of operations: rounding, amplified where ζ̃ is far from the
                # phase's axis as in the truth above.
                np.testing.assert_allclose(actual, expected, rtol=1e-9)

    def test_one_member_is_the_batch(self, measured):
        few = [jnp.asarray(a[:64]) for a in measured.phasors()]
        points = invert_phasor(*few)
        each = jax.jit(jax.vmap(invert_phasor))(*few)
        np.testing.assert_allclose(each.natural_frequency, points.natural_frequency, rtol=1e-12)
        np.testing.assert_allclose(each.damping_ratio, points.damping_ratio, rtol=1e-9)

    @pytest.mark.parametrize(
        "replaced",
        [
            (0.0, 500.0, 0.6 + 0j, 0j),
            (np.nan, 500.0, 0.6 + 0j, 0j),
            (6.0, 500.0, complex(np.nan, np.nan), 0j),
            (6.0, 500.0, -0.001j, 0j),  # no real frequency
            (6.0, 500.0, 1.0 + 0j, -2.0 + 0j),  # another root
            (6.0, 500.0, 1.0 + 0j, 1.0 - 0.5j),  # where two roots meet
        ],
    )
    def test_members_do_not_affect_one_another(self, measured, replaced):
        few = [a[:64].copy() for a in measured.phasors()]
        few[3][:] = 0.0
        few[2][:] = measured.mode_velocity[:64]
        before = arrays(invert_phasor(*few))
        assert np.isnan(before.alternative_natural_frequency).all()
        for column, value in zip(few, replaced, strict=True):
            column[20] = value
        after = arrays(invert_phasor(*few))
        others = np.arange(64) != 20
        for one, other in zip(leaves(before), leaves(after), strict=True):
            np.testing.assert_array_equal(one[others], other[others])  # to the last bit


# Three flexible modes and a rigid-body mode, the second mode of interest, seen by one sensor.
PARAMETERS = {
    "force": np.array([2.0]),
    "frequency": np.array([0.0]),  # set for every case
    "amplitude": np.array([0.0]),
    "phase": np.array([0.0]),
    "natural_frequency": np.array([310.0, 500.0, 1400.0]),
    "damping_ratio": np.array([0.02, 0.03, 0.01]),
    "mode_shape": np.array([1.3, 2.0, -0.8]),
    "participation": np.array([0.9, 1.5, 1.1]),
    "rigid_body_shape": np.array([0.7]),
    "rigid_body_participation": np.array([0.6]),
}
NAMES = [name for name, values in PARAMETERS.items() for _ in values]


def measurement_of(natural, damping, frequency, sign=1.0):
    """All parameters as one vector, with the velocity that ω̃ and ζ̃ would give."""
    values = {name: value.copy() for name, value in PARAMETERS.items()}
    values["participation"][1] *= sign
    values["frequency"][:] = frequency
    theta = np.concatenate(list(values.values()))
    force = 2.0
    own = 1j * frequency * 2.0 * 1.5 * sign * force
    own = own / (natural**2 - frequency**2 + 2j * damping * natural * frequency)
    velocity = own + residual_of(theta)
    theta[2:4] = abs(velocity), np.angle(velocity)
    return theta


def residual_of(theta):
    force, frequency = theta[0], theta[1]
    natural, damping, shape, participation = theta[4:16].reshape(4, 3)[:, [0, 2]]
    modes = 1j * frequency * force * shape * participation
    modes = modes / (natural**2 - frequency**2 + 2j * damping * natural * frequency)
    return modes.sum() - 1j * theta[16] * theta[17] * force / frequency


def answer(theta):
    """ω̃ and ζ̃ from AΩ/V_nl in plain NumPy, the paper's phase."""
    own = AS_PAPER * (theta[2] * np.exp(1j * theta[3]) - residual_of(theta))
    c = theta[11] * theta[14] * theta[0] * theta[1] / own
    natural = np.sqrt(theta[1] ** 2 + c.real)
    return np.array([natural, c.imag / (2 * natural * theta[1])])


def through_package(theta):
    force, frequency = theta[0], theta[1]
    natural, damping, shape, participation = theta[4:16].reshape(4, 3)
    modes = LinearModes(
        natural_frequency=natural,
        damping_ratio=damping,
        mode_shape=shape[None],
        participation=participation,
        rigid_body_shape=theta[16].reshape(1, 1),
        rigid_body_participation=theta[17].reshape(1),
        natural_frequency_std=jnp.zeros(3),
        damping_ratio_std=jnp.zeros(3),
        sensors=("tip",),
        mode_of_interest=1,
    )
    velocity = theta[2] * jnp.exp(1j * theta[3])
    residual = residual_velocity(modes, frequency, force)[0]
    constant = shape[1] * participation[1] * force
    point = invert_phasor(constant, frequency, velocity, residual)
    return jnp.stack([point.natural_frequency, point.damping_ratio])


CASES = np.stack(
    [
        measurement_of(520.0, 0.03, 515.0),
        measurement_of(520.0, 0.03, 531.0),  # past resonance
        measurement_of(520.0, 0.03, 520.0),  # at resonance
        measurement_of(480.0, 0.05, 470.0, sign=-1.0),
        measurement_of(505.0, 0.25, 320.0),  # near the first mode: the residual is larger
    ]
)


def fourth_order(function, at, step):
    """Central differences of fourth order for every input, one column each."""
    columns = []
    for k, h in enumerate(step):
        move = np.eye(at.size)[k] * h
        one = function(at + move) - function(at - move)
        two = function(at + 2 * move) - function(at - 2 * move)
        columns.append((8 * one - two) / (12 * h))
    return np.stack(columns, axis=-1)


class TestDerivatives:
    def test_first_derivatives_of_every_input_and_mode_parameter(self):
        both = jax.jit(
            jax.vmap(lambda x: (jax.jacfwd(through_package)(x), jax.jacrev(through_package)(x)))
        )
        forward, reverse = (np.asarray(a) for a in both(jnp.asarray(CASES)))
        residual = np.array([abs(residual_of(theta)) for theta in CASES])
        assert residual[-1] > CASES[-1, 2] > residual[0]
        for k, theta in enumerate(CASES):
            truth = fourth_order(answer, theta, 1e-5 * np.abs(theta))
            scaled = truth * np.abs(theta)  # per relative change of the input
            size = np.abs(scaled).max(axis=1, keepdims=True)
            for actual in (forward[k], reverse[k]):
                error = np.abs(actual * np.abs(theta) - scaled)
                # The differences err by (1e-5/ζ)⁴ and by rounding, 1e-16/1e-5 of the values.
                assert (error <= 1e-6 * np.abs(scaled) + 1e-10 * size).all()
            # The linear properties of the mode itself are no input.
            own = [5, 8]
            assert [NAMES[i] for i in own] == ["natural_frequency", "damping_ratio"]
            assert not forward[k][:, own].any()

    def test_gradient_of_a_batch_with_failing_members(self):
        few = np.array([[6.0, 490.0], [6.0, 500.0], [0.0, 500.0], [6.0, 510.0]])
        velocity = jnp.array([0.5 + 0.1j, 0.4 + 0j, 0.5 + 0j, complex(np.nan, 0)])

        def total(constant, velocity):
            points = invert_phasor(constant, few[:, 1], velocity, jnp.full(4, 0.01j))
            return jnp.sum(jnp.where(points.status == 0, points.damping_ratio, 0.0))

        constant = jnp.asarray(few[:, 0])
        gradient = np.asarray(jax.jit(jax.grad(total))(constant, velocity))
        # ω̃² = Ω² + A s, ζ̃ = A t/(2ω̃Ω) with s + it = iΩ/V_nl.
        part = 1j * few[:2, 1] / (np.asarray(velocity)[:2] - 0.01j)
        natural = np.sqrt(few[:2, 1] ** 2 + 6.0 * part.real)
        slope = part.imag / (2 * natural * few[:2, 1])
        slope = slope * (1 - 6.0 * part.real / (2 * natural**2))
        np.testing.assert_allclose(gradient[:2], slope, rtol=1e-12)  # a few roundings
        assert (gradient[2:] == 0).all()

    def test_second_derivatives(self):
        measured = 4  # force, frequency, amplitude, phase
        theta = measurement_of(520.0, 0.2, 480.0)

        def few(x):
            return through_package(jnp.concatenate([x, jnp.asarray(theta[measured:])]))

        actual = jax.jit(jax.jacfwd(jax.jacrev(few)))(jnp.asarray(theta[:measured]))
        actual = np.asarray(actual)

        def slopes(x):
            full = np.concatenate([x, theta[measured:]])
            return fourth_order(answer, full, 1e-3 * np.abs(full))[:, :measured]

        scale = np.abs(theta[:measured])
        truth = fourth_order(slopes, theta[:measured], 1e-3 * scale)
        scaled = truth * scale * scale[:, None]
        size = np.abs(scaled).max(axis=(1, 2), keepdims=True)
        # (1e-3/ζ)⁴ = 6e-10 from the steps, 1e-16/1e-6 from rounding.
        error = np.abs(actual * scale * scale[:, None] - scaled)
        assert (error <= 1e-7 * size).all()
        np.testing.assert_allclose(actual, actual.transpose(0, 2, 1), rtol=1e-9, atol=1e-12)


class TestCramersRule:
    def test_against_numpy(self):
        rng = np.random.default_rng(5)
        matrices = rng.normal(size=(200, 2, 2)) * 10.0 ** rng.uniform(-6, 6, (200, 1, 1))
        vectors = rng.normal(size=(200, 2))

        def solve(matrix, vector):
            return lx.linear_solve(lx.MatrixLinearOperator(matrix), vector, CramersRule()).value

        def transposed(matrix, vector):
            operator = lx.MatrixLinearOperator(matrix).transpose()
            return lx.linear_solve(operator, vector, CramersRule()).value

        def both(matrix, vector):
            return (
                solve(matrix, vector),
                transposed(matrix, vector),
                jax.grad(lambda v: solve(matrix, v)[0])(vector),
            )

        actual, back, gradient = jax.jit(jax.vmap(both))(matrices, vectors)
        # Cramer's rule in two dimensions: rounding times the condition number.
        condition = np.linalg.cond(matrices)
        for result, matrix in ((actual, matrices), (back, matrices.transpose(0, 2, 1))):
            truth = np.linalg.solve(matrix, vectors[..., None])[..., 0]
            error = np.linalg.norm(result - truth, axis=1) / np.linalg.norm(truth, axis=1)
            assert (error < 8 * EPS * condition).all()
        # The derivative solves with the transposed matrix: the first row of the inverse.
        rows = np.linalg.inv(matrices)[:, 0]
        error = np.linalg.norm(gradient - rows, axis=1) / np.linalg.norm(rows, axis=1)
        assert (error < 8 * EPS * condition).all()

    def test_another_size_is_refused(self):
        operator = lx.MatrixLinearOperator(jnp.eye(3))
        with pytest.raises(ValueError, match="two equations for two unknowns"):
            lx.linear_solve(operator, jnp.ones(3), CramersRule())


invert_compiled = eqx.filter_jit(invert_phasor)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    log_natural=st.floats(-2, 5),
    log_damping=st.floats(-6, -0.55),
    octave=st.floats(-1, 1),
    log_constant=st.floats(-6, 6),
    sign=st.sampled_from([-1.0, 1.0]),
    fraction=st.floats(0, 0.9),
    angle=st.floats(-3.2, 3.2),
    time=st.floats(-3, 3),
    length=st.floats(-3, 3),
)
def test_round_trip_and_units(
    log_natural, log_damping, octave, log_constant, sign, fraction, angle, time, length
):
    natural, damping = 10.0**log_natural, 10.0**log_damping
    frequency, constant = natural * 2.0**octave, sign * 10.0**log_constant
    c = natural**2 - frequency**2 + 2j * damping * natural * frequency
    own = 1j * constant * frequency / c
    residual = fraction * abs(own) * np.exp(1j * angle)
    point = invert_compiled(
        *(jnp.array([x]) for x in (constant, frequency, own + residual, residual))
    )
    # Rounding of V_nl, grown by the subtraction (up to 3) and by ω²/|c|; V is never at right
    # angles to V_nl here: its slope is at least √(1 − 0.9²) = 0.43.
    rounding = 64 * EPS * abs(c)
    assert int(point.status[0]) == STATUS.OK
    assert abs(point.natural_frequency[0] / natural - 1) <= rounding / natural**2 + 4 * EPS
    allowed = rounding / (2 * natural * frequency) + 8 * EPS * damping
    assert abs(point.damping_ratio[0] - damping) <= allowed
    # Other units of time and length: ω̃ scales with 1/time, ζ̃ stays.
    t, u = 10.0**time, 10.0**length
    scaled = invert_compiled(
        jnp.array([constant * u / t**2]),
        jnp.array([frequency / t]),
        jnp.array([(own + residual) * u / t]),
        jnp.array([residual * u / t]),
    )
    assert abs(scaled.natural_frequency[0] * t / natural - 1) <= rounding / natural**2 + 8 * EPS
    assert abs(scaled.damping_ratio[0] - damping) <= 2 * allowed
