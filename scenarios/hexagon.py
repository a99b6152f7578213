"""The paper's second object: a regular hexagon with sides of 6 cm, grasped by touch.

hqp-grasp run hexagon --stack fmk --trials 40 --probes 40 --seed 0 --jobs 2 --out DIR
"""

import hqp_grasp as hg
from hqp_grasp.experiments.scenario import main

# Every other face balances: 120° apart, 104 mm across.
scene = hg.Scene(robot="wam_bhand", object=hg.Prism.regular(sides=6, side=0.06, height=0.12))

if __name__ == "__main__":
    # The laws, their order and the limits come from the command line; see --help.
    main("hexagon", scene)
