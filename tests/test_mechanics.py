"""Statics of contact forces: wrenches, cones, friction demand, Ferrari and Canny's ε."""

import numpy as np
import pytest
from scipy.optimize import linprog

from hqp_grasp.errors import InputError
from hqp_grasp.mechanics import (
    arm,
    ferrari_canny,
    friction_demand,
    grasp_map,
    margin,
    net_wrench,
    pyramid_rows,
    pyramids,
    tangents,
)

FLOOR = 0.2

FOUND = 1e-6  # [–] to which friction_demand promises the least µ
ROUNDING = 1e-12


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def walls(k, lean=0.0, radius=0.05):
    """k contacts around the z axis, on walls that lean by `lean` [rad]."""
    a = 2.0 * np.pi * np.arange(k) / k
    around = np.column_stack([np.cos(a), np.sin(a), np.zeros(k)])
    return radius * around, np.cos(lean) * around + [0.0, 0.0, np.sin(lean)]


def drawn(k, rng):
    """Contacts on a lumpy ball."""
    n = unit(rng.normal(size=(k, 3)))
    return 0.05 * n + 0.01 * rng.normal(size=(k, 3)), n


def turned(rng):
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return R * np.linalg.det(R)


def test_the_grasp_map_gives_the_net_wrench_in_batches_too():
    rng = np.random.default_rng(0)
    x, f, c = rng.normal(size=(7, 4, 3)), rng.normal(size=(7, 4, 3)), rng.normal(size=(7, 3))
    G = grasp_map(x, c)
    assert G.shape == (7, 6, 12)
    wrench = net_wrench(f, x, c)
    assert np.abs((G @ f.reshape(7, 12, 1))[..., 0] - wrench).max() < ROUNDING
    by_hand = np.concatenate(
        [f[3].sum(0), sum(np.cross(x[3, i] - c[3], f[3, i]) for i in range(4))]
    )
    assert np.abs(wrench[3] - by_hand).max() < ROUNDING


def test_tangents_are_unit_across_the_normal_and_each_other():
    n = np.concatenate([np.eye(3), -np.eye(3), unit(np.random.default_rng(1).normal(size=(20, 3)))])
    frame = np.concatenate([n[:, None], tangents(n)], axis=1)
    assert np.abs(frame @ frame.transpose(0, 2, 1) - np.eye(3)).max() < ROUNDING


def test_pyramids_lie_in_the_cones_and_touch_them_along_their_edges():
    n = unit(np.random.default_rng(2).normal(size=(5, 3)))
    rims = pyramids(n, 0.6)  # (5, 8, 3)
    assert np.abs(margin(rims, n[:, None], 0.6)).max() < ROUNDING
    between = 0.5 * (rims + np.roll(rims, 1, axis=1))
    assert (margin(between, n[:, None], 0.6) > 0.0).all()


def test_the_faces_of_a_pyramid_and_its_edges_are_the_same_pyramid():
    rng = np.random.default_rng(3)
    n = unit(rng.normal(size=(5, 3)))
    rims, rows = pyramids(n, 0.6, 6), pyramid_rows(n, 0.6, 6)
    at_edges = rows @ rims.transpose(0, 2, 1)  # (5, faces, edges)
    assert at_edges.max() < ROUNDING
    assert ((np.abs(at_edges) < ROUNDING).sum(axis=1) == 2).all()  # an edge is where two faces meet
    assert np.abs(np.linalg.norm(rows, axis=-1) - 1.0).max() < ROUNDING


def test_margin_is_the_distance_to_the_cone():
    n = np.array([0.0, 0.0, 1.0])
    assert margin(np.array([0.0, 0.0, -1.0]), n, 0.75) == pytest.approx(0.75 / 1.25)
    assert margin(np.array([0.75, 0.0, -1.0]), n, 0.75) == pytest.approx(0.0)
    assert margin(np.array([2.0, 0.0, -1.0]), n, 0.75) == pytest.approx(-1.25 / 1.25)
    # Along the surface's own normal it grows as far as it is gone.
    inward = np.array([-1.0, 0.0, -0.75]) / 1.25
    assert margin(np.array([0.75, 0.0, -1.0]) + 0.1 * inward, n, 0.75) == pytest.approx(0.1)


# ---------------------------------------------------------------- friction demand


@pytest.mark.parametrize("tilt", [1e-3, 0.1, 0.7])
def test_two_contacts_need_the_tangent_of_their_tilt(tilt):
    x = np.array([[0.05, 0.0, 0.0], [-0.05, 0.0, 0.0]])
    n = np.array([[np.cos(tilt), np.sin(tilt), 0.0], [-np.cos(tilt), np.sin(tilt), 0.0]])
    assert friction_demand(x, n) == pytest.approx(np.tan(tilt), rel=FOUND)


@pytest.mark.parametrize("k", [3, 4, 7])
@pytest.mark.parametrize("lean", [0.0, 0.01, 0.1, 0.5])
def test_leaning_walls_need_the_tangent_of_their_lean(k, lean):
    assert friction_demand(*walls(k, lean)) == pytest.approx(np.tan(lean), rel=FOUND, abs=FOUND)


def test_one_contact_and_contacts_on_one_side_cannot_balance():
    x, n = walls(3, 0.3)
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    assert friction_demand(x[:1], n[:1]) == np.inf
    assert friction_demand(x, up) == np.inf
    assert friction_demand(x[:2], np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])) == np.inf
    # Two that face one another, along the line between them: what balances only rubs.
    pair, _ = walls(2)
    assert friction_demand(pair, np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])) == np.inf


def test_one_finger_against_two_on_a_box_needs_none():
    x = np.array([[0.03, 0.02, 0.0], [0.03, -0.02, 0.0], [-0.03, 0.01, 0.0]])
    n = np.array([[1.0, 0, 0], [1.0, 0, 0], [-1.0, 0, 0]])
    assert friction_demand(x, n) == pytest.approx(0.0, abs=FOUND)


def test_a_third_contact_that_must_push_its_share_makes_two_balanced_ones_need_friction():
    pair, n = walls(2)
    x = np.vstack([pair, [0.0, 0.0, 0.05]])
    n = np.vstack([n, [0.0, 0.0, 1.0]])
    assert friction_demand(x[:2], n[:2]) == pytest.approx(0.0, abs=FOUND)
    # Each of a third 0.2 on top; the others lift it: (0.2 / 2) / 1.4 in friction.
    assert friction_demand(x, n) == pytest.approx(0.1 / 1.4, rel=1e-5)


def test_the_demand_stays_where_the_grasp_is_moved_scaled_or_told_in_another_order():
    rng = np.random.default_rng(4)
    for k in (2, 3, 5):
        x, n = drawn(k, rng)
        if k == 2:
            n[1] = unit(-n[0] + 0.1 * rng.normal(size=3))
            x = 0.05 * n
        there, order = friction_demand(x, n), rng.permutation(k)
        R, p = turned(rng), rng.normal(size=3)
        assert friction_demand(x @ R.T + p, n @ R.T) == pytest.approx(there, abs=FOUND)
        for scale in (7.0, 1e-9):
            assert friction_demand(scale * x, n) == pytest.approx(there, abs=FOUND)
        assert friction_demand(x[order], n[order]) == pytest.approx(there, abs=FOUND)


def by_linear_programs(x, n, edges, outer):
    """The same with pyramids inside the cones, or around them: above the least µ, or below it."""
    k = len(x)
    G = grasp_map(x, x.mean(axis=0))
    G[3:] /= arm(x)
    ones = np.kron(np.eye(k), np.ones(edges))

    def balances(mu):
        rims = pyramids(n, mu / np.cos(np.pi / edges) if outer else mu, edges)
        columns = np.concatenate([G[:, 3 * i : 3 * i + 3] @ rims[i].T for i in range(k)], axis=1)
        return (
            linprog(
                np.zeros(k * edges),
                A_eq=np.vstack([columns, ones.sum(axis=0)]),
                b_eq=np.append(np.zeros(6), k),
                A_ub=-ones,
                b_ub=np.full(k, -FLOOR),
            ).status
            == 0
        )

    low, high = 0.0, 1.0
    while not balances(high):
        low, high = high, 4.0 * high
        if high > 1e4:
            return np.inf
    while high - low > 1e-5 * (1.0 + low):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if balances(middle) else (middle, high)
    return low if outer else high


@pytest.mark.parametrize("k", [2, 3, 4, 6])
def test_the_demand_lies_between_those_of_pyramids_inside_and_around_the_cones(k):
    rng = np.random.default_rng(50 + k)
    for _ in range(5):
        x, n = drawn(k, rng)
        if k == 2:
            n[1] = unit(-n[0] + 0.3 * rng.normal(size=3))
        low, high = (by_linear_programs(x, n, 32, outer) for outer in (True, False))
        assert low - 1e-5 * (1.0 + low) <= friction_demand(x, n) <= high + 1e-5 * (1.0 + high)


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-9, 1e-8, 1e-6, 1e-3])
@pytest.mark.parametrize("k", [3, 4, 5])
def test_rounding_in_grasps_of_parallel_plates_changes_nothing(k, noise):
    rng = np.random.default_rng(6)
    side = np.where(np.arange(k) % 2, 1.0, -1.0)
    flat = np.column_stack([side, np.zeros(k), np.zeros(k)])
    for _ in range(6):
        x = 0.03 * flat + np.array([0.0, 0.02, 0.02]) * rng.normal(size=(k, 3))
        n = unit(flat + noise * rng.normal(size=(k, 3)))
        there = friction_demand(x, flat)
        near = max(3e-6, 10.0 * noise) * (1.0 + there)
        assert friction_demand(x, n) == pytest.approx(there, abs=near)


def beam(*places):
    """Contacts along a beam [m], on its upper side, or with a minus sign below it."""
    x = np.column_stack([np.abs(places), np.zeros((len(places), 2))])
    return x, np.column_stack([np.zeros(len(places)), np.sign(places), np.zeros(len(places))])


def test_levers_on_a_beam_bind_normal_forces_to_one_another():
    assert friction_demand(*beam(0.10, -0.15, -0.08)) == pytest.approx(0.0, abs=FOUND)
    # The far one has 0.05 of the near one's force, 0.07 of their mean: less than its share.
    assert friction_demand(*beam(0.10, -0.15, -0.0975)) == np.inf
    # The way nearest to equal forces has too little at one contact, another way has not.
    assert friction_demand(*beam(0.10, -0.12, 0.14, 0.18)) == pytest.approx(0.0, abs=FOUND)


def test_the_demand_asks_for_contacts_and_unit_normals():
    x, n = walls(3)
    with pytest.raises(InputError, match="unit vectors"):
        friction_demand(x, 2.0 * n)
    with pytest.raises(InputError, match="shape"):
        friction_demand(x[:2], n)
    with pytest.raises(InputError, match="a contact"):
        friction_demand(np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(InputError, match="finite"):
        friction_demand(x * np.nan, n)


# ---------------------------------------------------------------- Ferrari and Canny's ε


def test_epsilon_is_the_weakest_wrench_by_a_linear_program_too():
    rng = np.random.default_rng(7)
    x, n = walls(3)
    epsilon = ferrari_canny(x, n, 0.6)
    rims = pyramids(n, 0.6)
    lever = (x - x.mean(axis=0)) / arm(x)
    w = np.concatenate([rims, np.cross(lever[:, None], rims)], axis=2).reshape(-1, 6).T

    def resisted(direction):
        """The most that normal forces of 1 N in all make along `direction`."""
        equal = np.column_stack([w, -direction])
        found = linprog(
            np.append(np.zeros(24), -1.0),
            A_eq=np.vstack([equal, np.append(np.ones(24), 0.0)]),
            b_eq=np.append(np.zeros(6), 1.0),
        )
        return -found.fun

    least = min(resisted(d) for d in unit(rng.normal(size=(100, 6))))
    assert 0.0 < epsilon <= least
    assert least < 2.5 * epsilon  # random directions come near the weakest one


def test_epsilon_is_none_where_some_wrench_is_not_resisted():
    x, n = walls(3)
    assert ferrari_canny(x[:2], np.array([n[0], -n[0]]), 0.6) == 0.0  # turns about their line
    assert ferrari_canny(x, np.tile([0.0, 0.0, 1.0], (3, 1)), 0.6) == 0.0
    assert ferrari_canny(x[:1], n[:1], 0.6) == 0.0
    tilted = walls(3, 0.7)  # 40°: past the cone
    assert ferrari_canny(*tilted, 0.6) == 0.0 < ferrari_canny(*tilted, 1.0)


def test_epsilon_stays_where_the_grasp_is_moved_or_scaled_and_grows_with_friction():
    rng = np.random.default_rng(8)
    x, n = walls(3, 0.1)
    there = ferrari_canny(x, n, 0.6, 32)
    R = turned(rng)
    assert ferrari_canny(3.0 * x @ R.T + 1.0, n @ R.T, 0.6, 32) == pytest.approx(there, rel=0.02)
    assert ferrari_canny(x, n, 0.4, 32) < there < ferrari_canny(x, n, 0.8, 32)


@pytest.mark.parametrize("friction", [0.0, -1.0, np.nan])
def test_epsilon_asks_for_friction_above_none(friction):
    with pytest.raises(InputError, match="friction"):
        ferrari_canny(*walls(3), friction)
