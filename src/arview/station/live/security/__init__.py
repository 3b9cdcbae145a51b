"""Access control, limits, certificates and addresses of the live server."""
