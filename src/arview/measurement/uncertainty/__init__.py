"""Uncertainty: methods combined, budgets, Monte Carlo, and the decision rule."""
