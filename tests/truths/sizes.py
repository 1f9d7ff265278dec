"""How much a test repeats: a sample in the usual run, all of it in the long one."""

import os


def repeats(usual: int, long: int) -> int:
    """How often a random test is repeated, by `SNRMJAX_LONG_TESTS`."""
    return long if os.environ.get("SNRMJAX_LONG_TESTS") else usual
