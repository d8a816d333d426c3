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


def _distance(offset: Tensor) -> Tensor:
    """Length of vectors (..., 2), (..., 1), whose slope at zero is zero."""
    return offset.square().sum(dim=-1, keepdim=True).add(1e-8).sqrt()


def features(observation: Observation, scale_m: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Tokens (B, K, 9), globals (B, 7), validity (B, K) bool and relative positions in metres (B, K, 2).

    Ages enter as log(1 + age), as they are, and as a share of the oldest: absolute for the value, relative for whom to
    serve. They are scaled by `REFERENCE_DEVICES` / K first: of K devices served in turn each waits K services, so a
    round looks the same whatever K, and a policy flies with more or fewer devices than it was trained with.
    """
    if not isinstance(observation, dict):
        raise TypeError('a set network takes observation = "devices"')
    # columns stay columns, and sums keep their axis: on board an operation costs more than its numbers
    offset, age, traffic, known = observation["devices"].split([2, 1, 2, 1], dim=-1)
    place, energy, left = observation["uav"].split([2, 1, 1], dim=-1)
    count = known.sum(dim=1, keepdim=True)
    age = age * (known * (REFERENCE_DEVICES / count))
    plain_age = age.clamp(max=20.0) / 5.0  # returns are sums of ages: linear where flights mostly are
    ages = torch.cat([torch.log1p(age), plain_age], dim=-1)
    oldest = age.amax(dim=1, keepdim=True)
    scaled = offset / scale_m
    traffic = traffic * torch.tensor([1.0, 0.5], device=traffic.device)  # priority, and packets of 2 Mbit
    tokens = torch.cat([scaled, _distance(scaled), ages, age / (oldest + 1e-3), traffic, known], dim=-1)
    of_ages = torch.cat([torch.log1p(oldest), ages.sum(dim=1, keepdim=True) / count], dim=-1).squeeze(1)
    globals_ = torch.cat([place / scale_m - 1.0, torch.log1p(energy), left, of_ages], dim=-1)
    return tokens, globals_, known.squeeze(-1) > 0, offset


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

    def join_tokens(self, token: Tensor, extra: Tensor) -> Tensor:
        """Encoded tokens (B, K, width) with their extra inputs (B, K, .)."""
        assert self.token_extra is not None  # noqa: S101  # for the type checker: who has extra inputs asked for them
        flat = extra.reshape(-1, extra.shape[-1])
        return torch.addmm(token.reshape(-1, self.width), flat, self.token_extra.weight.T).view_as(token)

    def join_globals(self, globals_: Tensor, extra: Tensor, part: slice = slice(None)) -> Tensor:
        """Encoded globals (B, width) with their extra inputs (B, .), or a `part` of these."""
        assert self.global_extra is not None  # noqa: S101  # as above
        return torch.addmm(globals_, extra, self.global_extra.weight[:, part].T)

    def forward(self, token: Tensor, globals_: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Hidden vectors of tokens (B, K, width) and globals (B, width), from both as encoded and joined."""
        hidden = functional.silu(token + self.global_to_token(globals_)[:, None])
        hidden = functional.silu(self.norms[0](self.token_hidden(hidden)))
        # equal scores make the mean
        score = functional.linear(hidden, functional.pad(self.score.weight, (0, 0, 1, 0)))
        weight = torch.where(valid[..., None], score, NEVER).softmax(dim=1)
        globals_ = functional.silu(self.norms[1](globals_ + self.pool((weight.transpose(1, 2) @ hidden).flatten(1))))
        globals_ = functional.silu(self.norms[2](self.global_hidden(globals_)))
        bias = functional.linear(globals_, self.global_out.weight, self.token_out.bias)
        hidden = functional.silu(self.norms[3](functional.linear(hidden, self.token_out.weight) + bias[:, None]))
        return hidden, globals_


def _column(layer: nn.Linear, hidden: Tensor) -> Tensor:
    """The one output of `layer` for hidden vectors (B, K, width), (B, K)."""
    return hidden @ layer.weight[0] + layer.bias


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
        length = _distance(continuous)
        move = continuous / length.clamp(min=1.0)
        after = (offset - self.reach_m * move[:, None]) / self.scale_m
        token = self.trunk.join_tokens(token, torch.cat([after, _distance(after)], dim=-1))
        # a move takes time in proportion to its length, a cone that a smooth network cannot make from w alone
        globals_ = self.trunk.join_globals(globals_, torch.cat([continuous, length], dim=1))
        hidden, whole = self.trunk(token, globals_, valid)
        devices = torch.where(valid, _column(self.device_out, hidden), NEVER)
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
        """The first layer's step part, (n, width)."""
        none = torch.zeros((), device=step.device)
        return self.trunk.join_globals(
            none, step_embedding(step, self.embedding_size), slice(self.continuous + 1, None)
        )

    def predict(self, context: Context, vector: Tensor | None, step: Tensor) -> Tensor:
        """See `Denoiser`."""
        token, globals_, valid = context
        globals_ = globals_ + step
        if vector is not None:
            rest = slice(self.continuous + 1)
            globals_ = self.trunk.join_globals(globals_, vector[:, rest], rest)
            token = self.trunk.join_tokens(token, vector[:, self.continuous + 1 :, None])
        hidden, whole = self.trunk(token, globals_, valid)
        return torch.cat([self.global_out(whole), _column(self.device_out, hidden)], dim=-1)

    def vector_size(self, context: Context) -> int:
        """C + K + 1 for this observation's K."""
        return self.continuous + 1 + context[2].shape[1]

    def possible(self, context: Context, vector: Tensor) -> Tensor:
        """See `Denoiser`."""
        first = self.continuous + 1
        return torch.cat([vector[:, :first], torch.where(context[2], vector[:, first:], NEVER)], dim=1)


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
        hidden, whole = self.trunk(*self.trunk.encode(tokens, globals_), valid)
        mean, log_std, idle = self.global_out(whole).split([self.continuous, self.continuous, 1], dim=-1)
        devices = torch.where(valid, _column(self.device_out, hidden), NEVER)
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
        hidden, whole = self.trunk(*self.trunk.encode(tokens, globals_), valid)
        raw = torch.cat([self.idle_out(whole)[:, None], self.device_out(hidden)], dim=1)
        mean, log_std, logits = choice_output(raw)
        devices = torch.where(valid, logits[:, 1:], NEVER)
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
            weight = valid / valid.sum(dim=1, keepdim=True)
            extra = inputs
        else:
            idle, weight = choice[:, :1], choice[:, 1:]
            token = self.trunk.join_tokens(token, weight[:, :, None])
            extra = idle if inputs is None else torch.cat([inputs, idle], dim=1)
        if extra is not None:
            globals_ = self.trunk.join_globals(globals_, extra)
        hidden, whole = self.trunk(token, globals_, valid)
        own = (weight[:, None] @ hidden).squeeze(1)
        outputs: Tensor = self.out(torch.cat([whole, own], dim=1))
        return outputs
