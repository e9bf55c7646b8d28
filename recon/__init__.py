"""Reconstruction: one instant in space. Calibration, rectified stereo, fusion, scan meshes."""

import os

# open3d loads an older TBB, at which numba would warn; OpenMP is there on every machine.
os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")
