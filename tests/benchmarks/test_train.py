from __future__ import annotations

import torch
from torch import nn

from uavrl.benchmarks.train import Products


def test_products_are_those_of_forward_and_backward() -> None:
    layer, x = nn.Linear(6, 5), torch.ones(4, 6, requires_grad=True)
    with Products() as products:
        layer(x).sum().backward()
    assert sum(products.found.values()) == 3  # y, the weight's gradient, x's gradient
    assert products.flop == 3 * 2 * 4 * 6 * 5
    assert 0 < products.seconds(torch.float32, 0.003) < 0.1
