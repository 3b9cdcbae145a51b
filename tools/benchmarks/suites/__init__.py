"""Suites of the evaluation and of the speed benchmark."""
