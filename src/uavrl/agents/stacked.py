"""Several Diffusion-SAC learners of equal settings as one: each tensor of theirs is a slice of a stack of S.

An update of all of them takes about twice the operations of a single learner's, however many they are, each S times as
large: meant for a GPU, which a single learner leaves idle. The losses are `DiffusionSac`'s own under `torch.vmap`.
Random numbers stay each learner's own, so a learner learns what it would learn alone, up to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from uavrl.actions import HybridAction
from uavrl.agents.base import Batch, Metrics, adam
from uavrl.agents.diffusion_actor import ChainNoise
from uavrl.agents.diffusion_sac import ActorNoise, CriticNoise, DiffusionSac

_Tensors = dict[str, Any]  # tensors by name, or such a dictionary
_AVERAGES = (("target.", "critic."), ("actor.average.", "actor.denoiser."))


class StackedDiffusionSac:
    """S Diffusion-SAC agents that learn together.

    Args:
        agents: of equal spaces and settings, on one device, after equally many updates. Their weights and their
            optimisers' moments become views of the stack, so what is asked of one, saved or flown, is up to date. While
            the stack learns, none is to be updated or restored by itself.

    Raises:
        ValueError: none, or agents of different settings or after different numbers of updates.
    """

    def __init__(self, agents: Sequence[DiffusionSac]) -> None:
        if not agents or any((agent.spaces, agent.config) != (agents[0].spaces, agents[0].config) for agent in agents):
            raise ValueError("agents: a stack needs at least one, and all of equal spaces and settings")
        self.agents = list(agents)
        self.tensors = {name: _stacked([_named(agent)[name] for agent in agents]) for name in _named(agents[0])}
        self.optimisers = {name: self._optimiser(name) for name in agents[0].optimisers}
        self._steps: list[Tensor] = []  # of the agents' optimisers, which count for themselves

    def _optimiser(self, name: str) -> torch.optim.Optimizer:
        """That of the stack, going on from the agents' own."""
        each = [agent.optimisers[name] for agent in self.agents]
        parameters = [one.param_groups[0]["params"] for one in each]
        place = {id(tensor): key for key, tensor in _named(self.agents[0]).items()}
        mine = [self.tensors[place[id(parameter)]].requires_grad_() for parameter in parameters[0]]
        made = adam(mine, self.agents[0].config)
        for index, stack in enumerate(mine):
            states = [one.state.get(own[index], {}) for one, own in zip(each, parameters, strict=True)]
            if len({float(state.get("step", 0)) for state in states}) > 1:
                raise ValueError("agents: those of a stack need to stand after equally many updates")
            for key, value in states[0].items():
                made.state[stack][key] = torch.stack([state[key] for state in states]) if value.dim() else value.clone()
        return made

    def _link(self) -> None:
        """Let the agents' optimisers see the moments of the stack's, which are there from its first step on."""
        for name, optimiser in self.optimisers.items():
            for index, stack in enumerate(optimiser.param_groups[0]["params"]):
                for row, agent in enumerate(self.agents):
                    own = agent.optimisers[name]
                    state = {
                        key: value[row] if value.dim() else value.clone()
                        for key, value in optimiser.state[stack].items()
                    }
                    own.state[own.param_groups[0]["params"][index]] = state
                    self._steps.append(state["step"])

    def update(self, batches: Batch, generators: Sequence[torch.Generator]) -> list[Metrics]:
        """`DiffusionSac.update` of each agent, with its rows of `batches` (S, B, ...) and its own generator.

        The learning rate and `progress` are those of the first agent.
        """
        first, config = self.agents[0], self.agents[0].config
        drawn = [first.draw(batches.reward.shape[1], generator) for generator in generators]
        of_critic, of_actor = _joined([one for one, _ in drawn]), _joined([one for _, one in drawn])
        batch = _entries(batches)
        losses, metrics = self._losses(_critic_loss, "critic.", batch, of_critic)
        metrics["critic_gradient"] = self._minimise(losses, "critic")
        losses, more = self._losses(_actor_loss, "actor.denoiser.", batch, of_actor)
        metrics |= more
        metrics["actor_gradient"] = self._minimise(losses, "actor")
        for (target, source), rate in zip(_AVERAGES, (config.polyak, 1.0 - config.actor_average), strict=True):
            self._move(target, source, rate)
        if self._steps:
            torch._foreach_add_(self._steps, 1)
        else:
            self._link()
        return [{name: values[row] for name, values in metrics.items()} for row in range(len(self.agents))]

    def _losses(
        self, loss: Callable[..., Any], trained: str, batch: _Tensors, noise: _Tensors
    ) -> tuple[Tensor, Metrics]:
        """A loss (S,) and its metrics, with gradients for the weights whose names begin with `trained`."""
        weights = {
            f"networks.{name}": tensor if name.startswith(trained) else tensor.detach()
            for name, tensor in self.tensors.items()
        }
        module = _Loss(self.agents[0], loss)

        def one(weights: _Tensors, batch: _Tensors, noise: _Tensors) -> tuple[Tensor, Metrics]:
            found: tuple[Tensor, Metrics] = torch.func.functional_call(module, weights, (batch, noise))
            return found

        losses: tuple[Tensor, Metrics] = torch.vmap(one)(weights, batch, noise)
        return losses

    def _minimise(self, losses: Tensor, name: str) -> Tensor:
        """One step of each agent, its gradient clipped by itself; the norms (S,)."""
        optimiser = self.optimisers[name]
        group, theirs = optimiser.param_groups[0], self.agents[0].optimisers[name].param_groups[0]
        group["lr"] = theirs["lr"]
        gradients = torch.autograd.grad(losses.sum(), group["params"])
        norms: Tensor = torch.stack([gradient.flatten(1).norm(dim=1) for gradient in gradients]).norm(dim=0)
        clip = self.agents[0].config.gradient_clip
        if clip is not None:
            share = (clip / (norms + 1e-6)).clamp(max=1.0)  # as torch.nn.utils.clip_grad_norm_
            gradients = tuple(gradient * share.view(-1, *[1] * (gradient.dim() - 1)) for gradient in gradients)
        for parameter, gradient in zip(group["params"], gradients, strict=True):
            parameter.grad = gradient.contiguous()  # as in `minimise`
        optimiser.step()
        return norms

    @torch.no_grad()
    def _move(self, target: str, source: str, rate: float) -> None:
        """As `move_towards`."""
        buffers = dict(self.agents[0].networks.named_buffers())
        mine, theirs = [], []
        for name, tensor in self.tensors.items():
            if not name.startswith(target):
                continue
            other = self.tensors[source + name.removeprefix(target)]
            if name in buffers:
                tensor.copy_(other)
            else:
                mine.append(tensor)
                theirs.append(other)
        torch._foreach_lerp_(mine, theirs, rate)


class _Loss(nn.Module):
    """A loss of an agent, as `torch.func.functional_call` wants it."""

    def __init__(self, agent: DiffusionSac, loss: Callable[..., tuple[Tensor, Metrics]]) -> None:
        super().__init__()
        self.networks, self._agent, self._loss = agent.networks, agent, loss

    def forward(self, batch: _Tensors, noise: _Tensors) -> tuple[Tensor, Metrics]:
        return self._loss(self._agent, Batch(**batch | {"action": HybridAction(**batch["action"])}), noise)


def _critic_loss(agent: DiffusionSac, batch: Batch, noise: _Tensors) -> tuple[Tensor, Metrics]:
    return agent.critic_loss(batch, *CriticNoise(**_separate(noise)))


def _actor_loss(agent: DiffusionSac, batch: Batch, noise: _Tensors) -> tuple[Tensor, Metrics]:
    return agent.actor_loss(batch, *ActorNoise(**_separate(noise)))


def _joined(drawn: Sequence[CriticNoise] | Sequence[ActorNoise]) -> _Tensors:
    """Noise of S agents, stacked, without what none of them has: vmap takes tensors alone."""
    found: _Tensors = {}
    for name, value in drawn[0]._asdict().items():
        if isinstance(value, ChainNoise):
            found[name] = {
                part: torch.stack([getattr(getattr(one, name), part) for one in drawn]) for part in value._fields
            }
        elif value is not None:
            found[name] = torch.stack([getattr(one, name) for one in drawn])
    return found


def _separate(noise: _Tensors) -> _Tensors:
    return {name: ChainNoise(**value) if isinstance(value, dict) else value for name, value in noise.items()}


def _entries(batch: Batch) -> _Tensors:
    return vars(batch) | {"action": batch.action._asdict()}


def _named(agent: DiffusionSac) -> dict[str, Tensor]:
    """Parameters and buffers."""
    return dict(agent.networks.named_parameters()) | dict(agent.networks.named_buffers())


def _stacked(tensors: Sequence[Tensor]) -> Tensor:
    """(S, ...), of which `tensors` become views."""
    stack = torch.stack([tensor.detach() for tensor in tensors])
    for row, tensor in enumerate(tensors):
        tensor.data = stack[row]
    return stack
