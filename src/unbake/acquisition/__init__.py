"""Renders data sets: built-in scenes, placed cameras, photographs with their true materials."""
