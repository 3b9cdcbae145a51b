"""Adjustment: poses, points and lenses together, the normal equations, and what they say of uncertainty."""
