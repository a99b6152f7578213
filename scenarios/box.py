"""A box of 30 × 40 × 30 cm, its long side between the two arms that grasp it by touch.

hqp-grasp run box --help
hqp-grasp run box --hand both --stack fm --trials 40 --seed 0 --jobs 2 --out DIR
hqp-grasp run box --hand palms --stack fm --trials 40 --seed 0 --jobs 2 --out DIR
"""

import hqp_grasp as hg
from hqp_grasp.experiments.scenario import main

scene = hg.Scene(robot="umass_torso", object=hg.Prism.box(0.3, 0.4, 0.3), hand="both")

if __name__ == "__main__":
    # The laws, their order and the limits come from the command line; see --help.
    main("box", scene)
