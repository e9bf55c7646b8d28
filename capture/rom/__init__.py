"""The range-of-motion session: what is prompted, in which state it stands, and who drives it."""
