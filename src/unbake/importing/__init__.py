"""Turns photographs, cameras and meshes of other programs into data sets."""
