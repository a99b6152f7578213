"""The cylinder of the paper's experiment on the robot: 6.5 cm radius, grasped by touch.

hqp-grasp run cylinder_65 --stack fmk --trials 40 --probes 40 --seed 0 --jobs 2 --out DIR
"""

import hqp_grasp as hg
from hqp_grasp.experiments.scenario import main

# The force law assumes 5 cm throughout: the hand does not know the object.
scene = hg.Scene(robot="wam_bhand", object=hg.Cylinder(radius=0.065, height=0.12))

if __name__ == "__main__":
    # The laws, their order and the limits come from the command line; see --help.
    main("cylinder_65", scene)
