"""From sightings of a board to a calibrated array, and the proof of it."""
