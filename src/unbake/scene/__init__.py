"""Mitsuba scenes: read, edited, and the space in them that is free."""
