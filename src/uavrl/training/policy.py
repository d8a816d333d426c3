"""A trained agent as a policy that `evaluate` can fly."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from uavrl.agents.base import Agent
from uavrl.agents.diffusion_actor import DiffusionActor, Solver, SolverName
from uavrl.agents.registry import AnyConfig, make_agent
from uavrl.errors import CheckpointError, ConfigError
from uavrl.networks import Spaces
from uavrl.scenario import Scenario, describe_validation, parse_scenario
from uavrl.simulation.state import FlightAction
from uavrl.training.batches import OBSERVATION_OF, to_tensors
from uavrl.training.checkpoint import (
    Checkpoint,
    Tensors,
    checkpoint_in,
    load_checkpoint,
    restore_networks,
    save_checkpoint,
)


class Decision(BaseModel):
    """How a trained policy decides, where that is not to be as it was trained."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    candidates: int | None = Field(None, ge=1, description="actions drawn at a decision, for an agent that re-ranks")
    null_candidate: bool | None = Field(
        None,
        description="whether holding the place, serving nobody, is among them, or what idling is without a critic",
    )
    greedy_choice: bool | None = Field(
        None,
        description="whether the critic says whom to serve, or the actor itself: with one candidate no critic is asked",
    )
    choice_prior: float | None = Field(
        None,
        ge=0,
        allow_inf_nan=False,
        description="weight of the actor's own opinion where the critic says whom to serve",
    )
    shortest_move: float | None = Field(
        None,
        ge=0,
        lt=1,
        allow_inf_nan=False,
        description="moves shorter than this share of the longest one are held",
    )
    solver: SolverName | None = Field(None, description="ddim without noise, or dpm: DPM-Solver++(2M)")
    steps: int | None = Field(None, ge=1, description="of the solver, at most M; by default M")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.steps is not None and self.solver is None:
            raise ValueError("steps needs a solver: ddim or dpm")
        if self.choice_prior and self.greedy_choice is False:
            raise ValueError("choice_prior counts beside the critic's choice, which greedy_choice=false leaves out")
        return self

    def apply(self, agent: Agent) -> None:
        """Let `agent` decide so.

        Raises:
            ConfigError: the agent has no such part, or a chain of fewer steps.
        """
        name = agent.config.name  # type: ignore[attr-defined]  # every agent's own config names it
        able = dict.fromkeys(("null_candidate", "greedy_choice", "choice_prior"), "Diffusion-SAC")
        able["candidates"] = "agents that re-rank"
        for setting in (*able, "shortest_move"):  # which every agent has
            value = getattr(self, setting)
            if value is None:
                continue
            if not hasattr(agent.config, setting):
                raise ConfigError(f"{setting} = {value}, allowed for {able[setting]}; not for {name}")
            try:
                agent.config = type(agent.config).model_validate(agent.config.model_dump() | {setting: value})
            except ValidationError as error:
                raise ConfigError(describe_validation(error, "setting")) from None
        if self.solver is not None:
            actor = getattr(agent, "actor", None)
            if not isinstance(actor, DiffusionActor):
                raise ConfigError(f"solver = {self.solver!r}, allowed for agents with a chain; {name} has none")
            most = actor.config.steps
            if self.steps is not None and self.steps > most:
                raise ConfigError(f"steps = {self.steps}, allowed: 1 to {most}, those of the chain as it was trained")
            actor.use(Solver(self.solver, self.steps or most))


AS_TRAINED = Decision()


class AgentPolicy:
    """Maps observations to displacements in metres and devices.

    Args:
        name: what it is filed under.
        agent: what decides.
        scenario: where it learned; its longest move is the unit of the agent's displacements wherever it is flown.
        decision: how it decides.
    """

    def __init__(self, name: str, agent: Agent, scenario: Scenario, decision: Decision = AS_TRAINED) -> None:
        self.name = name
        self.agent = agent
        self.decision = decision
        self.reach_m = scenario.airframe.max_displacement_m
        self.needs: Literal["paper", "devices", "state"] = OBSERVATION_OF[agent.config.network.kind]

    def reset(self, count: int) -> None:
        """Nothing is remembered between steps."""

    def act(self, observation: Any, *, generator: np.random.Generator, deterministic: bool = False) -> FlightAction:
        """One action a flight; its torch generator is seeded from `generator`.

        Raises:
            ConfigError: `deterministic`, and candidates were asked for, of which there is only one then.
        """
        if deterministic and self.decision.candidates is not None:
            raise ConfigError(f"policy '{self.name}' has candidates to choose from, allowed: without --deterministic")
        device = next(self.agent.networks.parameters()).device
        draws = torch.Generator(device).manual_seed(int(generator.integers(2**62)))
        seen = to_tensors(observation, device)
        action = self.agent.to_fly(self.agent.act(seen, generator=draws, deterministic=deterministic))
        return FlightAction(action.continuous.double().cpu().numpy() * self.reach_m, action.choice.cpu().numpy())


def load_agent(checkpoint: Checkpoint, path: Path) -> Agent:
    """The agent of a checkpoint, weights only.

    Raises:
        CheckpointError: its configuration or weights are not of this version's agents.
    """
    try:
        config = TypeAdapter[Any](AnyConfig).validate_python(checkpoint.document["config"])
        spaces = Spaces.model_validate(checkpoint.document["spaces"])
    except (KeyError, ValidationError):
        raise CheckpointError(f"checkpoint '{path}' holds no agent of this version of uavrl") from None
    agent = make_agent(spaces, config)
    restore_networks(agent, _with_learning_only(agent, checkpoint.tensors["networks"]))
    return agent


def _with_learning_only(agent: Agent, networks: Tensors) -> Tensors:
    """Weights of all networks of an agent: those that `ship` left out are those of the network in their place."""
    filled = dict(networks)
    for left_out, instead in agent.learning_only.items():
        if not any(name.startswith(left_out) for name in networks):
            filled |= {
                left_out + name.removeprefix(instead): value
                for name, value in networks.items()
                if name.startswith(instead)
            }
    return filled


def ship(run: Path, out: Path) -> None:
    """Write the run's last checkpoint to `out` without optimisers, generators and networks that no decision asks.

    It decides as the run does and is a checkpoint like any other, but no training goes on from it.

    Raises:
        CheckpointError: `run` holds no checkpoint.
    """
    place = checkpoint_in(run)
    checkpoint = load_checkpoint(place)
    left_out = tuple(load_agent(checkpoint, place).learning_only)
    networks = {name: value for name, value in checkpoint.tensors["networks"].items() if not name.startswith(left_out)}
    kept = ("agent", "config", "spaces", "scenario", "train", "data", "step")
    document = {key: checkpoint.document[key] for key in kept if key in checkpoint.document}
    save_checkpoint(out, {"kind": "policy", **document}, {"networks": networks})


def load_policy(path: Path, scenario: Scenario, decision: Decision = AS_TRAINED) -> AgentPolicy:
    """The policy of a run's directory or of a checkpoint's, for `scenario`.

    Raises:
        CheckpointError: missing or damaged; or a perceptron trained with another number of devices.
        ConfigError: a decision that the agent cannot make.
    """
    path = Path(path)
    place = checkpoint_in(path)
    checkpoint = load_checkpoint(place)
    agent = load_agent(checkpoint, place)
    devices, trained = scenario.traffic.devices, agent.spaces.choices - 1
    if agent.spaces.observation is not None and devices != trained:
        raise CheckpointError(
            f"checkpoint '{path}' is a perceptron for devices = {trained}, the scenario has {devices}"
        )
    decision.apply(agent)
    name = str(checkpoint.document.get("agent", place.name))
    return AgentPolicy(name, agent, parse_scenario(checkpoint.document["scenario"]), decision)


def trained_scenario(path: Path) -> Scenario:
    """The scenario that a checkpoint was trained in."""
    return parse_scenario(load_checkpoint(checkpoint_in(Path(path))).document["scenario"])
