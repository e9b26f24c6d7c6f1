"""Muon against the singular value decomposition and torch's AdamW."""

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given
from torch import nn
from torch.optim.lr_scheduler import OneCycleLR

from dopepp.training.optimizers import Muon, orthogonalise


def step(optimizer, parameters, gradients):
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient.clone()
    optimizer.step()


@given(rows=st.integers(1, 60), columns=st.integers(1, 60), seed=st.integers(0, 2**31))
def test_singular_values_become_nearly_one_and_directions_remain(rows, columns, seed):
    matrix = np.random.default_rng(seed).normal(size=(rows, columns))
    U, S, Vt = np.linalg.svd(matrix, full_matrices=False)
    result = orthogonalise(torch.tensor(matrix)).numpy()
    inside = U.T @ result @ Vt.T
    kept = np.diag(inside)[S / np.linalg.norm(S) > 0.002]
    assert ((kept > 0.65) & (kept < 1.25)).all()
    assert np.allclose(inside, np.diag(np.diag(inside)), atol=1e-6)
    assert np.allclose(U @ inside @ Vt, result, atol=1e-6)


def test_a_step_has_the_size_of_adamws():
    torch.manual_seed(0)
    shape, rate = (16, 8, 3, 3), 0.01
    parameters = [nn.Parameter(torch.zeros(shape))]
    optimizer = Muon(parameters, lr=rate, weight_decay=0)
    for _ in range(20):
        before = parameters[0].detach().clone()
        step(optimizer, parameters, [torch.randn(shape)])
    rms = (parameters[0] - before).square().mean().sqrt().item() / rate
    assert rms == pytest.approx(0.2, rel=0.25)


def test_biases_and_norms_take_the_step_of_adamw():
    torch.manual_seed(1)
    ours, theirs = nn.Parameter(torch.ones(5)), nn.Parameter(torch.ones(5))
    settings = {"lr": 0.01, "betas": (0.9, 0.99), "weight_decay": 0.1}
    muon, adamw = Muon([ours], **settings), torch.optim.AdamW([theirs], **settings)
    for _ in range(4):
        gradient = torch.randn(5)
        step(muon, [ours], [gradient])
        step(adamw, [theirs], [gradient])
    assert torch.equal(ours, theirs)


def test_weights_without_a_gradient_shrink_by_the_decay():
    assert not orthogonalise(torch.zeros(3, 5)).any()
    weight = nn.Parameter(torch.full((4, 4), 2.0))
    step(Muon([weight], lr=0.1, weight_decay=0.5), [weight], [torch.zeros(4, 4)])
    assert torch.allclose(weight, torch.full((4, 4), 1.9))


def test_a_resumed_run_is_exact():
    def run(parameters, optimizer, steps):
        schedule = OneCycleLR(optimizer, 0.02, total_steps=20)
        for number in range(steps.stop):
            if number >= steps.start:
                torch.manual_seed(number)
                step(optimizer, parameters, [torch.randn_like(weight) for weight in parameters])
            optimizer._opt_called = True  # prevents torch's warning of skipped steps
            schedule.step()

    def fresh():
        return [nn.Parameter(torch.ones(6, 3, 2, 2)), nn.Parameter(torch.ones(6))]

    whole, first = fresh(), fresh()
    run(whole, Muon(whole), range(10))
    muon = Muon(first)
    run(first, muon, range(5))
    second = [nn.Parameter(item.detach().clone()) for item in first]
    resumed = Muon(second)
    resumed.load_state_dict(muon.state_dict())
    run(second, resumed, range(5, 10))
    assert all(torch.equal(a, b) for a, b in zip(whole, second, strict=True))
