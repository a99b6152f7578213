"""Contacts and grasps: what is refused, and that what is accepted cannot change."""

import dataclasses

import numpy as np
import pytest

from hqp_grasp.errors import InputError
from hqp_grasp.grasp import Contact, Frame, Grasp

Z = np.array([0.0, 0.0, 1.0])
N = 4


def contact(**given):
    return Contact(**({"position": np.zeros(3), "normal": Z} | given))


def grasp(**given):
    rng = np.random.default_rng(0)
    usual = {
        "q": rng.standard_normal(N),
        "contacts": (contact(), contact(position=Z)),
        "jacobian": rng.standard_normal((6, N)),
    }
    return Grasp(**(usual | given))


def test_a_plain_contact_is_a_material_point_felt_with_certainty():
    plain = Contact(position=[1, 2, 3], normal=[0, 1, 0])
    np.testing.assert_array_equal(plain.position, [1.0, 2.0, 3.0])
    assert plain.position.dtype == float
    assert (plain.tip_radius, plain.flexion) == (0.0, ())
    assert plain.wrench is None and plain.point is None
    assert contact(flexion=[np.int64(2), 0]).flexion == (2, 0)


@pytest.mark.parametrize(
    ("field", "size"), [("position", 3), ("normal", 3), ("point", 3), ("wrench", 6)]
)
@pytest.mark.parametrize("fault", ["short", "long", "matrix", "number", "text", "NaN", "inf"])
def test_a_contacts_arrays_have_their_shape_and_are_finite(field, size, fault):
    good = np.zeros(size)
    good[-1] = 1.0
    bad, message = {
        "short": (good[1:], rf"must have shape \({size}\); got \({size - 1},\)"),
        "long": (np.r_[0.0, good], rf"must have shape \({size}\)"),
        "matrix": (good[None], rf"must have shape \({size}\)"),
        "number": (1.0, rf"must have shape \({size}\); got \(\)"),
        "text": (["up"] * size, "must be an array of numbers"),
        "NaN": (np.where(good == 1.0, np.nan, good), r"must be finite; entry \(\d,\) is nan"),
        "inf": (np.where(good == 1.0, -np.inf, good), r"must be finite; entry \(\d,\) is -inf"),
    }[fault]
    with pytest.raises(InputError, match=rf"Contact\.{field} {message}"):
        contact(**{field: bad})


@pytest.mark.parametrize("length", [0.0, 0.5, 1.0 + 2e-6, 1.0 - 2e-6, 2.0])
def test_a_normal_has_unit_length(length):
    with pytest.raises(InputError, match=r"Contact\.normal must be a unit vector; its length is"):
        contact(normal=length * Z)


def test_a_normal_may_carry_rounding():
    contact(normal=(1.0 + 5e-7) * Z)
    contact(normal=np.ones(3) / np.sqrt(3))


@pytest.mark.parametrize("radius", [-1e-9, np.nan, np.inf, None, "round"])
def test_a_tip_radius_is_finite_and_not_negative(radius):
    with pytest.raises(InputError, match=r"Contact\.tip_radius"):
        contact(tip_radius=radius)


@pytest.mark.parametrize("noise", [-1e-9, np.nan, np.inf, None, "little"])
def test_noise_is_finite_and_not_negative(noise):
    with pytest.raises(InputError, match=r"Contact\.noise"):
        contact(noise=noise)


@pytest.mark.parametrize("flexion", [("a",), (1.5,), 3, (None,)], ids=str)
def test_flexion_is_a_list_of_indices(flexion):
    with pytest.raises(InputError, match=r"Contact\.flexion"):
        contact(flexion=flexion)


def test_closing_is_one_number_for_each_joint():
    assert contact().closing is None
    np.testing.assert_array_equal(contact(closing=[0, 1, -0.5]).closing, [0.0, 1.0, -0.5])
    with pytest.raises(InputError, match=r"Contact\.closing must have shape \(any\)"):
        contact(closing=np.eye(2))
    with pytest.raises(InputError, match=r"Contact\.closing must be finite; entry \(1,\) is nan"):
        contact(closing=[0.0, np.nan])
    with pytest.raises(InputError, match=r"Contact\.closing must have shape \(4,\).*got \(3,\)"):
        grasp(contacts=(contact(closing=np.zeros(N)), contact(closing=np.zeros(3))))


# ---------------------------------------------------------------- frames


def frame(**given):
    usual = {
        "name": "left",
        "position": Z,
        "rotation": np.eye(3),
        "jacobian": np.ones((6, N)),
    }
    return Frame(**(usual | given))


@pytest.mark.parametrize(
    ("field", "size"),
    [("position", r"\(3\)"), ("rotation", r"\(3, 3\)"), ("jacobian", r"\(6, any\)")],
)
def test_a_frames_arrays_have_their_shape_and_are_finite(field, size):
    with pytest.raises(InputError, match=rf"Frame\.{field} must have shape {size}; got \(2, 2\)"):
        frame(**{field: np.eye(2)})
    bad = np.array(getattr(frame(), field))
    bad.flat[-1] = np.inf
    with pytest.raises(InputError, match=rf"Frame\.{field} must be finite"):
        frame(**{field: bad})


def test_a_grasp_has_a_frame_for_each_group_and_each_moves_with_its_joints():
    assert grasp().frames == ()
    both = grasp(frames=[frame(), frame(name="right")]).frames
    assert [each.name for each in both] == ["left", "right"]
    with pytest.raises(InputError, match=r"one frame for each group; .*'left', 'left'"):
        grasp(frames=(frame(), frame()))
    with pytest.raises(InputError, match=r"Frame\.jacobian of 'left' must have shape \(6, 4\)"):
        grasp(frames=(frame(jacobian=np.ones((6, 3))),))
    with pytest.raises(InputError, match=r"Grasp\.frames holds 'left'; it must hold Frame"):
        grasp(frames=("left",))
    with pytest.raises(InputError, match=r"Grasp\.frames must list Frame values; got 3"):
        grasp(frames=3)


# ---------------------------------------------------------------- grasps


def test_a_grasp_counts_its_contacts_and_joints():
    felt = grasp()
    assert (felt.k, felt.n) == (2, N)
    np.testing.assert_array_equal(felt.positions, [[0, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(felt.normals, [Z, Z])
    for i in range(2):
        np.testing.assert_array_equal(felt.contact_jacobian(i), felt.jacobian[3 * i : 3 * i + 3])


def test_without_a_coupling_every_joint_is_independent():
    felt = grasp()
    np.testing.assert_array_equal(felt.coupling, np.eye(N))
    np.testing.assert_array_equal(felt.q_full, felt.q)


def test_all_joints_follow_as_the_coupling_says():
    rng = np.random.default_rng(1)
    C, c0 = rng.standard_normal((7, N)), rng.standard_normal(7)
    felt = grasp(coupling=C, offset=c0)
    np.testing.assert_allclose(felt.q_full, C @ felt.q + c0)
    np.testing.assert_allclose(grasp(coupling=C).q_full, C @ felt.q)


def test_a_grasp_keeps_what_it_was_given_whatever_happens_to_it_later():
    q, J, x = np.zeros(N), np.ones((3, N)), np.zeros(3)
    felt = grasp(q=q, contacts=[contact(position=x)], jacobian=J)
    q += 1.0
    J += 1.0
    x += 1.0
    np.testing.assert_array_equal(felt.q, np.zeros(N))
    np.testing.assert_array_equal(felt.jacobian, np.ones((3, N)))
    np.testing.assert_array_equal(felt.positions, np.zeros((1, 3)))
    assert isinstance(felt.contacts, tuple)


def test_nothing_in_a_grasp_can_be_changed():
    felt = grasp(
        hessian=np.zeros((6, N, N)), contacts=(contact(point=Z), contact(wrench=[0.0] * 6))
    )
    with pytest.raises(dataclasses.FrozenInstanceError):
        felt.q = np.zeros(N)
    with pytest.raises(dataclasses.FrozenInstanceError):
        felt.contacts[0].normal = Z
    arrays = [felt.q, felt.jacobian, felt.hessian, felt.coupling, felt.offset]
    arrays += [felt.contacts[0].position, felt.contacts[0].normal, felt.contacts[0].point]
    arrays += [felt.contacts[1].wrench, felt.contact_jacobian(0)]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


@pytest.mark.parametrize(
    ("field", "bad", "message"),
    [
        ("q", np.zeros((N, 1)), r"Grasp\.q must have shape \(any\)"),
        ("q", 0.0, r"Grasp\.q must have shape"),
        ("q", [np.nan] * N, r"Grasp\.q must be finite; entry \(0,\)"),
        ("q", ["a"] * N, r"Grasp\.q must be an array of numbers"),
        ("q", np.zeros(N + 1), r"Grasp\.jacobian must have shape \(6, 5\); got \(6, 4\)"),
        ("jacobian", np.zeros((3, N)), r"Grasp\.jacobian must have shape \(6, 4\); got \(3, 4\)"),
        ("jacobian", np.zeros((2, 3, N)), r"Grasp\.jacobian must have shape \(6, 4\)"),
        ("jacobian", np.full((6, N), np.inf), r"Grasp\.jacobian must be finite; entry \(0, 0\)"),
        ("jacobian", [[0.0] * N, [0.0]], r"Grasp\.jacobian must be an array of numbers"),
        ("hessian", np.zeros((6, N)), r"Grasp\.hessian must have shape \(6, 4, 4\)"),
        ("hessian", np.full((6, N, N), np.nan), r"Grasp\.hessian must be finite"),
        ("coupling", np.zeros((7, N + 1)), r"Grasp\.coupling must have shape \(any, 4\)"),
        ("coupling", np.full((7, N), np.nan), r"Grasp\.coupling must be finite"),
        ("offset", np.zeros(N + 1), r"Grasp\.offset must have shape \(4\)"),
        ("offset", np.full(N, np.inf), r"Grasp\.offset must be finite"),
        ("contacts", (), r"Grasp\.contacts is empty"),
        ("contacts", (contact(), Z), r"Grasp\.contacts holds .*must hold Contact values"),
        ("contacts", None, r"Grasp\.contacts"),
        ("contacts", (contact(), contact(flexion=(N,))), r"flexion index 4 is outside 0 … 3"),
        ("contacts", (contact(flexion=(-1,)), contact()), r"flexion index -1 is outside 0 … 3"),
    ],
)  # fmt: skip
def test_a_misshapen_grasp_is_refused_by_name(field, bad, message):
    with pytest.raises(InputError, match=message):
        grasp(**{field: bad})


def test_the_floor_is_what_noise_makes_of_a_balanced_grasp_on_average():
    rng, noise = np.random.default_rng(0), np.array([0.01, 0.02, 0.03])
    angles = 2.0 * np.pi * np.arange(3) / 3.0
    normals = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])
    felt = normals + noise[:, None] * rng.normal(size=(20_000, 3, 3))
    felt /= np.linalg.norm(felt, axis=2)[..., None]
    force, moment = felt.sum(axis=1), np.cross(0.05 * normals, felt).sum(axis=1)
    contacts = [
        contact(position=0.05 * n, normal=n, noise=s) for n, s in zip(normals, noise, strict=True)
    ]
    floor = Grasp(q=[0.0], contacts=contacts, jacobian=np.zeros((9, 1))).floor
    eps = (force**2).sum(axis=1).mean(), (moment**2).sum(axis=1).mean()
    np.testing.assert_allclose(eps, floor, rtol=0.03)


def test_without_noise_there_is_no_floor():
    assert Grasp(q=[0.0], contacts=[contact()], jacobian=np.zeros((3, 1))).floor == (0.0, 0.0)


def test_centres_of_round_tips_are_their_radius_beyond_the_touch():
    contacts = [
        Contact([0.1, 0.0, 0.2], [0.0, 0.6, 0.8], tip_radius=0.01),
        Contact([0.0, 0.3, 0.0], [1.0, 0.0, 0.0]),
    ]
    grasp = Grasp(np.zeros(2), contacts, np.zeros((6, 2)))
    np.testing.assert_allclose(grasp.centers, [[0.1, 0.006, 0.208], [0.0, 0.3, 0.0]])
