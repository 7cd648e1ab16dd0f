"""`python -m unbake`."""

from .cli import main

main()
