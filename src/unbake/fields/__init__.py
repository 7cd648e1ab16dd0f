"""Trainable fields over the scene, and the Mitsuba textures that evaluate them."""
