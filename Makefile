# On a fresh machine: `make test` or `make demo`. Every target first makes the environment in .venv, where the program is
# .venv/bin/arview: `make demo` a small one, the others all of it.
SHELL := /bin/bash
READY := .venv/.ready
DEMO_READY := .venv/.ready-demo
SAMPLE := samples/plate
# A worker for each core; each test file goes to one worker, in the order of conftest.py. (Groups of xdist 3.8 have no
# effect with pytest 9, which does not read the suffix that they add to the names of tests.)
PARALLEL := -n auto --dist loadfile --no-loadscope-reorder --durations=10
# make test ROOM=refinement: the tests of that room and of the rooms that import it.
ROOM :=
TESTS = $(if $(ROOM),$$(.venv/bin/python tests/helpers/rooms.py $(ROOM)))

.PHONY: help demo demo-live test test-fast check docs guideviews bench evaluate soak screens clean

help:
	@echo "make demo      inspect the sample plate: report and annotated video in out/demo"
	@echo "make demo-live the whole inspection on the live page, unattended: report and pictures in out/demo-live"
	@echo "make test      formatting, linting, types, all tests: ten minutes on two cores"
	@echo "make test ROOM=refinement  the same for one room and the rooms that import it"
	@echo "make test-fast the quick tests of every room, or of ROOM: a minute"
	@echo "make check     formatting, linting, types"
	@echo "make docs      the documentation as a site: out/docs/index.html"
	@echo "make guideviews the small guide-view sets of the samples in guideviews/"
	@echo "make bench     measure speed: out/bench.json"
	@echo "make evaluate  measure accuracy on the recorded sequences: out/evaluation.json, out/evaluation.md"
	@echo "make soak      run the live server for ten minutes, and check its memory and the age of frames"
	@echo "make screens   photograph the live page in every state and look: out/screens"
	@echo "make clean     remove what these targets made, except .venv"

$(READY): pyproject.toml $(wildcard requirements.lock) tools/lab/pyproject.toml tools/setup
	tools/setup
	@touch $(DEMO_READY) $@

# Only what the demo needs; a full environment has it, too.
$(DEMO_READY): pyproject.toml $(wildcard requirements-demo.lock) tools/setup
	tools/setup demo
	@touch $@

# Four components of the sample are out of tolerance: arview must end with exit code 1, fail.
demo: $(DEMO_READY)
	.venv/bin/arview inspect --part $(SAMPLE)/part.toml --photos $(SAMPLE)/photos --video $(SAMPLE)/clip.mp4 \
	    -o out/demo; code=$$?; [ $$code -eq 1 ] || { echo "demo: exit code $$code, expected 1" >&2; exit 1; }

# Chromium and the tracker share the cores: a few minutes on two of them.
demo-live: $(READY)
	.venv/bin/python tools/demo_live.py -o out/demo-live

test: check
	.venv/bin/python -m pytest $(PARALLEL) $(TESTS)

test-fast: $(READY)
	.venv/bin/python -m pytest $(PARALLEL) -m "not slow and not browser" $(TESTS)

check: $(READY)
	tools/check

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 .venv/bin/python -m mkdocs build --quiet --strict -f tools/docs/mkdocs.yml

# Small sets: 8° apart instead of 4°, and packed.
guideviews: $(READY)
	for part in $(patsubst samples/%/part.toml,%,$(wildcard samples/*/part.toml)); do \
	    .venv/bin/arview guideviews samples/$$part/part.toml -o guideviews/$$part/$$part.gv --spacing 8 --packed \
	        --preview guideviews/$$part/sheet.jpg --report guideviews/$$part/report.md || exit 1; \
	done

bench: $(READY)
	.venv/bin/python tools/benchmarks/bench.py --json out/bench.json

evaluate: $(READY)
	.venv/bin/python tools/benchmarks/evaluate.py --folder out

soak: $(READY)
	.venv/bin/python tools/benchmarks/soak.py

screens: $(READY)
	.venv/bin/python tools/screens.py -o out/screens

clean:
	rm -rf out dist .pytest_cache .mypy_cache .ruff_cache
	find src tests tools samples -name __pycache__ -type d -prune -exec rm -rf {} +
