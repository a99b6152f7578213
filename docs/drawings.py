"""Each law as a drawing, from what it computes: `make pictures` writes images/law-*.svg.

Left a grasp as it may be felt, right the same after some steps of the law. One file for light pages
and one for dark ones.
"""

from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, FancyArrowPatch, Polygon

import hqp_grasp as hg

IMAGES = Path(__file__).parent / "images"
MM = 1e3  # drawings are in millimetres
UNIT = 26.0  # [mm] a unit vector, a force of 1 N
WIDTH = 144.0  # [mm] of one picture
STEPS = 6

Palette = dict[str, str]
PALETTES: dict[str, Palette] = {
    "light": {
        "ink": "#2b2b2b", "faint": "#8a8a8a", "object": "#f4e3cc", "edge": "#b79a72",
        "force": "#1c56d6", "normal": "#c2348f", "net": "#c81414", "motion": "#0f8060",
        "finger": "#5b6770", "tip": "#d9481c",
    },
    "dark": {
        "ink": "#e2e4e9", "faint": "#9aa1ad", "object": "#4b4439", "edge": "#b79a72",
        "force": "#82b1ff", "normal": "#ff8ad4", "net": "#ff7b72", "motion": "#4fd1a5",
        "finger": "#a9b4bd", "tip": "#ff8a5c",
    },
}  # fmt: skip


def arrow(ax: Axes, start: np.ndarray, vector: np.ndarray, colour: str, width: float = 2.2) -> None:
    """An arrow from `start` along `vector`, both [mm]."""
    start, end = start[:2], (start + vector)[:2]
    head = {"arrowstyle": "-|>", "mutation_scale": 6 * width, "shrinkA": 0, "shrinkB": 0}
    ax.add_patch(FancyArrowPatch(start, end, lw=width, color=colour, zorder=4, **head))


def word(ax: Axes, at: np.ndarray, text: str, colour: str) -> None:
    """Text around a place [mm]."""
    ax.text(at[0], at[1], text, color=colour, ha="center", va="center", zorder=6)


def panels(bottom: float, top: float) -> tuple[Figure, list[Axes]]:
    """Two pictures of the same WIDTH, from `bottom` to `top` [mm]."""
    figure = plt.figure(figsize=(8.0, 4.0 * (top - bottom) / WIDTH))
    axes = [figure.add_axes((0.5 * i, 0.0, 0.5, 1.0)) for i in range(2)]
    for ax in axes:
        ax.set(xlim=(-WIDTH / 2, WIDTH / 2), ylim=(bottom, top), aspect="equal")
        ax.axis("off")
    return figure, axes


def touches(ax: Axes, grasp: hg.Grasp, palette: Palette) -> None:
    """Contacts, their normals and the forces of the fingers."""
    for i, (p, n) in enumerate(zip(MM * grasp.positions, grasp.normals, strict=True), 1):
        arrow(ax, p, 0.5 * UNIT * n, palette["normal"], 1.6)
        arrow(ax, p, -UNIT * n, palette["force"])
        ax.add_patch(Circle(p[:2], 2.2, fc=palette["tip"], zorder=5))
        aside = 7.0 * np.array([-n[1], n[0]])
        word(ax, p[:2] - 0.6 * UNIT * n[:2] + aside, f"$f_{i}$", palette["force"])


def slide(
    at: np.ndarray,
    surface: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    task: hg.ContactSpaceTask,
) -> list[hg.Grasp]:
    """Grasps on the way: contacts free to slide by what the law asks, from places (k, 3) [m].

    `surface` sets places back onto it, and gives its outward normals there (k, 3).
    """
    grasps: list[hg.Grasp] = []
    k = len(at)
    for _ in range(STEPS + 1):
        at, normals = surface(at)
        contacts = [hg.Contact(p, n) for p, n in zip(at, normals, strict=True)]
        grasps.append(hg.Grasp(np.zeros(3 * k), contacts, np.eye(3 * k)))
        x = hg.HQP().solve(hg.Stack.of(task).levels(grasps[-1])).x
        at = at + x.reshape(k, 3)
    return grasps


def force(palette: Palette) -> Figure:
    """Three contacts on a disc: the net force vanishes where they stand 120° apart."""
    r = 0.05  # [m]
    law = hg.ForceTask(radius=r)

    def sphere(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        n = p / np.linalg.norm(p, axis=1, keepdims=True)
        return r * n, n

    angles = np.radians([20.0, 90.0, 215.0])
    at = r * np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    first, *_, last = slide(at, sphere, law)
    figure, axes = panels(-74.0, 68.0)
    for ax, grasp in zip(axes, (first, last), strict=True):
        ax.add_patch(Circle((0, 0), MM * r, fc=palette["object"], ec=palette["edge"], lw=1.5))
        touches(ax, grasp, palette)
        net = UNIT * law.error(grasp)
        if np.linalg.norm(net) > 1.0:
            arrow(ax, np.zeros(3), net, palette["net"], 3.0)
            word(ax, net - np.array([8.0, -4.0, 0.0]), "$f$", palette["net"])
        value = law.potential(grasp)
        word(ax, np.array([0, -68]), rf"$\varepsilon_f = {value:.2f}$ N²", palette["ink"])
    edge = 0.7071 * MM * r * np.array([1.0, -1.0])
    axes[0].plot([0, edge[0]], [0, edge[1]], "--", color=palette["faint"], lw=1.2)
    word(axes[0], 0.6 * edge + np.array([5.0, 3.0]), "$r$", palette["faint"])
    for a, b in zip(first.normals, last.normals, strict=True):  # how far each slid
        way = a + np.linspace(0.0, 1.0, 20)[:, None] * (b - a)
        way *= 1.1 * MM * r / np.linalg.norm(way, axis=1, keepdims=True)
        axes[1].plot(*way.T[:2], ":", color=palette["faint"])
    return figure


def moment(palette: Palette) -> Figure:
    """Three contacts on the faces of a triangle: no net force, and a moment until lines meet."""
    law = hg.MomentTask()
    angles = np.radians([90.0, 210.0, 330.0])
    faces = np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    along = np.column_stack([-faces[:, 1], faces[:, 0], faces[:, 2]])
    inner = 0.03  # [m] from the middle to a face
    at = inner * faces + np.array([[0.022], [0.008], [0.015]]) * along
    first, *_, last = slide(at, lambda p: (p, faces), law)
    figure, axes = panels(-76.0, 50.0)
    corners = -2.0 * MM * inner * faces[:, :2]
    for ax, grasp in zip(axes, (first, last), strict=True):
        ax.add_patch(Polygon(corners, fc=palette["object"], ec=palette["edge"], lw=1.5))
        for p, n in zip(MM * grasp.positions, faces, strict=True):
            line = np.array([p, p - 75.0 * n])
            ax.plot(*line.T[:2], "--", color=palette["faint"], lw=1.0, zorder=3)
        touches(ax, grasp, palette)
        m = MM * abs(law.error(grasp)[2])  # [mm·N], here against the clock
        if m > 1.0:
            turn = np.radians(np.linspace(-70.0, 190.0, 40))
            c = MM * grasp.positions.mean(axis=0)
            way = np.column_stack([c[0] + 11 * np.cos(turn), c[1] + 11 * np.sin(turn)])
            ax.plot(*way[:-2].T, color=palette["net"], lw=3.0, zorder=5)
            arrow(ax, way[-3], way[-1] - way[-3], palette["net"], 3.0)
            word(ax, c[:2], "$m$", palette["net"])
        text = rf"$\sqrt{{\varepsilon_m}} = {m:.0f}$ mm·N"
        word(ax, np.array([0, -68]), text, palette["ink"])
    return figure


def kinematic(palette: Palette) -> Figure:
    """A finger on a surface: the angle between the tip's motion as it flexes, and the normal."""
    law = hg.KinematicTask(error="angle")
    n, tip = np.array([0.0, 1.0, 0.0]), 0.008
    figure, axes = panels(-52.0, 56.0)
    for ax, joint in zip(axes, ([-0.042, 0.042, 0.0], [-0.058, 0.008, 0.0]), strict=True):
        motion = np.cross([0.0, 0.0, -1.0], tip * n - joint)  # [m/rad] of the tip's centre
        contact = hg.Contact(np.zeros(3), n, flexion=(0,), tip_radius=tip)
        grasp = hg.Grasp(np.zeros(1), [contact], motion[:, None])
        (angle,) = law.error(grasp)
        at, center = MM * np.array(joint), MM * tip * n
        ground = np.array([[-72.0, 0.0], [72.0, 0.0], [72.0, -22.0], [-72.0, -22.0]])
        ax.add_patch(Polygon(ground, fc=palette["object"], ec="none"))
        ax.plot([-72, 72], [0, 0], color=palette["edge"], lw=1.5)
        link = np.array([at, center])
        ax.plot(*link.T[:2], color=palette["finger"], lw=11, solid_capstyle="round", zorder=2)
        ax.add_patch(Circle(center[:2], MM * tip, fc=palette["tip"], zorder=3))
        ax.add_patch(Circle(at[:2], 5.0, fc=palette["ink"], zorder=3))
        word(ax, at[:2] + np.array([-9.0, 6.0]), r"$\gamma$", palette["ink"])
        arrow(ax, center, 1.6 * UNIT * n, palette["normal"])
        word(ax, center[:2] + np.array([6.0, 1.6 * UNIT]), "$n$", palette["normal"])
        flexing = 1.4 * UNIT * motion / np.linalg.norm(motion)
        arrow(ax, center, flexing, palette["motion"], 3.0)
        word(ax, (center + 1.18 * flexing)[:2], r"$J_\gamma$", palette["motion"])
        text = rf"$\varepsilon_i = {np.degrees(angle):.0f}°$"
        word(ax, np.array([0, -46]), text, palette["ink"])
        if angle > 0.1:
            down = np.degrees(np.arctan2(flexing[1], flexing[0]))
            ax.plot([0, 0], [MM * tip, -36], "--", color=palette["faint"], lw=1.2)
            arc = {"theta1": min(down, -90.0), "theta2": max(down, -90.0)}
            ax.add_patch(Arc(center[:2], 50, 50, color=palette["ink"], lw=1.5, **arc))
            middle = np.radians((down - 90.0) / 2.0)
            place = center[:2] + 32.0 * np.array([np.cos(middle), np.sin(middle)])
            word(ax, place, r"$\varepsilon_i$", palette["ink"])
    return figure


if __name__ == "__main__":
    plt.rcParams.update({"svg.hashsalt": "hqp_grasp", "mathtext.fontset": "stix", "font.size": 17})
    for draw in (force, moment, kinematic):
        for scheme, palette in PALETTES.items():
            figure = draw(palette)
            path = IMAGES / f"law-{draw.__name__}-{scheme}.svg"
            figure.savefig(path, transparent=True, metadata={"Date": None})
            plt.close(figure)
