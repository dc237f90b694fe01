"""The object itself, from frames whose motion is known."""
