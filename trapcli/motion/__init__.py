"""From attenuation to motion, one step of the paper a file."""
