"""Uncertainty of displacements: combination of methods, budget, Monte Carlo, and the decision rule."""
