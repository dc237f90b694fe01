"""Reading and writing video stacks, block by block."""
