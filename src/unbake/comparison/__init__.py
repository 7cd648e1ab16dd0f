"""Methods side by side: their quality over time, and their step times."""
