"""`unbake doctor`."""


def doctor() -> int:
    """Check that unbake runs on this machine, and say what to install if it does not."""
    from ..doctor import main as run_doctor

    return run_doctor()
