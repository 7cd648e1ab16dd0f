"""What is learned: fields over the scene's volume, and their dress as Mitsuba textures."""
