"""An exported policy on board. It needs numpy and onnxruntime alone; this one file also works copied beside the model.

    policy = Policy("policy.onnx")
    displacement_m, device = policy.decide({"uav": uav, "devices": devices})

What a decision is given is checked first: shape, finiteness, and units, as far as a range tells them. A reading that is
missing is told by its token's `valid` = 0; see docs/deployment.md.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike, NDArray

FORMAT = 1  # of the metadata
KEY = "uavrl"  # what the metadata are filed under in the model

Float32 = NDArray[np.float32]


class PolicyError(ValueError):
    """A file that is no exported policy, or an observation that it cannot be asked about; one line."""


class Decision(NamedTuple):
    """What to do next: of one aircraft, or of B.

    displacement_m: (2,) or (B, 2) float32, metres along x and y; longer than `reach_m` is to be shortened to it.
    device: whom to serve after the move, 0 nobody, k device k, counted from 1: an int, or (B,) int64.
    """

    displacement_m: Float32
    device: Any


class _Input:
    """Bounds of an input's last axis, and what its entries are called."""

    def __init__(self, name: str, facts: Mapping[str, Any]) -> None:
        self.name, self.entries = name, facts["entries"]
        self.shape = tuple(facts["shape"])  # of one aircraft; None: any number
        self.low, self.high, self.cap = (np.array(facts[bound]) for bound in ("low", "high", "cap"))
        self._fitting: set[tuple[int, ...]] = set()  # shapes of one aircraft met before

    def told(self, batch: bool) -> str:
        sizes = ["K" if size is None else str(size) for size in self.shape]
        return f"({', '.join(['B'] * batch + sizes)}{',' * (len(sizes) == 1 and not batch)})"

    def array(self, value: ArrayLike) -> NDArray[np.float64]:
        """`value` (...) as numbers of the right shape, for one aircraft or for B."""
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise PolicyError(f"{self.name} holds something that is no number, needed: {self.told(False)}") from None
        if array.shape in self._fitting:
            return array
        own = array.shape[max(0, array.ndim - len(self.shape)) :]
        fits = array.ndim in (len(self.shape), len(self.shape) + 1) and all(
            wanted in (None, size) for wanted, size in zip(self.shape, own, strict=True)
        )
        if not fits or 0 in array.shape:
            raise PolicyError(
                f"{self.name} has shape {array.shape}, needed: {self.told(False)}, or {self.told(True)} for B aircraft"
            )
        if array.ndim == len(self.shape):  # of one aircraft, and few such shapes are met
            self._fitting.add(array.shape)
        return array

    def checked(self, array: NDArray[np.float64]) -> Float32:
        """`array` within its bounds, as the model takes it; what lies above a cap counts as the cap."""
        if not ((array >= self.low) & (array <= self.high)).all():
            self._refuse(array)
        result = np.empty(array.shape, dtype=np.float32)
        np.minimum(array, self.cap, out=result, casting="same_kind")
        return result

    def _refuse(self, array: NDArray[np.float64]) -> None:
        place = tuple(np.argwhere(~((array >= self.low) & (array <= self.high)))[0])
        low, high = self.low[place[-1]], self.high[place[-1]]
        where = ", ".join(str(index) for index in place)
        raise PolicyError(
            f"{self.name}[{where}], {self.entries[place[-1]]} = {array[place]:g}, allowed: {low:g} to {high:g}"
        )


class _Single:
    """The usual case, one aircraft with a reading of every device: checked at once, in arrays that stay where they are.

    Handing arrays over and checking them one by one takes as long as a small network does.
    """

    def __init__(self, session: onnxruntime.InferenceSession, inputs: Sequence[_Input], shapes: Sequence[Any]) -> None:
        def flat(bound: str) -> NDArray[np.float64]:
            each = [np.broadcast_to(getattr(one, bound), shape) for one, shape in zip(inputs, shapes, strict=True)]
            return np.concatenate([array.ravel() for array in each])

        self._low, self._high, self._cap = flat("low"), flat("high"), flat("cap")
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1]
        for one, low in zip(inputs, np.split(self._low, ends), strict=True):
            if one.entries[-1] == "valid":
                low[len(one.entries) - 1 :: len(one.entries)] = 1.0  # a reading that is missing is not for here
        self._given, self._taken = np.empty(len(self._low)), np.empty(len(self._low), dtype=np.float32)
        self._parts = [part.reshape(shape) for part, shape in zip(np.split(self._given, ends), shapes, strict=True)]
        self._displacement_m, self._device = np.empty((1, 2), dtype=np.float32), np.empty(1, dtype=np.int64)
        self._session, self._binding, self._lock = session, session.io_binding(), Lock()
        for one, part, shape in zip(inputs, np.split(self._taken, ends), shapes, strict=True):
            self._binding.bind_ortvalue_input(one.name, _shared(part.reshape(1, *shape)))
        self._binding.bind_ortvalue_output("displacement_m", _shared(self._displacement_m))
        self._binding.bind_ortvalue_output("device", _shared(self._device))

    def decide(self, arrays: Sequence[NDArray[np.float64]]) -> Decision | None:
        """None where something is out of its bounds, or a device has no reading."""
        with self._lock:
            for part, array in zip(self._parts, arrays, strict=True):
                part[...] = array
            if not ((self._given >= self._low) & (self._given <= self._high)).all():
                return None
            np.minimum(self._given, self._cap, out=self._taken, casting="same_kind")
            self._session.run_with_iobinding(self._binding)
            return Decision(self._displacement_m[0].copy(), int(self._device[0]))


def _shared(array: NDArray[Any]) -> onnxruntime.OrtValue:
    return onnxruntime.OrtValue.ortvalue_from_numpy(array)  # on the CPU it has the array's own memory


class Policy:
    """A policy written by `uavrl export`.

    Args:
        path: the file.
        threads: of a decision; one is fastest for one aircraft.
        seed: of the noise of a file that was exported with --sampled; others take none.

    Attributes:
        info: metadata: agent, scenario, devices, seed, version, and more.
        reach_m: longest displacement of a step (m).
        sampled: whether a decision takes noise.

    Raises:
        PolicyError: the file is missing or damaged, or `uavrl export` has not written it.
    """

    def __init__(self, path: str | Path, *, threads: int = 1, seed: int = 0) -> None:
        if not Path(path).is_file():
            raise PolicyError(f"policy file '{path}' does not exist")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        options.log_severity_level = 3  # errors
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
            found = self._session.get_modelmeta().custom_metadata_map
        except Exception as error:  # onnxruntime's errors share no class
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise PolicyError(f"policy file '{path}' cannot be read: {reason}") from None
        if KEY not in found:
            raise PolicyError(f"policy file '{path}' has no metadata '{KEY}', needed: a file written by `uavrl export`")
        self.info: dict[str, Any] = json.loads(found[KEY])
        if self.info["format"] != FORMAT:
            raise PolicyError(f"policy file '{path}' is of format {self.info['format']}, allowed here: {FORMAT}")
        self.reach_m = float(self.info["reach_m"])
        self.sampled = bool(self.info["sampled"])
        self._inputs = {name: _Input(name, facts) for name, facts in self.info["inputs"].items()}
        self._outputs = ["displacement_m", "device"]
        self._singles: dict[tuple[int, ...], _Single] = {}  # by the shape of the last input
        self._generator = np.random.default_rng(seed)

    def __repr__(self) -> str:
        """What it is and where it learned."""
        kind = "any K" if self._any_number else f"K = {self.info['devices']}"
        return f"Policy({self.info['agent']!r}, scenario={self.info['scenario']['name']!r}, {kind})"

    @property
    def _any_number(self) -> bool:
        return "devices" in self._inputs

    def decide(self, observation: Mapping[str, ArrayLike] | ArrayLike, noise: ArrayLike | None = None) -> Decision:
        """The action for one observation, or for B at once.

        Args:
            observation: of a network over the set of devices, {"uav": (4,), "devices": (K, 6)} for any K; of a
                perceptron (K + 3,), K being what it was trained with. Or each with B in front. Entries, with their
                units in their names, and bounds are in `info["inputs"]`. A token whose `valid` is 0 may hold anything:
                it has no say and is never chosen. Where no token is valid, the answer is to hover and serve nobody.
            noise: (B, R, E) standard normal, as `draw_noise` gives it, for a file exported with --sampled; without,
                the policy draws its own.

        Raises:
            PolicyError: a wrong shape, a number that is not finite or out of its bounds, or noise that is not wanted.
        """
        arrays = self._arrays(observation)
        single = arrays[0].ndim == 1
        if single and not self.sampled and noise is None:
            decided = self._single(arrays).decide(arrays)
            if decided is not None:
                return decided
        lost = None
        if self._any_number:
            arrays[1], lost = _without_lost(arrays[1])
        feeds = {one.name: one.checked(array) for one, array in zip(self._inputs.values(), arrays, strict=True)}
        if single:
            feeds = {name: value[None] for name, value in feeds.items()}
        if self.sampled or noise is not None:
            feeds["noise"] = self._noise(noise, feeds)
        displacement_m, device = self._session.run(self._outputs, feeds)
        if lost is not None:
            displacement_m[lost], device[lost] = 0.0, 0
        return Decision(displacement_m[0], int(device[0])) if single else Decision(displacement_m, device)

    def _arrays(self, observation: Any) -> list[NDArray[np.float64]]:
        """Of each input in turn, for one aircraft or for B."""
        if not self._any_number:
            return [self._inputs["observation"].array(observation)]
        if not isinstance(observation, Mapping) or observation.keys() != self._inputs.keys():
            needed = ", ".join(f"'{name}' {one.told(False)}" for name, one in self._inputs.items())
            given = sorted(observation) if isinstance(observation, Mapping) else type(observation).__name__
            raise PolicyError(f"observation is {given}, needed: a mapping of {needed}")
        uav, devices = (one.array(observation[name]) for name, one in self._inputs.items())
        if uav.shape[:-1] != devices.shape[:-2]:
            raise PolicyError(f"uav has shape {uav.shape} and devices {devices.shape}, needed: the same B in front")
        return [uav, devices]

    def _single(self, arrays: Sequence[NDArray[np.float64]]) -> _Single:
        shape = arrays[-1].shape
        if shape not in self._singles:
            self._singles[shape] = _Single(self._session, [*self._inputs.values()], [array.shape for array in arrays])
        return self._singles[shape]

    def noise_shape(self, count: int, devices: int) -> tuple[int, int, int]:
        """(B, R, E) of the noise of B = `count` decisions between K = `devices` devices."""
        noise = self.info["noise"]
        return count, noise["rows"], noise["entries"] + noise["entries_per_device"] * devices

    def draw_noise(self, count: int, devices: int, generator: np.random.Generator | None = None) -> Float32:
        """Standard normal noise of B = `count` decisions, from `generator` or the policy's own."""
        own = self._generator if generator is None else generator
        return own.standard_normal(self.noise_shape(count, devices), dtype=np.float32)

    def _noise(self, noise: ArrayLike | None, feeds: Mapping[str, Float32]) -> Float32:
        if not self.sampled:
            raise PolicyError("noise is given, needed: none, for the file was exported without --sampled")
        count = len(next(iter(feeds.values())))
        devices = feeds["devices"].shape[1] if self._any_number else self.info["devices"]
        if noise is None:
            return self.draw_noise(count, devices)
        array, shape = np.asarray(noise, dtype=np.float32), self.noise_shape(count, devices)
        if array.shape != shape or not np.isfinite(array).all():
            raise PolicyError(f"noise has shape {array.shape}, needed: {shape}, finite")
        return array


def _without_lost(devices: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_] | None]:
    """Tokens (K, 6) or (B, K, 6), nothing in those without a reading, and the rows without any (None: no such row)."""
    heard, lost = devices[..., -1] == 1.0, devices[..., -1] == 0.0
    if heard.all():
        return devices, None
    if not (heard | lost).all():
        place = tuple(np.argwhere(~(heard | lost))[0])
        where = ", ".join(str(index) for index in (*place, devices.shape[-1] - 1))
        raise PolicyError(f"devices[{where}], valid = {devices[..., -1][place]:g}, allowed: 0 or 1")
    devices = np.where(lost[..., None], 0.0, devices)
    # an average over no device has no value: let one in, and overrule the answer
    alone = lost.all(axis=-1, keepdims=True)
    devices[..., :1, -1] += alone
    return devices, alone.reshape(-1)
