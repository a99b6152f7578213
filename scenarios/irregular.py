"""The paper's third kind of object: an irregular prism of six sides.

hqp-grasp run irregular --stack fmk --trials 40 --probes 40 --seed 0 --jobs 2 --out DIR
"""

import hqp_grasp as hg
from hqp_grasp.experiments.scenario import main

# The paper does not tell its outline. On these faces alone three unit forces leave 0.043 N² at
# least, so a grasp needs an edge or more; benchmarks/edges.py lists which.
CORNERS = (  # [m], counter-clockwise; sides of 50 to 69 mm, 41 to 55 mm from the middle
    (0.055, -0.023),
    (0.048, 0.027),
    (0.005, 0.055),
    (-0.045, 0.032),
    (-0.058, -0.018),
    (0.000, -0.055),
)
scene = hg.Scene(robot="wam_bhand", object=hg.Prism(CORNERS, height=0.12))

if __name__ == "__main__":
    # The laws, their order and the limits come from the command line; see --help.
    main("irregular", scene)
