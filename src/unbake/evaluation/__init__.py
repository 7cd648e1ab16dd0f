"""Path traced renderings of what was recovered, and its errors against the truth."""
