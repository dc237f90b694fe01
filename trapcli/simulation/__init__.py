"""Test objects with closed-form projections, motions and a camera."""
