"""Core: what every room may use and that knows nothing of parts or pictures of them."""
