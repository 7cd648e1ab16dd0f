"""Results for other programs: textures, glTF, and scenes for Mitsuba without unbake."""
