"""Assembly: is every component where the CAD has it."""
