"""Photos → camera poses → metric scale → dense cloud."""
