"""Measurement in a dense cloud: registration to the CAD, deviations, foreign objects, distances."""
