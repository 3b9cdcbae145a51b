"""Printed boards and tags with coded markers: what they are, how they are drawn, and finding them in a picture."""
