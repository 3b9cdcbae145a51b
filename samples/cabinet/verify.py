"""Compares the result of `arview inspect` on the cabinet with the truth: verify.py OUT [--truth OTHER/truth.json]."""

import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER.parent / "common"))

import compare  # noqa: E402  # found by the line above

if __name__ == "__main__":
    compare.main(FOLDER, __doc__)
