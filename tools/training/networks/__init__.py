"""What the trained networks are made of, and how they are trained and written."""
