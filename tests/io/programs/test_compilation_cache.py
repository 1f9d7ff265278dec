"""Programs that one process stores on disk and the next one loads."""

import os
import subprocess
import sys

SCRIPT = """
import sys, jax, snrmjax as sj
heard = []
jax.monitoring.register_event_listener(lambda name, **_: heard.append(name))
sj.use_compilation_cache(sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.jit(lambda x: x * 3.0)(2.0)
print(heard.count("/jax/compilation_cache/cache_hits"))
"""


def test_the_second_process_reads_what_the_first_compiled(tmp_path):
    hidden = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    variables = {k: v for k, v in os.environ.items() if k not in hidden}
    hits = [
        int(
            subprocess.run(
                [sys.executable, "-c", SCRIPT, tmp_path / "programs"],
                check=True,
                capture_output=True,
                text=True,
                env=variables,
            ).stdout
        )
        for _ in range(2)
    ]
    assert hits[0] == 0
    assert hits[1] > 0
