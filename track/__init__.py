"""Tracking: the same face through time. Rasterizer, flow, lifting, registration."""

import os

# open3d loads an older TBB, at which numba would warn; OpenMP is there on every machine.
os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")
