"""Test objects with closed-form projections, motions, and a camera: stacks whose true motion is known."""
