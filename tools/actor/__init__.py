"""The simulated actor: a procedural head, its shapes, its skin, and a renderer."""
