"""Networks and rankers that score poses of a picture."""
