"""Reconstruction: photos → camera poses → metric scale → dense cloud."""
