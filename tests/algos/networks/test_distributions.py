"""Action distributions against torch.distributions."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import Categorical, Independent, Normal, kl_divergence

from headway_algos.networks.distributions import CategoricalProduct, DiagonalGaussian, MaskedCategorical

P, A, B = 3, 5, 40
DTYPES = [torch.float32, torch.float64]


def _close(got: Tensor, expected: Tensor) -> None:
    tolerance = 1e-5 if got.dtype == torch.float32 else 1e-12
    torch.testing.assert_close(got, expected, rtol=tolerance, atol=tolerance)


def _categorical_case(dtype: torch.dtype, masked: bool) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
    """Two sets of logits (P, A, B), masks (P, B, A) and allowed actions (P, B)."""
    random = torch.Generator().manual_seed(0)
    new, old = (2 * torch.randn(P, A, B, generator=random, dtype=dtype) for _ in range(2))
    masks = torch.rand(P, B, A, generator=random) < 0.5
    masks[..., 2] |= ~masks.any(-1)
    if not masked:
        masks = torch.ones_like(masks)
    actions = (masks * torch.rand(P, B, A, generator=random)).argmax(-1)
    return new, old, masks if masked else None, actions


def _torch_categorical(logits: Tensor, masks: Tensor | None) -> Any:  # noqa: ANN401 - torch leaves its methods untyped
    rows = logits.transpose(1, 2)
    # torch's own sums need finite logits; e^-200 is 0 beside allowed actions for every figure compared.
    return Categorical(logits=rows if masks is None else rows.masked_fill(~masks, -200.0))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("masked", [False, True])
def test_categorical_equals_torch(dtype: torch.dtype, masked: bool) -> None:
    new, old, masks, actions = _categorical_case(dtype, masked)
    ours, theirs = MaskedCategorical.of_logits(new, masks), _torch_categorical(new, masks)
    ours_old, theirs_old = MaskedCategorical.of_logits(old, masks), _torch_categorical(old, masks)
    _close(ours.log_prob(actions), theirs.log_prob(actions))
    _close(ours.entropy(), theirs.entropy())
    _close(ours.kl_from(ours_old), kl_divergence(theirs_old, theirs))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("what", ["log_prob", "entropy", "kl"])
def test_gradients_of_the_categorical_equal_torchs_and_are_finite(what: str, masked: bool) -> None:
    new, old, masks, actions = _categorical_case(torch.float64, masked)
    gradients: list[Tensor] = []
    for mine in (True, False):
        logits = new.clone().requires_grad_()
        if mine:
            ours = MaskedCategorical.of_logits(logits, masks)
            kl = ours.kl_from(MaskedCategorical.of_logits(old, masks))
            value = {"log_prob": ours.log_prob(actions), "entropy": ours.entropy(), "kl": kl}[what]
        else:
            theirs = _torch_categorical(logits, masks)
            kl = kl_divergence(_torch_categorical(old, masks), theirs)
            value = {"log_prob": theirs.log_prob(actions), "entropy": theirs.entropy(), "kl": kl}[what]
        gradients += torch.autograd.grad(value.sin().sum(), logits)
    assert torch.isfinite(gradients[0]).all()
    _close(gradients[0], gradients[1])


@pytest.mark.parametrize("dtype", DTYPES)
def test_forbidden_actions_have_probability_exactly_zero(dtype: torch.dtype) -> None:
    new, _, masks, _ = _categorical_case(dtype, masked=True)
    assert masks is not None
    new[:, 0] += 80  # a forbidden favourite, and extreme logits beside it
    new[:, 1] -= 80
    new.requires_grad_()
    ours = MaskedCategorical.of_logits(new, masks)
    probabilities = ours.log_probs.exp().transpose(1, 2)
    assert (probabilities[~masks] == 0).all()
    torch.testing.assert_close(probabilities.sum(-1), torch.ones(P, B, dtype=dtype))
    sure = masks.sum(-1) == 1
    assert sure.any()
    assert (ours.entropy()[sure] == 0).all()
    old = MaskedCategorical.of_logits(new.detach(), masks)
    (gradient,) = torch.autograd.grad((ours.entropy() + ours.kl_from(old)).sum(), new)
    assert torch.isfinite(gradient).all()
    assert (gradient.transpose(1, 2)[~masks] == 0).all()


def _gaussian(mean: Tensor, log_std: Tensor) -> tuple[DiagonalGaussian, Any]:
    normal = Normal(mean.transpose(1, 2), log_std.exp().transpose(1, 2).expand(P, B, A))
    return DiagonalGaussian(mean, log_std), Independent(normal, 1)


@pytest.mark.parametrize("dtype", DTYPES)
def test_gaussian_equals_torch(dtype: torch.dtype) -> None:
    random = torch.Generator().manual_seed(1)
    means = [torch.randn(P, A, B, generator=random, dtype=dtype).requires_grad_() for _ in range(2)]
    log_stds = [0.3 * torch.randn(P, A, 1, generator=random, dtype=dtype) for _ in range(2)]
    for log_std in log_stds:
        log_std.requires_grad_()
    ours, theirs = _gaussian(means[0], log_stds[0])
    ours_old, theirs_old = _gaussian(means[1], log_stds[1])
    actions = torch.randn(P, B, A, generator=random, dtype=dtype)
    pairs = [
        (ours.log_prob(actions), theirs.log_prob(actions)),
        (ours.entropy(), theirs.entropy()),
        (ours.kl_from(ours_old), kl_divergence(theirs_old, theirs)),
    ]
    tensors = [*means, *log_stds]
    for mine, torchs in pairs:
        _close(mine, torchs)
        for a, b in zip(
            torch.autograd.grad(mine.mean(), tensors, retain_graph=True, materialize_grads=True),
            torch.autograd.grad(torchs.mean(), tensors, retain_graph=True, materialize_grads=True),
            strict=True,
        ):
            _close(a, b)


NVEC = (2, 3)


def _joint(logits: Tensor, masks: Tensor | None) -> Any:  # noqa: ANN401 - torch leaves its methods untyped
    """The categorical over all 6 joint actions (i, j), in the order 3 i + j."""
    if masks is not None:
        logits = logits.masked_fill(~masks.transpose(1, 2), -200.0)
    first, second = logits[:, :2], logits[:, 2:]
    return Categorical(logits=(first[:, :, None] + second[:, None]).flatten(1, 2).transpose(1, 2))


@pytest.mark.parametrize("masked", [False, True])
def test_a_product_of_categoricals_equals_the_categorical_of_joint_actions(masked: bool) -> None:
    """Values, gradients, the Fisher information and the scores of drawn actions."""
    random = torch.Generator().manual_seed(2)
    new, old = (torch.randn(P, 5, B, generator=random, dtype=torch.float64) for _ in range(2))
    masks = None
    if masked:
        masks = torch.rand(P, B, 5, generator=random) < 0.6
        masks[..., 1] |= ~masks[..., :2].any(-1)
        masks[..., 4] |= ~masks[..., 2:].any(-1)
    new.requires_grad_()
    ours, theirs = CategoricalProduct.of_logits(new, masks, NVEC), _joint(new, masks)
    ours_old, theirs_old = CategoricalProduct.of_logits(old, masks, NVEC), _joint(old, masks)
    drawn = theirs.sample()
    actions = torch.stack([drawn // 3, drawn % 3], dim=-1)
    kl = kl_divergence(theirs_old, theirs)
    pairs = [
        (ours.log_prob(actions), theirs.log_prob(drawn)),
        (ours.entropy(), theirs.entropy()),
        (ours.kl_from(ours_old), kl),
    ]
    for mine, torchs in pairs:
        _close(mine, torchs)
        [one], [other] = (torch.autograd.grad(x.sin().sum(), new, retain_graph=True) for x in (mine, torchs))
        _close(one, other)
    # The Fisher information is the second derivative of KL(pi || pi').
    direction = torch.randn(new.shape, generator=random, dtype=torch.float64)
    own = _joint(new.detach(), masks)
    [slope] = torch.autograd.grad(kl_divergence(own, _joint(new, masks)).sum(), new, create_graph=True)
    [product] = torch.autograd.grad((slope * direction).sum(), new)
    _close(ours.detach().fisher_of_outputs(direction), product)
    # The score of the actions that uniforms draw: of the first option whose distribution function exceeds it.
    uniforms = torch.rand(P, B, 2, generator=random, dtype=torch.float64)
    by_choice = [c.log_probs.exp().cumsum(1).transpose(1, 2) for c in ours.choices]
    picked = [(c <= uniforms[..., i, None]).sum(-1) for i, c in enumerate(by_choice)]
    [score] = torch.autograd.grad(_joint(new, masks).log_prob(3 * picked[0] + picked[1]).sum(), new)
    _close(ours.detach().drawn_score(uniforms), score)
