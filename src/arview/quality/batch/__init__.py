"""Batches of inspections, on one machine or a Dask cluster."""
