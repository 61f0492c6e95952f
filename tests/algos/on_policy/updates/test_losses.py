"""Losses that return something else than one value per row are refused in one line."""

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, cast

import pytest
import torch
from torch import Tensor

from headway.contracts import HeadwayError
from headway_algos.networks.distributions import Distribution, MaskedCategorical
from headway_algos.on_policy.updates.losses import A2CLoss, LossRows, checked_loss, require_reports

P, B = 2, 5
NEW = MaskedCategorical.of_logits(torch.zeros(P, 3, B, requires_grad=True), None)
BATCH = LossRows(torch.zeros(P, B, dtype=torch.int64), torch.zeros(P, B), torch.ones(P, B))


class _Loss:
    reports: ClassVar[tuple[str, ...]] = ("entropy",)

    def __init__(self, returned: Callable[[Tensor], object]) -> None:
        self.returned = returned

    def __call__(self, new: Distribution, batch: LossRows) -> tuple[Tensor, dict[str, Tensor]]:
        return cast("tuple[Tensor, dict[str, Tensor]]", self.returned(new.log_prob(batch.actions)))


def test_the_loss_of_a2c_at_uniform_policies_of_three_actions() -> None:
    """-A log pi - c H, with -log pi = H = log 3."""
    loss, metrics = A2CLoss(0.3)(NEW, replace(BATCH, advantages=torch.full((P, B), 2.0)))
    entropy = torch.full((P, B), 3.0).log()
    torch.testing.assert_close(loss, (2 - 0.3) * entropy)
    torch.testing.assert_close(metrics["entropy"], entropy)


def test_a_loss_per_row_and_its_metrics_are_returned() -> None:
    values, metrics = checked_loss(_Loss(lambda x: (-x, {"entropy": x, "other": 1})), NEW, BATCH)
    torch.testing.assert_close(values, torch.full((P, B), 3.0).log())
    assert metrics.shape == (1, P, B)
    assert not metrics.requires_grad


@pytest.mark.parametrize(
    ("returned", "line"),
    [
        (lambda x: x, "must return a pair"),
        (lambda x: (x, {}), "reports entropy, and must return it"),
        (
            lambda x: (x.mean(), {"entropy": x}),
            r"one value per row.*\(2, 5\) here, and its loss has shape \(\)",
        ),
        (lambda x: (x.sum(1), {"entropy": x}), r"and its loss has shape \(2,\); leave out means and sums"),
        (lambda x: (x, {"entropy": x.mean()}), r"and entropy has shape \(\)"),
        (lambda x: (x, {"entropy": 0.5}), "tensors of torch, and entropy is of type float"),
        (lambda x: (x.detach().numpy(), {"entropy": x}), "and its loss is of type ndarray"),
        (lambda x: (x.detach(), {"entropy": x}), "has no gradient"),
    ],
)
def test_other_results_are_refused(returned: Callable[[Tensor], object], line: str) -> None:
    with pytest.raises(HeadwayError, match=f"^_Loss .*{line}"):
        checked_loss(_Loss(returned), NEW, BATCH)


@pytest.mark.parametrize(
    ("reports", "line"),
    [
        (None, r"_Reporting\.reports must be a tuple"),
        ("entropy", r"_Reporting\.reports must be a tuple"),
        ((1,), r"_Reporting\.reports must be a tuple"),
        (("gradient_norm",), "_Reporting reports gradient_norm, which the update reports"),
    ],
)
def test_other_names_of_metrics_are_refused(reports: object, line: str) -> None:
    class _Reporting(_Loss):
        pass

    _Reporting.reports = cast("tuple[str, ...]", reports)
    with pytest.raises(HeadwayError, match=f"^{line}"):
        require_reports(_Reporting(lambda x: x))


def test_a_loss_may_report_nothing() -> None:
    loss = _Loss(lambda x: (-x, {}))
    loss.reports = ()
    require_reports(loss)
    values, metrics = checked_loss(loss, NEW, BATCH)
    assert values.shape == (P, B)
    assert metrics.shape == (0, P, B)
