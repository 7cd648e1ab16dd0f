"""The program `unbake`, also `python -m unbake`."""

from . import signals


def main() -> None:
    """Handle signals, then load and run the command line."""
    signals.run_program(_command_line)


def _command_line() -> None:
    from .cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()
