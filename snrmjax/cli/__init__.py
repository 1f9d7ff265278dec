"""The commands, in the order in which a test needs them.

Each imports its own dependencies, so that none waits for the imports of another.
"""

import gc
import os
import sys
import traceback
from collections.abc import Callable

import typer

from snrmjax.cli.check_command import check
from snrmjax.cli.compare_command import compare
from snrmjax.cli.console import print_line, read_more, refuse, supervised
from snrmjax.cli.demo_command import demo
from snrmjax.cli.diagnose_command import diagnose
from snrmjax.cli.identify_command import identify
from snrmjax.cli.import_command import import_
from snrmjax.cli.modes_command import modes
from snrmjax.cli.options import add_command
from snrmjax.cli.rom_command import rom
from snrmjax.cli.simulate_commands import nnm, simulate
from snrmjax.cli.study_commands import study_app
from snrmjax.cli.whole_test_command import whole_test

_OWN_ERROR = (
    "this is an error of snrmjax and not of the input: please report it with the command and the "
    "lines above."
)

app = typer.Typer(
    name="snrmjax",
    help="Backbones and damping of nonlinear normal modes from near-resonant steady states.",
    epilog="Try it: snrmjax demo --out demo. Each command has its own --help with an example.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

# The first example of each runs in the tests.
_EXAMPLES: dict[Callable[..., None], tuple[str, ...]] = {
    demo: ("snrmjax demo --out demo",),
    whole_test: ("snrmjax test measurements --out report",),
    import_: (
        "snrmjax import test.csv",
        "snrmjax import test.mat --force CH1 --force-unit N --response CH2:acceleration --unit g "
        "--out imported",
        "snrmjax import next.mat --map imported/map.toml --out next",
    ),
    check: ("snrmjax check measured.csv --model model.toml --out checked",),
    modes: (
        "snrmjax modes frf.uff --out model.toml",
        "snrmjax modes low_level.csv --drive-point tip --out model.toml",
        "snrmjax modes decay.mat --to-hz 200 --unscaled --out model.toml",
    ),
    identify: (
        "snrmjax identify measured.csv --model model.toml --out result",
        "snrmjax identify measured.csv --model model.toml --predict-force 0.5 --out result",
        "snrmjax identify driven.csv --model model.toml --fit auto --free force_gain --next 5 "
        "--out result",
    ),
    compare: (
        "snrmjax compare measured.csv --model model.toml --out compared",
        "snrmjax compare measured.csv decay.csv --model model.toml --out compared",
    ),
    diagnose: (
        "snrmjax diagnose measured.csv --model model.toml --out result",
        "snrmjax diagnose sets/*.csv --model model.toml --out results",
    ),
    simulate: (
        "snrmjax simulate model.toml --force 0.5 --from-hz 60 --to-hz 110 --out result",
        "snrmjax simulate model.toml --force 0.5 --force 1 --from-hz 60 --to-hz 110 --out result",
        "snrmjax simulate model.toml --force 0.5 --from-hz 60 --to-hz 110 --follow fold "
        "--parameter mode_1.damping_ratio --to 0.01 --out result",
    ),
    nnm: ("snrmjax nnm model.toml --to-hz 110 --out result",),
    rom: (
        "snrmjax rom beam.toml --out reduced",
        "snrmjax rom --tables load_cases --out reduced",
        "snrmjax rom --calculix deck.inp --modes 1,3,5 --out reduced",
    ),
}
_OBJECTS = 100_000  # allocated between two garbage collections, some 10 MB
_READ_MODELS = (whole_test, check, identify, compare, diagnose, simulate, nnm)
# Names reserved by Python or pytest.
_NAMES = {whole_test: "test", import_: "import"}


for _command, _examples in _EXAMPLES.items():
    add_command(
        app,
        _command,
        _NAMES.get(_command, _command.__name__),
        _examples,
        reads_models=_command in _READ_MODELS,
    )

app.add_typer(study_app)


def main() -> None:
    """Run the commands; wrong input ends with exit code 2 and one sentence.

    An error of this package ends with exit code 1 and its traceback.
    """
    # Imports and programs live to the end: garbage collection would take a tenth of the run time.
    gc.set_threshold(_OBJECTS)
    # Responses are many times slower on a GPU than on a CPU core, and every process would allocate
    # most of its memory (the site's validation page on other programs).
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    asks_help = not {"--help", "--help-all"}.isdisjoint(sys.argv)
    if sys.argv[1:] and not asks_help:  # help does not wait for the import of JAX
        from snrmjax.io.programs.compilation_cache import use_compilation_cache

        use_compilation_cache()
    try:
        with supervised():
            app(prog_name="snrmjax")
    except Exception as error:
        from snrmjax.numerics.rules import InputError  # imports NumPy, for which help does not wait

        if not isinstance(error, InputError):
            traceback.print_exc()
            refuse(_OWN_ERROR)
            sys.exit(1)
        refuse(str(error))
        more = read_more(error)
        if more:
            print_line(more)
        sys.exit(2)
