"""Awkward places to begin from: contacts side by side on one face, and fingers on edges."""

from hqp_grasp.grasp import Grasp
from hqp_grasp.touch.geometric import GeometricProbe
from hqp_grasp.world.scene import Prism, Scene

BOX = Prism(((0.06, -0.06), (0.06, 0.06), (-0.06, 0.06), (-0.06, -0.06)))
WALL = Prism(((0.05, -0.15), (0.05, 0.15), (-0.05, 0.15), (-0.05, -0.15)), height=0.3)
HEXAGON = Prism.regular(6, 0.06)
# Each with its scene and a posture of the wam_bhand [rad] from which all fingers touch.
AWKWARD = {
    "two contacts on one face": (
        Scene(object=BOX),
        (-0.7877, 1.1737, 0.9009, 1.9852, -0.521, -0.1903, -0.2431, 1.0639, 0.8144, 1.3312, 0.8601),
    ),
    "three contacts on one face": (
        Scene(object=WALL, position=(0.75, 0.0, 0.35)),
        (0.0, 0.713, 0.0, 2.256, 0.0, -1.049, 0.0, 0.349, 0.1, 0.812, 0.407),
    ),
    "a finger on an edge": (
        Scene(object=HEXAGON),
        (0.679, 1.0871, -0.8821, 1.8223, 0.7078, 0.1498, 1.0289, 0.8892, 1.0376, 1.3327, 0.8669),
    ),
    "two fingers on edges": (
        Scene(object=HEXAGON),
        (-0.4469, 0.9809, 0.4566, 2.1596, -0.3362, -0.716, 0.1019, 1.1488, 0.888, 1.4029, 0.8108),
    ),
}


def begin(name: str) -> tuple[Scene, Grasp]:
    """The scene of an awkward start, and the grasp felt there: Trial(scene, …, start=grasp)."""
    scene, posture = AWKWARD[name]
    felt = GeometricProbe(scene).touch(posture)
    assert isinstance(felt, Grasp), (name, felt)
    return scene, felt
