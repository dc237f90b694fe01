"""Figure of docs/which-motions.md: the viewing direction γ(t) = R e₃ on the sphere for five motions."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from trapcli.simulation.motions import SingleAxis, Tumbling

FIGURE = Path(__file__).parent.parent / "docs/images/which-motions.png"


def main() -> None:
    rng = np.random.default_rng(3)
    motions = {"tumbling": Tumbling.random(rng, total_angle=480.0, duration=1.0)}
    for name, tilt in (
        ("axis in the image plane", 0.0),
        ("tilted by 45°", 45.0),
        ("by 80°", 80.0),
        ("optical axis", 90.0),
    ):
        motions[name] = SingleAxis.from_turns(turns=1.2, duration=1.0, tilt=tilt)
    time = np.linspace(0, 1, 400)
    u, v = np.mgrid[0 : 2 * np.pi : 37j, 0 : np.pi : 19j]
    sphere = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
    figure, axes = plt.subplots(1, len(motions), figsize=(13, 3), subplot_kw={"projection": "3d"})
    for axis, (name, motion) in zip(axes, motions.items(), strict=True):
        R = motion.rotations(time)
        gamma = (R[0].T @ R)[:, :, 2]
        axis.plot_wireframe(*sphere, color="0.85", linewidth=0.4, zorder=1)
        axis.plot(*(1.02 * gamma.T), color="C0", linewidth=2, zorder=3)
        axis.scatter(*gamma[0], color="C3", s=30, zorder=4)
        axis.set(title=name)
        axis.set_box_aspect((1, 1, 1), zoom=1.5)
        axis.view_init(25, 20)
        axis.set_axis_off()
    figure.tight_layout()
    figure.savefig(FIGURE, dpi=110)


if __name__ == "__main__":
    main()
