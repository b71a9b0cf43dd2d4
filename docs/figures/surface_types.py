#!/usr/bin/env python3
"""Draws docs/figures/surface-types.png: cross-sections of four molecular surfaces of two carbon atoms.

    pip install matplotlib
    docs/figures/surface_types.py

Both panels show the plane through the two centres. The surfaces are symmetric about the axis between the centres, so
the cross-section is exact and not a two-dimensional approximation.
"""

import pathlib

import matplotlib
import numpy as np

matplotlib.use("agg")
import matplotlib.pyplot as plt  # noqa: E402

RADIUS, PROBE = 1.7, 1.4  # Å: carbon (Bondi), water
TOLERANCE = 0.01
OUT = pathlib.Path(__file__).with_name("surface-types.png")


def gaussian(u, a):
    """Density of one atom at u = d²/r², with the C¹ cut-off."""
    end = 1 + np.log(1 / TOLERANCE) / a
    value = (np.exp(-a * (u - 1)) - TOLERANCE * (1 + a * (end - u))) / (1 - TOLERANCE * (1 + np.log(1 / TOLERANCE)))
    return np.where(u < end, value, 0)


def excluded(x, y, distance):
    """Distance (Å) from points inside the SAS to the SAS, minus the probe radius: 0 on the SES."""
    big, half = RADIUS + PROBE, distance / 2
    best = np.full(x.shape, np.inf)
    for side in (-1, 1):
        dx, dy = x - side * half, y
        length = np.maximum(np.hypot(dx, dy), 1e-9)
        # The nearest point of this sphere counts if the other sphere does not bury it.
        px, py = side * half + dx / length * big, dy / length * big
        exposed = np.hypot(px + side * half, py) >= big
        best = np.where(exposed, np.minimum(best, big - length), best)
    if half < big:  # The circle in which the two spheres meet.
        for sign in (-1, 1):
            best = np.minimum(best, np.hypot(x, y - sign * np.sqrt(big**2 - half**2)))
    inside = np.minimum(np.hypot(x - half, y), np.hypot(x + half, y)) < big
    return np.where(inside, best, -1) - PROBE


def panel(axes, distance, title):
    """One pair of atoms at `distance` (Å)."""
    x, y = np.meshgrid(np.linspace(-5.6, 5.6, 1121), np.linspace(-3.4, 3.4, 681))
    squares = [((x - s * distance / 2) ** 2 + y**2) / RADIUS**2 for s in (-1, 1)]
    nearest = np.sqrt(np.minimum(*squares)) * RADIUS
    axes.contourf(x, y, nearest, levels=[0, RADIUS], colors=["#dfe4ea"])
    for values, level, color, style in [
        (nearest, RADIUS + PROBE, "#7f8c9a", "dashed"),
        (nearest, RADIUS, "#4b5563", "solid"),
        (excluded(x, y, distance), 0, "#1f6fb2", "solid"),
        (sum(gaussian(u, 1.25) for u in squares), 1, "#d9480f", "solid"),
        (sum(gaussian(u, 0.75) for u in squares), 1.9, "#2b8a3e", "dotted"),
    ]:
        axes.contour(x, y, values, levels=[level], colors=[color], linestyles=[style], linewidths=1.6)
    axes.plot([-distance / 2, distance / 2], [0, 0], "o", color="#4b5563", markersize=3)
    axes.set(aspect="equal", title=title)
    axes.axis("off")


def main():
    figure, both = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    panel(both[0], 1.5, "bonded, 1.5 Å apart")
    panel(both[1], 4.0, "in contact, 4.0 Å apart")
    lines = [
        plt.Line2D([], [], color=color, linestyle=style, label=label)
        for label, color, style in [
            ("VDW", "#4b5563", "solid"),
            ("SAS", "#7f8c9a", "dashed"),
            ("SES", "#1f6fb2", "solid"),
            ("Gaussian, default", "#d9480f", "solid"),
            ("Gaussian, ses-like", "#2b8a3e", "dotted"),
        ]
    ]
    figure.legend(handles=lines, loc="outside lower center", ncols=5, frameon=False)
    figure.savefig(OUT, dpi=110, facecolor="white", metadata={"Software": None})


main()
