"""Contacts felt with noise: what is felt, what is, and what comes of it."""

import dataclasses

import numpy as np
import pytest

import hqp_grasp as hg
from hqp_grasp.touch.noisy import NoisyProbe

STACK = hg.ForceTask() >> hg.MomentTask() >> hg.KinematicTask()


@pytest.fixture(scope="module")
def scene():
    return hg.Scene()


@pytest.fixture(scope="module")
def began(scene):
    rng = np.random.default_rng(0)
    return hg.Start().draw(scene, hg.GeometricProbe, rng).grasp


def test_errors_have_the_spread_that_was_asked_for(scene, began):
    noise, rng = hg.Noise(normal=0.02, position=5e-4), np.random.default_rng(1)
    probe = NoisyProbe(hg.GeometricProbe(scene), scene.articulated, noise, rng)
    angles, ways = [], []
    for true in began.contacts * 200:
        contact = probe._felt(true)
        angles.append(contact.normal - (contact.normal @ true.normal) * true.normal)
        ways.append(contact.position - true.position)
    square = (np.array(angles) ** 2).sum(axis=1).mean()
    assert np.sqrt(square / 2) == pytest.approx(0.02, rel=0.1)  # 600 errors about two axes
    np.testing.assert_allclose(np.std(ways, axis=0), 5e-4, rtol=0.15)
    np.testing.assert_allclose(np.mean(ways, axis=0), 0.0, atol=1e-4)


def test_a_ball_felt_with_noise_is_touched_where_its_normal_says(scene, began):
    """Kinematics know the ball's centre better than touch knows the place."""
    rng = np.random.default_rng(1)
    probe = NoisyProbe(hg.GeometricProbe(scene), scene.articulated, hg.Noise(0.02, 5e-4), rng)
    felt, centers = probe.touch(began.q), scene.articulated.centers(began.q)
    for contact, center in zip(felt.contacts, centers, strict=True):
        place = center - contact.tip_radius * contact.normal
        np.testing.assert_allclose(contact.position, place, atol=1e-6)


def test_without_noise_what_is_felt_is_what_is(scene):
    exact = hg.Trial(scene, STACK, probes=3).run(4)
    noisy = hg.Trial(scene, STACK, probes=3, noise=hg.Noise()).run(4)
    for name in ("eps_f", "eps_m"):
        np.testing.assert_allclose(noisy.column(name), exact.column(name), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(noisy.column(f"{name}_true"), noisy.column(name), rtol=1e-12)


def test_true_errors_are_those_of_the_same_touch_without_noise(scene):
    trial = hg.Trial(scene, STACK, probes=4, noise=hg.Noise(0.02, 5e-4))
    record = trial.run(4)
    probe = hg.GeometricProbe(scene)
    for row, felt in zip(record.rows, record.grasps, strict=True):
        true = probe.touch(felt.q)
        assert row["eps_f_true"] == pytest.approx(hg.ForceTask().potential(true), abs=1e-7)
        assert row["eps_m_true"] == pytest.approx(hg.MomentTask().potential(true), abs=1e-9)
        assert row["eps_f"] == hg.ForceTask().potential(felt) != row["eps_f_true"]


def test_a_seed_gives_the_same_noise_and_the_start_of_a_trial_without(scene):
    trial = hg.Trial(scene, STACK, probes=2, noise=hg.Noise(0.02, 5e-4))
    same = [trial.run(7).column("eps_f") for _ in range(2)]
    np.testing.assert_array_equal(*same)
    exact = dataclasses.replace(trial, noise=None).run(7)
    assert trial.run(7).rows[0]["eps_f_true"] == pytest.approx(exact.rows[0]["eps_f"], abs=1e-7)


def test_a_miss_is_passed_on_as_it_is(scene):
    class Nothing:
        def touch(self, q_target):
            return hg.Missed(hg.Miss.NO_TOUCH, "finger_1")

    noise, rng = hg.Noise(0.02), np.random.default_rng(0)
    probe = NoisyProbe(Nothing(), scene.articulated, noise, rng)
    assert probe.touch(scene.articulated.home) is probe.felt[-1]


@pytest.mark.parametrize("wrong", [-0.1, np.inf, np.nan, "much"])
@pytest.mark.parametrize("name", ["normal", "position"])
def test_noise_that_cannot_be_is_refused_by_name(name, wrong):
    with pytest.raises(hg.InputError, match=f"Noise.{name}"):
        hg.Noise(**{name: wrong})


def test_a_simulated_hand_has_sensors_of_its_own(scene):
    with pytest.raises(hg.InputError, match="preset"):
        hg.Trial(scene, STACK, probe="physical", noise=hg.Noise(0.02))
