"""Fitted numbers: the weights of all networks, and a manifest that says where each comes from."""
