"""The version of unbake, for `unbake.__version__` and for files that name what wrote them."""

VERSION = "0.2.0.dev0"
