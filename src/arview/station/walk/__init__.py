"""Measuring while photos arrive: the folder of a job, and the process that works on it."""
