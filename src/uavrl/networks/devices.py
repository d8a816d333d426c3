"""Networks over the set of devices: they meet other layouts and another K, and do not care about the devices' order.

A device's token and the aircraft's global vector each pass a first layer; tokens are pooled into the global vector,
which goes back to every token; one output a device, one for idling (Zaheer et al. 2017, "Deep sets"; Lee et al. 2019,
"Set Transformer", for the weighted pooling).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from uavrl.networks.interfaces import (
    Actor,
    ActorOutput,
    ChoiceActor,
    ChoiceActorOutput,
    Conditional,
    Context,
    Critic,
    Denoiser,
    Observation,
)
from uavrl.networks.mlp import bounded_log_std, choice_output, step_embedding

TOKEN_FEATURES = 9
GLOBAL_FEATURES = 7
REFERENCE_DEVICES = 10  # whose ages enter as they are: the K of the built-in data
NEVER = -1e4  # logit and Q of a padded device


def _place(offset_m: Tensor, scale_m: float) -> Tensor:
    """Relative position and distance over `scale_m`, (..., 2) -> (..., 3)."""
    scaled = offset_m / scale_m
    return torch.cat([scaled, scaled.square().sum(dim=-1, keepdim=True).add(1e-8).sqrt()], dim=-1)


def features(observation: Observation, scale_m: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Tokens (B, K, 9), globals (B, 7), validity (B, K) and relative positions in metres (B, K, 2).

    Ages enter as log(1 + age), as they are, and as a share of the oldest: absolute for the value, relative for whom to
    serve. They are scaled by `REFERENCE_DEVICES` / K first: of K devices served in turn each waits K services, so a
    round looks the same whatever K, and a policy flies with more or fewer devices than it was trained with.
    """
    if not isinstance(observation, dict):
        raise TypeError('a set network takes observation = "devices"')
    uav, devices = observation["uav"], observation["devices"]
    offset, known = devices[..., :2], devices[..., 5:]  # columns stay columns: an operation costs more than its numbers
    count = known.sum(dim=1)
    age = devices[..., 2:3] * (REFERENCE_DEVICES / count)[:, None]
    plain_age = age.clamp(max=20.0) / 5.0  # returns are sums of ages: linear where flights mostly are
    ages = torch.cat([torch.log1p(age), plain_age], dim=-1) * known
    age = age * known
    oldest = age.amax(dim=1)
    share = age / (oldest + 1e-3)[:, None]
    traffic = devices[..., 3:5] * torch.tensor([1.0, 0.5], device=devices.device)  # priority, and packets of 2 Mbit
    tokens = torch.cat([_place(offset, scale_m), ages, share, traffic, known], dim=-1)
    place, energy, left = uav[:, :2] / scale_m - 1.0, torch.log1p(uav[:, 2:3]), uav[:, 3:]
    globals_ = torch.cat([place, energy, left, torch.log1p(oldest), ages.sum(dim=1) / count], dim=-1)
    valid = known.squeeze(-1)
    return tokens, globals_, valid, offset


class SetTrunk(nn.Module):
    """Tokens (B, K, .) and globals (B, .) to hidden vectors of both; `extra` inputs join the encoded ones later.

    Pooling is the mean and `HEADS` softmax-weighted means of the tokens, one matrix product in all: a maximum costs as
    much as a layer on a CPU. Padded devices have weight 0. Layer normalisation, where asked for, comes before each
    activation but the first.
    """

    HEADS = 3

    def __init__(self, token_extra: int, global_extra: int, width: int, layer_norm: bool = False) -> None:
        super().__init__()
        self.width = width
        self.token = nn.Linear(TOKEN_FEATURES, width)
        self.globals = nn.Linear(GLOBAL_FEATURES, width)
        self.token_extra = nn.Linear(token_extra, width, bias=False) if token_extra else None
        self.global_extra = nn.Linear(global_extra, width, bias=False) if global_extra else None
        self.global_to_token = nn.Linear(width, width, bias=False)
        self.token_hidden = nn.Linear(width, width)
        self.score = nn.Linear(width, self.HEADS, bias=False)
        self.pool = nn.Linear((1 + self.HEADS) * width, width, bias=False)
        self.global_hidden = nn.Linear(width, width)
        self.token_out = nn.Linear(width, width)
        self.global_out = nn.Linear(width, width, bias=False)
        self.norms = nn.ModuleList(nn.LayerNorm(width) if layer_norm else nn.Identity() for _ in range(4))

    def encode(self, tokens: Tensor, globals_: Tensor) -> tuple[Tensor, Tensor]:
        """The first layer's observation part."""
        return self.token(tokens), self.globals(globals_)

    def forward(
        self, token: Tensor, globals_: Tensor, valid: Tensor, token_extra: Tensor | None, global_extra: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Hidden vectors of tokens (B, K, width) and globals (B, width)."""
        if self.global_extra is not None and global_extra is not None:
            globals_ = globals_ + self.global_extra(global_extra)
        if self.token_extra is not None and token_extra is not None:
            flat = token_extra.reshape(-1, token_extra.shape[-1])
            token = torch.addmm(token.reshape(-1, self.width), flat, self.token_extra.weight.T).view_as(token)
        hidden = functional.silu(token + self.global_to_token(globals_)[:, None])
        hidden = functional.silu(self.norms[0](self.token_hidden(hidden)))
        mask = valid[:, None]
        score = self.score(hidden).transpose(1, 2) + (mask - 1.0) * -NEVER
        weight = torch.cat([mask / mask.sum(dim=2, keepdim=True), score.softmax(dim=2)], dim=1)
        globals_ = functional.silu(self.norms[1](globals_ + self.pool((weight @ hidden).flatten(1))))
        globals_ = functional.silu(self.norms[2](self.global_hidden(globals_)))
        hidden = functional.silu(self.norms[3](self.token_out(hidden) + self.global_out(globals_)[:, None]))
        return hidden, globals_


class _SetQ(nn.Module):
    """One Q function with an output for each device and one for idling."""

    def __init__(self, continuous: int, width: int, scale_m: float, reach_m: float, layer_norm: bool) -> None:
        super().__init__()
        self.scale_m, self.reach_m = scale_m, reach_m
        self.trunk = SetTrunk(3, continuous + 1, width, layer_norm)
        self.device_out = nn.Linear(width, 1)
        self.idle_out = nn.Linear(width, 1)

    def all_choices(self, context: Context, valid: Tensor, offset: Tensor, continuous: Tensor) -> Tensor:
        token, globals_ = context
        # the link that will carry the packet is the one after the move, which a disc of reach_m limits
        length = continuous.square().sum(dim=1, keepdim=True).add(1e-8).sqrt()
        move = self.reach_m * continuous / length.clamp(min=1.0)
        after = _place(offset - move[:, None], self.scale_m)
        # a move takes time in proportion to its length, a cone that a smooth network cannot make from w alone
        hidden, whole = self.trunk(token, globals_, valid, after, torch.cat([continuous, length], dim=1))
        devices = torch.where(valid > 0, self.device_out(hidden).squeeze(-1), NEVER)
        return torch.cat([self.idle_out(whole), devices], dim=-1)


class SetCritic(Critic):
    """Two Q functions over the set of devices; all K + 1 choices cost one pass."""

    def __init__(
        self, continuous: int, *, width: int, scale_m: float, reach_m: float, layer_norm: bool = False
    ) -> None:
        super().__init__()
        self.scale_m = scale_m
        self.first = _SetQ(continuous, width, scale_m, reach_m, layer_norm)
        self.second = _SetQ(continuous, width, scale_m, reach_m, layer_norm)

    def encode(self, observation: Observation) -> Context:
        """First layers of both Q functions, validity and relative positions."""
        tokens, globals_, valid, offset = features(observation, self.scale_m)
        first = self.first.trunk.encode(tokens, globals_)
        return (*first, *self.second.trunk.encode(tokens, globals_), valid, offset)

    def all_choices(self, context: Context, continuous: Tensor) -> Tensor:
        """See `Critic`."""
        valid, offset = context[4:]
        return torch.stack(
            [
                self.first.all_choices(context[:2], valid, offset, continuous),
                self.second.all_choices(context[2:4], valid, offset, continuous),
            ]
        )

    def value(self, context: Context, continuous: Tensor, choice: Tensor) -> Tensor:
        """See `Critic`."""
        return (self.all_choices(context, continuous) * choice).sum(dim=-1)

    @torch.no_grad()
    def shift(self, amount: float) -> None:
        """See `Critic`."""
        for q in (self.first, self.second):
            q.device_out.bias.add_(amount)
            q.idle_out.bias.add_(amount)


class SetDenoiser(Denoiser):
    """Predicted noise: displacement and idle entries from the global vector, each device's entry from its token."""

    def __init__(self, continuous: int, *, width: int, scale_m: float) -> None:
        super().__init__()
        self.scale_m, self.continuous = scale_m, continuous
        self.embedding_size = 16
        self.trunk = SetTrunk(1, continuous + 1 + self.embedding_size, width)
        self.device_out = nn.Linear(width, 1)
        self.global_out = nn.Linear(width, continuous + 1)

    def encode(self, observation: Observation) -> Context:
        """First layer and validity."""
        tokens, globals_, valid, _ = features(observation, self.scale_m)
        return (*self.trunk.encode(tokens, globals_), valid)

    def steps(self, step: Tensor) -> Tensor:
        """Their embedding, (n, 16)."""
        return step_embedding(step, self.embedding_size)

    def predict(self, context: Context, vector: Tensor, step: Tensor) -> Tensor:
        """See `Denoiser`."""
        token, globals_, valid = context
        own, rest = vector[:, self.continuous + 1 :, None], vector[:, : self.continuous + 1]
        whole = torch.cat([rest, step.expand(rest.shape[0], -1)], dim=-1)
        hidden, whole = self.trunk(token, globals_, valid, own, whole)
        return torch.cat([self.global_out(whole), self.device_out(hidden).squeeze(-1)], dim=-1)

    def vector_size(self, context: Context) -> int:
        """C + K + 1 for this observation's K."""
        return self.continuous + 1 + context[2].shape[1]

    def possible(self, context: Context, vector: Tensor) -> Tensor:
        """See `Denoiser`."""
        first = self.continuous + 1
        return torch.cat([vector[:, :first], torch.where(context[2] > 0, vector[:, first:], NEVER)], dim=1)


class SetActor(Actor):
    """Gaussian over the displacement from the global vector, a logit a device from its token."""

    def __init__(self, continuous: int, *, width: int, scale_m: float) -> None:
        super().__init__()
        self.scale_m, self.continuous = scale_m, continuous
        self.trunk = SetTrunk(0, 0, width)
        self.device_out = nn.Linear(width, 1)
        self.global_out = nn.Linear(width, 2 * continuous + 1)

    def forward(self, observation: Observation) -> ActorOutput:
        """See `Actor`."""
        tokens, globals_, valid, _ = features(observation, self.scale_m)
        hidden, whole = self.trunk(*self.trunk.encode(tokens, globals_), valid, None, None)
        mean, log_std, idle = self.global_out(whole).split([self.continuous, self.continuous, 1], dim=-1)
        devices = torch.where(valid > 0, self.device_out(hidden).squeeze(-1), NEVER)
        return ActorOutput(mean, bounded_log_std(log_std), torch.cat([idle, devices], dim=-1))


class SetChoiceActor(ChoiceActor):
    """A logit, a mean and a log standard deviation from each device's token, those of idling from the global vector."""

    def __init__(self, continuous: int, *, width: int, scale_m: float) -> None:
        super().__init__()
        self.scale_m = scale_m
        self.trunk = SetTrunk(0, 0, width)
        self.device_out = nn.Linear(width, 1 + 2 * continuous)
        self.idle_out = nn.Linear(width, 1 + 2 * continuous)

    def forward(self, observation: Observation) -> ChoiceActorOutput:
        """See `ChoiceActor`."""
        tokens, globals_, valid, _ = features(observation, self.scale_m)
        hidden, whole = self.trunk(*self.trunk.encode(tokens, globals_), valid, None, None)
        raw = torch.cat([self.idle_out(whole)[:, None], self.device_out(hidden)], dim=1)
        mean, log_std, logits = choice_output(raw)
        devices = torch.where(valid > 0, logits[:, 1:], NEVER)
        return ChoiceActorOutput(mean, log_std, torch.cat([logits[:, :1], devices], dim=1))


class SetConditional(Conditional):
    """Outputs from the global vector beside the chosen device's, or the mean device's where there is no choice.

    A choice marks its device's token before the trunk, or the global vector when it is to idle.
    """

    def __init__(self, inputs: int, outputs: int, *, choice: bool, width: int, scale_m: float) -> None:
        super().__init__()
        self.scale_m = scale_m
        self.trunk = SetTrunk(int(choice), inputs + int(choice), width)
        self.out = nn.Linear(2 * width, outputs)

    def encode(self, observation: Observation) -> Context:
        """First layer and validity."""
        tokens, globals_, valid, _ = features(observation, self.scale_m)
        return (*self.trunk.encode(tokens, globals_), valid)

    def forward(self, context: Context, inputs: Tensor | None = None, choice: Tensor | None = None) -> Tensor:
        """See `Conditional`."""
        token, globals_, valid = context
        if choice is None:
            hidden, whole = self.trunk(token, globals_, valid, None, inputs)
            weight = valid / valid.sum(dim=1, keepdim=True)
        else:
            idle, weight = choice[:, :1], choice[:, 1:]
            extra = idle if inputs is None else torch.cat([inputs, idle], dim=1)
            hidden, whole = self.trunk(token, globals_, valid, weight[:, :, None], extra)
        own = (weight[:, None] @ hidden).squeeze(1)
        outputs: Tensor = self.out(torch.cat([whole, own], dim=1))
        return outputs
