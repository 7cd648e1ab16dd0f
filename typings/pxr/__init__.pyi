# OpenUSD as an untyped library: usd-core comes without stubs.
from typing import Any

def __getattr__(name: str) -> Any: ...
