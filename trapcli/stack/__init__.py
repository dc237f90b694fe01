"""Reading and writing video stacks, block by block."""

from trapcli.stack.frames import Frames, StackInfo
from trapcli.stack.opening import open_stack

__all__ = ["Frames", "StackInfo", "open_stack"]
