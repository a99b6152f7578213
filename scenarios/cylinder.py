"""The paper's first object: a cylinder of 5 cm radius, grasped by touch.

hqp-grasp run cylinder --help
hqp-grasp run cylinder --stack fmk --trials 40 --probes 40 --seed 0 --jobs 2 --out DIR
"""

import hqp_grasp as hg
from hqp_grasp.experiments.scenario import main

# As tall as a can: the hand ends above it, with the palm and the links clear of its top.
scene = hg.Scene(robot="wam_bhand", object=hg.Cylinder(radius=0.05, height=0.12))

if __name__ == "__main__":
    # The laws, their order and the limits come from the command line; see --help.
    main("cylinder", scene)
