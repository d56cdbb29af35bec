"""The arithmetic of double Q-learning, with numbers worked by hand."""

import pytest
import torch

from learner.targets import (
    double_q_target,
    huber,
    importance_weights,
    td_error,
    weighted_mean,
)


def test_online_selects_and_target_evaluates():
    target = double_q_target(
        r_t=torch.tensor([1.0, -1.0, 0.5]),
        discount_t=torch.tensor([0.9, 0.9, 0.0]),
        q_online_t=torch.tensor([[1.0, 2.0], [5.0, 4.0], [1.0, 2.0]]),
        q_target_t=torch.tensor([[10.0, 3.0], [-2.0, 7.0], [8.0, 9.0]]),
    )
    # 1 + 0.9 * 3;  -1 + 0.9 * -2;  terminal: the reward alone.
    torch.testing.assert_close(target, torch.tensor([3.7, -2.8, 0.5]))


def test_a_target_has_no_gradient():
    q = torch.ones(1, 2, requires_grad=True)
    r, discount = torch.zeros(1), torch.ones(1)
    assert not double_q_target(r, discount, q, q).requires_grad


def test_td_error_is_of_the_action_taken():
    delta = td_error(
        torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
        torch.tensor([2, 0]),
        torch.tensor([2.5, 7.0]),
    )
    torch.testing.assert_close(delta, torch.tensor([-0.5, 3.0]))


@pytest.mark.parametrize(
    ("threshold", "expected"),
    [(1.0, [0.0, 0.125, 0.5, 2.5]), (2.0, [0.0, 0.125, 0.5, 4.0])],
)
def test_huber_by_hand(threshold, expected):
    # threshold 1: |-3| gives 1 * (3 - 0.5); threshold 2: 2 * (3 - 1).
    losses = huber(torch.tensor([0.0, 0.5, -1.0, -3.0]), threshold)
    torch.testing.assert_close(losses, torch.tensor(expected))


def test_importance_weights_by_hand():
    # (1/0.1, 1/0.4, 1/0.9) = (10, 2.5, 1.11); / 10; square root.
    weights = importance_weights(torch.tensor([0.1, 0.4, 0.9]), 0.5)
    torch.testing.assert_close(weights, torch.tensor([1.0, 0.5, 1 / 3]))


def test_exponent_zero_weighs_all_alike():
    weights = importance_weights(torch.tensor([0.1, 0.4, 0.9]), 0.0)
    torch.testing.assert_close(weights, torch.ones(3))


def test_tiny_probabilities_do_not_overflow():
    weights = importance_weights(torch.tensor([1e-38, 1e-38, 1.0]), 1.0)
    torch.testing.assert_close(weights, torch.tensor([1.0, 1.0, 0.0]))


def test_weighted_mean_is_acmes():
    # (1 * 2 + 0.5 * 4) / 2 = 2, where sum(w l) / sum(w) would be 2.67.
    mean = weighted_mean(torch.tensor([2.0, 4.0]), torch.tensor([1.0, 0.5]))
    assert float(mean) == 2.0
