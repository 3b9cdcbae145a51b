"""The quality office: history of measurements, decisions by people, rework and batches of inspections."""
