"""The live server: web application, shared state, start and stop."""
