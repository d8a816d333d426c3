from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file

from uavrl.errors import CheckpointError
from uavrl.training import checkpoint as module
from uavrl.training.checkpoint import (
    MANIFEST,
    checkpoint_in,
    load_checkpoint,
    numpy_state,
    recover,
    save_checkpoint,
    set_numpy_state,
)

TENSORS = {
    "networks": {"a.weight": torch.arange(6.0).view(2, 3), "flag": torch.tensor([True, False])},
    "loop": {"generator": torch.Generator().manual_seed(3).get_state(), "step": torch.tensor(7)},
}


def save(path: Path, number: int) -> None:
    save_checkpoint(path, {"kind": "test", "step": number}, TENSORS | {"more": {"x": torch.full((3,), float(number))}})


def test_what_is_loaded_is_what_was_saved(tmp_path: Path) -> None:
    save(tmp_path / "deep" / "c", 1)
    found = load_checkpoint(tmp_path / "deep" / "c")
    assert found.document["kind"] == "test"
    assert set(found.document["versions"]) == {"uavrl", "python", "torch"}
    assert {name: set(entries) for name, entries in found.tensors.items()} == {
        "networks": {"a.weight", "flag"},
        "loop": {"generator", "step"},
        "more": {"x"},
    }
    for name, entries in TENSORS.items():
        for key, value in entries.items():
            assert found.tensors[name][key].dtype == value.dtype
            assert torch.equal(found.tensors[name][key], value)
    assert sorted(path.name for path in (tmp_path / "deep").iterdir()) == ["c"]  # nothing temporary stays


def test_tensors_that_share_memory_or_are_views_are_saved_whole(tmp_path: Path) -> None:
    whole = torch.arange(12.0).view(3, 4)
    save_checkpoint(tmp_path / "c", {}, {"t": {"whole": whole, "same": whole, "turned": whole.T, "row": whole[1]}})
    found = load_checkpoint(tmp_path / "c").tensors["t"]
    assert torch.equal(found["turned"], whole.T)
    assert torch.equal(found["same"], whole)
    assert torch.equal(found["row"], whole[1])


@pytest.mark.parametrize("file", [MANIFEST, "networks.safetensors", "more.safetensors"])
def test_a_file_cut_at_any_place_is_found_in_one_line(tmp_path: Path, file: str) -> None:
    save(tmp_path / "c", 1)
    path = tmp_path / "c" / file
    content = path.read_bytes()
    for length in sorted({0, 1, 7, 8, 9, *range(0, len(content), max(1, len(content) // 23)), len(content) - 1}):
        path.write_bytes(content[:length])
        with pytest.raises(CheckpointError, match=file) as error:
            load_checkpoint(tmp_path / "c")
        assert "\n" not in str(error.value)
    path.unlink()
    with pytest.raises(CheckpointError, match=file):
        load_checkpoint(tmp_path / "c")
    path.write_bytes(content)
    load_checkpoint(tmp_path / "c")


def test_an_altered_byte_is_found(tmp_path: Path) -> None:
    save(tmp_path / "c", 1)
    path = tmp_path / "c" / "networks.safetensors"
    content = bytearray(path.read_bytes())
    content[-2] ^= 1
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(tmp_path / "c")


@pytest.mark.parametrize("text", ["", "[]", "null", "{}", '{"files": 3}', '{"files": {}', "\ud83d"])
def test_a_manifest_of_something_else_is_found(tmp_path: Path, text: str) -> None:
    save(tmp_path / "c", 1)
    (tmp_path / "c" / MANIFEST).write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(CheckpointError, match=MANIFEST):
        load_checkpoint(tmp_path / "c")


def test_a_place_without_a_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"'.*nowhere' does not exist"):
        load_checkpoint(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match=f"it has no {MANIFEST}"):
        load_checkpoint(tmp_path)
    assert recover(tmp_path / "nowhere") is None


class Killed(BaseException):
    """The process is gone at this point."""


def kill(patch: pytest.MonkeyPatch, operation: int, share: float) -> None:
    """Let the writer be killed within its file operation of this number, when `share` of it is done."""
    left = operation

    def instead(original: Callable[..., Any], part: Callable[..., None]) -> Callable[..., Any]:
        def run(*arguments: Any, **options: Any) -> Any:
            nonlocal left
            left -= 1
            if left:
                return original(*arguments, **options)
            part(original, *arguments, **options)
            raise Killed

        return run

    def whole_or_not(original: Callable[..., Any], *arguments: Any, **options: Any) -> None:
        if share >= 0.5:
            original(*arguments, **options)

    def cut(original: Callable[..., Any], *arguments: Any, **options: Any) -> None:
        original(*arguments, **options)
        path = arguments[0] if original is write_text else arguments[1]
        os.truncate(path, int(share * path.stat().st_size))

    def some(original: Callable[..., Any], path: Path, **options: Any) -> None:
        files = sorted(path.iterdir()) if path.exists() else []
        for file in files[: round(share * len(files))]:
            file.unlink()

    write_text = Path.write_text
    patch.setattr(shutil, "rmtree", instead(shutil.rmtree, some))
    patch.setattr(module, "save_file", instead(save_file, cut))
    patch.setattr(module, "sync", instead(lambda path: None, whole_or_not))
    patch.setattr(Path, "write_text", instead(write_text, cut))
    patch.setattr(Path, "mkdir", instead(Path.mkdir, whole_or_not))
    patch.setattr(Path, "rename", instead(Path.rename, whole_or_not))


OPERATIONS = 16  # of a save that replaces: the two last deletions included


def writers_come_and_die(folder: Path, plan: list[tuple[int, float, bool]]) -> None:
    """Writers one after the other, each killed in an operation; between them a reader, and here and there `recover`."""
    place, newest = folder / "c", 0
    for number, (operation, share, recovers) in enumerate(plan, start=1):
        killed = False
        with pytest.MonkeyPatch.context() as patch:
            kill(patch, operation, share)  # without the disk's own waiting
            patch.setattr(os, "getpid", lambda number=number: 9000 - number)  # each a process of its own
            try:
                save(place, number)
            except Killed:
                killed = True
        if recovers:
            assert (recover(place) is None) == (not place.exists())
        try:
            found = load_checkpoint(place).document["step"]
        except CheckpointError as error:
            assert "does not exist" in str(error)  # never a damaged one
            found = 0
        assert found in (newest, number) if killed else found == number
        newest = found
    with pytest.MonkeyPatch.context() as patch:
        kill(patch, 100, 0.0)
        save(place, 1000)
    assert load_checkpoint(place).document["step"] == 1000
    assert [path.name for path in folder.iterdir()] == ["c"]  # nothing that they left stays


@pytest.mark.parametrize("share", [0.0, 0.6])
@pytest.mark.parametrize("second", range(1, OPERATIONS + 2))
def test_two_writers_killed_anywhere_leave_a_whole_checkpoint(tmp_path: Path, second: int, share: float) -> None:
    """What is found is the newest whole one: what was being written when it was in place, else the one before it."""
    for first in range(1, OPERATIONS + 2):
        folder = tmp_path / str(first)
        folder.mkdir()
        writers_come_and_die(folder, [(100, 0.0, False), (first, share, False), (second, 0.5, False)])


PLANS = st.lists(st.tuples(st.integers(1, OPERATIONS + 2), st.floats(0, 1), st.booleans()), min_size=1, max_size=5)


@given(plan=PLANS)
@settings(max_examples=40)
def test_writers_killed_at_any_byte_leave_a_whole_checkpoint(
    tmp_path_factory: pytest.TempPathFactory, plan: list[tuple[int, float, bool]]
) -> None:
    writers_come_and_die(tmp_path_factory.mktemp("plan"), plan)


def test_a_save_that_replaces_has_as_many_operations_as_are_tried(tmp_path: Path) -> None:
    save(tmp_path / "c", 1)
    for operation in (OPERATIONS, OPERATIONS + 1):
        with pytest.MonkeyPatch.context() as patch:
            kill(patch, operation, 0.0)
            if operation == OPERATIONS:
                with pytest.raises(Killed):
                    save(tmp_path / "c", 2)
            else:
                save(tmp_path / "c", 2)


SAVE_UNTIL_KILLED = """
import os, signal, sys, time
from pathlib import Path
import torch
from uavrl.training.checkpoint import load_checkpoint, recover, save_checkpoint
place, number = Path(sys.argv[1]), 0
for round in range(12):
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        while True:
            number += 1
            save_checkpoint(place, {"step": number}, {"t": {"x": torch.full((200_000,), float(number))}})
            os.write(writer, b"%d " % number)
    os.close(writer)
    seen = os.read(reader, 1 << 16)
    time.sleep(0.004 * round)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    seen += os.read(reader, 1 << 16)
    os.close(reader)
    written = int(seen.split()[-1])
    if round % 2:
        recover(place)
    found = load_checkpoint(place)
    assert found.document["step"] >= written, (found.document["step"], written)
    assert (found.tensors["t"]["x"] == found.document["step"]).all()
    number = found.document["step"]
print("rounds", round + 1, "step", number)
"""


def test_a_process_that_is_killed_while_writing_leaves_a_whole_checkpoint(tmp_path: Path) -> None:
    command = [sys.executable, "-c", SAVE_UNTIL_KILLED, str(tmp_path / "c")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("rounds 12")


def test_a_checkpoint_that_was_being_replaced_is_read_and_put_back(tmp_path: Path) -> None:
    save(tmp_path / "run" / "checkpoint", 1)
    (tmp_path / "run" / "checkpoint").rename(tmp_path / "run" / ".checkpoint.old")
    place = checkpoint_in(tmp_path / "run")
    assert place == tmp_path / "run" / "checkpoint"
    assert load_checkpoint(place).document["step"] == 1
    assert not place.exists()  # a reader beside a writer moves nothing
    assert recover(place) == place
    assert load_checkpoint(place).document["step"] == 1
    assert checkpoint_in(place) == place


def test_a_numpy_generator_goes_on_from_json() -> None:
    first, second = np.random.default_rng(1), np.random.default_rng(2)
    first.random(5)
    first.integers(0, 7)  # leaves half of a 64-bit draw behind, which is part of the state
    set_numpy_state(second, json.loads(json.dumps(numpy_state(first))))
    assert first.integers(0, 7) == second.integers(0, 7)
    assert (first.random(5) == second.random(5)).all()
