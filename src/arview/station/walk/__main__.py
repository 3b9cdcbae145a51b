"""``python -m arview.station.walk JOB``: measure a job while its photos arrive; ends when the job is done."""

from __future__ import annotations

import sys

from arview.station.walk.process import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
