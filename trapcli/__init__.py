"""trap-motion: the rigid motion of a trapped particle from its video."""
