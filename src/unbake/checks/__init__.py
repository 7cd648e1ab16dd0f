"""Checks of a data set before it is fitted: `unbake data check`."""
