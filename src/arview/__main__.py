"""The program, run as ``python -m arview``."""

from arview.cli import main

if __name__ == "__main__":
    main(prog_name="arview")
