"""Pictures: reading, writing, colour, and metrics."""
