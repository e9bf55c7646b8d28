"""Reconstruction: one instant in space. Calibration, rectified stereo, fusion, scan meshes."""
