"""Data sets on disk: cameras, views, photographs and the pixels that a step draws."""
