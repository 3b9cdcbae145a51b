"""Dense reconstruction."""
