"""Minari datasets: whole episodes, with the layout and the reward's terms in their infos."""

from __future__ import annotations

import shutil
import tomllib
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from uavrl.datasets.transitions import Transitions
from uavrl.datasets.validation import validate
from uavrl.errors import DatasetError
from uavrl.scenario import PRESETS, Scenario, parse_scenario, scenario_diff
from uavrl.simulation.environment import action_space, observation_space
from uavrl.simulation.observations import ObservationKind

_SCENARIO = "uavrl_scenario"  # TOML, in the dataset's metadata; written last, so that half a dataset has none

# of infos, T + 1 a flight: the state at the start and after each step ...
_STATES = ("position_m", "age_s", "energy_j", "used_j")
# ... and what each step did, 0 at the start
_STEPS = {
    "executed_displacement_m": "displacement_m",
    "age_term": "age_term",
    "energy_term": "energy_term",
    "duration_s": "duration_s",
}


def free_minari_folder(dataset_id: str) -> Path:
    """Where a dataset of this id is to be written; asked before an hour's flights, too.

    Raises:
        DatasetError: an invalid id, or a dataset of that id exists.
    """
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.storage.datasets_root_dir import get_dataset_path

    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError):  # TypeError: an id without a version
        raise DatasetError(f"dataset id '{dataset_id}', allowed: 'name-v0' or 'namespace/name-v0'") from None
    folder = Path(get_dataset_path(dataset_id))
    if folder.exists():
        raise DatasetError(f"dataset id '{dataset_id}' exists in {folder.parent}, choose another name or version")
    return folder


def write_minari(
    dataset_id: str,
    transitions: Transitions,
    scenario: Scenario,
    observation_kind: ObservationKind = "devices",
    *,
    algorithm: str = "unknown",
    description: str = "Flights of a UAV that collects data from devices, logged by uavrl.",
) -> None:
    """Write whole episodes as a Minari dataset, in `MINARI_DATASETS_PATH` or Minari's own folder.

    Minari's observation after a step is the one before the next, so steps must follow each other; the last episode may
    be unfinished. Infos carry names of the environment's and what rebuilds every column.

    Args:
        dataset_id: "namespace/name-v0".
        transitions: sorted by (episode, step), without gaps inside an episode.
        scenario: what they were flown in.
        observation_kind: observations to write.
        algorithm: what flew.
        description: a sentence for readers.

    Raises:
        DatasetError: invalid transitions or id, a gap, or a dataset of that id exists.
    """
    import minari
    from minari.data_collector import EpisodeBuffer

    validate(transitions, scenario, dataset_id)
    t = transitions
    starts = np.flatnonzero(np.diff(t.episode, prepend=t.episode[0] - 1))
    gap = np.flatnonzero((np.diff(t.episode) == 0) & (np.diff(t.step) != 1))
    if len(gap):
        row = int(gap[0]) + 1
        raise DatasetError(
            f"{dataset_id}: row {row}, column 'step' = {t.step[row]}, allowed: {t.step[row - 1] + 1}: Minari keeps "
            "whole episodes, write a selection to a .parquet file"
        )
    folder = free_minari_folder(dataset_id)
    before, after = transitions.observations(observation_kind, scenario)
    episodes = [
        _episode(t, slice(start, stop), before, after)
        for start, stop in zip(starts, [*starts[1:], len(t)], strict=True)
    ]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # Minari asks for an author, e-mail and permalink
            dataset = minari.create_dataset_from_buffers(
                dataset_id,
                [EpisodeBuffer(**episode) for episode in episodes],
                env=_environment(t, scenario, observation_kind),
                observation_space=observation_space(observation_kind, scenario),
                action_space=action_space(scenario),
                algorithm_name=algorithm,
                description=description,
                data_format="hdf5",
            )
        dataset.storage.update_metadata({_SCENARIO: scenario.to_toml()})
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise DatasetError(f"dataset '{dataset_id}' cannot be written to {folder}: {error}") from None


def _environment(t: Transitions, scenario: Scenario, kind: ObservationKind) -> EnvSpec:
    """The environment that was flown, in JSON's types: a preset and what differs from it."""
    preset = scenario.name if scenario.name in PRESETS else "released"
    changed = {key.split(".")[1]: new for key, (_, new) in scenario_diff(PRESETS[preset], scenario).items()}
    kwargs: dict[str, Any] = {"scenario": preset, "observation": kind, "name": scenario.name, **changed}
    if (t.layout_m == t.layout_m[0]).all():
        kwargs["layout"] = t.layout_m[0].tolist()
    entry = "uavrl.simulation.environment:DataCollectionEnv"
    return EnvSpec(id="uavrl/DataCollection-v0", entry_point=entry, kwargs=kwargs)


def _episode(t: Transitions, rows: slice, before: Any, after: Any) -> dict[str, Any]:
    def with_last(first: NDArray[Any], then: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([first[rows], then[rows][-1:]])

    def from_start(values: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([np.zeros_like(values[rows][:1]), values[rows]])

    columns = t.columns()
    infos = {name: with_last(columns[name], columns[f"next_{name}"]) for name in _STATES}
    infos |= {info: from_start(columns[name]) for name, info in _STEPS.items()}
    infos["layout_m"] = with_last(t.layout_m, t.layout_m)
    infos["episode"] = with_last(t.episode, t.episode)
    infos["step"] = with_last(t.step, t.step + 1)
    if isinstance(before, dict):
        observations: Any = {key: with_last(before[key], after[key]) for key in before}
    else:
        observations = with_last(before, after)
    return {
        "observations": observations,
        "actions": {"displacement_m": t.displacement_m[rows], "device": t.device[rows]},
        "rewards": t.reward[rows],
        "terminations": t.terminated[rows],
        "truncations": t.truncated[rows],
        "infos": infos,
    }


def read_minari(dataset_id: str) -> tuple[Transitions, Scenario]:
    """Read what `write_minari` wrote: all transitions and their scenario.

    Raises:
        DatasetError: no such dataset, or one that is damaged, unfinished or not of uavrl.
    """
    import minari

    try:
        dataset = minari.load_dataset(dataset_id)
        text = dataset.storage.metadata.get(_SCENARIO)
        if text is None:
            raise DatasetError(f"dataset '{dataset_id}' carries no uavrl scenario: of other origin, or not finished")
        scenario = parse_scenario(tomllib.loads(text))
        parts = [_columns(episode) for episode in dataset.iterate_episodes()]
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    except FileNotFoundError:
        raise DatasetError(
            f"data '{dataset_id}' is no built-in data, no .parquet, .npz or .mapped, and no Minari dataset here"
        ) from None
    except (OSError, KeyError, ValueError, TypeError, IndexError) as error:
        reason = " ".join(str(error).split())
        raise DatasetError(f"dataset '{dataset_id}' cannot be read, damaged or of other origin: {reason}") from None
    transitions = Transitions(**columns)
    validate(transitions, scenario, dataset_id)
    return transitions, scenario


def _columns(episode: Any) -> dict[str, NDArray[Any]]:
    infos, actions = episode.infos, episode.actions
    columns = {name: infos[name][:-1] for name in (*_STATES, "layout_m", "episode", "step")}
    columns |= {f"next_{name}": infos[name][1:] for name in _STATES}
    columns |= {name: infos[info][1:] for name, info in _STEPS.items()}
    return columns | {
        "displacement_m": actions["displacement_m"],
        "device": actions["device"],
        "reward": episode.rewards,
        "terminated": episode.terminations,
        "truncated": episode.truncations,
    }
