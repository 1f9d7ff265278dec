"""Runs of `snrmjax import` in this process."""

from typer.testing import CliRunner

from snrmjax.cli import app


def run_import(*words):
    """The command's exit code, and what it says or its error of one sentence."""
    result = CliRunner().invoke(app, ["import", *map(str, words)])
    if isinstance(result.exception, ValueError):
        return 2, str(result.exception)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output
