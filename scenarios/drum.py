"""A drum of 20 cm radius, too wide for one hand: two arms grasp it by touch.

hqp-grasp run drum --help
hqp-grasp run drum --hand both --stack fm --trials 40 --seed 0 --jobs 2 --out DIR
hqp-grasp run drum --hand palms --stack fm --trials 40 --seed 0 --jobs 2 --out DIR
"""

import hqp_grasp as hg
from hqp_grasp.experiments.scenario import main

scene = hg.Scene(robot="umass_torso", object=hg.Cylinder(radius=0.2, height=0.4), hand="both")

if __name__ == "__main__":
    # The laws, their order and the limits come from the command line; see --help.
    main("drum", scene)
