"""Fits whose processes each learn from views of their own: the same objective, the same numbers."""

import subprocess
import sys
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support import MPIEXEC, needs_mpi, on_ranks, tiny_fields

from unbake import Ranks  # noqa: F401
