"""A beam of 10 × 60 × 10 cm, which two palms grasp at its ends by touch.

hqp-grasp run beam --help
hqp-grasp run beam --stack fm --trials 40 --seed 0 --jobs 2 --out DIR
"""

import hqp_grasp as hg
from hqp_grasp.experiments.scenario import main

scene = hg.Scene(robot="umass_torso", object=hg.Prism.box(0.1, 0.6, 0.1), hand="palms")

if __name__ == "__main__":
    # The laws, their order and the limits come from the command line; see --help.
    main("beam", scene)
