"""`python -m snrmjax`: the commands."""

from snrmjax.cli import main

main()
