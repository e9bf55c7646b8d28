"""Applications: the command line, the demo, reports, benchmarks and the simulated actor."""
