"""What every agent owes, whatever it learns: update, act, save, resume."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.agents.problems import (
    DEVICES,
    KINDS,
    NAMES,
    Kind,
    agent,
    batch,
    copies,
    diffusion_sac,
    disturb,
    equal,
    network,
    observation,
    spaces,
)
from uavrl.agents.base import Agent
from uavrl.agents.diffusion_sac import _prior_unit
from uavrl.agents.registry import PRESETS, make_agent, preset
from uavrl.errors import CheckpointError, ConfigError
from uavrl.networks import Observation, Spaces, repeat
from uavrl.training.checkpoint import agent_tensors, load_checkpoint, restore_agent, save_checkpoint

EVERY = [(name, kind) for name in NAMES for kind in KINDS]
ALL = pytest.mark.parametrize(("name", "kind"), EVERY)


@ALL
def test_weight_decay_reaches_every_network_and_no_temperature(name: str, kind: Kind) -> None:
    for part, optimiser in agent(name, kind, weight_decay=0.3).optimisers.items():
        expected = 0.0 if part == "temperature" else 0.3
        assert [group["weight_decay"] for group in optimiser.param_groups] == [expected], part


def test_a_single_choice_has_no_spread_to_scale_by() -> None:
    alone = Spaces(observation=3, continuous=2, choices=1)
    with pytest.raises(ConfigError, match="q_scale = 'spread', allowed with a single choice: 'absolute' or 'none'"):
        make_agent(alone, preset("diffusion_sac", "default").model_copy(update={"network": network("mlp")}))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def teach(made: Agent, kind: Kind, first: int, count: int, noise: torch.Generator) -> list[dict[str, float]]:
    """`count` updates on the batches numbered from `first`."""
    return [
        {name: float(value) for name, value in made.update(batch(kind, 8, seed), noise).items()}
        for seed in range(first, first + count)
    ]


def rows_of(seen: Observation, rows: slice) -> Observation:
    return {key: value[rows] for key, value in seen.items()} if isinstance(seen, dict) else seen[rows]


@ALL
def test_update_reports_finite_numbers_and_moves_what_it_trains(name: str, kind: Kind) -> None:
    made = agent(name, kind)
    before = {key: copies(network) for key, network in made.networks.items()}
    for metrics in teach(made, kind, 0, 2, generator()):
        assert metrics
        assert all(value == value and abs(value) < 1e6 for value in metrics.values()), metrics
        assert metrics["actor_gradient"] > 0
    for key, part in made.networks.items():
        taught = name == "one_step" and key in ("teacher", "critic")
        assert equal(before[key], copies(part)) == taught, key


@ALL
def test_actions_are_legal_and_come_from_the_generator_alone(name: str, kind: Kind) -> None:
    made, seen = agent(name, kind), observation(kind, 64)
    torch.manual_seed(0)
    first = made.act(seen, generator=generator(1))
    torch.manual_seed(1)
    again, other = made.act(seen, generator=generator(1)), made.act(seen, generator=generator(2))
    assert first.continuous.shape == (64, 2)
    assert first.continuous.abs().max() <= 1.0
    assert first.choice.shape == (64,)
    assert first.choice.dtype == torch.int64
    found = set(first.choice.tolist())
    assert found <= set(range(DEVICES + 1))
    assert len(found) > 1  # untrained: no choice is all that occurs
    assert torch.equal(first.continuous, again.continuous)
    assert torch.equal(first.choice, again.choice)
    assert not torch.equal(first.continuous, other.continuous)
    if name not in ("bcq", "one_step"):  # their choice is a critic's, and displacements of little difference
        assert not torch.equal(first.choice, other.choice)
    assert not first.continuous.requires_grad


@ALL
def test_deterministic_actions_depend_on_their_own_row_alone(name: str, kind: Kind) -> None:
    made, seen = agent(name, kind), observation(kind, 12)
    whole = made.act(seen, generator=generator(1), deterministic=True)
    again = made.act(seen, generator=generator(2), deterministic=True)
    assert torch.equal(whole.continuous, again.continuous)
    assert torch.equal(whole.choice, again.choice)
    for rows in (slice(0, 1), slice(5, 9)):
        part = made.act(rows_of(seen, rows), generator=generator(3), deterministic=True)
        torch.testing.assert_close(part.continuous, whole.continuous[rows], rtol=1e-4, atol=1e-5)
        assert torch.equal(part.choice, whole.choice[rows])
    assert whole.continuous.std() > 1e-3  # and not on nothing


@pytest.mark.parametrize("name", NAMES)
def test_a_set_network_acts_for_another_number_of_devices(name: str) -> None:
    made = agent(name, "devices")
    action = made.act(observation("devices", 50, devices=9), generator=generator())
    assert set(action.choice.tolist()) - set(range(DEVICES + 1))
    assert action.choice.max() <= 9


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_a_padded_device_is_never_chosen(name: str, deterministic: bool) -> None:
    seen = observation("devices", 200)
    assert isinstance(seen, dict)
    seen["devices"][:, 1, 5] = 0.0
    settings: list[dict[str, Any]] = [
        {"candidates": 1, "greedy_choice": False},
        {"candidates": 3, "greedy_choice": False},
        {"candidates": 2},
        {"null_candidate": True},
        {"choice_prior": 2.0, "null_candidate": True},
    ]
    for changes in settings if name == "diffusion_sac" else [{}]:
        made = agent(name, "devices", **changes)
        action = made.act(seen, generator=generator(), deterministic=deterministic)
        assert 2 not in action.choice.tolist()


@ALL
def test_a_saved_agent_acts_and_learns_as_before(name: str, kind: Kind, tmp_path: Path) -> None:
    """2 N updates equal N, a checkpoint, and N more, bit for bit."""
    straight, noise = agent(name, kind), generator(3)
    teach(straight, kind, 0, 6, noise)
    made, noise = agent(name, kind), generator(3)
    teach(made, kind, 0, 3, noise)
    save_checkpoint(tmp_path / "c", {}, agent_tensors(made) | {"loop": {"generator": noise.get_state()}})
    seen = observation(kind, 10)
    expected = made.act(seen, generator=generator(4))

    tensors = load_checkpoint(tmp_path / "c").tensors
    loaded, noise = agent(name, kind, seed=99), generator(99)
    assert not equal(copies(loaded.networks), copies(made.networks))
    restore_agent(loaded, tensors)
    noise.set_state(tensors["loop"]["generator"])
    assert equal(copies(loaded.networks), copies(made.networks))
    found = loaded.act(seen, generator=generator(4))
    assert torch.equal(found.continuous, expected.continuous)
    assert torch.equal(found.choice, expected.choice)
    teach(loaded, kind, 3, 3, noise)
    assert equal(copies(loaded.networks), copies(straight.networks))
    for key, tensor in agent_tensors(straight)["optimisers"].items():
        assert torch.equal(tensor, agent_tensors(loaded)["optimisers"][key]), key


RESUME = """
import sys
from pathlib import Path
import torch
from tests.agents.problems import agent
from tests.agents.test_conformance import generator, teach
from uavrl.training.checkpoint import agent_tensors, load_checkpoint, restore_agent, save_checkpoint
folder = Path(sys.argv[1])
torch.set_num_threads(int(sys.argv[2]))
for name in sys.argv[3:]:
    tensors = load_checkpoint(folder / f"{name} before").tensors
    made, noise = agent(name, "devices", seed=5), generator(5)
    restore_agent(made, tensors)
    noise.set_state(tensors["loop"]["generator"])
    teach(made, "devices", 3, 3, noise)
    save_checkpoint(folder / f"{name} after", {}, agent_tensors(made))
"""


def test_a_new_process_goes_on_bit_for_bit(tmp_path: Path) -> None:
    """Every agent, in one new process, which takes long to start."""
    expected = {}
    for name in NAMES:
        straight, noise = agent(name, "devices"), generator(3)
        teach(straight, "devices", 0, 3, noise)
        tensors = agent_tensors(straight) | {"loop": {"generator": noise.get_state()}}
        save_checkpoint(tmp_path / f"{name} before", {}, tensors)
        teach(straight, "devices", 3, 3, noise)
        expected[name] = copies(straight.networks)
    command = [sys.executable, "-c", RESUME, str(tmp_path), str(torch.get_num_threads()), *NAMES]
    subprocess.run(command, check=True, cwd=Path(__file__).parents[2])
    for name, networks in expected.items():
        assert equal(load_checkpoint(tmp_path / f"{name} after").tensors["networks"], networks), name


@ALL
def test_learning_does_not_depend_on_the_number_of_threads(name: str, kind: Kind) -> None:
    """But for the order of sums, with batches and layers large enough to be split between threads."""
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            made, noise = agent(name, kind, network={"width": 64}), generator(3)
            for seed in range(2):
                made.update(batch(kind, 600, seed), noise)
            found.append(made.act(observation(kind, 300), generator=generator(4)))
    finally:
        torch.set_num_threads(threads)
    torch.testing.assert_close(found[0].continuous, found[1].continuous, rtol=1e-3, atol=1e-3)
    assert (found[0].choice == found[1].choice).float().mean() > 0.99


@ALL
def test_weights_of_another_shape_are_refused_in_one_line(name: str, kind: Kind) -> None:
    wide = agent(name, kind, network={"width": 16})
    with pytest.raises(CheckpointError, match="does not fit") as error:
        restore_agent(agent(name, kind), agent_tensors(wide))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", KINDS)
def test_of_several_candidates_the_best_by_the_smaller_q_is_taken(kind: Kind) -> None:
    made = diffusion_sac(kind, candidates=5, greedy_choice=False)
    disturb(made.critic, 1)
    seen = observation(kind, 30)

    def worth(count: int) -> torch.Tensor:
        made.config = made.config.model_copy(update={"candidates": count})
        action = made.act(seen, generator=generator(1))
        with torch.no_grad():
            table = made.critic.all_choices(made.critic.encode(seen), action.continuous).amin(dim=0)
        return table.gather(1, action.choice[:, None]).squeeze(1)

    few, many = worth(1), worth(64)
    assert (many > few).float().mean() > 0.8
    with (
        torch.no_grad()
    ):  # with many candidates, no worse than the best choice at a fixed displacement, but for few rows
        best = made.critic.all_choices(made.critic.encode(seen), torch.zeros(30, 2)).amin(dim=0).amax(dim=1)
    assert (many > best - 0.1).float().mean() > 0.8


@pytest.mark.parametrize("kind", KINDS)
def test_a_greedy_choice_is_the_critics_best_for_the_actors_displacement(kind: Kind) -> None:
    seen = observation(kind, 40)
    for deterministic in (False, True):
        made = {greedy: diffusion_sac(kind, greedy_choice=greedy) for greedy in (False, True)}
        own, greedy = (
            made[key].act(seen, generator=generator(1), deterministic=deterministic) for key in (False, True)
        )
        assert torch.equal(own.continuous, greedy.continuous)
        with torch.no_grad():
            critic = made[True].critic
            best = critic.all_choices(critic.encode(seen), greedy.continuous).amin(dim=0).argmax(dim=1)
        assert torch.equal(greedy.choice, best)
        assert not torch.equal(own.choice, best)


@pytest.mark.parametrize("settings", [{}, {"greedy_choice": False, "candidates": 3}, {"candidates": 3}])
@pytest.mark.parametrize("kind", KINDS)
def test_the_null_action_is_taken_where_the_critic_finds_it_better(kind: Kind, settings: dict[str, Any]) -> None:
    seen = observation(kind, 200)
    without = diffusion_sac(kind, **settings)
    made = diffusion_sac(kind, **settings, null_candidate=True)
    for one in (without, made):
        disturb(one.critic, 3)
    acted, action = (one.act(seen, generator=generator(1)) for one in (without, made))
    with torch.no_grad():
        critic = made.critic
        context = critic.encode(seen)
        own = critic.all_choices(context, acted.continuous).amin(dim=0).gather(1, acted.choice[:, None])[:, 0]
        null = critic.all_choices(context, torch.zeros(200, 2)).amin(dim=0)[:, 0]
    holds = null > own
    assert 0 < holds.sum() < 200
    assert (action.choice[holds] == 0).all()
    assert (action.continuous[holds] == 0).all()
    assert torch.equal(action.choice[~holds], acted.choice[~holds])
    flies = ~holds & (acted.choice > 0)
    assert torch.equal(action.continuous[flies], acted.continuous[flies])
    assert (action.continuous[action.choice == 0] == 0).all()  # who idles, whyever, holds its place


@pytest.mark.parametrize("candidates", [1, 3])
@pytest.mark.parametrize("null", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_the_chains_opinion_counts_beside_the_critics_in_units_of_its_deviation(
    kind: Kind, null: bool, candidates: int
) -> None:
    made = diffusion_sac(kind, candidates=candidates, null_candidate=null, choice_prior=0.7)
    disturb(made.actor.average, 8)
    seen, rows = observation(kind, 60), 60
    context = repeat(made.actor.average.encode(seen), candidates)
    vector = made.actor.answer(context, made.actor.draw(context, generator(1)))
    w, z = vector[:, :2].clamp(-1.0, 1.0).view(rows, candidates, 2), vector[:, 2:].view(rows, candidates, -1)
    if null:
        w, z = torch.cat([w, torch.zeros(rows, 1, 2)], dim=1), torch.cat([z, z.mean(dim=1, keepdim=True)], dim=1)
    with torch.no_grad():
        encoded = made.critic.encode(seen)
        q = torch.stack([made.critic.all_choices(encoded, w[:, k]).amin(dim=0) for k in range(w.shape[1])], dim=1)
    score = q + 0.7 * q.flatten(1).std(dim=1, correction=0)[:, None, None] * z
    if null:
        score[:, candidates, 1:] = -torch.inf
    best = score.flatten(1).argmax(dim=1)
    number, choice = best // z.shape[2], best % z.shape[2]
    wanted = w[torch.arange(rows), number]
    if null:
        wanted = torch.where((choice > 0)[:, None], wanted, 0.0)
    action = made.act(seen, generator=generator(1))
    assert torch.equal(action.choice, choice)
    torch.testing.assert_close(action.continuous, wanted)
    made.config = made.config.model_copy(update={"choice_prior": 0.0})
    assert not torch.equal(made.act(seen, generator=generator(1)).choice, choice)


@pytest.mark.parametrize("kind", KINDS)
def test_a_chain_that_is_believed_above_all_chooses_alone_but_for_ties(kind: Kind) -> None:
    """Entries of a chain are clipped to 1, so several may be the largest."""
    made, seen = diffusion_sac(kind, choice_prior=1e6), observation(kind, 60)
    z = made.actor.answer(made.actor.average.encode(seen), None)[:, 2:]
    choice = made.act(seen, generator=generator(1), deterministic=True).choice
    assert torch.equal(z.gather(1, choice[:, None])[:, 0], z.amax(dim=1))
    assert len(choice.unique()) > 1


@ALL
def test_what_is_flown_of_a_move_shorter_than_the_shortest_is_nothing_and_of_a_longer_one_all(
    name: str, kind: Kind
) -> None:
    made = agent(name, kind)
    decided = made.act(observation(kind, 200), generator=generator())
    assert torch.equal(made.to_fly(decided).continuous, decided.continuous)
    length = decided.continuous.norm(dim=1)
    middle = float(length.median())
    made.config = made.config.model_copy(update={"shortest_move": middle})
    flown = made.to_fly(decided)
    wanted = torch.where((length >= middle)[:, None], decided.continuous, 0.0)
    assert torch.equal(flown.continuous, wanted)
    assert torch.equal(flown.choice, decided.choice)


def test_a_padded_device_does_not_widen_the_deviation() -> None:
    q = torch.tensor([[[-3.0, -1.0, -2.0, -1e4], [-4.0, 0.0, -2.0, -1e4]]])
    real = torch.tensor([-3.0, -1.0, -2.0, -4.0, 0.0, -2.0])
    assert float(_prior_unit(q, 3)) == pytest.approx(float(real.std(correction=0)))


def test_the_chains_opinion_weighs_less_among_more_devices_than_it_learned_with() -> None:
    q = torch.randn(4, 2, 44, generator=generator(5))
    whole = _prior_unit(q, 44)
    torch.testing.assert_close(_prior_unit(q, 11), 0.25 * whole)
    torch.testing.assert_close(_prior_unit(q, 90), whole)  # with fewer devices it counts as it did


@pytest.mark.parametrize("kind", KINDS)
def test_an_actor_that_chooses_alone_asks_no_critic_and_holds_its_place_when_idle(kind: Kind) -> None:
    seen = observation(kind, 200)
    plain, held = (diffusion_sac(kind, greedy_choice=False, null_candidate=null) for null in (False, True))
    for parameter in held.critic.parameters():
        parameter.data.fill_(float("nan"))
    for made in (plain, held):
        disturb(made.actor.average, 8)
    before, after = (made.act(seen, generator=generator(1)) for made in (plain, held))
    idle = before.choice == 0
    assert 0 < idle.sum() < 200
    assert torch.equal(after.choice, before.choice)
    assert (after.continuous[idle] == 0).all()
    assert (before.continuous[idle] != 0).any()
    assert torch.equal(after.continuous[~idle], before.continuous[~idle])


def test_the_average_acts_not_the_network_in_training() -> None:
    for name in ("bc", "diffusion_sac"):
        made, seen = agent(name, "mlp"), observation("mlp", 20)
        before = made.act(seen, generator=generator(1))
        disturb(made.actor.denoiser, 1)  # type: ignore[attr-defined]  # of both agents
        assert torch.equal(made.act(seen, generator=generator(1)).continuous, before.continuous)
        disturb(made.actor.average, 1)  # type: ignore[attr-defined]  # as above
        assert not torch.equal(made.act(seen, generator=generator(1)).continuous, before.continuous)


@pytest.mark.parametrize(("name", "which"), [(name, which) for name in PRESETS for which in PRESETS[name]])
def test_presets_make_agents_that_learn(name: str, which: str) -> None:
    config = preset(name, which)
    assert config.name == name
    small: dict[str, Any] = {"network": config.network.model_copy(update={"width": 8})}
    kind = config.network.kind
    made = make_agent(spaces(kind), config.model_copy(update=small))
    assert teach(made, kind, 0, 1, generator())


def test_the_papers_preset_is_the_papers() -> None:
    config = preset("diffusion_sac", "paper")
    assert config.name == "diffusion_sac"
    assert (config.network.kind, config.network.width, config.network.depth) == ("mlp", 256, 3)
    assert (config.batch_size, config.discount, config.diffusion.steps) == (64, 0.99, 50)
    assert (config.bc_weight, config.cql_weight, config.gradient) == (0.5, 0.0, "full_chain")
    assert (config.diffusion.schedule, config.diffusion.variance, config.diffusion.clip_x0) == ("linear", "beta", False)
    assert (config.reward.transform, config.reward.clip, config.candidates) == ("zscore", None, 1)
    assert (config.q_scale, config.huber, config.greedy_choice, config.displacement_weight) == (
        "none",
        None,
        False,
        1.0,
    )


@pytest.mark.parametrize(("name", "which"), [("sca", "default"), ("bc", "papers")])
def test_an_unknown_preset_is_refused(name: str, which: str) -> None:
    with pytest.raises(ConfigError, match="allowed: "):
        preset(name, which)


@pytest.mark.parametrize(
    "changes",
    [
        {"gradient": "last_k", "gradient_steps": 6},
        {"action_noise": 0.1, "final_action_noise": 0.2},
        {"final_action_noise": 0.0},
        {"guidance": "softmax"},
        {"bc_weight": 1.1},
        {"cql_weight": -0.1},
        {"choice_temperature": 0.0},
        {"surprise": 1},
    ],
)
def test_settings_that_contradict_each_other_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(changes)) if "gradient" not in changes else "gradient_steps"):
        agent("diffusion_sac", "devices", **changes)
