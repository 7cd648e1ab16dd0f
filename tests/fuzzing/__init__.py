"""Files that are damaged at random, and what reads them: see `formats.py` for the table."""
