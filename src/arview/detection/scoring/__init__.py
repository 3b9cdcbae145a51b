"""Networks and rankers that score the poses of an image."""
