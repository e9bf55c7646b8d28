"""Drawing calibration boards at true scale, for printers."""
