"""Commands that work for long say what they do, and end on Ctrl-C whatever holds them."""

import os
import signal
import subprocess
import sys
import time

import pytest

# A command that stages a file and then stays in compiled code, which Python cannot interrupt.
_STUCK = """
import logging, sys, time
from pathlib import Path
import jax, jax.numpy as jnp
import snrmjax.cli.console as console
from snrmjax.report.writing import staged

console._QUIET = 0.2
endless = jax.jit(lambda x: jax.lax.while_loop(lambda x: x < 2, lambda x: jnp.cos(x), x))
with console.supervised(), staged(Path(sys.argv[1])) as folder:
    (folder / "half.csv").write_text("half")
    logging.getLogger("snrmjax.test").info("fits 3 effects")
    print("begun", flush=True)
    endless(1.0).block_until_ready()
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of Windows")
def test_a_command_in_compiled_code_reports_and_ends_on_ctrl_c(tmp_path):
    out = tmp_path / "out"
    command, pipe = [sys.executable, "-c", _STUCK, str(out)], subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "begun\n"
            assert list(out.glob("*/half.csv"))
            time.sleep(1.0)
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=10)  # cores are shared here
        finally:
            process.kill()
    assert process.returncode == 130
    assert "fits 3 effects" in said
    assert said.rstrip().endswith("stopped.")
    assert not out.exists()
