"""Optimization: from a data set and settings to recovered fields."""
