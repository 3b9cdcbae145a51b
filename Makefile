# On a fresh machine: `make test`, `make demo`. Both make the environment in .venv first; the program is
# .venv/bin/arview.
SHELL := /bin/bash
READY := .venv/.ready
SAMPLE := samples/bracket_plate

.PHONY: help demo test check bench evaluate soak clean

help:
	@echo "make demo      annotate the sample clip: out/demo/annotated.mp4 and poses.jsonl"
	@echo "make test      run the tests"
	@echo "make check     formatting, linting, types, tests"
	@echo "make bench     measure speed: out/bench.json"
	@echo "make evaluate  measure accuracy on the recorded sequences: out/evaluation.json, out/evaluation.md"
	@echo "make soak      the live server for ten minutes: does its memory grow, do its frames get old?"
	@echo "make clean     remove what these made, but for .venv"

$(READY): pyproject.toml tools/setup
	tools/setup
	@touch $@

demo: $(READY)
	@mkdir -p out/demo
	.venv/bin/arview annotate $(SAMPLE)/clip.mp4 --part $(SAMPLE)/part.toml --camera $(SAMPLE)/camera.json \
	    --inspection $(SAMPLE)/inspection.json -o out/demo/annotated.mp4 --poses out/demo/poses.jsonl

test: $(READY)
	.venv/bin/python -m pytest

check: $(READY)
	tools/check

bench: $(READY)
	.venv/bin/python tools/bench --json out/bench.json

evaluate: $(READY)
	.venv/bin/python tools/evaluate --folder out

soak: $(READY)
	.venv/bin/python tools/soak

clean:
	rm -rf out dist .pytest_cache .mypy_cache .ruff_cache
	find src tests tools samples -name __pycache__ -type d -prune -exec rm -rf {} +
