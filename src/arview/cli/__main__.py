"""``python -m arview.cli``."""

from arview.cli import main

main()
