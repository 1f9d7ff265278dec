"""Models: round trips, accepted files, and refusals with their messages."""

import os
import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snrmjax.io.models import read_model, write_model
from snrmjax.model.effect_base import AbstractMemoryless
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect
from snrmjax.model.modes import LinearModesStd, RigidBodyModes, linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import Structure, structure

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"

MODEL = """\
name = "two modes"
mode_of_interest = 1
[[mode]]
frequency_hz = 79.02
damping_ratio = 0.05
shape = { midspan = 11.8, tip = -3 }
participation = 247.8
frequency_std_hz = 0.02
damping_ratio_std = 0.001
[[mode]]
frequency_hz = 427
damping_ratio = 0
shape = { tip = 0.0, midspan = -10.5 }
participation = -108.5
[[rigid_body_mode]]
shape = { midspan = 1.0, tip = 2.0 }
participation = 1.5
[potential]
"1111" = { coefficient = 3.4e12, std = 1e10 }
112 = -2.5e6
"2-2-2" = 0
[[effect]]
kind = "quadratic_damping"
coefficient = 0.01
[[effect]]
kind = "gap_stiffness"
gap = 1e-4
stiffness = 1000
[measurement]
level_gain_std = 0.01
level_phase_std_deg = 0.5
"""

MINIMAL = """\
[[mode]]
frequency_hz = 80
damping_ratio = 0.01
shape = { tip = 1 }
participation = 2
"""


def read(tmp_path, content):
    path = tmp_path / "model.toml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_model(path)


def same(one: Structure, other: Structure, *, rtol: float) -> bool:
    """Equal in structure and names, and in numbers to `rtol`."""
    a, tree_a = jax.tree.flatten(one)
    b, tree_b = jax.tree.flatten(other)
    return tree_a == tree_b and all(
        x.shape == y.shape and np.allclose(x, y, rtol=rtol, atol=0.0)
        for x, y in zip(a, b, strict=True)
    )


# ------------------------------------------------------------------------------ accepted


def test_reads_everything(tmp_path):
    model = read(tmp_path, MODEL)
    expected = structure(
        linear_modes(
            np.array([79.02, 427.0]) * 2 * np.pi,
            [0.05, 0.0],
            [[11.8, -10.5], [-3.0, 0.0]],
            [247.8, -108.5],
            sensors=("midspan", "tip"),
            rigid_body=RigidBodyModes(np.array([[1.0], [2.0]]), np.array([1.5])),
            std=LinearModesStd(np.array([0.02, 0.0]) * 2 * np.pi, [0.001, 0.0]),
        ),
        polynomial_potential(
            {"1111": 3.4e12, "112": -2.5e6, "222": 0.0}, 2, coefficient_std={"1111": 1e10}
        ),
        effects=(
            make_effect("quadratic_damping", {"coefficient": 0.01}),
            make_effect("gap_stiffness", {"stiffness": 1000.0, "gap": 1e-4}),
        ),
        level_gain_std=0.01,
        level_phase_std=0.5 * (np.pi / 180.0),
        name="two modes",
    )
    assert same(model, expected, rtol=0.0)


def test_reads_the_least(tmp_path):
    model = read(tmp_path, MINIMAL)
    assert model.name == "model"  # the file's
    assert model.modes.sensors == ("tip",)
    assert model.modes.mode_of_interest == 0
    assert model.potential.monomials == ()
    assert model.effects == ()
    assert model.modes.rigid_body_shape.shape == (1, 0)
    assert float(model.level_gain_std) == 0.0


def test_counts_modes_from_one_in_files(tmp_path):
    model = read(tmp_path, MODEL.replace("mode_of_interest = 1", "mode_of_interest = 2"))
    assert model.modes.mode_of_interest == 1


@pytest.mark.parametrize(
    "content",
    [
        MODEL.replace("\n", "\r\n"),
        "\ufeff" + MODEL,
        "# a comment\n" + MODEL + "\n\n",
        MODEL.replace("[measurement]", "[measurement] # shared"),
        MODEL.replace("mode_of_interest = 1\n", ""),
        MODEL.replace("112 =", '"211" ='),
        MODEL.replace("112 =", '"1-2-1" ='),
        MODEL.replace("frequency_hz = 427", "frequency_hz = 4_27.0"),
        MODEL.replace(
            "{ coefficient = 3.4e12, std = 1e10 }", "{ std = 1e10, coefficient = 3.4e12 }"
        ),
        MODEL.replace("-2.5e6", "{ coefficient = -2.5e6 }"),
        MODEL.replace("-2.5e6", "{ coefficient = -2.5e6, std = 0 }"),
    ],
)
def test_accepts(tmp_path, content):
    assert same(read(tmp_path, content), read(tmp_path, MODEL), rtol=0.0)


@pytest.mark.parametrize("kind", EFFECTS)
def test_reads_every_effect(tmp_path, kind):
    # Different numbers that every rule allows.
    values = {name: k + 1.5 for k, name in enumerate(effect_parameters(kind))}
    values |= {name: 0.25 for name in values if name == "damping_ratio"}
    lines = [f"{name} = {value}" for name, value in values.items()]
    content = MINIMAL + f'[[effect]]\nkind = "{kind}"\n' + "\n".join(lines)
    path = tmp_path / "copy.toml"
    write_model(path, read(tmp_path, content))
    assert all(line in path.read_text() for line in lines)
    (effect,) = read_model(path).effects
    assert type(effect) is EFFECTS[kind]
    assert {name: float(getattr(effect, name)) for name in values} == values


# ------------------------------------------------------------------------------ refused


def swapped(old, new, content=MODEL):
    assert old in content
    return content.replace(old, new, 1)


# Invalid frequencies of mode 1, and the expectation.
NO_FREQUENCIES = {
    **dict.fromkeys(['"79.02"', '""', "true", "2024-01-01", "[79.02]"], "a number"),
    **dict.fromkeys(["nan", "inf", "1" + "0" * 400, "0x" + "F" * 5000], "a finite number"),
    **dict.fromkeys(["-3.2", "0"], "positive"),
    "1.5e308": "below 1e300 Hz",
}
# Other numbers out of range: the line, its replacement, the location, and the expectation.
OUT_OF_RANGE = [
    ("damping_ratio = 0.05", "damping_ratio = -0.05", "mode 1", "from 0 to below 1"),
    ("damping_ratio = 0.05", "damping_ratio = 1.0", "mode 1", "from 0 to below 1"),
    ("participation = 247.8", "participation = -inf", "mode 1", "a finite number"),
    ("frequency_std_hz = 0.02", "frequency_std_hz = -0.02", "mode 1", "zero or positive"),
    ("damping_ratio_std = 0.001", "damping_ratio_std = -1", "mode 1", "zero or positive"),
    ("std = 1e10", "std = -1.0", "monomial '1111' in [potential]", "zero or positive"),
    ("level_gain_std = 0.01", "level_gain_std = -0.01", "[measurement]", "zero or positive"),
    ("tip = -3", "tip = inf", "the shape of mode 1", "a finite number"),
    ("tip = -3", 'tip = "x"', "the shape of mode 1", "a number"),
    ("112 = -2.5e6", '112 = "-2.5e6"', "[potential]", "a number"),
    ("coefficient = 3.4e12", "coefficient = nan", "monomial '1111' in [potential]", "finite"),
    ("stiffness = 1000", 'stiffness = "stiff"', "effect 2", "a number"),
    ("stiffness = 1000", "stiffness = inf", "effect 2", "a finite number"),
]
# A missing line, and the location that lacks its key.
MISSING = {
    "frequency_hz = 79.02\n": "mode 1 of",
    "damping_ratio = 0\n": "mode 2 of",
    "participation = 247.8\n": "mode 1 of",
    "shape = { tip = 0.0, midspan = -10.5 }\n": "mode 2 of",
    "participation = 1.5\n": "rigid_body_mode 1 of",
    "coefficient = 3.4e12, ": "monomial '1111'",
    "stiffness = 1000\n": "(gap_stiffness)",
}
# A key, its misspelling, and its location.
MISSPELT = [
    ("damping_ratio =", "dampin_ratio =", "mode 1 of"),
    ("frequency_hz =", "frequency_rad_s =", "mode 1 of"),
    ("frequency_hz =", "frequency =", "mode 1 of"),
    ("frequency_std_hz =", "frequency_std =", "mode 1 of"),
    ("level_phase_std_deg =", "level_phase_std =", "[measurement] of"),
    (" std =", " sdt =", "monomial '1111'"),
    ("stiffness =", "stifness =", "effect 2 of model.toml (gap_stiffness)"),
    ("potential", "potentials", "model.toml"),
]


@pytest.mark.parametrize("value", NO_FREQUENCIES)
def test_refuses_what_is_no_frequency(tmp_path, value, check_message):
    with pytest.raises(ValueError, match="`frequency_hz` must be") as error:
        read(tmp_path, swapped("79.02", value))
    check_message(error, [NO_FREQUENCIES[value], "mode 1 of model.toml has"])


@pytest.mark.parametrize(("line", "other", "location", "expected"), OUT_OF_RANGE)
def test_refuses_numbers_out_of_range(tmp_path, line, other, location, expected, check_message):
    with pytest.raises(ValueError, match=f"`{line.partition(' ')[0]}` must be") as error:
        read(tmp_path, swapped(line, other))
    check_message(error, [expected, f"{location} of model.toml"])


@pytest.mark.parametrize("line", MISSING)
def test_refuses_a_missing_key(tmp_path, line, check_message):
    with pytest.raises(ValueError, match=f"lacks the key `{line.partition(' ')[0]}`") as error:
        read(tmp_path, swapped(line, ""))
    check_message(error, [MISSING[line], "model.toml"])


@pytest.mark.parametrize(("key", "other", "location"), MISSPELT)
def test_refuses_a_misspelt_key_and_suggests_the_right_one(
    tmp_path, key, other, location, check_message
):
    word, meant = (name.strip(" =") for name in (other, key))
    with pytest.raises(ValueError, match=f"unknown key '{word}'") as error:
        read(tmp_path, swapped(key, other))
    check_message(error, [location, f"did you mean `{meant}`"])


BAD = {
    "empty": ("", ["model.toml", "at least one mode with a shape", "[[mode]]"]),
    "no mode": ('name = "x"\n[potential]\n111 = 1\n', ["model.toml", "at least one mode"]),
    "not TOML": ("level,frequency_hz\n1,2\n", ["model.toml", "not valid TOML", "line 1"]),
    "open bracket": (MODEL + "[effect\n", ["model.toml", "not valid TOML", "line 32"]),
    "decimal comma": (swapped("79.02", "79,02"), ["model.toml", "not valid TOML", "line 4"]),
    "doubled key": (
        swapped("damping_ratio = 0.05", "damping_ratio = 0.05\ndamping_ratio = 0.06"),
        ["model.toml", "not valid TOML", "line 6"],
    ),
    "doubled table": (MODEL + "[measurement]\n", ["model.toml", "not valid TOML", "line 32"]),
    "deep nesting": (
        "x = " + "[" * 5000 + "]" * 5000,
        ["model.toml", "not valid TOML", "nests too deeply"],
    ),
    "endless number": (swapped("79.02", "9" * 5000), ["model.toml", "too many digits"]),
    "NUL bytes": (MODEL.encode() + b"\0", ["model.toml", "not a UTF-8 text"]),
    "Latin-1": (b"# \xfc\n" + MODEL.encode(), ["model.toml", "not a UTF-8 text"]),
    "unknown list": (
        MODEL.replace("[[effect]]", "[[effects]]"),
        ["model.toml", "'effects'", "did you mean `effect`"],
    ),
    "unknown key at the top": (swapped("name", "title"), ["model.toml", "unknown key 'title'"]),
    "shape as a number": (swapped("{ midspan = 11.8, tip = -3 }", "11.8"), ["`shape`", "table"]),
    "empty shape": (
        swapped("{ midspan = 11.8, tip = -3 }", "{}"),
        ["shape of mode 1 of model.toml", "at least one sensor"],
    ),
    "a mode lacks a sensor": (
        swapped("{ tip = 0.0, midspan = -10.5 }", "{ midspan = -10.5 }"),
        ["mode 2 of model.toml", "lacks the sensor 'tip'"],
    ),
    "a mode misspells a sensor": (
        swapped("{ tip = 0.0, midspan = -10.5 }", "{ tip = 0.0, mid_span = -10.5 }"),
        ["mode 2 of model.toml", "lacks the sensor 'midspan'", "is it 'mid_span'"],
    ),
    "a mode has a further sensor": (
        swapped("{ tip = 0.0, ", "{ root = 1, tip = 0.0, "),
        ["mode 2 of model.toml", "the sensor 'root'", "mode 1 lacks"],
    ),
    "a rigid-body mode lacks a sensor": (
        swapped("midspan = 1.0, ", ""),
        ["rigid_body_mode 1 of model.toml", "lacks the sensor 'midspan'"],
    ),
    "sensor with spaces around": (
        swapped("shape = { tip = 1 }", 'shape = { " tip" = 1 }', MINIMAL),
        ["sensor", "shape of mode 1 of model.toml", "' tip'"],
    ),
    "sensor without a name": (
        swapped("shape = { tip = 1 }", 'shape = { "" = 1 }', MINIMAL),
        ["sensor", "shape of mode 1 of model.toml", "''"],
    ),
    "zero shape": (
        swapped("tip = 1", "tip = 0", MINIMAL),
        ["model.toml", "at least one mode with a shape", "zero at every sensor"],
    ),
    "mode of interest 0": (
        swapped("mode_of_interest = 1", "mode_of_interest = 0"),
        ["`mode_of_interest`", "from 1", "model.toml", "0"],
    ),
    "mode of interest 3": (
        swapped("mode_of_interest = 1", "mode_of_interest = 3"),
        ["`mode_of_interest`", "(2)", "model.toml", "3"],
    ),
    "mode of interest 1.0": (
        swapped("mode_of_interest = 1", "mode_of_interest = 1.0"),
        ["`mode_of_interest`", "whole number", "model.toml", "1.0"],
    ),
    "mode of interest true": (
        swapped("mode_of_interest = 1", "mode_of_interest = true"),
        ["`mode_of_interest`", "whole number", "model.toml", "True"],
    ),
    "one pair of brackets": (
        MINIMAL.replace("[[mode]]", "[mode]"),
        ["`mode`", "[[mode]]", "model.toml has [mode]"],
    ),
    "effect in one pair of brackets": (
        MINIMAL + '[effect]\nkind = "cubic_stiffness"\n',
        ["`effect`", "[[effect]]", "model.toml has [effect]"],
    ),
    "mode as a number": ("mode = 1", ["`mode`", "[[mode]]", "model.toml has 1"]),
    "modes as numbers": ("mode = [1, 2]", ["`mode`", "[[mode]]", "model.toml has [1, 2]"]),
    "potential as a number": ("potential = 1\n" + MINIMAL, ["`potential`", "table", "model.toml"]),
    "name as a number": (swapped('"two modes"', "5"), ["`name`", "a text", "model.toml has 5"]),
    "monomial of a missing mode": (
        swapped("112 =", "113 ="),
        ["[potential] of model.toml", "'113'", "does not exist"],
    ),
    "monomial of mode 0": (swapped("112 =", "110 ="), ["[potential] of model.toml", "'110'"]),
    "monomial in words": (swapped("112 =", "cubic ="), ["[potential] of model.toml", "'cubic'"]),
    "monomial of degree 1": (swapped("112 =", "1 ="), ["[potential] of model.toml", "degree"]),
    "monomial with a point": (swapped("112 =", "1.12 ="), ["[potential] of model.toml", "'1'"]),
    "empty monomial": (swapped("112 =", '"" ='), ["[potential] of model.toml", "''"]),
    "monomial in other digits": (swapped("112 =", '"١١" ='), ["[potential] of model.toml", "'١١'"]),
    "monomial in two orders": (
        swapped("112 = -2.5e6", "112 = -2.5e6\n121 = 1.0"),
        ["[potential] of model.toml", "'121'", "twice"],
    ),
    "unknown effect": (
        swapped('"quadratic_damping"', '"quadratic_dampng"'),
        ["effect 1 of model.toml", "'quadratic_dampng'", "did you mean `quadratic_damping`"],
    ),
    "near miss of an effect of another sort": (
        swapped('"quadratic_damping"', '"frequency_drft"'),
        ["effect 1 of model.toml", "'frequency_drft'", "did you mean `frequency_drift`"],
    ),
    "far from any effect": (
        swapped('"quadratic_damping"', '"xyz"'),
        ["effect 1 of model.toml", "'xyz'", "cubic_damping"],
    ),
    "effect without a kind": (
        swapped('kind = "gap_stiffness"\n', ""),
        ["effect 2 of model.toml", "`kind`"],
    ),
    "kind as a number": (
        swapped('"gap_stiffness"', "3"),
        ["`kind`", "a text", "effect 2 of model.toml", "3"],
    ),
    "parameter of another effect": (
        MINIMAL + '[[effect]]\nkind = "coulomb_friction"\nforce = 1\nsmoothing_velocity = 1\n',
        ["effect 1 of model.toml (coulomb_friction)", "unknown key 'smoothing_velocity'"],
    ),
    "near miss of a slider's parameter": (
        MINIMAL + '[[effect]]\nkind = "jenkins_slider"\nstiffness = 1\nslip_displacment = 1\n',
        ["effect 1 of model.toml (jenkins_slider)", "did you mean `slip_displacement`"],
    ),
    "parameter out of its range": (
        MINIMAL + '[[effect]]\nkind = "iwan_microslip"\ncoefficient = 1\nexponent = 3.0\n',
        ["`exponent`", "above 1 and below 3", "effect 1 of model.toml (iwan_microslip)", "3.0"],
    ),
    "mass that leaves nothing": (
        MINIMAL + '[[effect]]\nkind = "added_mass"\nmass = -1\n',
        ["`mass`", "above -1", "effect 1 of model.toml (added_mass)"],
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_refuses(tmp_path, case, check_message):
    content, parts = BAD[case]
    with pytest.raises(ValueError, match=re.escape(parts[0])) as error:
        read(tmp_path, content)
    check_message(error, parts)


def test_refuses_a_missing_file_and_a_folder(tmp_path, check_message):
    with pytest.raises(ValueError, match="does not exist") as error:
        read_model(tmp_path / "gone.toml")
    check_message(error, ["gone.toml"])
    with pytest.raises(ValueError, match="is a folder") as error:
        read_model(tmp_path)
    check_message(error, [tmp_path.name])


@settings(max_examples=100, deadline=None)
@given(content=st.one_of(st.text(), st.binary()))
def test_reads_or_refuses_anything(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("any") / "model.toml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
    with pytest.raises(ValueError, match=r"model\.toml") as error:
        read_model(path)
    assert "\n" not in str(error.value)


FRAGMENTS = ["", " ", "\n", '"', "=", "[", "]", "{", "-", "9", "e9", "nan", "true", "\0", "é", "'"]


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_reads_or_refuses_a_damaged_model(tmp_path_factory, data):
    start = data.draw(st.integers(0, len(MODEL)))
    length = data.draw(st.integers(0, 3))
    content = MODEL[:start] + data.draw(st.sampled_from(FRAGMENTS)) + MODEL[start + length :]
    path = tmp_path_factory.mktemp("damaged") / "model.toml"
    path.write_bytes(content.encode())
    try:
        model = read_model(path)
    except ValueError as error:
        message = str(error)
        assert "model.toml" in message
        assert "\n" not in message
    else:
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(model))


# ------------------------------------------------------------------------------ round trips

finite = st.floats(-1e200, 1e200)
spread = st.one_of(st.just(0.0), st.floats(0.0, 1e200))
above_minus_one = st.floats(-1.0, 1e200, exclude_min=True)
# Ranges of the parameters with a rule.
PARAMETERS = {
    "relative_shift": above_minus_one,
    "relative_drift": above_minus_one,
    "mass": above_minus_one,
    "gain": above_minus_one,
    "force": spread,
    "gap": spread,
    "stiffness": spread,
    "coefficient": spread,
    "slip_displacement": st.floats(1e-200, 1e200),
    "exponent": st.floats(1.0, 3.0, exclude_min=True, exclude_max=True),
    "frequency_hz": st.floats(1e-200, 1e200),
    "damping_ratio": st.floats(0.0, 1.0, exclude_max=True),
}


@st.composite
def models(draw):
    n, n_rigid = draw(st.integers(1, 3)), draw(st.integers(0, 2))
    sensors = ("mid span", 'the "tip"', "Fläche.3")[: draw(st.integers(1, 3))]

    def array(of, *shape):
        count = int(np.prod(shape))
        return np.array(draw(st.lists(of, min_size=count, max_size=count))).reshape(shape)

    j = draw(st.integers(0, n - 1))
    shape = array(finite, len(sensors), n)
    shape[0, j] = draw(st.floats(1e-3, 1e3))
    not_zero = finite.filter(lambda value: value != 0)
    monomials = draw(
        st.sets(
            st.lists(st.integers(0, n - 1), min_size=2, max_size=6).map(lambda m: tuple(sorted(m))),
            max_size=4,
        )
    )
    kinds = draw(st.lists(st.sampled_from(sorted(EFFECTS)), max_size=2))
    return structure(
        linear_modes(
            array(st.floats(1e-200, 1e200), n),
            array(st.floats(0, 1, exclude_max=True), n),
            shape,
            array(not_zero, n),
            sensors=sensors,
            mode_of_interest=j,
            rigid_body=RigidBodyModes(
                array(finite, len(sensors), n_rigid), array(not_zero, n_rigid)
            ),
            std=LinearModesStd(
                array(st.floats(0, 1e6, allow_subnormal=False), n), array(spread, n)
            ),
        ),
        polynomial_potential(
            {m: draw(finite) for m in sorted(monomials)},
            n,
            coefficient_std={m: draw(spread) for m in sorted(monomials)},
        ),
        effects=tuple(
            make_effect(
                kind, {name: draw(PARAMETERS.get(name, finite)) for name in effect_parameters(kind)}
            )
            for kind in kinds
        ),
        level_gain_std=draw(spread),
        level_phase_std=draw(st.floats(0, 10, allow_subnormal=False)),
        name=draw(st.text(st.characters(exclude_categories=["Cs"]), max_size=8)),
    )


@settings(max_examples=80, deadline=None)
@given(model=models())
def test_round_trip(tmp_path_factory, model):
    path = tmp_path_factory.mktemp("round") / "model.toml"
    write_model(path, model)
    back = read_model(path)
    # Through Hz or degrees: a quotient and a product, each correctly rounded.
    assert same(back, model, rtol=2 * np.finfo(float).eps)
    assert np.array_equal(back.modes.mode_shape, model.modes.mode_shape)
    assert np.array_equal(back.potential.coefficient, model.potential.coefficient)
    # Numbers from a file are restored exactly.
    content = path.read_bytes()
    write_model(path, back)
    assert path.read_bytes() == content


def test_many_modes_make_longer_monomials(tmp_path):
    n = 12
    modes = linear_modes(np.arange(1.0, n + 1), np.zeros(n), np.ones((1, n)), np.ones(n))
    potential = polynomial_potential({"1-1-12": 5.0, "123": 6.0}, n)
    model = structure(modes, potential)
    path = tmp_path / "model.toml"
    write_model(path, model)
    assert '"1-1-12"' in path.read_text() or "1-1-12 = 5.0" in path.read_text()
    assert same(read_model(path), model, rtol=2 * np.finfo(float).eps)


def test_numbers_of_a_file_stay_as_they_are(tmp_path):
    path = tmp_path / "copy.toml"
    write_model(path, read(tmp_path, MODEL))
    text = path.read_text()
    for line in ("frequency_hz = 79.02", "frequency_std_hz = 0.02", "level_phase_std_deg = 0.5"):
        assert line in text.splitlines()
    assert same(read_model(path), read(tmp_path, MODEL), rtol=0.0)
    assert sorted(os.listdir(tmp_path)) == ["copy.toml", "model.toml"]


class Unheard(AbstractMemoryless):
    kind = "unheard_of"

    def force(self, displacement, velocity):
        return 0.0 * displacement


def small(**changes):
    arguments = {"mode_shape": [[1.0]], "participation": [1.0]} | changes
    return linear_modes([500.0], [0.01], **arguments)


BATCH = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), structure(small()))


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (structure(small(participation=[0.0])), "a `participation` other than zero"),
        (structure(small(mode_shape=[[0.0]])), "zero at every sensor"),
        (
            eqx.tree_at(lambda m: m.modes.mode_shape, structure(small()), jnp.array([[jnp.nan]])),
            "must be a finite number",
        ),
        (structure(small(sensors=(" a ",))), "without spaces around it"),
        (structure(small(), level_gain_std=-1.0), "`level_gain_std` must be zero or positive"),
        (structure(small(), level_phase_std=np.inf), "`level_phase_std_deg` must be a finite"),
        (structure(small(), effects=(Unheard(),)), "'unheard_of'"),
        (
            structure(small(), effects=(EFFECTS["cubic_stiffness"](jnp.ones(3)),)),
            "`coefficient` must be one number, but has shape (3,)",
        ),
        (BATCH, "one structure"),
    ],
)
def test_does_not_write_what_could_not_be_read(tmp_path, model, message, check_message):
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        write_model(tmp_path / "model.toml", model)
    check_message(error, [])
    assert os.listdir(tmp_path) == []


# ------------------------------------------------------------------------------ measured files


@pytest.mark.parametrize(
    ("folder", "sensor", "frequency_hz"),
    [("brake_reuss_beam", "drive_point", 80.37), ("suspended_beam", "laser", 42.80)],
)
def test_reads_the_models_of_the_measured_structures(folder, sensor, frequency_hz):
    path = SHARED / folder / "model.toml"
    if not path.exists():
        pytest.skip(f"the measured file {path} is not there (it is kept outside the repository)")
    model = read_model(path)
    assert model.modes.sensors == (sensor,)
    assert float(model.modes.natural_frequency[0]) == frequency_hz * (2 * np.pi)
    assert float(model.modes.natural_frequency_std[0]) > 0.0
